"""Poses refined by windows, and the covariance of places, against the geometry they come from."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.picture import Picture
from optnav_cli.hazard.ground_view import KnownPose, look_from
from optnav_cli.hazard.registration import (
    Reference,
    UncertainPose,
    WindowMatches,
    coarsen_view,
    compute_place_jacobian,
    make_grid,
    match_windows,
    refine_pose,
    sample_ground,
)
from optnav_cli.hazard.settings import load_hazard_model

RADIUS, HEIGHT, SIZE = 1737400.0, 400.0, 300
LAT, LON = np.radians(-70.0), np.radians(20.0)
LOCAL = body_from_local(LAT, LON)
CAMERA = Camera("cam", "pinhole", SIZE, SIZE, 400.0, (0.5 * (SIZE - 1), 0.5 * (SIZE - 1)))
SUN = LOCAL @ (0.6, 0.7, 0.39)
POSE = KnownPose(
    xyz_from_latlon(LAT, LON, RADIUS + HEIGHT),
    Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]) @ LOCAL.T),
    SUN / np.linalg.norm(SUN),
    RADIUS,
)


def move(pose: KnownPose, shift: np.ndarray, turn: np.ndarray) -> KnownPose:
    """Move a camera, and turn it about the body's axes."""
    turned = pose.camera_from_body * Rotation.from_rotvec(turn).inv()
    return replace(pose, position_m=pose.position_m + shift, camera_from_body=turned)


def ground_picture(pose: KnownPose, seed: int = 2) -> Picture:
    """A picture of level ground of random brightness about (LAT, LON)."""
    noise = np.random.default_rng(seed).standard_normal((600, 600))
    ground = gaussian_filter(noise, 2.0)
    pixels = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1).astype(float)
    rays = CAMERA.unproject(pixels) @ pose.camera_from_body.as_matrix() @ LOCAL
    camera = (pose.position_m - xyz_from_latlon(LAT, LON, RADIUS)) @ LOCAL
    along = -camera[2] / rays[..., 2]
    x, y = (camera[i] + along * rays[..., i] for i in range(2))
    seen = map_coordinates(100.0 + 60.0 * ground / ground.std() * 0.3, [300 - y, 300 + x], order=1)
    return Picture(seen.astype(np.float32), None)


PICTURE = ground_picture(POSE)


def view_from(pose: KnownPose, ground_m: float = 0.0) -> object:
    return look_from(PICTURE, CAMERA, pose, ground_m)


@pytest.mark.parametrize("axis", range(7))
def test_the_jacobian_of_places_is_that_of_finite_differences(axis: int) -> None:
    """The same ray meets the ground elsewhere when the camera moves or turns, or the ground rises.

    0.02 m of 1 m at 150 m from the middle: the body's curvature, which the plane neglects.
    """
    view = view_from(POSE)
    pixel = np.array([40.0, 210.0])
    step = np.zeros(7)
    step[axis] = 1.0 if axis in (0, 1, 2, 6) else 1e-3
    places = []
    for sign in (0.0, 1.0):
        pose = move(POSE, sign * step[:3], sign * step[3:6])
        ray = pose.camera_from_body.inv().apply(CAMERA.unproject(pixel))
        ray /= np.linalg.norm(ray)
        level = RADIUS + sign * step[6]
        b = pose.position_m @ ray
        reach = -b - np.sqrt(b**2 - pose.position_m @ pose.position_m + level**2)
        places.append(np.array(view.projection.xy_from_xyz(pose.position_m + reach * ray)).ravel())
    wanted = (places[1] - places[0]) / step[axis]
    found = compute_place_jacobian(view, POSE, places[0][None])[0, :, axis]
    np.testing.assert_allclose(found, wanted, rtol=0.01, atol=0.02 if axis < 3 or axis == 6 else 4)


@pytest.mark.parametrize("ground_sigma_m", [0.0, 10.0])
def test_a_pose_that_errs_is_refined_by_the_ground_of_another_frame(ground_sigma_m: float) -> None:
    """Off by 6 m along each axis, it places all of the picture within 3 sigmas, and 0.4 m.

    Whether the camera's height is wrong or the ground's, the picture alone cannot tell.
    """
    right = view_from(POSE)
    wrong = move(POSE, LOCAL @ np.array([6.0, -5.0, 6.0]), np.zeros(3))
    given = UncertainPose.make(wrong, 36.0 * np.eye(3), 1e-5, ground_sigma_m)
    at, view = given, view_from(wrong)
    refined = given
    for _ in range(2):
        margin = 30
        x, y = make_grid(view, view.cell_m, margin)
        bright = sample_ground(right.brightness, right.valid, right, x, y, view)
        reference = Reference(
            bright, *coarsen_view(view, view.cell_m), view.cell_m, margin, 0.04 * np.eye(2), False
        )
        found = match_windows(view, reference, 6)
        assert len(found.places_m) >= 9
        refined = refine_pose(given, at, view, found, reference)
        assert refined is not None
        at = refined
        view = view_from(at.pose, at.raised_m)
    for pixel in ([150.0, 150.0], [20.0, 20.0], [280.0, 40.0]):
        place = _place(at.pose, np.array(pixel), at.raised_m)
        off = place - _place(POSE, np.array(pixel))
        covariance = refined.compute_place_covariance(view, *place)
        assert off @ np.linalg.solve(covariance, off) < 9.0
        assert np.hypot(*off) < 0.4
        assert np.sqrt(np.trace(covariance)) < 2.0
    over_m = (at.pose.position_m - POSE.position_m) @ LOCAL[:, 2] - at.raised_m
    assert abs(over_m) < 2.0


def _place(pose: KnownPose, pixel: np.ndarray, ground_m: float = 0.0) -> np.ndarray:
    ray = pose.camera_from_body.inv().apply(CAMERA.unproject(pixel)) @ LOCAL
    camera = (pose.position_m - xyz_from_latlon(LAT, LON, RADIUS)) @ LOCAL
    return (camera - (camera[2] - ground_m) / ray[2] * ray)[:2]


def test_a_reference_never_makes_a_place_surer_than_itself() -> None:
    """Covariance intersection: a pose that may rest on the reference gains nothing beyond it."""
    view = view_from(POSE)
    given = UncertainPose.make(POSE, 1.0 * np.eye(3), 0.0, 0.0)
    places = np.array([[-60.0, -60.0], [60.0, -60.0], [-60.0, 60.0], [60.0, 60.0], [0.0, 0.0]])
    reference = Reference(
        np.zeros((9, 9), np.float32), np.zeros((9, 9), np.float32), np.ones((9, 9), bool), 0.01, 0,
        1.0 * np.eye(2), False,
    )  # fmt: skip
    refined = refine_pose(given, given, view, WindowMatches(places, np.zeros((5, 2))), reference)
    assert refined is not None
    covariance = refined.compute_place_covariance(view, 0.0, 0.0)
    assert np.linalg.eigvalsh(covariance)[0] > 0.95


@pytest.mark.parametrize("scatter_m", [0.0, 1.0])
def test_windows_that_scatter_leave_their_reference_less_sure(scatter_m: float) -> None:
    """And what all windows are known to be off by is taken off."""
    view = view_from(POSE)
    given = UncertainPose.make(POSE, 25.0 * np.eye(3), 0.0, 0.0)
    places = 60.0 * np.array([[x, y] for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])
    off = scatter_m * np.random.default_rng(3).standard_normal((9, 2))
    reference = Reference(
        np.zeros((9, 9), np.float32), np.zeros((9, 9), np.float32), np.ones((9, 9), bool), 1.0, 0,
        0.04 * np.eye(2), True, (3.0, -2.0),
    )  # fmt: skip
    matches = WindowMatches(places, off - off.mean(axis=0) + [3.0, -2.0])
    refined = refine_pose(given, given, view, matches, reference)
    assert refined is not None
    sigma = np.sqrt(np.trace(refined.compute_place_covariance(view, 0.0, 0.0)) / 2.0)
    assert (0.2 < sigma < 0.3) if not scatter_m else sigma > 0.8
    assert np.linalg.norm((refined.pose.position_m - POSE.position_m) @ LOCAL[:, :2]) < 0.5 * sigma


def test_a_low_sun_shifts_all_windows_away_from_it() -> None:
    numbers = load_hazard_model().registration
    low, high = (np.array([np.cos(e), 0.0, np.sin(e)]) for e in np.radians([5.0, 60.0]))
    shift, covariance = numbers.compute_shift(low, 20.0)
    assert shift[0] == pytest.approx(numbers.sunward_postings * 20.0 / np.tan(np.radians(5.0)))
    assert shift[1] == 0.0
    shared = (20.0 * numbers.shared_postings) ** 2
    assert np.diag(covariance) == pytest.approx([shared + shift[0] ** 2, shared])
    assert abs(numbers.compute_shift(high, 20.0)[0][0]) < 0.1


def test_windows_of_other_ground_refine_nothing() -> None:
    view = view_from(POSE)
    other = look_from(ground_picture(POSE, 7), CAMERA, POSE, 0.0)
    x, y = make_grid(view, view.cell_m, 20)
    bright = sample_ground(other.brightness, other.valid, other, x, y, view)
    coarse = coarsen_view(view, view.cell_m)
    reference = Reference(bright, *coarse, view.cell_m, 20, np.eye(2), False)
    assert not len(match_windows(view, reference, 6).places_m)
