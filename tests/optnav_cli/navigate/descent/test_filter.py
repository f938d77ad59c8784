"""The joint filter of a descent: its derivatives, its likeness to least squares, its honesty."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.navigate.descent.filter import TRACK, DescentFilter, TrackErrors
from tests.studies.descent_measurements import Formulation, fly

CAMERA = preset_camera("tsnn2_wide")
ERRORS = TrackErrors(300.0, 0.8, 0.02, 6e-5, 4e-7, 1.5e-5)
POSE = Pose(
    np.array([1.7454e6, 0.0, 0.0]), Rotation.from_matrix([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
)


class LinearCamera:
    """Sees a point's x and y, so that nothing but the attitude is not linear."""

    def project_with_jacobian(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        jacobian = np.zeros((len(points), 2, 3))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
        return points[:, :2].copy(), jacobian


def ground(rng: np.random.Generator, count: int) -> FloatArray:
    """Points below POSE."""
    return np.array([1.7374e6, 0.0, 0.0]) + rng.normal(size=(count, 3)) * [150.0, 3e3, 3e3]


def test_the_step_of_an_update_is_the_derivative_of_its_pixels() -> None:
    """By differences: what the filter predicts changes with each unknown as its rows say."""
    rng = np.random.default_rng(1)
    flown = DescentFilter(ERRORS)
    numbers = flown.add_points(ground(rng, 3), 25.0 * np.eye(9))
    base, _ = flown.predict(CAMERA, POSE, numbers)
    # the covariance with the pixels is P H^T: with P = I it is the derivative itself
    flown.covariance = np.eye(TRACK + 9)
    _, by_pose = predict(CAMERA, POSE, flown.places_m)
    for unknown in (0, 1, 2, 6, 7, 8, TRACK, TRACK + 4, TRACK + 8):
        step = 1e-7 if 6 <= unknown < 9 else 1e-2
        moved = flown.copy()
        moved.state[unknown] += step
        slope = (moved.predict(CAMERA, POSE, numbers)[0] - base) / step
        wanted = np.zeros((3, 2))
        if unknown < 3:
            wanted = by_pose[:, :, unknown]
        elif unknown < TRACK:
            wanted = by_pose[:, :, unknown - 3]
        else:
            point, axis = divmod(unknown - TRACK, 3)
            wanted[point] = -by_pose[point, :, axis]
        assert slope == pytest.approx(wanted, rel=1e-3, abs=1e-6)


def test_a_range_moves_the_state_along_its_derivative_and_narrows_it() -> None:
    flown = DescentFilter(ERRORS)
    flown.add_points(np.zeros((1, 3)), np.eye(3))
    beam, up = np.array([0.0, 1e3, 0.0]), np.array([1.0, 0.0, 0.0])
    row, variance = flown.predict_range(beam, up, (0, -up))
    noise = ERRORS.attitude_noise_rad**2 * 1e6
    expected = 300.0**2 + 1.0 + 1e6 * ERRORS.attitude_rad**2 + noise
    assert variance == pytest.approx(expected)
    flown.update_range(row, 50.0, variance + 4.0)
    assert flown.state[0] == pytest.approx(50.0 * 300.0**2 / (expected + 4.0))
    left = 300.0**2 - 300.0**4 / (expected + 4.0)
    assert flown.covariance[0, 0] == pytest.approx(left)
    assert np.linalg.eigvalsh(flown.covariance).min() >= 0.0


def test_a_linear_descent_is_the_least_squares_of_all_its_sightings() -> None:
    """Three frames of four ground points, against the normal equations of all at once."""
    rng = np.random.default_rng(2)
    errors = TrackErrors(30.0, 0.5, 0.0, 1e-12, 1e-15, 0.0)
    prior, places = np.diag(rng.uniform(1.0, 9.0, 12)), rng.normal(size=(4, 3)) * 50.0
    flown, camera = DescentFilter(errors), LinearCamera()
    numbers = flown.add_points(places, prior)
    stated = Pose(np.zeros(3), Rotation.identity())
    pixel = np.array([[0.09, 0.02], [0.02, 0.16]])
    normal, right = np.zeros((18, 18)), np.zeros(18)
    normal[:3, :3], normal[3:6, 3:6] = np.eye(3) / 30.0**2, np.eye(3) / 0.5**2
    normal[6:, 6:] = np.linalg.inv(prior)
    for time in (0.0, 5.0, 10.0):
        if time:
            flown.propagate(5.0)
        pixels = places[:, :2] + rng.normal(size=(4, 2)) * 0.3
        flown.update(camera, stated, numbers, Sightings(places, pixels, np.tile(pixel, (4, 1, 1))))
        for k in range(4):
            row = np.zeros((2, 18))
            row[:, :2], row[:, 3:5] = -np.eye(2), -time * np.eye(2)
            row[:, 6 + 3 * k : 8 + 3 * k] = np.eye(2)
            normal += row.T @ np.linalg.solve(pixel, row)
            right += row.T @ np.linalg.solve(pixel, pixels[k] - places[k, :2])
    solved, covariance = np.linalg.solve(normal, right), np.linalg.inv(normal)
    assert flown.state[TRACK:] == pytest.approx(solved[6:], abs=1e-6)
    assert flown.state[:3] == pytest.approx(solved[:3] + 10.0 * solved[3:6], abs=1e-6)
    assert flown.covariance[TRACK:, TRACK:] == pytest.approx(covariance[6:, 6:], abs=1e-6)


def test_a_wrong_sighting_is_left_out_and_moves_nothing() -> None:
    rng = np.random.default_rng(3)
    places = ground(rng, 12)
    flown, clean = DescentFilter(ERRORS), DescentFilter(ERRORS)
    pixels, _ = predict(CAMERA, POSE, places)
    pixels += 0.2 * rng.normal(size=pixels.shape)
    covariances = np.tile(0.04 * np.eye(2), (12, 1, 1))
    wrong = pixels.copy()
    wrong[4] += [25.0, -10.0]
    for each, seen in ((flown, wrong), (clean, pixels)):
        numbers = each.add_points(places, 4.0 * np.eye(36))
        found = each.update(CAMERA, POSE, numbers, Sightings(places, seen, covariances))
        assert list(np.flatnonzero(~found.used)) == ([4] if each is flown else [])
    assert flown.state[:3] == pytest.approx(clean.state[:3], abs=1.0)


def test_a_narrow_gate_leaves_out_what_a_wide_one_keeps() -> None:
    rng = np.random.default_rng(3)
    places = ground(rng, 12)
    pixels, _ = predict(CAMERA, POSE, places)
    pixels[4] += [3.5 * np.hypot(0.2, 1.0), 0.0]  # 3.5 sigma of a pixel and of ground at 8 km
    covariances = np.tile(1.04 * np.eye(2), (12, 1, 1))
    for gate, kept in ((16.0, 12), (9.0, 11)):
        flown = DescentFilter(ERRORS)
        numbers = flown.add_points(places, 1e-6 * np.eye(36))
        seen = Sightings(places, pixels, covariances)
        assert flown.update(CAMERA, POSE, numbers, seen, gate=gate).used.sum() == kept


def test_sightings_that_leave_the_view_change_nothing() -> None:
    flown = DescentFilter(ERRORS)
    numbers = flown.add_points(np.array([[1.76e6, 0.0, 0.0]]), np.eye(3))
    seen = Sightings(np.zeros((1, 3)), np.zeros((1, 2)), np.eye(2)[None])
    with pytest.raises(NoSolutionError):
        flown.update(CAMERA, POSE, numbers, seen)
    assert not flown.state.any()


def test_points_that_are_dropped_leave_the_others_as_they_were() -> None:
    rng = np.random.default_rng(4)
    flown = DescentFilter(ERRORS)
    flown.add_points(ground(rng, 3), np.diag(rng.uniform(1.0, 9.0, 9)))
    before, covariance = flown.places_m, flown.get_point_covariance(2)
    flown.keep(np.array([True, False, True]))
    assert flown.places_m == pytest.approx(before[[0, 2]])
    assert flown.get_point_covariance(1) == pytest.approx(covariance)


def test_the_joint_state_is_honest_where_independent_landmarks_are_not() -> None:
    """Four descents without pictures: NEES about 1 against hundreds, and a smaller error."""
    joint, alone = (
        [fly(CAMERA, formulation, seed) for seed in range(4)]
        for formulation in (Formulation.JOINT, Formulation.INDEPENDENT)
    )
    assert 0.5 < np.mean([each.nees for each in joint]) < 1.6
    assert np.mean([each.nees[-1] for each in alone]) > 100.0
    last = [[each.error_m[-1] for each in runs] for runs in (joint, alone)]
    rms = [float(np.sqrt(np.mean(np.square(ends)))) for ends in last]
    assert rms[0] < 0.6 * rms[1]


def test_what_sightings_have_in_common_is_not_averaged_away() -> None:
    """A hundred known points, all moved by one shift of 5 m: the place is known to 5 m."""
    rng = np.random.default_rng(9)
    errors = TrackErrors(300.0, 0.8, 0.0, 1e-9, 1e-12, 0.0)
    places = ground(rng, 100)
    pixels, by_pose = predict(CAMERA, POSE, places)
    seen = Sightings(places, pixels, np.tile(0.01 * np.eye(2), (100, 1, 1)))
    sigmas = []
    for shared in (None, 5.0 * by_pose[:, :, :3]):
        flown = DescentFilter(errors)
        numbers = flown.add_points(places, 1e-6 * np.eye(300))
        flown.update(CAMERA, POSE, numbers, seen, shared)
        sigmas.append(np.sqrt(np.diag(flown.compute_pose_covariance())[:3]))
    assert sigmas[0].max() < 1.0
    assert sigmas[1] == pytest.approx(np.full(3, 5.0), rel=0.05)
