"""Resection against exact geometry, finite differences and the spread of many noisy trials."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.errors import NoSolutionError
from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.estimation.resection import resect, resect_robustly

RADIUS_M = 1_737_400.0


class Pinhole:
    """A bare pinhole of 4000 px focal length, so that these tests need no camera module."""

    focal_px = 4000.0

    def project_with_jacobian(self, points):
        x, y, z = points.T
        pixels = self.focal_px * points[:, :2] / z[:, None] + 1000.0
        jacobian = np.zeros((len(points), 2, 3))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = self.focal_px / z
        jacobian[:, 0, 2] = -self.focal_px * x / z**2
        jacobian[:, 1, 2] = -self.focal_px * y / z**2
        return pixels, jacobian


def scene(rng, count=12, height_m=200e3, half_field=0.22):
    """A camera looking down at `count` points of rough ground inside its field."""
    position = xyz_from_latlon(-0.7, 0.3, RADIUS_M + height_m)
    enu = body_from_local(-0.7, 0.3)
    camera_from_local = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    turn = Rotation.from_rotvec(rng.normal(0, 0.02, 3)) * Rotation.from_matrix(
        camera_from_local @ enu.T
    )
    reach = height_m * np.tan(half_field)
    offsets = rng.uniform(-reach, reach, (count, 2))
    ground = np.column_stack([offsets, rng.normal(0, 1500.0, count) - height_m])
    points = position + ground @ enu.T
    return Pose(position, turn), points


def sightings_of(pose, points, rng, sigma_px=0.0, stated_px=0.3):
    pixels, _ = predict(Pinhole(), pose, points)
    pixels = pixels + rng.normal(0, 1, pixels.shape) * sigma_px
    return Sightings(points, pixels, np.broadcast_to(np.eye(2) * stated_px**2, (len(points), 2, 2)))


@pytest.mark.parametrize("attitude_sigma", [0.0, 1e-4, None])
def test_exact_sightings_give_the_true_pose_back_from_kilometres_off(attitude_sigma):
    rng = np.random.default_rng(1)
    truth, points = scene(rng)
    start_turn = truth.camera_from_body
    if attitude_sigma is None:
        start_turn = Rotation.from_rotvec([0.02, -0.03, 0.05]) * start_turn
    start = Pose(truth.position_m + rng.normal(0, 3000.0, 3), start_turn)
    solution = resect(Pinhole(), sightings_of(truth, points, rng), start, attitude_sigma)
    assert np.linalg.norm(solution.state.position_m - truth.position_m) < 1e-3
    off = (solution.state.camera_from_body * truth.camera_from_body.inv()).magnitude()
    assert off < 1e-9


def test_the_jacobian_agrees_with_finite_differences():
    rng = np.random.default_rng(2)
    pose, points = scene(rng)
    _, jacobian = predict(Pinhole(), pose, points)
    for k, step in enumerate([1.0, 1.0, 1.0, 1e-6, 1e-6, 1e-6]):
        delta = np.zeros(6)
        delta[k] = step
        plus, _ = predict(Pinhole(), pose.moved(delta), points)
        minus, _ = predict(Pinhole(), pose.moved(-delta), points)
        numeric = (plus - minus) / (2.0 * step)
        assert np.allclose(numeric, jacobian[:, :, k], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("attitude_sigma", [0.0, 5e-5, None])
def test_the_covariance_matches_the_scatter_of_many_trials(attitude_sigma):
    rng = np.random.default_rng(3)
    truth, points = scene(rng, count=10)
    scores = []
    for _ in range(300):
        seen = sightings_of(truth, points, rng, sigma_px=0.3)
        turn = truth.camera_from_body
        if attitude_sigma:
            turn = Rotation.from_rotvec(rng.normal(0, attitude_sigma, 3)) * turn
        solution = resect(Pinhole(), seen, Pose(truth.position_m, turn), attitude_sigma)
        error = solution.state.position_m - truth.position_m
        scores.append(error @ np.linalg.solve(solution.covariance[:3, :3], error) / 3.0)
    # the mean of 300 chi-square(3)/3 has a sigma of sqrt(2/3/300) = 0.047
    assert 0.85 < np.mean(scores) < 1.15


def test_wrong_matches_are_thrown_out_and_right_ones_kept():
    rng = np.random.default_rng(4)
    for _ in range(20):
        truth, points = scene(rng, count=14)
        seen = sightings_of(truth, points, rng, sigma_px=0.3)
        wrong = rng.choice(14, 5, replace=False)
        pixels = seen.pixels.copy()
        pixels[wrong] += rng.choice([-1, 1], (5, 2)) * rng.uniform(20, 200, (5, 2))
        start = Pose(truth.position_m + rng.normal(0, 3000.0, 3), truth.camera_from_body)
        found = resect_robustly(
            Pinhole(), Sightings(points, pixels, seen.covariances_px2), start, 0.0
        )
        assert not found.used[wrong].any()
        assert found.used.sum() >= 8
        assert np.linalg.norm(found.pose.position_m - truth.position_m) < 300.0


def test_common_errors_go_by_the_scatter_of_the_frame():
    """A shift of a share of the scatter moves a camera with an exact attitude by as much ground."""
    rng = np.random.default_rng(8)
    truth, points = scene(rng, count=200)
    added = []
    for noise in (0.3, 0.6):
        seen = sightings_of(truth, points, rng, sigma_px=noise)
        alone, shared = (
            resect_robustly(Pinhole(), seen, truth, 0.0, common_shares=shares)
            for shares in ((0.0, 0.0), (0.5, 0.0))
        )
        added.append(np.trace(shared.covariance - alone.covariance))
    # twice the scatter, four times the square; the stated sigmas are 0.3 px in both
    assert added[1] == pytest.approx(4.0 * added[0], rel=0.15)
    per_px = np.linalg.norm(points - truth.position_m, axis=1).mean() / Pinhole.focal_px
    assert np.sqrt(added[0] / 2.0) == pytest.approx(0.5 * 0.3 * per_px, rel=0.25)


def test_sightings_that_share_a_large_error_count_for_less():
    """Half of the sightings are moved together: the others lead, and the covariance says so."""
    rng = np.random.default_rng(9)
    truth, points = scene(rng, count=40)
    shared = np.zeros((40, 2, 1))
    shared[:20, 0] = 0.9
    far = {True: [], False: []}
    nees = {True: [], False: []}
    for _ in range(60):
        seen = sightings_of(truth, points, rng, sigma_px=0.3)
        seen = Sightings(points, seen.pixels + shared[:, :, 0] * rng.normal(), seen.covariances_px2)
        for known in far:
            errors = shared if known else None
            found = resect_robustly(Pinhole(), seen, truth, 0.0, common_errors_px=errors)
            error = found.pose.position_m - truth.position_m
            far[known].append(error @ error)
            nees[known].append(error @ np.linalg.solve(found.covariance, error) / 3.0)
    assert np.mean(far[True]) < 0.5 * np.mean(far[False])
    assert 0.6 < np.mean(nees[True]) < 1.4


def test_contradicting_matches_are_no_solution():
    rng = np.random.default_rng(5)
    truth, points = scene(rng, count=2)
    seen = sightings_of(truth, points, rng)
    pixels = seen.pixels + np.array([[300.0, 0.0], [0.0, 300.0]])
    with pytest.raises(NoSolutionError):
        resect_robustly(Pinhole(), Sightings(points, pixels, seen.covariances_px2), truth, 0.0)


def test_one_sighting_is_too_few():
    rng = np.random.default_rng(6)
    truth, points = scene(rng, count=1)
    with pytest.raises(NoSolutionError, match="needed"):
        resect_robustly(Pinhole(), sightings_of(truth, points, rng), truth, 0.0)
