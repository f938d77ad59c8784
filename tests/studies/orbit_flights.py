"""Flights for the study of orbits: truth by scipy's integrator, and fixes with drawn errors.

The forces of the truth are the compiled accelerations, which `make study-orbit_motion` checks
against a field written another way; the path is scipy's DOP853 at 1e-12, not the estimator's.
"""

import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.body import Body, load_body
from catalog.bodies.ephemeris import AnalyticEphemeris, Ephemeris
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import ConfigError
from catalog.geometry.rotations import rnb_axes
from catalog.geometry.vectors import unit
from optnav_cli.dynamics.forces import SUNLIGHT, Forces
from optnav_cli.dynamics.gravity_field import read_field
from optnav_cli.dynamics.orbit_integrator import acceleration
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from optnav_cli.orbit.fit.motion import rnb_of, white
from optnav_cli.orbit.fit.problem import OrbitFix

START_UTC = "2026-01-01T00:00:00Z"
HEIGHT_M = 100e3
SHARED = "OPTNAV_SHARED_DATA"
TOLERANCE = 1e-12
OFF_DEG, LENS = 37.0, 0.009  # of a station's pictures: off the nadir, and a lens that is longer
KICK_S = 30.0  # white noise of the truth is drawn as kicks so far apart
SURE_DEGREE, TRUE_DEGREE, FIELD_ERROR = 20, 90, 0.1
FIELD = "gravity/glgm3150.txt"  # of OPTNAV_SHARED_DATA
MIN_LIT = 24  # fixes of a flight of 12 h, two hours of them
LOWEST_SUN = 0.1  # sine of the Sun's elevation below the craft by which ground is called lit


@lru_cache
def ephemeris_of(name: str) -> Ephemeris:
    """Of a body of configs/bodies, by theory."""
    return AnalyticEphemeris(load_body(name))


@dataclass(frozen=True, eq=False)
class TrueFlight:
    """Times (n,), TDB s, and true inertial states (n, 6)."""

    body: Body
    ephemeris: Ephemeris
    times: FloatArray
    states: FloatArray

    def lit(self) -> BoolArray:
        """(n,) whether the Sun shines on the ground below."""
        return np.array(
            [
                float(unit(state[:3]) @ self.ephemeris.sun_inertial(float(time))) > LOWEST_SUN
                for time, state in zip(self.times, self.states, strict=True)
            ]
        )

    def part(self, kept: BoolArray) -> "TrueFlight":
        """Some of its times."""
        return replace(self, times=self.times[kept], states=self.states[kept])


@dataclass(frozen=True)
class FixErrors:
    """What fixes are wrong by.

    across_m, height_m  1 sigma of noise
    focal               relative error of the focal length
    clock_s             pictures are taken so much later than they say
    """

    across_m: float = 15.0
    height_m: float = 15.0
    focal: float = 0.0
    clock_s: float = 0.0
    camera: str = "unk"


def random_start(rng: np.random.Generator, body: Body, height_m: float) -> FloatArray:
    """A state (6,) on a circular orbit of any plane."""
    up, other = unit(rng.normal(size=3)), rng.normal(size=3)
    radius = body.radius_m + height_m
    speed = float(np.sqrt(body.gm_m3_s2 / radius))
    return np.concatenate([radius * up, speed * rnb_axes(up, other)[1]])


def fly(
    forces: Forces,
    start: FloatArray,
    times: FloatArray,
    push: Callable[[float, FloatArray], FloatArray] | None = None,
    kicks: tuple[np.random.Generator, FloatArray] | None = None,
) -> TrueFlight:
    """The path of a start at the first time.

    push   a further acceleration (3,), inertial, by time and state
    kicks  generator and spectral density (3,), m^2/s^3, of white acceleration along R, N, B
    """
    first, last = float(times[0]), float(times[-1])
    sunlight = float(forces.values()[SUNLIGHT][0])
    world = forces.world(first, last, sunlight, sees_sunlight=False)
    pull, none = np.empty(3), np.zeros(3)

    def rates(t: float, y: FloatArray) -> FloatArray:
        acceleration(t - first, y, none, world, pull)
        return np.concatenate([y[3:], pull if push is None else pull + push(t, y)])

    def path(state: FloatArray, at: FloatArray) -> FloatArray:
        tolerances = np.array([1e-6] * 3 + [1e-9] * 3)
        span = (float(at[0]), float(at[-1]))
        found = solve_ivp(rates, span, state, "DOP853", at, rtol=TOLERANCE, atol=tolerances)
        flown: FloatArray = found.y.T
        return flown

    if kicks is None:
        states = path(start, times)
    else:
        rng, density = kicks
        states = np.empty((len(times), 6))
        states[0] = state = start
        for k in range(len(times) - 1):
            count = max(round(float(times[k + 1] - times[k]) / KICK_S), 1)
            for a in np.linspace(times[k], times[k + 1], count + 1)[:-1]:
                state = path(state, np.array([a, a + (times[k + 1] - times[k]) / count]))[-1]
                axes = rnb_of(state)
                spread = white((axes.T * density) @ axes, KICK_S)
                state = state + np.linalg.cholesky(spread) @ rng.normal(size=6)
            states[k + 1] = state
    return TrueFlight(forces.motion.body, forces.motion, times, states)


def fixes_of(flight: TrueFlight, rng: np.random.Generator, errors: FixErrors) -> list[OrbitFix]:
    """Fixes along a flight: height noise along the vertical, the other across it."""
    found = []
    radius = flight.body.radius_m
    for number, (time, state) in enumerate(zip(flight.times, flight.states, strict=True)):
        place = flight.ephemeris.body_from_inertial(float(time)) @ state[:3]
        up = unit(place)
        noise = errors.across_m * rng.normal(size=3)
        noise += (errors.height_m * rng.normal() - float(noise @ up)) * up
        place = place + noise + errors.focal * (float(np.linalg.norm(place)) - radius) * up
        across, along = errors.across_m**2, errors.height_m**2
        covariance = across * np.eye(3) + (along - across) * np.outer(up, up)
        stamp = float(time) - errors.clock_s
        utc, name = utc_from_tdb_s(stamp), f"{errors.camera}_{number:04d}"
        found.append(OrbitFix(name, utc, stamp, "run", errors.camera, place, covariance))
    return found


def sight_of(place: FloatArray, level: FloatArray, radius_m: float) -> FloatArray:
    """(3,) to a craft at a place (3,) from the ground OFF_DEG off its nadir, towards `level`."""
    ahead = np.cos(np.radians(OFF_DEG)) * -unit(place) + np.sin(np.radians(OFF_DEG)) * level
    along = float(place @ ahead)
    away = -along - np.sqrt(along**2 - float(place @ place) + radius_m**2)
    sight: FloatArray = -away * ahead
    return sight


DAY_SIDE = FixErrors(8.0, 20.0)


def day_fixes(arc: TrueFlight, seed: int) -> list[OrbitFix]:
    """Fixes of the size DAY_SIDE."""
    return fixes_of(arc, np.random.default_rng(seed), DAY_SIDE)


def every(minutes: float, hours: float) -> FloatArray:
    """Times from the start, TDB s."""
    count = round(60.0 * hours / minutes) + 1
    return utc_to_tdb_s(START_UTC) + 60.0 * minutes * np.arange(float(count))


def rough_flights(seed: int, count: int) -> Iterator[tuple[TrueFlight, TrueFlight, int]]:
    """Flights over fields with drawn errors: the lit part of 12 h, all 25 h, and a seed of noise.

    Raises ConfigError without the folder of OPTNAV_SHARED_DATA.
    """
    shared = os.environ.get(SHARED)
    if not shared:
        raise ConfigError(f"flights over another field need {SHARED}; name the folder with {FIELD}")
    found = 0
    with tempfile.TemporaryDirectory() as folder:
        for k in range(2 * count):
            rng = np.random.default_rng((seed, 1000 + k))
            truth = rough_forces(1000 * seed + k, Path(shared), Path(folder))
            start = random_start(rng, truth.motion.body, HEIGHT_M)
            whole = fly(truth, start, every(5.0, 25.0))
            arc = whole.part(whole.times <= whole.times[0] + 12 * 3600.0 + 1.0)
            lit = arc.lit()
            if lit.sum() < MIN_LIT:  # along the terminator nothing is navigated
                continue
            yield arc.part(lit), whole, int(rng.integers(2**31))
            found += 1
            if found == count:
                return


def rough_forces(seed: int, shared: Path, folder: Path) -> Forces:
    """The Moon's field to degree 90 with drawn errors above degree 20, as a file in a folder."""
    ephemeris = ephemeris_of("moon")
    field = read_field(shared / FIELD, ephemeris.body).cut(TRUE_DEGREE)
    rng = np.random.default_rng(seed)
    head = f"{field.radius_m / 1e3},{ephemeris.body.gm_m3_s2 / 1e9},0"
    lines = [f"{head},{TRUE_DEGREE},{TRUE_DEGREE},1,0,0"]
    for n in range(2, TRUE_DEGREE + 1):
        for m in range(n + 1):
            size = FIELD_ERROR if n > SURE_DEGREE else 0.0
            c, s = (v[n, m] * (1.0 + size * rng.normal()) for v in (field.c, field.s))
            lines.append(f"{n},{m},{c:.15e},{s:.15e}")
    path = folder / f"rough_{seed}.tab"
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return Forces(ephemeris, ForcesSettings(degree=TRUE_DEGREE, field=str(path.resolve())))
