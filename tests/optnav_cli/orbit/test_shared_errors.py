"""Errors that near fixes share: which do, and what an orbit through them says of itself."""

from dataclasses import replace

import numpy as np
import pytest

from optnav_cli.orbit.fit import densify, fit_orbit
from optnav_cli.orbit.motion import ArcMotion, OrbitNoiseSizes, rnb_of
from optnav_cli.orbit.problem import OrbitProblem
from optnav_cli.orbit.settings import NoiseSettings, ParameterSettings
from optnav_cli.orbit.shared_errors import SharedErrorSizes
from tests.optnav_cli.orbit.flights import FORCES, MOON, QUIET, flight

SIZES = SharedErrorSizes(0.8, 12.0)
HIGH_M, SIGMA_M = 2.0 * MOON.radius_m, 15.0


def named(fixes, method="control_points"):
    return [replace(fix, method=method) for fix in fixes]


def shared_of(fixes):
    return OrbitProblem(
        ArcMotion(FORCES, QUIET), fixes, [], [], MOON.radius_m, shared_sizes=SIZES
    ).shared


def fitted(fixes, sizes=SIZES, parameters=()):
    motion = ArcMotion(FORCES, QUIET)
    problem = OrbitProblem(motion, fixes, [], list(parameters), MOON.radius_m, shared_sizes=sizes)
    return fit_orbit(problem, "white", 1e-5)


def test_fixes_over_other_ground_err_for_themselves():
    low = named(flight().fixes)  # 5 minutes apart at 100 km
    assert shared_of(low).width == 0


def test_each_method_shares_its_own_errors_and_no_method_none():
    fixes = flight(minutes=20.0, every_s=60.0, height_m=HIGH_M).fixes
    assert shared_of(fixes).width == 0
    mixed = [*named(fixes[:10]), *named(fixes[10:20], "horizon"), *fixes[20:]]
    shared = shared_of(mixed)
    assert shared.width == 6
    assert shared.group == [0] * 10 + [1] * 10 + [-1]
    covariance = np.diag([4.0, 9.0, 25.0]) + 1.0
    moved, own = shared.split(12, covariance)
    np.testing.assert_allclose(moved @ moved.T + own, covariance)
    assert not moved[:, :3].any()


def test_the_fading_is_that_of_the_angle_about_the_body():
    fixes = named(flight(minutes=20.0, every_s=60.0, height_m=HIGH_M).fixes)
    shared = shared_of(fixes)
    first, last = (fixes[k].position_m / np.linalg.norm(fixes[k].position_m) for k in (0, -1))
    angle = np.degrees(np.arccos(first @ last))
    assert np.prod(shared.fading(shared.times)) == pytest.approx(np.exp(-angle / 12.0), rel=1e-3)


@pytest.mark.parametrize("parameters", [(), (ParameterSettings("acceleration"),)])
def test_an_orbit_by_fixes_with_one_error_does_not_call_it_averaged(parameters):
    """25 fixes moved alike: white errors are called 5 times smaller, these are not."""
    flown = flight(minutes=24.0, every_s=60.0, height_m=HIGH_M)
    moved = np.sqrt(0.8) * SIGMA_M * np.array([1.0, -1.0, 1.0])
    off = []
    for fix, state in zip(flown.fixes, flown.states, strict=True):
        turn = FORCES.motion.body_from_inertial(fix.tdb_s)
        own = np.sqrt(0.2) * (fix.position_m - turn @ state[:3])
        off.append(replace(fix, position_m=turn @ state[:3] + own + moved, method="horizon"))
    white = fitted(off, SharedErrorSizes(0.0, 12.0), parameters)
    common = fitted(off, SIZES, parameters)
    middle = len(off) // 2
    for fit, least, most in ((white, 3.0, np.inf), (common, 0.0, 2.5)):
        error = (fit.trajectory.states[middle] - flown.states[middle])[:3]
        spread = fit.covariances[middle, :3, :3]
        nees = float(error @ np.linalg.solve(spread, error)) / 3.0
        assert least < nees < most
    dense = densify(common, 30.0)
    node = int(np.argmin(np.abs(dense.problem.times - off[middle].tdb_s)))
    np.testing.assert_allclose(dense.covariances[node], common.covariances[middle], rtol=1e-3)
    assert common.last_covariance.shape[0] == 6 + 3 * len(parameters)


def test_what_is_local_adds_to_the_speed_along_the_motion_alone():
    state = flight(minutes=1.0).states[0]
    sizes = OrbitNoiseSizes(1.0, 0.1, 2.0)
    (found,) = ArcMotion(FORCES, NoiseSettings(), sizes=sizes).local(state[None])
    speed = 2.0 * FORCES.unmodelled_speed(state[:3])
    along = rnb_of(state)[1]
    assert not found[:3].any()
    assert along @ found[3:, 3:] @ along == pytest.approx(speed**2)
    assert np.trace(found) == pytest.approx(speed**2)
    assert not ArcMotion(FORCES, QUIET, sizes=sizes).local(state[None]).any()
