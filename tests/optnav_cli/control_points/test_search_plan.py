"""Where and how wide to search: never too narrow, never finer than the picture resolves."""

import numpy as np
import pytest

from optnav_cli.control_points.search_plan import (
    NO_DISTORTION,
    compute_ground_uncertainty_m,
    find_finest_level,
    plan_distortion,
    search_room,
)

POSTINGS = 118.0 * 2.0 ** np.arange(5)


@pytest.mark.parametrize("uncertainty_m", [0.0, 10.0, 200.0, 1000.0, 3000.0, 8000.0])
@pytest.mark.parametrize("finest", [0, 1, 3])
def test_the_room_covers_the_uncertainty_whenever_a_level_can(uncertainty_m, finest):
    level, nodes = search_room(POSTINGS, finest, uncertainty_m, 3.5, 24)
    assert finest <= level < 5
    assert nodes <= 24
    room_m = nodes * POSTINGS[level]
    assert room_m >= min(3.5 * uncertainty_m, 24 * POSTINGS[-1])


def test_a_better_pose_is_never_searched_coarser_and_never_wider():
    plans = [search_room(POSTINGS, 0, u, 3.5, 24) for u in np.geomspace(1.0, 5000.0, 60)]
    levels = [level for level, _ in plans]
    room = [nodes * POSTINGS[level] for level, nodes in plans]
    assert levels == sorted(levels)
    # a coarser level's nodes of margin are larger ones: the room may only grow
    assert room == sorted(room)


def test_an_uncertainty_beyond_all_levels_takes_the_coarsest_at_full_width():
    level, nodes = search_room(POSTINGS, 0, 1e6, 3.5, 24)
    assert (level, nodes) == (4, 24)


@pytest.mark.parametrize("levels", [1, 2])
def test_without_coarse_levels_the_last_is_searched_twice_as_far(levels):
    level, nodes = search_room(POSTINGS[:levels], 0, 1e6, 3.5, 24)
    assert (level, nodes) == (levels - 1, 48)
    assert search_room(POSTINGS[:1], 0, 118.0 * 10.0, 3.5, 24)[1] == 37


def test_the_finest_level_is_the_first_that_the_pixels_resolve():
    assert find_finest_level(POSTINGS, 10.0, 0.6) == 0
    assert find_finest_level(POSTINGS, 118.0 / 0.6, 0.6) == 0
    assert find_finest_level(POSTINGS, 118.1 / 0.6, 0.6) == 1
    assert find_finest_level(POSTINGS, 1e5, 0.6) == 4


def test_a_well_known_pose_needs_no_rolls_or_scales():
    assert plan_distortion(80, np.radians(0.1), 0.002, 2.0) == NO_DISTORTION


@pytest.mark.parametrize("nodes", [32, 80])
def test_rolls_and_scales_reach_the_sigmas_and_step_within_a_node_or_two(nodes):
    roll, scale = np.radians(1.5), 0.02
    plan = plan_distortion(nodes, roll, scale, 2.0)
    for values, centre, reach in [(plan.rolls, 0.0, 2.0 * roll), (plan.scales, 1.0, 2.0 * scale)]:
        values = np.array(values) - centre
        assert 0.0 in values
        assert np.allclose(values, -values[::-1])
        # a value covers one node at the template's rim to either side
        assert values.max() + 2.0 / nodes >= reach * 0.99
        assert np.diff(values).max(initial=0.0) <= max(4.0 / nodes, reach / 3.0) * 1.01
        assert len(values) <= 7


def test_the_uncertainty_on_the_ground_is_that_of_the_worst_direction():
    """A camera 200 km up, 1 px = 50 m: position alone, then a roll about the boresight."""
    per_m = 1.0 / 50.0
    jacobian = np.zeros((2, 2, 6))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = per_m
    jacobian[1, 1, 5] = 800.0  # the second point lies 800 px off the middle
    covariance = np.diag([100.0**2, 300.0**2, 500.0**2, 0.0, 0.0, 0.0])
    metres = np.full(2, 50.0)
    assert np.allclose(compute_ground_uncertainty_m(jacobian, covariance, metres), 300.0)
    covariance[5, 5] = 0.01**2
    turned = compute_ground_uncertainty_m(jacobian, covariance, metres)
    assert np.allclose(turned, [300.0, np.hypot(300.0, 800.0 * 0.01 * 50.0)])
