"""An arc through noisy fixes of a lunar orbit: honest predictions, and what it does when fooled."""

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from optnav_cli.dynamics.arc import OrbitArc, TimedPosition
from optnav_cli.dynamics.forces import Forces, OrbitMotion

MOON = load_body("moon")
START_S = 8.2e8


@pytest.fixture(scope="module")
def orbit():
    return OrbitMotion(Forces(AnalyticEphemeris(MOON)))


def state_at(height_m=100e3, heading=0.8):
    radius = MOON.radius_m + height_m
    speed = np.sqrt(MOON.gm_m3_s2 / radius)
    velocity = speed * np.array([0.0, np.cos(heading), np.sin(heading)])
    return np.concatenate([[radius, 0.0, 0.0], velocity])


def flight(orbit, times, sigma_m, seed=0, state=None):
    """True positions and noisy fixes of them at times, s after the start."""
    state = state_at() if state is None else state
    states, _ = orbit.propagate(state, START_S, START_S + np.asarray(times, dtype=float))
    rng = np.random.default_rng(seed)
    covariance = np.eye(3) * sigma_m**2
    fixes = [
        TimedPosition(START_S + t, reached[:3] + rng.normal(0.0, sigma_m, 3), covariance)
        for t, reached in zip(times, states, strict=True)
    ]
    return states[:, :3], fixes


def test_predictions_lie_within_their_covariance(orbit):
    """Normalised error squared over seeds near its 3; the noise of the field is only stated."""
    errors = []
    for seed in range(12):
        truth, fixes = flight(orbit, [0, 20, 40, 60, 80, 130], 30.0, seed)
        arc = OrbitArc(orbit)
        for fix in fixes[:-1]:
            assert arc.add(fix) is None
        found = arc.predict(fixes[-1].tdb_s)
        assert found.source == "arc of 5 fixes"
        offset = found.position_m - truth[-1]
        errors.append(offset @ np.linalg.solve(found.covariance_m2, offset))
    assert 1.5 < np.mean(errors) < 5.0


def test_a_single_fix_predicts_some_seconds_and_no_minutes(orbit):
    truth, (fix, *_) = flight(orbit, [0, 4, 600], 30.0)
    arc = OrbitArc(orbit)
    assert arc.predict(START_S) is None
    arc.add(fix)
    soon = arc.predict(START_S + 4.0)
    offset = soon.position_m - truth[1]
    assert offset @ np.linalg.solve(soon.covariance_m2, offset) < 16.0
    assert arc.predict(START_S + 600.0) is None


def test_the_uncertainty_grows_with_time_from_the_last_fix(orbit):
    _, fixes = flight(orbit, [0, 30, 60, 90], 20.0)
    arc = OrbitArc(orbit)
    for fix in fixes:
        arc.add(fix)
    sigmas = [np.sqrt(np.trace(arc.predict(START_S + 90 + t).covariance_m2)) for t in (0, 60, 300)]
    assert sigmas[0] < sigmas[1] < sigmas[2]
    assert sigmas[0] < 40.0


def test_one_wrong_fix_is_named_and_left_out(orbit):
    truth, fixes = flight(orbit, [0, 20, 40, 60, 80, 100], 30.0)
    fixes[4] = TimedPosition(
        fixes[4].tdb_s, fixes[4].position_m + [0.0, 3e3, 0.0], fixes[4].covariance_m2
    )
    arc = OrbitArc(orbit)
    contradicted = [arc.add(fix) is not None for fix in fixes]
    assert contradicted == [False] * 4 + [True, False]
    found = arc.predict(START_S + 100.0)
    assert found.source == "arc of 5 fixes"
    assert np.linalg.norm(found.position_m - truth[-1]) < 200.0


@pytest.mark.parametrize("sure", [False, True])
def test_after_a_manoeuvre_the_arc_begins_anew(orbit, sure):
    """40 m/s across the orbit at 90 s, between the fixes at 80 s and 140 s."""
    _, before = flight(orbit, [0, 20, 40, 60, 80], 30.0)
    (turned,), _ = orbit.propagate(state_at(), START_S, np.array([START_S + 90.0]))
    turned = turned + np.concatenate([[0.0] * 3, [40.0, 0.0, 0.0]])
    begin, _ = orbit.propagate(turned, START_S + 90.0, np.array([START_S]))
    truth, after = flight(orbit, [140, 180, 220, 260], 30.0, seed=1, state=begin[0])
    arc = OrbitArc(orbit)
    for fix in before:
        assert arc.add(fix) is None
    said = [arc.add(fix, confirmed=sure) for fix in after]
    ended = [None if odd is None else odd.new_arc for odd in said]
    assert ended == ([True, None, None, None] if sure else [False, True, None, None])
    found = arc.predict(START_S + 260.0)
    assert found.source == "arc of 4 fixes"
    assert np.linalg.norm(found.position_m - truth[-1]) < 200.0


def test_of_two_fixes_at_one_time_the_better_stays(orbit):
    truth, fixes = flight(orbit, [0, 20, 40, 60], 30.0)
    arc = OrbitArc(orbit)
    rng = np.random.default_rng(9)
    for place, fix in zip(truth, fixes, strict=True):
        arc.add(TimedPosition(fix.tdb_s, place + rng.normal(0.0, 2e3, 3), np.eye(3) * 4e6))
        arc.add(fix)
    found = arc.predict(START_S + 60.0)
    assert found.source == "arc of 4 fixes"
    assert np.sqrt(np.trace(found.covariance_m2)) < 60.0


def test_a_long_gap_ends_the_arc(orbit):
    _, fixes = flight(orbit, [0, 20, 40, 6 * 3600.0], 200.0)
    arc = OrbitArc(orbit)
    for fix in fixes[:3]:
        arc.add(fix)
    assert arc.predict(fixes[3].tdb_s) is None
    far = TimedPosition(fixes[3].tdb_s, -fixes[3].position_m, fixes[3].covariance_m2)
    assert arc.add(far) is None
    assert arc.predict(far.tdb_s).source == "arc of one fix"
