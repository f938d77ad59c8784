"""Poses from nearly above, where the cost of a lean is no parabola."""

import numpy as np

from catalog.errors import NoSolutionError
from tests.optnav_cli.made_picks import scene

NADIR_DEG, TRIALS = 0.001, 60


def normalised(off_m, covariance):
    return off_m @ np.linalg.solve(covariance, off_m) / 3.0


def test_sigmas_from_straight_above_hold_the_errors():
    """By the curvature at the best pose alone, errors squared are many times what is stated."""
    by_curvature, by_likelihood = [], []
    for seed in range(TRIALS):
        made = scene(seed, 8, NADIR_DEG)
        problem = made.problem((0.7, 10.0), seed)
        try:
            found = problem.solve()
        except NoSolutionError:
            continue
        off = found.pose.position_m - made.pose.position_m
        by_curvature.append(normalised(off, found.position_covariance_m2))
        wider = problem.expand_over_leans(found)
        assert np.array_equal(wider.pose.position_m, found.pose.position_m)
        by_likelihood.append(normalised(off, wider.position_covariance_m2))
    assert len(by_likelihood) > 0.9 * TRIALS
    assert np.mean(by_curvature) > 2.0
    assert 0.7 < np.mean(by_likelihood) < 1.4


def test_the_lens_error_is_in_the_likelihood_of_leans():
    made = scene(3, 20, NADIR_DEG)
    problem = made.problem((0.7, 10.0), 3, lens=(0.009, 20.0))
    found = problem.solve()
    wider = problem.expand_over_leans(found)
    up = made.pose.position_m / np.linalg.norm(made.pose.position_m)
    height = np.sqrt(up @ wider.position_covariance_m2 @ up)
    assert 0.8 * 0.009 * 420e3 < height < 1.3 * 0.009 * 420e3


def test_oblique_pictures_keep_the_covariance_of_the_fit():
    made = scene(2, 20, 37.0)
    problem = made.problem((0.7, 10.0), 2)
    found = problem.solve()
    assert problem.expand_over_leans(found) is found
