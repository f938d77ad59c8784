"""Landmarks: chosen where the picture has corners, found where another view shows them."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.control_points.picture_pyramid import PicturePyramid
from optnav_cli.estimation.models.points import Pose
from optnav_cli.navigate.descent.landmark import (
    choose_pixels,
    compute_hessian_determinant,
    cut_patch,
    match_patch,
)
from optnav_cli.reasons import ReasonCode

CAMERA = preset_camera("tsnn2_wide")
DOWN = Rotation.from_matrix([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
GROUND_M = 1.7374e6
UP = np.array([1.0, 0.0, 0.0])


def picture_of(pose: Pose) -> Float32Array:
    """Flat ground at GROUND_M with a texture of its own, as the camera sees it."""
    x, y = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    rays = CAMERA.unproject(np.stack([x, y], axis=-1)) @ pose.camera_from_body.as_matrix()
    places = pose.position_m + rays * ((GROUND_M - pose.position_m[0]) / rays[..., :1])
    texture = cv2.GaussianBlur(
        np.random.default_rng(1).normal(size=(1600, 1600)).astype(np.float32), (0, 0), 3.0
    )
    where = (places[..., 1:] / 5.0 + 800.0).astype(np.float32)
    seen = cv2.remap(texture, where[..., 0], where[..., 1], cv2.INTER_CUBIC)
    return np.asarray(seen, np.float32)


def test_the_hessian_of_a_blob_is_largest_at_its_middle() -> None:
    x, y = np.meshgrid(np.arange(60.0), np.arange(50.0))
    blob = np.exp(-((x - 33.0) ** 2 + (y - 21.0) ** 2) / 18.0).astype(np.float32)
    response = compute_hessian_determinant(blob)
    assert np.unravel_index(int(np.argmax(response)), response.shape) == (21, 33)
    # a straight edge has curvature in one direction alone
    edge = np.tile(np.tanh((np.arange(60.0) - 30.0) / 4.0), (50, 1)).astype(np.float32)
    inner = compute_hessian_determinant(edge)[10:-10, 10:-10]
    assert float(np.abs(inner).max()) < 0.02 * float(response.max())


def test_landmarks_are_chosen_in_the_free_squares_alone() -> None:
    picture = np.random.default_rng(2).normal(size=(200, 300)).astype(np.float32)
    free = np.zeros((4, 4), dtype=bool)
    free[1, 2] = free[3, 3] = True
    chosen = choose_pixels(picture, free, 10)
    squares = {(int(y * 4 // 200), int(x * 4 // 300)) for x, y in chosen}
    assert squares == {(1, 2), (3, 3)}
    assert len(choose_pixels(np.zeros_like(picture) + 5.0, free, 10)) == 0


def test_a_landmark_is_found_from_lower_and_aside() -> None:
    """A fifth lower, 300 m on and turned by 2 deg: within a fifth of a pixel, and it says so."""
    first = Pose(np.array([GROUND_M + 3000.0, 0.0, 0.0]), DOWN)
    tilt = Rotation.from_rotvec([0.03, -0.02, 0.01])
    second = Pose(np.array([GROUND_M + 2400.0, 250.0, -170.0]), tilt * DOWN)
    place = np.array([GROUND_M, 120.0, 260.0])
    patch = cut_patch(PicturePyramid(picture_of(first)), CAMERA, first, place, UP)
    assert patch is not None
    wrong = place + [0.0, 12.0, -8.0]
    view = PicturePyramid(picture_of(second))
    found = match_patch(patch, view, CAMERA, second, wrong, 4.0)
    true = CAMERA.project_from_body(place, second.position_m, second.camera_from_body.as_matrix())
    assert not found.reason
    assert found.pixel == pytest.approx(true, abs=0.2)
    far = match_patch(patch, view, CAMERA, second, place + [0.0, 900.0, 0.0], 4.0)
    assert far.reason.code in (ReasonCode.LOW_SCORE, ReasonCode.SEARCH_BORDER, ReasonCode.RIVAL)
    assert patch.is_stale(place, CAMERA, Pose(second.position_m - [800.0, 0.0, 0.0], DOWN))
    assert not patch.is_stale(place, CAMERA, first)
