"""A pose from picked points alone, its honesty, and the older constructions beside it."""

import cv2
import numpy as np
import pytest

from catalog.errors import NoSolutionError
from optnav_cli.points.constructions import (
    Picks,
    apply_homography,
    fit_homography,
    locate_by_circles,
    locate_by_tori,
    propagate_covariance,
)
from tests.optnav_cli.made_picks import WIDE, scene


def picks_of(made):
    rays = made.camera.unproject(made.pixels)
    half = made.camera.height_px / 2.0 / made.camera.focal_length_px
    return Picks(made.places_m, rays[:, :2] / rays[:, 2:], half)


@pytest.mark.parametrize("count", [4, 5, 20])
def test_exact_points_give_the_pose_without_any_guess(count):
    for seed in range(5):
        made = scene(seed, count)
        found = made.problem().solve()
        assert np.linalg.norm(found.pose.position_m - made.pose.position_m) < 0.5
        turned = found.pose.camera_from_body * made.pose.camera_from_body.inv()
        assert turned.magnitude() < 2e-6


def test_stated_sigmas_hold_the_errors_of_noisy_points():
    squares = []
    for seed in range(60):
        made = scene(seed)
        found = made.problem((0.7, 10.0), seed).solve()
        off = found.pose.position_m - made.pose.position_m
        squares.append(off @ np.linalg.solve(found.position_covariance_m2, off) / 3.0)
    assert 0.7 < np.mean(squares) < 1.4


def test_a_blunder_among_eight_points_is_found():
    """Kept, 68 px in one point move the position by kilometres and leave a residual of 44 px."""
    for seed in range(10):
        made = scene(seed, 8)
        made.pixels[3] += (60.0, -32.0)
        found = made.problem((0.7, 10.0), seed).solve()
        assert list(np.flatnonzero(~found.used)) == [3]
        assert np.linalg.norm(found.pose.position_m - made.pose.position_m) < 4000.0


def test_four_blunders_among_twenty_points_are_found():
    for seed in range(5):
        made = scene(seed)
        made.pixels[:4] += np.random.default_rng(seed).normal(0.0, 90.0, (4, 2))
        found = made.problem((0.7, 10.0), seed).solve()
        assert found.fits
        assert not found.used[:4].any()
        assert found.used[4:].sum() >= 15


def test_a_lens_that_may_be_longer_moves_the_camera_along_the_line_of_sight():
    made = scene(1)
    found = made.problem(lens=(0.009, 20.0)).solve()
    sight = made.places_m.mean(axis=0) - made.pose.position_m
    distance = np.linalg.norm(sight)
    sight /= distance
    along = np.sqrt(sight @ found.position_covariance_m2 @ sight)
    assert 0.6 * 0.009 * distance < along < 1.05 * 0.009 * distance
    values, vectors = np.linalg.eigh(found.position_covariance_m2)
    assert abs(vectors[:, 2] @ sight) > 0.99
    # the principal point is taken up by the attitude: 20 px are 170 m of ground, and add less
    assert np.sqrt(values[0]) < 200.0


def test_a_wrong_lens_stays_inside_the_sigmas_that_state_it():
    inside = []
    for seed in range(20):
        made = scene(seed)
        problem = made.problem((0.7, 10.0), seed, (0.009, 0.0))
        longer = 1.0 + np.random.default_rng(seed).normal(0.0, 0.009)
        middle = np.array(made.camera.principal_point_px)
        problem.points.pixels[:] = middle + longer * (problem.points.pixels - middle)
        problem.rays[:] = made.camera.unproject(problem.points.pixels)
        found = problem.solve()
        off = found.pose.position_m - made.pose.position_m
        inside.append(off @ np.linalg.solve(found.position_covariance_m2, off) < 14.2)
    assert np.mean(inside) >= 0.95


def test_three_points_have_several_places_and_one_is_the_true_one():
    for seed in range(10):
        made = scene(seed, 3)
        found = made.problem().solve_three()
        off = [np.linalg.norm(p.pose.position_m - made.pose.position_m) for p in found]
        assert 2 <= len(found) <= 4
        assert min(off) < 5.0


def test_points_on_a_line_or_in_one_pixel_are_refused():
    made = scene(0, 6)
    made.pixels[:] = np.linspace((500.0, 400.0), (5000.0, 3300.0), 6)
    with pytest.raises(NoSolutionError, match="on a line"):
        made.problem().solve()
    made.pixels[:] = (700.0, 900.0)
    with pytest.raises(NoSolutionError, match="one pixel"):
        made.problem().solve()


def test_the_homography_is_opencvs():
    rng = np.random.default_rng(3)
    image = rng.uniform(-0.04, 0.04, (4, 2))
    plane = rng.uniform(-1e4, 1e4, (4, 2))
    ours, theirs = (
        fit_homography(image, plane),
        cv2.getPerspectiveTransform(image.astype(np.float32), plane.astype(np.float32)),
    )
    grid = rng.uniform(-0.02, 0.02, (9, 2))
    assert np.allclose(apply_homography(ours, image), plane, atol=1e-4)
    assert np.allclose(
        apply_homography(ours, grid), apply_homography(theirs, grid), rtol=1e-3, atol=10.0
    )


def test_circles_on_the_tangent_plane_find_the_exact_place():
    """What stays is the relief of 500 m between the points that the plane is laid through."""
    for seed in range(5):
        made = scene(seed, 4)
        found = locate_by_circles(picks_of(made))
        assert np.linalg.norm(found - made.pose.position_m) < 60.0


@pytest.mark.parametrize("ground", ["flat", "map"])
def test_circles_on_a_flat_map_miss_by_the_curvature(ground):
    off = []
    for seed in range(8):
        made = scene(seed, 4, relief_m=0.0)
        off.append(np.linalg.norm(locate_by_circles(picks_of(made), ground) - made.pose.position_m))
    assert np.mean(off) > 5e3


def test_tori_find_the_exact_place_from_a_start_nearby():
    made = scene(2, 6)
    start = made.pose.position_m + np.array([2e4, -1e4, 1.5e4])
    assert np.linalg.norm(locate_by_tori(picks_of(made), start) - made.pose.position_m) < 1e-2


def test_the_covariance_of_circles_is_that_of_their_scatter():
    made, off = scene(4, 8, off_deg=20.0, camera=WIDE), []
    picks = picks_of(made)
    sigma = np.full(8, 0.7 / WIDE.focal_length_px)
    covariance = propagate_covariance(locate_by_circles, picks, sigma, np.full(8, 10.0), (0.0, 0.0))
    for seed in range(80):
        noisy = picks_of(made)
        rng = np.random.default_rng(seed)
        noisy.image[:] += rng.normal(0.0, sigma[0], noisy.image.shape)
        places = noisy.places_m + rng.normal(0.0, 10.0, noisy.places_m.shape)
        off.append(
            locate_by_circles(Picks(places, noisy.image, noisy.half_side)) - made.pose.position_m
        )
    seen = np.trace(np.cov(np.array(off).T))
    assert 0.6 < seen / np.trace(covariance) < 1.6
