"""A position from the silhouette of a shape of any form, also a concave one, without a prior.

Ours. A coarse position is where the drawn shape has the centre and the area of the lit one. Then
the shape is drawn again and again, each time nearer, and position and attitude follow its edges in
the picture. The attitude is held by its own sigma, or free within that of a free one.

The covariance is that of the residuals taken over sectors of the outline, for errors of the shape
are the same along it, and of what all edges share: their own width and the scale of the shape.
"""

from functools import lru_cache
from typing import NamedTuple

import cv2
import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, Float32Array, FloatArray, IntArray
from catalog.bodies.body import Body
from catalog.config import Positive, load_toml, resource
from catalog.errors import NoSolutionError
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.mesh.terrain import make_relief_mesh
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import Evidence, Fix, Method, OutlineMarks
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.segmentation import Levels, Segmented, remove_smear
from optnav_cli.outline.neighbour import CameraView
from optnav_cli.outline.silhouette.edges import (
    PIECE,
    PIECE_STEP,
    DrawnShape,
    LitShape,
    draw_shape,
    find_edges,
    match_light,
)
from optnav_cli.reasons import ReasonCode

MIN_ACROSS_PX = 40.0  # of the lit shape: a smaller one is solved by its light
SECTORS = 16
# Gates, from wrong attitudes, Suns, mirrored pictures and other bodies (see the study `comet`).
MIN_FOUND, MAX_SCATTER, MIN_CORRELATION, MIN_SECTORS = 0.6, 0.02, 0.9, 9
MIN_EDGES = 60
CUT_PX = 2
EXACT_RAD = 1e-7  # an attitude that is known better is taken to be known so well
MIN_SCATTER = 0.2  # px; no shape is known better
# By the light on the shape: steps of the grid that pieces are searched, how many are needed, blocks
# a side whose pieces err together.
BLOCKS = 5
FILE = "configs/models/silhouette.toml"


class SilhouetteErrors(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fitted errors; FILE explains each number."""

    absorbed: Positive
    edge_px: Positive
    edge_scale: Positive
    ground_scale: Positive


@lru_cache(maxsize=1)
def _load_errors() -> SilhouetteErrors:
    return load_toml(resource(FILE), SilhouetteErrors)


class _EdgeFit(NamedTuple):
    """Measurements of one round, one per row, and the pose change that follows.

    rows     (n, 6) of px by position, m, and rotation, rad, camera frame
    offsets  (n,) px from the drawn place;  weights (n,);  groups (n,) that err together
    normal   (6, 6), the attitude's own sigma in it;  change (6,)
    scatter  px, robust, of what is left
    """

    rows: FloatArray
    offsets: FloatArray
    weights: FloatArray
    groups: IntArray
    normal: FloatArray
    change: FloatArray
    scatter: float


class _Step(NamedTuple):
    """A round of edges: what was drawn, and which of its edges were found."""

    drawn: DrawnShape
    used: BoolArray
    fit: _EdgeFit


@lru_cache(maxsize=2)
def _make_mesh(relief: GlobalRelief) -> MeshRays:
    return make_relief_mesh(relief)


def navigate(
    picture: Picture, view: CameraView, body: Body, relief: GlobalRelief, lit: Segmented
) -> Fix:
    """Solve the camera's pose from the edges of the body's shape.

    Raises NoSolutionError where the picture does not show the shape, or not as it should look.
    """
    clean = remove_smear(lit.picture, lit.levels)
    if clean is not None:
        lit = Segmented(clean)
    ground, levels = LitShape(_make_mesh(relief), body.photometry.surface), lit.levels
    mask = _find_lit_mask(lit)
    # the lit shape is whole: pixels without a value lie beside it
    values = np.nan_to_num(lit.picture, nan=levels.sky)
    position = _solve_by_moments(mask, ground, view)
    turn = view.camera_from_body
    smooth = np.asarray(cv2.GaussianBlur(values, (0, 0), 0.7), dtype=np.float32)
    turned = np.zeros(3)
    across = 2.0 * ground.reach_m / float(np.linalg.norm(position)) * view.camera.focal_length_px
    # Edges are searched to these shares of the shape on either side.
    for share in (0.12, 0.12, 0.08, 0.05, 0.03, 0.02, 0.02, 0.02):
        reach = max(share * across, 4.0)
        last = _fit_edges(smooth, ground, view, turn, position, levels, reach, turned)
        position, turn, turned = _move_pose(position, turn, turned, last.fit.change)
    _check(values, last, ground, view, turn, position, across)
    light = None
    # Grid steps that pieces of the light are searched to all sides.
    for steps in (8, 4, 3):
        light_fit = _fit_light(values, ground, view, turn, position, steps, turned)
        if light_fit is None:
            break
        light = light_fit
        position, turn, turned = _move_pose(position, turn, turned, light.change)
    return _make_fix(last, light or last.fit, turn, position, view)


def _move_pose(
    position: FloatArray, turn: Rotation, turned: FloatArray, change: FloatArray
) -> tuple[FloatArray, Rotation, FloatArray]:
    turn = Rotation.from_rotvec(change[3:]) * turn
    return position + change[:3], turn, turned + change[3:]


def _find_lit_mask(lit: Segmented) -> BoolArray:
    """Find the body's lit pixels. Raises NoSolutionError for a body that is small or cut."""
    blobs = lit.blobs
    if not len(blobs):
        raise NoSolutionError("nothing lit stands out of the sky", ReasonCode.NO_BODY)
    # Areas below 1 % of the largest are stars and dust.
    kept = blobs.label[blobs.area >= 0.01 * blobs.area[0]]
    mask: BoolArray = np.isin(blobs.labels, kept)
    if np.sqrt(mask.sum()) < MIN_ACROSS_PX:
        text = f"the lit shape is {np.sqrt(mask.sum()):.0f} px across; a silhouette wants more"
        raise NoSolutionError(text, ReasonCode.SMALL_DISC)
    inner = mask[CUT_PX:-CUT_PX, CUT_PX:-CUT_PX]
    if inner.sum() < mask.sum() or (lit.blobs.cut is not None and lit.blobs.cut[0]):
        text = "the frame, or pixels without a value, cut the lit shape: it is not whole"
        raise NoSolutionError(text, ReasonCode.CUT_DISC)
    return mask


def _solve_by_moments(mask: BoolArray, ground: LitShape, view: CameraView) -> FloatArray:
    """Find a coarse position (3,) whose drawn lit shape has the centre and area of the mask."""
    camera, turn = view.camera, view.camera_from_body
    rows, cols = np.nonzero(mask)
    centre, area = np.array([cols.mean(), rows.mean()]), float(mask.sum())
    towards = centre.copy()
    distance = 0.5 * ground.reach_m * camera.focal_length_px / np.sqrt(area / np.pi)
    for _ in range(8):
        position = _place_camera(camera, turn, towards, distance)
        # The drawing is 1.35 reaches of the shape to each side.
        half = 1.35 * ground.reach_m / distance * camera.focal_length_px
        box = float(towards[0]), float(towards[1]), half
        drawn = draw_shape(ground, camera, turn, position, view.sun_body, box, 72)
        bright = drawn.light > 0.0
        if not bright.any():
            raise NoSolutionError(
                "the shape shows no lit side under this Sun", ReasonCode.WRONG_LIGHT
            )
        towards = towards + centre - drawn.pixels[bright].mean(axis=0)
        distance *= float(np.clip(np.sqrt(bright.sum() * drawn.step**2 / area), 0.5, 2.0))
    return _place_camera(camera, turn, towards, distance)


def _place_camera(
    camera: Camera, turn: Rotation, towards: FloatArray, distance: float
) -> FloatArray:
    ray = camera.unproject(towards)
    if not np.isfinite(ray).all():
        raise NoSolutionError("the lens has no ray for the lit shape", ReasonCode.BAD_PICTURE)
    position: FloatArray = -distance * turn.apply(ray, inverse=True)
    return position


def _draw(ground: LitShape, view: CameraView, turn: Rotation, position: FloatArray) -> DrawnShape:
    """Draw the shape at a pose on a grid of one pixel, or coarser for a large shape."""
    camera, distance = view.camera, float(np.linalg.norm(position))
    x, y = camera.project(turn.apply(-position))
    if not np.isfinite([x, y]).all() or distance < 1.2 * ground.reach_m:
        raise NoSolutionError("the silhouette leads to no pose", ReasonCode.NOT_SETTLED)
    half = 1.05 * ground.reach_m / distance * camera.focal_length_px + 6.0
    nodes = int(min(384, np.ceil(2.0 * half)))
    return draw_shape(ground, camera, turn, position, view.sun_body, (x, y, half), nodes)


def _fit_edges(
    picture: Float32Array,
    ground: LitShape,
    view: CameraView,
    turn: Rotation,
    position: FloatArray,
    levels: Levels,
    reach: float,
    turned: FloatArray,
) -> _Step:
    """Fit edges once: draw them at a pose, find them in the picture, fit the pose to them."""
    drawn = _draw(ground, view, turn, position)
    offsets = find_edges(picture, drawn, reach, levels.sky, levels.threshold)
    used = np.isfinite(offsets)
    if used.sum() < MIN_EDGES:
        raise NoSolutionError(
            f"{int(used.sum())} edge points of the shape show in the picture; {MIN_EDGES} are "
            "needed",
            ReasonCode.NO_LIMB,
        )
    seen, by_point = _compute_derivatives(drawn.places, view, turn, position)
    across = np.einsum("ni,nij->nj", drawn.outward, by_point)
    rows = np.concatenate([-across @ turn.as_matrix(), np.cross(seen, across)], axis=1)
    # inner and outer edges of one direction are two places of the shape
    groups = 2 * _group_by_sector(drawn) + drawn.outer
    # An edge errs as one along 12 px.
    thinning = drawn.step / 12.0
    fit = _fit_pose(rows[used], offsets[used], groups[used], thinning, view, turned)
    return _Step(drawn, used, fit)


def _fit_light(
    values: Float32Array,
    ground: LitShape,
    view: CameraView,
    turn: Rotation,
    position: FloatArray,
    steps: int,
    turned: FloatArray,
) -> _EdgeFit | None:
    """Fit the light on the shape once; None where too little of it is matched."""
    drawn = _draw(ground, view, turn, position)
    places, moves = match_light(values, drawn, steps)
    if len(places) < 25:
        return None
    seen, by_point = _compute_derivatives(places, view, turn, position)
    turning = np.stack([np.cross(seen, by_point[:, k]) for k in range(2)], axis=1)
    rows = np.concatenate([-by_point @ turn.as_matrix(), turning], axis=2)
    pixels = view.camera.project(seen)
    span = np.ptp(drawn.pixels[..., 0]) / BLOCKS
    block = np.floor((pixels - drawn.pixels[0, 0]) / span).astype(np.int64)
    groups = np.repeat(block[:, 0] + BLOCKS * block[:, 1], 2)
    thinning = (PIECE_STEP / (2.0 * PIECE)) ** 2
    fit = _fit_pose(rows.reshape(-1, 6), moves.ravel(), groups, thinning, view, turned)
    return fit if fit.scatter < 1.5 else None


def _compute_derivatives(
    places: FloatArray, view: CameraView, turn: Rotation, position: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return points (n, 3) in the camera frame and derivatives (n, 2, 3) of their pixels."""
    seen = (places - position) @ turn.as_matrix().T
    return seen, view.camera.project_with_jacobian(seen)[1]


def _fit_pose(
    rows: FloatArray,
    offsets: FloatArray,
    groups: IntArray,
    thinning: float,
    view: CameraView,
    turned: FloatArray,
) -> _EdgeFit:
    """Fit the pose change to offsets; thinning: weight of a row for correlated neighbours."""
    prior = 1.0 / max(view.attitude_sigma_rad, EXACT_RAD) ** 2
    hold, change = np.diag([0.0, 0.0, 0.0, prior, prior, prior]), np.zeros(6)
    scatter = max(1.4826 * float(np.median(np.abs(offsets - np.median(offsets)))), MIN_SCATTER)
    weights, normal = np.ones(len(offsets)), hold
    for _ in range(8):
        residuals = np.abs(offsets - rows @ change) / scatter
        weights = np.where(residuals < 4.0, 1.0, 0.0) / np.maximum(residuals / 1.5, 1.0)
        weights *= thinning / (_load_errors().absorbed * scatter) ** 2
        normal = (rows * weights[:, None]).T @ rows + hold
        wanted = (rows * weights[:, None]).T @ offsets
        wanted[3:] -= prior * turned
        change = _invert(normal) @ wanted
        left = np.abs(offsets - rows @ change)
        scatter = max(1.4826 * float(np.median(left)), MIN_SCATTER)
    return _EdgeFit(rows, offsets, weights, groups, normal, change, scatter)


def _invert(normal: FloatArray) -> FloatArray:
    size = np.sqrt(np.diag(normal))
    if not (size > 0.0).all():
        raise NoSolutionError("the edges leave the pose open", ReasonCode.DEGENERATE)
    inverse: FloatArray = np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size)
    return inverse


def _check(
    values: Float32Array,
    last: _Step,
    ground: LitShape,
    view: CameraView,
    turn: Rotation,
    position: FloatArray,
    across: float,
) -> None:
    """Raise NoSolutionError unless the picture shows the shape as it should look."""
    kept = last.fit.weights > 0.0
    share = float(kept.sum() / len(last.used))
    sectors = np.unique(_group_by_sector(last.drawn)[last.used][kept]).size
    drawn = _draw(ground, view, turn, position)
    x, y = (np.ascontiguousarray(drawn.pixels[..., k], np.float32) for k in range(2))
    shown = cv2.remap(values, x, y, cv2.INTER_LINEAR)
    # roots: a few glints count no more than the ground
    pair = [
        np.sqrt(np.maximum(cv2.GaussianBlur(image, (0, 0), 1.0), 0.0)).ravel()
        for image in (drawn.light, shown - float(np.median(shown[drawn.light == 0.0])))
    ]
    correlation = float(np.corrcoef(pair[0], pair[1])[0, 1])
    if share < MIN_FOUND or last.fit.scatter > max(MAX_SCATTER * across, 2.0):
        raise NoSolutionError(
            f"the picture shows {share:.0%} of the edges of the shape, to "
            f"{last.fit.scatter:.1f} px: attitude, time, Sun or shape is wrong",
            ReasonCode.LIMB_MISFIT,
        )
    if sectors < MIN_SECTORS:
        text = f"edges in {sectors} of {SECTORS} directions; a position wants {MIN_SECTORS}"
        raise NoSolutionError(text, ReasonCode.SHORT_ARC)
    if not correlation > MIN_CORRELATION:
        raise NoSolutionError(
            f"the shape as it should look correlates {correlation:.2f} with the picture; wanted "
            f"{MIN_CORRELATION:g}: attitude, time, Sun or shape is wrong",
            ReasonCode.LIMB_MISFIT,
        )


def _group_by_sector(drawn: DrawnShape) -> IntArray:
    """Number the sector of the outline that each edge belongs to, by its direction."""
    angle = np.arctan2(drawn.outward[:, 1], drawn.outward[:, 0])
    return np.floor((angle / (2.0 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS


def _make_fix(
    last: _Step, fit: _EdgeFit, turn: Rotation, position: FloatArray, view: CameraView
) -> Fix:
    """Make the fix with its covariance; fit: the last round, by edges or light."""
    inverse = _invert(fit.normal)
    misfits = fit.offsets - fit.rows @ fit.change
    pulls = fit.rows * (fit.weights * misfits)[:, None]
    names, number = np.unique(fit.groups, return_inverse=True)
    sums = np.zeros((len(names), 6))
    np.add.at(sums, number, pulls)
    spread = (
        sums.T @ sums * (_load_errors().absorbed ** 2 * len(names) / max(len(names) - 6.0, 1.0))
    )
    prior = 1.0 / max(view.attitude_sigma_rad, EXACT_RAD) ** 2
    spread[3:, 3:] += prior * np.eye(3)
    covariance = inverse @ spread @ inverse
    share = _load_errors().ground_scale
    if fit is last.fit:
        share = _load_errors().edge_scale
        wide = inverse @ (fit.rows.T @ fit.weights) * _load_errors().edge_px
        covariance = covariance + np.outer(wide, wide)
    larger = np.concatenate([share * position, np.zeros(3)])
    covariance = covariance + np.outer(larger, larger)
    drawn, edges, used = last.drawn, last.fit, last.used
    left = edges.offsets - edges.rows @ edges.change
    kept = edges.weights > 0.0
    points = drawn.edges[used] + edges.offsets[:, None] * drawn.outward[used]
    aside = points - points.mean(axis=0)
    order = np.argsort(np.arctan2(aside[:, 1], aside[:, 0]), kind="stable")
    residuals = np.where(kept, left, np.nan)[order]
    marks = OutlineMarks(points[order], -drawn.outward[used][order], residuals)
    sectors = np.unique(_group_by_sector(drawn)[used][kept]).size
    evidence = Evidence(
        residual_rms_px=float(np.sqrt(np.mean(left[kept] ** 2))),
        n_limb=int(kept.sum()),
        arc_deg=360.0 * sectors / SECTORS,
        outline=marks,
    )
    sigma = float(np.sqrt(np.trace(covariance[3:, 3:]) / 3.0))
    return Fix(Method.SILHOUETTE, position, covariance[:3, :3], turn, sigma, evidence)
