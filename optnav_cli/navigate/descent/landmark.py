"""Landmarks of a picture: where to choose them, and where a later picture shows them.

Source: Zhukov 2025, ch. 3 (determinant of the Hessian, scale-normalised). A landmark is a patch of
picture brightness on a small plane of the ground, so that the next picture, from lower and from
another side, is compared in the same map; its Sun is the same.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.correlation.filters import crop, filter_grid_quickly
from catalog.correlation.ncc import match_cut
from catalog.geometry.projection import make_node_grid
from catalog.geometry.vectors import unit
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.picture_pyramid import PicturePyramid
from optnav_cli.estimation.models.points import Pose
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

PATCH_NODES, MARGIN_NODES = 24, 8
NODE_PX = 1.25  # pixels of the picture that a node of a new patch spans
SCALE_PX = 3.0  # of the Hessian
MIN_SCORE, RIVAL_RATIO = 0.6, 0.9
MAX_SEARCH_NODES = 14


@dataclass(frozen=True, eq=False)
class LandmarkPatch:
    """Picture brightness around a ground point.

    brightness  (n, n) on a plane through the point, row 0 north, with MARGIN_NODES about it
    posting_m   between nodes;  axes (2, 3) unit vectors of the columns and of the rows upward
    sight       (3,) unit vector to the camera, body frame;  gsd_m what a pixel saw of the ground
    """

    brightness: Float32Array
    posting_m: float
    axes: FloatArray
    sight: FloatArray
    gsd_m: float

    def is_stale(self, place_m: FloatArray, camera: Camera, pose: Pose) -> bool:
        """Whether a picture from a pose shows the point better, or from another side."""
        offset = pose.position_m - place_m
        gsd = float(np.linalg.norm(offset)) / camera.coarse_focal_px
        turned = np.arccos(np.clip(unit(offset) @ self.sight, -1.0, 1.0))
        # A patch is cut again when a pixel sees 1.5 times less ground, or from 10 deg aside.
        return bool(gsd * 1.5 < self.gsd_m or turned > np.radians(10.0))


@dataclass(frozen=True, eq=False)
class LandmarkMatch:
    """Where a landmark was found, or why not; pixel (2,) with its covariance (2, 2)."""

    reason: Reason
    pixel: FloatArray | None = None
    covariance_px2: FloatArray | None = None
    score: float | None = None
    runner_up: float | None = None


def compute_hessian_determinant(picture: Float32Array, sigma_px: float = SCALE_PX) -> Float32Array:
    """Compute sigma^4 (I_xx I_yy - I_xy^2) of a picture (height, width) blurred by sigma_px."""
    soft = cv2.GaussianBlur(np.nan_to_num(picture), (0, 0), sigma_px)
    step = np.array([1.0, -2.0, 1.0], np.float32)
    slope = np.array([-0.5, 0.0, 0.5], np.float32)
    identity = np.ones(1, np.float32)
    xx, yy, xy = (
        cv2.sepFilter2D(soft, cv2.CV_32F, a, b)
        for a, b in ((step, identity), (identity, step), (slope, slope))
    )
    determinant: Float32Array = np.float32(sigma_px**4) * (xx * yy - xy * xy)
    return determinant


def choose_pixels(picture: Float32Array, free: BoolArray, border_px: int) -> FloatArray:
    """Choose the best pixel (n, 2), x and y, of each square of a picture that is free."""
    response = np.abs(compute_hessian_determinant(picture))
    gaps = np.isnan(picture)
    if gaps.any():  # pixels without a value make edges of their own
        side = 2 * int(np.ceil(3.0 * SCALE_PX)) + 1
        wide = np.ones((side, side), np.uint8)
        response[cv2.dilate(gaps.view(np.uint8), wide) > 0] = 0.0
    height, width = picture.shape
    rows, cols = free.shape
    # less than a hundredth of what the picture's best squares have is noise
    least = 0.01 * float(np.quantile(response, 0.99))
    chosen = []
    for row, col in np.argwhere(free):
        top, bottom = (
            max(border_px, min(height - border_px, height * k // rows)) for k in (row, row + 1)
        )
        left, right = (
            max(border_px, min(width - border_px, width * k // cols)) for k in (col, col + 1)
        )
        square = response[top:bottom, left:right]
        if square.size == 0 or float(square.max()) <= least:
            continue
        y, x = np.unravel_index(int(np.argmax(square)), square.shape)
        chosen.append((left + x, top + y))
    return np.array(chosen, dtype=np.float64).reshape(-1, 2)


def cut_patch(
    picture: PicturePyramid, camera: Camera, pose: Pose, place_m: FloatArray, normal: FloatArray
) -> LandmarkPatch | None:
    """Cut the patch about a point (3,) on a plane with a normal (3,); None if the frame cuts it."""
    offset = pose.position_m - place_m
    gsd = float(np.linalg.norm(offset)) / camera.coarse_focal_px
    east = unit(np.cross([0.0, 0.0, 1.0], normal))
    axes = np.stack([east, np.cross(normal, east)])
    posting = NODE_PX * gsd
    size = PATCH_NODES + 2 * MARGIN_NODES
    pixels = _project_nodes(camera, pose, place_m, axes, posting, size)
    brightness = picture.sample(pixels, posting / gsd)
    if not np.isfinite(brightness).all():
        return None
    return LandmarkPatch(brightness, posting, axes, unit(offset), gsd)


def match_patch(
    patch: LandmarkPatch,
    picture: PicturePyramid,
    camera: Camera,
    pose: Pose,
    place_m: FloatArray,
    sigma_px: float,
) -> LandmarkMatch:
    """Search a patch about where a pose puts its place (3,), to 3.5 sigma_px."""
    gsd = float(np.linalg.norm(pose.position_m - place_m)) / camera.coarse_focal_px
    nodes = int(np.ceil(3.5 * sigma_px * gsd / patch.posting_m + 2.0))
    room = min(nodes, MAX_SEARCH_NODES)
    size = PATCH_NODES + 2 * (MARGIN_NODES + room)
    pixels = _project_nodes(camera, pose, place_m, patch.axes, patch.posting_m, size)
    window = picture.sample(pixels, patch.posting_m / gsd)
    if not np.isfinite(window).all():
        return LandmarkMatch(Reason(ReasonCode.OUT_OF_VIEW, "outside the picture"))
    image = filter_grid_quickly(window, MARGIN_NODES)
    match = match_cut(patch.brightness, window, image, MARGIN_NODES, remainder=True)
    if not np.isfinite(match.covariance).all():
        reason = Reason(ReasonCode.SEARCH_BORDER, "peak at the border of the search")
        return LandmarkMatch(reason, score=match.score, runner_up=match.runner_up)
    # the plane is small: its middle nodes tell how pixels go with nodes
    middle = crop(pixels, (size - 4) // 2)
    by_col = (middle[1:3, 3] - middle[1:3, 0]).mean(axis=0) / 3.0
    by_row = (middle[3, 1:3] - middle[0, 1:3]).mean(axis=0) / 3.0
    jacobian = np.stack([by_col, by_row], axis=1)
    at = middle.reshape(-1, 2).mean(axis=0) + jacobian @ [match.dx, match.dy]
    reason = NO_REASON
    if match.score < MIN_SCORE:
        reason = Reason(ReasonCode.LOW_SCORE, f"score {match.score:.2f} below {MIN_SCORE:g}")
    elif match.runner_up > RIVAL_RATIO * match.score:
        text = f"rival {match.runner_up:.2f} near score {match.score:.2f}"
        reason = Reason(ReasonCode.RIVAL, text)
    covariance = jacobian @ match.covariance @ jacobian.T
    return LandmarkMatch(reason, at, covariance, match.score, match.runner_up)


def _project_nodes(
    camera: Camera, pose: Pose, place_m: FloatArray, axes: FloatArray, posting_m: float, size: int
) -> FloatArray:
    """Project the nodes of a plane about a point to pixels (size, size, 2); row 0 is its top."""
    x, y = make_node_grid(size, posting_m)
    nodes = place_m + x[..., None] * axes[0] + y[..., None] * axes[1]
    turn = pose.turn
    pixels: FloatArray = camera.project_from_body(nodes, pose.position_m, turn)
    return pixels
