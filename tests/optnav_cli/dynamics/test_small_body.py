"""Motion past Phobos, where Mars pulls more than Phobos: against scipy and a truth of its own."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from optnav_cli.dynamics.arc import OrbitArc, TimedPosition
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.dynamics.gravity_field import even_field, kaula_by_gravity
from optnav_cli.simulation.inertial_path import Approach, approach_states
from optnav_cli.simulation.scenario import load_scenario

PHOBOS = load_body("phobos")
MOTION = AnalyticEphemeris(PHOBOS)
NOON = 8.2e8  # TDB s, late in 2025
SHARE_SIGMA = 1e-4  # of the distance: what a limb gives
ROOT = Path(__file__).resolve().parents[3]


@cache
def path():
    """The shipped approach: times and true states about Phobos."""
    scenario = load_scenario(ROOT / "configs" / "scenarios" / "phobos_approach.toml")
    assert isinstance(scenario, Approach)
    return approach_states(scenario, MOTION)


def test_the_path_is_that_of_two_bodies_that_fall_about_mars():
    """Phobos' even field and Mars as points, each body integrated about Mars for itself."""
    gm, mars_gm = PHOBOS.gm_m3_s2, load_body("mars").gm_m3_s2
    even = replace(PHOBOS, gravity=type(PHOBOS.gravity)(j2=0.0, radius_km=11.08, kaula=0.0))
    orbit = OrbitMotion(Forces(AnalyticEphemeris(even)))
    start = np.array([60e3, -20e3, 10e3, -20.0, 5.0, 3.0])

    def rates(t, y):
        mars = MOTION.position_m("mars", NOON + t)
        away = y[:3] - mars
        pull = -gm * y[:3] / np.linalg.norm(y[:3]) ** 3
        tide = -mars_gm * away / np.linalg.norm(away) ** 3 - mars_gm * mars / (mars @ mars) ** 1.5
        return np.concatenate([y[3:], pull + tide])

    wanted = solve_ivp(rates, (0.0, 3000.0), start, "DOP853", rtol=1e-11, atol=1e-6).y[:, -1]
    found = orbit.propagate(start, NOON, np.array([NOON + 3000.0]))[0][0]
    assert np.linalg.norm(found[:3] - wanted[:3]) < 0.05
    # Mars is the greater part of it
    alone = start[:3] + 3000.0 * start[3:]
    assert np.linalg.norm(wanted[:3] - alone) > 10e3


def test_the_tide_s_error_covers_what_a_flattened_mars_and_the_true_shape_do():
    """Predictions from true states over up to 20 minutes, by what the noise says of them.

    Less than the expected 3: the truth's Mars starts where the theory has it, not 0.02 deg off.
    """
    times, states = path()
    orbit = OrbitMotion(Forces(MOTION))
    squares = []
    for first in range(0, len(times) - 1, 6):
        ahead = times[(times > times[first]) & (times < times[first] + 1200.0)]
        there = states[np.searchsorted(times, ahead)]
        found = orbit.propagate(states[first], times[first], ahead)[0]
        for t, true, off in zip(ahead, there, found - there, strict=True):
            spread = orbit.noise(true, t - times[first])[:3, :3]
            squares.append(off[:3] @ np.linalg.solve(spread, off[:3]))
    assert 0.1 < np.mean(squares) < 4.0


@pytest.mark.parametrize(("known", "seeds"), [(True, 2), (False, 1)])
def test_predicted_priors_are_as_good_as_they_say(known, seeds):
    """Normalised error squared near its 3 over an approach, told limbs' noise, and of use.

    known  False: of a body whose file has no [gravity]
    """
    body = PHOBOS if known else replace(PHOBOS, gravity=None)
    orbit = OrbitMotion(Forces(AnalyticEphemeris(body)))
    times, states = path()
    squares, sigmas = [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        arc = OrbitArc(orbit)
        for t, state in zip(times, states, strict=True):
            sigma = SHARE_SIGMA * np.linalg.norm(state[:3])
            found = arc.predict(t)
            if found is not None:
                offset = found.position_m - state[:3]
                squares.append(offset @ np.linalg.solve(found.covariance_m2, offset))
                sigmas.append(np.sqrt(found.covariance_m2.trace()) / np.linalg.norm(state[:3]))
            fix = TimedPosition(t, state[:3] + rng.normal(0.0, sigma, 3), np.eye(3) * sigma**2)
            assert arc.add(fix) is None
    # the first two fixes alone say nothing
    assert len(squares) == seeds * (len(times) - 2)
    assert 1.5 < np.mean(squares) < 4.5
    assert np.median(sigmas) < 10.0 * SHARE_SIGMA


def test_an_unknown_field_is_that_of_the_even_ellipsoid():
    """Mars' J2 is 1.96e-3, Phobos' by its shape 0.105 (see the body files)."""
    for name, share in (("mars", 0.25), ("phobos", 0.05)):
        body = load_body(name)
        assert even_field(body).j2 == pytest.approx(body.gravity.j2, rel=share)
    # Kaula's own planet
    assert kaula_by_gravity(load_body("earth")) == pytest.approx(1e-5, rel=0.02)


def test_fixes_a_day_apart_are_no_arc():
    """Phobos goes round Mars three times a day: what flew past it yesterday says nothing today."""
    arc = OrbitArc(OrbitMotion(Forces(MOTION)))
    place, spread = np.array([0.0, 1.0e6, 0.0]), np.eye(3) * 1e4
    for day in range(4):
        assert arc.predict(NOON + 86400.0 * day) is None
        assert arc.add(TimedPosition(NOON + 86400.0 * day, place, spread)) is None
    assert arc.predict(NOON + 86400.0 * 3 + 1.0) is not None
