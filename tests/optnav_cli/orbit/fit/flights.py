"""Fixes along orbits about the Moon that another integrator flew, and run folders of them."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_from_tdb_s
from optnav_cli.dynamics.forces import Forces
from optnav_cli.fix import Fix, Method, Solution
from optnav_cli.frames.run_settings import FileAttitude, RunSettings, write_run_settings
from optnav_cli.frames.truth import Truth, write_truth
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.problem import OrbitFix, OrbitProblem
from optnav_cli.orbit.fit.settings import NoiseSettings
from optnav_cli.output.tables import write_solutions

MOON = load_body("moon")
EPHEMERIS = AnalyticEphemeris(MOON)
FORCES = Forces(EPHEMERIS)
START_S = 7e8
QUIET = NoiseSettings("white", 1e-12)  # the truth below has the forces of the fit


@dataclass(frozen=True)
class Flight:
    """Times (n,), true inertial states (n, 6), fixes."""

    times: np.ndarray
    states: np.ndarray
    fixes: list[OrbitFix]


def truth(times, height_m=100e3, kick_s=None, kick_m_s=(0.0, 0.0, 0.0)):
    """States (n, 6) by scipy's LSODA with the landed forces of degree 2."""
    return _truth(tuple(map(float, times)), height_m, kick_s, tuple(kick_m_s)).copy()


@cache
def _truth(times, height_m, kick_s, kick_m_s):
    times = np.array(times)
    radius = MOON.radius_m + height_m
    speed = np.sqrt(FORCES.gm / radius)
    state = np.array([radius, 0.0, 0.0, 0.0, 0.3 * speed, np.sqrt(1 - 0.09) * speed])

    def rates(t, y):
        return np.concatenate([y[3:], FORCES.acceleration(t, y[:3])[0]])

    def fly(state, times):
        if len(times) == 1:
            return state[None]
        span = (times[0], times[-1])
        return solve_ivp(rates, span, state, "LSODA", times, rtol=1e-11, atol=1e-6).y.T

    if kick_s is None:
        return fly(state, times)
    at = START_S + kick_s
    before = np.append(times[times < at], at)
    first = fly(state, before)
    kicked = first[-1] + np.concatenate([np.zeros(3), kick_m_s])
    after = np.concatenate([[at], times[times >= at]])
    return np.concatenate([first[:-1], fly(kicked, after)[1:]])


def fixes_of(times, states, sigma_m=15.0, seed=1, camera="unk", run="run", clock_s=0.0, focal=0.0):
    """Fixes with errors drawn; their stamps are early by a clock's offset."""
    rng, found = np.random.default_rng(seed), []
    for number, (time, state) in enumerate(zip(times, states, strict=True)):
        place = EPHEMERIS.body_from_inertial(time) @ state[:3]
        place = place * (1.0 + focal * (1.0 - MOON.radius_m / np.linalg.norm(place)))
        place = place + sigma_m * rng.normal(size=3)
        stamp = time - clock_s
        name = f"{camera}_{number:03d}.png"
        covariance = np.eye(3) * sigma_m**2
        utc = utc_from_tdb_s(stamp, 6)
        found.append(OrbitFix(name, utc, stamp, run, camera, place, covariance))
    return found


def flight(minutes=90.0, every_s=300.0, **how):
    """A flight with its fixes; further words as for `truth` (height, kick) and `fixes_of`."""
    times = START_S + np.arange(0.0, 60.0 * minutes + 1.0, every_s)
    of_truth = {k: how.pop(k) for k in ("height_m", "kick_s", "kick_m_s") if k in how}
    states = truth(times, **of_truth)
    return Flight(times, states, fixes_of(times, states, **how))


def problem(fixes, parameters=(), priors=(), noise=QUIET):
    """What is fitted, with the forces that the truth has."""
    motion = ArcMotion(FORCES, noise)
    return OrbitProblem(motion, list(fixes), list(priors), list(parameters), MOON.radius_m)


def moved(fix, metres):
    return replace(fix, position_m=fix.position_m + np.asarray(metres))


def write_run(folder: Path, fixes, body="moon"):
    """A run folder with these fixes."""
    folder.mkdir(parents=True)
    attitude = FileAttitude("camera_from_body", load_body(body))
    write_run_settings(RunSettings(body, "camera_from_body"), folder)
    rows = [
        Solution(f.file, f.utc, Fix(Method.CONTROL_POINTS, f.position_m, f.covariance_m2))
        for f in fixes
    ]
    write_solutions(folder / "solution.csv", rows, attitude)
    return folder


def write_truth_of(path: Path, times, states):
    """A truth.csv with places of a flight, for its fixes in order and for times after them."""
    frames = FileAttitude("camera_from_body", MOON)
    rows = []
    for number, (time, state) in enumerate(zip(times, states, strict=True)):
        place = EPHEMERIS.body_from_inertial(time) @ state[:3]
        utc = utc_from_tdb_s(time, 6)
        rows.append(Truth(f"unk_{number:03d}.png", utc, time, place, Rotation.identity()))
    write_truth(path, frames, rows)
