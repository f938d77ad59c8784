"""Errors that near fixes share: which do, and what an orbit through them says of itself."""

from dataclasses import replace

import numpy as np
import pytest

from optnav_cli.orbit.fit import parameters as shared_errors
from optnav_cli.orbit.fit.fit import densify, fit_orbit
from optnav_cli.orbit.fit.motion import ArcMotion, OrbitNoiseSizes, rnb_of
from optnav_cli.orbit.fit.parameters import SharedErrorSizes
from optnav_cli.orbit.fit.problem import OrbitProblem
from optnav_cli.orbit.fit.settings import NoiseSettings, ParameterSettings
from tests.optnav_cli.orbit.fit.flights import FORCES, MOON, QUIET, flight

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


def test_cameras_that_look_at_one_time_have_the_better_ones_error_in_common():
    fixes = named(flight().fixes)  # 5 minutes apart at 100 km
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    wide, narrow = np.diag([100.0, 100.0, 400.0]), turn @ np.diag([900.0, 900.0, 50.0]) @ turn.T
    first = [replace(fix, camera="wide", covariance_m2=wide) for fix in fixes]
    beside = [replace(fix, camera="narrow", covariance_m2=narrow) for fix in fixes]
    shared = shared_of([f for pair in zip(first, beside, strict=True) for f in pair])
    assert shared.group == [0] * len(first + beside)
    assert (shared.fading(shared.times)[1::2] < 0.3).all()  # from one time to the next
    moved, own = zip(*(shared.split(k, c) for k, c in enumerate((wide, narrow))), strict=True)
    common = moved[0] @ moved[1].T / SIZES.share
    for one, rest, whole in zip(moved, own, (wide, narrow), strict=True):
        np.testing.assert_allclose(one @ one.T + rest, whole, atol=1e-9)
        assert np.linalg.eigvalsh(rest)[0] > 0.0
        assert np.linalg.eigvalsh(whole - common)[0] > -1e-9
    np.testing.assert_allclose(np.diag(common)[:2], 100.0, rtol=0.5)  # what both know is less


def test_a_long_arc_from_afar_looks_at_few_neighbours_of_each_fix(monkeypatch):
    """From afar all fixes see the same ground: each with each would be a million pairs."""
    calls = []
    within = shared_errors._within_both
    monkeypatch.setattr(shared_errors, "_within_both", lambda a, b: calls.append(1) or within(a, b))
    fixes = named(flight(minutes=10.0, every_s=60.0, height_m=HIGH_M).fixes)
    crowd = [replace(fix, tdb_s=fix.tdb_s + 1e-3 * k) for k in range(100) for fix in fixes[:1]]
    assert shared_of(crowd).group == [0] * 100
    assert len(calls) <= 100 * 2 * shared_errors.MAX_TOGETHER


def test_an_orbit_by_two_cameras_that_err_alike_is_honest():
    """Independent errors would call it a third better than it is by the first camera alone."""
    squares: dict[float, list[float]] = {0.0: [], SIZES.share: []}
    for seed in range(20):
        flown, rng = flight(minutes=60.0, sigma_m=0.0), np.random.default_rng(seed)
        fixes = []
        for fix in flown.fixes:
            common, more = 15.0 * rng.normal(size=3), 5.0 * rng.normal(size=3)
            for camera, error, sigma in (("a", common, 15.0), ("b", common + more, 250.0**0.5)):
                moved = replace(fix, camera=camera, file=f"{camera}_{fix.file}")
                covariance = np.eye(3) * sigma**2
                place = fix.position_m + error
                fixes.append(replace(moved, position_m=place, covariance_m2=covariance))
        middle = len(flown.fixes) // 2
        for share in squares:
            fit = fitted(named(fixes), SharedErrorSizes(share, 12.0))
            error = (fit.trajectory.states[middle] - flown.states[middle])[:3]
            squares[share].append(error @ np.linalg.solve(fit.covariances[middle, :3, :3], error))
    nees = {share: np.mean(found) / 3.0 for share, found in squares.items()}
    assert 0.7 < nees[SIZES.share] < 1.4
    assert nees[0.0] > 1.4


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
