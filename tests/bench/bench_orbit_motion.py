"""A day of an orbit with its transition against scipy's DOP853 with the same compiled forces."""

import time

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.dynamics.orbit_integrator import RELATIVE, acceleration
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from tests.bench.timing import in_turn, result, sized, spread, within
from tests.studies.orbit_motion import START_UTC, low_orbit

pytestmark = pytest.mark.bench

ROUNDS = 9
LIMITS_MS = {20: 30.0, 50: 120.0}
MIN_RATIO = {20: 2.0, 50: 1.2}  # scipy's time over ours, without its transition


@pytest.mark.parametrize("degree", LIMITS_MS)
def test_a_day_with_transition_and_an_output_every_five_minutes(degree):
    """288 outputs; scipy follows the state alone, a call of the compiled forces at a time."""
    forces = Forces(AnalyticEphemeris(load_body("moon")), ForcesSettings(degree=degree))
    orbit, start, epoch = OrbitMotion(forces), low_orbit(), utc_to_tdb_s(START_UTC)
    times = epoch + 300.0 * np.arange(1.0, sized(288.0, 12.0) + 1.0)
    span = float(times[-1] - epoch)
    world = forces.world(epoch, float(times[-1]), 0.0, sees_sunlight=False)
    none, out = np.zeros(3), np.empty(3)

    def rates(t, y):
        acceleration(t, y, none, world, out)
        return np.concatenate([y[3:], out])

    def by_scipy():
        bounds = np.array([1e-4] * 3 + [1e-7] * 3)
        solve_ivp(rates, (0.0, span), start, "DOP853", times - epoch, rtol=RELATIVE, atol=bounds)

    calls = {"scipy": by_scipy, "ours": lambda: orbit.propagate(start, epoch, times)}
    spent = in_turn(calls, ROUNDS, time.process_time)
    ratio = spread(np.divide(spent["scipy"], np.maximum(spent["ours"], 1e-6)))
    milliseconds = 1e3 * float(np.median(spent["ours"]))
    result(
        f"a day of an orbit at 100 km with its transition, 288 outputs: field of degree {degree}",
        f"{milliseconds:.1f} ms",
        f"{ratio} × as fast as scipy's DOP853 with the same compiled forces and without the "
        f"transition; limit {LIMITS_MS[degree]:.0f} ms",
    )
    assert within(milliseconds, LIMITS_MS[degree])
    assert within(MIN_RATIO[degree], ratio.median)
