"""Fixes and zenith distances in one fit: better than either, outliers of both left out."""

import numpy as np
import pytest

from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.orbit.fit.fit import densify, fit_orbit
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.problem import OrbitProblem
from tests.optnav_cli.orbit.fit.flights import FORCES, MOON, QUIET, START_S, fixes_of, moved, truth
from tests.optnav_cli.orbit.fit.test_zenith import sights_of

GATE = 1e-5
HEIGHT_M = 1000e3
TIMES = START_S + np.arange(0.0, 4.0 * 3600.0, 120.0)
MOTION = ArcMotion(FORCES, QUIET)


@pytest.fixture(scope="module")
def states():
    return truth(TIMES, height_m=HEIGHT_M)


def both(states, seed=1):
    """Fixes every 20 minutes and zenith distances every 2."""
    fixes = fixes_of(TIMES[::10], states[::10], sigma_m=30.0, seed=seed)
    return fixes, sights_of(TIMES, states, seed=seed + 100)


def fitted(fixes, sights):
    return fit_orbit(
        OrbitProblem(MOTION, fixes, [], [], MOON.radius_m, sights=sights), "white", GATE
    )


def sigma_m(fit):
    return np.sqrt(np.trace(fit.covariances[:, :3, :3], axis1=1, axis2=2).mean())


def errors_m(fit, states):
    nodes = [int(np.argmin(np.abs(fit.problem.times - time))) for time in TIMES[::10]]
    return (fit.trajectory.states[nodes] - states[::10])[:, :3], fit.covariances[nodes][:, :3, :3]


def test_both_together_are_better_than_either_and_as_good_as_stated(states):
    fixes, sights = both(states)
    together = fitted(fixes, sights)
    alone = fitted(fixes, None), fitted([], sights)
    assert sigma_m(together) < 0.9 * min(map(sigma_m, alone))
    assert together.problem.measured == "fixes and zenith distances"
    assert together.count == len(fixes) + len(sights)
    assert 0.7 < together.chi_square / together.degrees_of_freedom < 1.4
    found, covariances = errors_m(together, states)
    assert np.einsum("ni,nij,nj->n", found, np.linalg.inv(covariances), found).max() < 20.0


def test_outliers_of_each_kind_are_left_out(states):
    fixes, sights = both(states)
    fixes[3] = moved(fixes[3], [900.0, 0.0, 0.0])
    sights.values_rad[[10, 60]] += np.array([0.3, -200.0 * ARCSEC])
    fit = fitted(fixes, sights)
    wanted = [3, len(fixes) + 10, len(fixes) + 60]
    assert np.flatnonzero(~fit.is_used).tolist() == wanted


def test_further_nodes_change_neither_the_orbit_nor_its_sigma(states):
    fit = fitted(*both(states))
    dense = densify(fit, 60.0)
    nodes = [int(np.argmin(np.abs(dense.problem.times - time))) for time in fit.problem.times]
    assert len(dense.problem.times) > len(fit.problem.times) + 100
    assert np.allclose(dense.trajectory.states[nodes], fit.trajectory.states, atol=0.05)
    assert np.allclose(dense.covariances[nodes], fit.covariances, rtol=0.05, atol=1e-3)


def test_sights_of_another_flight_than_the_fixes_are_refused(states):
    fixes, _ = both(states)
    other = truth(TIMES, height_m=HEIGHT_M + 20e3)
    with pytest.raises(NoSolutionError, match=r"refute|fit no one orbit|converge"):
        fitted(fixes, sights_of(TIMES, other))
