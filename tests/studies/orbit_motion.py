"""How exact and how quick the compiled motion about a body is, and what its field leaves out.

The check is written another way: the field by latitude and longitude with the Legendre functions of
scipy, rotation and neighbours by the theories themselves instead of tables, integrated by scipy's
DOP853 at 1e-13.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.special import assoc_legendre_p_all

from catalog.arrays import FloatArray
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import SUN_GM_M3_S2, AnalyticEphemeris, Neighbour
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.progress import Progress
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from tests.studies.tables import StudyReport, StudyTable, columns

START_UTC = "2026-01-01T00:00:00Z"
DEGREES = (2, 20, 50)
HEIGHT_M, INCLINATION_DEG, OUTPUT_S = 100e3, 86.0, 300.0
STEPS = np.array([10.0] * 3 + [0.01] * 3)  # of differences, m and m/s
EXACT, EXACT_M, EXACT_M_S = 1e-13, 1e-6, 1e-9  # tolerances of the check
REPEATS = 5

Rates = Callable[[float, FloatArray], FloatArray]


@dataclass(frozen=True)
class MotionRow:
    """One degree of the field.

    error_m            of the place at the end, against scipy
    transition         of the place by the start, against differences of paths, a share
    milliseconds       of a processor, with transition and an output every 5 minutes
    sigma_m_s2, lasting_s  what the field leaves out at this height
    """

    degree: int
    error_m: float
    transition: float
    milliseconds: float
    sigma_m_s2: float
    lasting_s: float


def run(progress: Progress, hours: float = 24.0) -> list[MotionRow]:
    """A path at 100 km over the Moon by fields of three degrees."""
    rows = []
    with progress.stage("orbit motion", len(DEGREES), "degree") as bar:
        for degree in DEGREES:
            rows.append(one_degree(degree, hours))
            bar.advance()
    return rows


def one_degree(degree: int, hours: float) -> MotionRow:
    """Errors, time and neglected part of a field of one degree."""
    motion = AnalyticEphemeris(load_body("moon"))
    forces = Forces(motion, ForcesSettings(degree=degree))
    orbit, start, epoch = OrbitMotion(forces), low_orbit(), utc_to_tdb_s(START_UTC)
    count = max(int(hours * 3600.0 / OUTPUT_S), 1)
    times = epoch + OUTPUT_S * np.arange(1.0, count + 1.0)
    spent = []
    for _ in range(REPEATS + 1):  # the first compiles and tabulates
        began = time.process_time()
        states, _ = orbit.propagate(start, epoch, times)
        spent.append(time.process_time() - began)
    wanted = exact_place(forces, start, epoch, float(times[-1]))
    error = float(np.linalg.norm(states[-1, :3] - wanted))
    left = forces.unmodelled(start[:3])
    transition = transition_error(orbit, start, epoch, float(times[-1]))
    spent_ms = 1e3 * min(spent[1:])
    return MotionRow(degree, error, transition, spent_ms, left.sigma_m_s2, left.lasting_s)


def transition_error(orbit: OrbitMotion, start: FloatArray, from_s: float, to_s: float) -> float:
    """How far the derivative of the place by the start is off, a share of its size.

    Its equations take the gradient of lower degrees only (`GRADIENT_DEGREE`); the check is the
    difference of whole paths.
    """
    end = np.array([to_s])
    _, transitions = orbit.propagate(start, from_s, end)
    moved = transitions[0, :3] * STEPS
    for k, step in enumerate(np.diag(STEPS)):
        sides = [orbit.propagate(start + sign * step, from_s, end)[0][0, :3] for sign in (1, -1)]
        moved[:, k] -= 0.5 * (sides[0] - sides[1])
    return float(np.linalg.norm(moved) / np.linalg.norm(transitions[0, :3] * STEPS))


def low_orbit() -> FloatArray:
    """A state (6,) on a circular orbit over the Moon."""
    body = load_body("moon")
    radius, tilt = body.radius_m + HEIGHT_M, math.radians(INCLINATION_DEG)
    speed = math.sqrt(body.gm_m3_s2 / radius)
    return np.array([radius, 0.0, 0.0, 0.0, speed * math.cos(tilt), speed * math.sin(tilt)])


def exact_place(forces: Forces, state: FloatArray, from_s: float, to_s: float) -> FloatArray:
    """Where a state leads (3,), by scipy at 1e-13 with the rates below."""
    tolerances = np.array([EXACT_M] * 3 + [EXACT_M_S] * 3)
    rates = reference_rates(forces, from_s)
    found = solve_ivp(rates, (0.0, to_s - from_s), state, "DOP853", rtol=EXACT, atol=tolerances)
    place: FloatArray = found.y[:3, -1]
    return place


def reference_rates(forces: Forces, from_s: float) -> Rates:
    """Rates of a state (6,) about the Moon: field in spherical coordinates, Earth and Sun."""
    motion, field, gm = forces.motion, forces.field, forces.gm
    n, m = np.meshgrid(*2 * [np.arange(field.degree + 1.0)], indexing="ij")
    # scipy's functions have the Condon-Shortley phase and half the squared norm, twice for m > 0
    norm = (-1.0) ** m * np.where(m == 0.0, math.sqrt(2.0), 2.0)
    c, s = np.where(n < 2.0, 0.0, field.c), np.where(n < 2.0, 0.0, field.s)
    others: tuple[tuple[Neighbour, float], ...]
    others = (("earth", load_body("earth").gm_m3_s2), ("sun", SUN_GM_M3_S2))

    def rates(t: float, y: FloatArray) -> FloatArray:
        turn = motion.body_from_inertial(from_s + t)
        place = turn @ y[:3]
        r, rho = float(np.linalg.norm(place)), math.hypot(place[0], place[1])
        sine, cosine = place[2] / r, rho / r
        found = assoc_legendre_p_all(field.degree, field.degree, sine, norm=True, diff_n=1)
        legendre, slope = found[:, :, : field.degree + 1] * norm
        longitudes = m * math.atan2(place[1], place[0])
        even, odd = np.cos(longitudes), np.sin(longitudes)
        falls = gm / r * (field.radius_m / r) ** n
        along, aside = c * even + s * odd, m * (s * even - c * odd)
        up = -gm / r**2 - float((falls * (n + 1.0) * legendre * along).sum()) / r
        east = float((falls * legendre * aside).sum()) / rho
        north = float((falls * slope * along).sum()) * cosine / r
        to_east = np.array([-place[1], place[0], 0.0]) / rho
        to_north = np.cross(place / r, to_east)
        pull = turn.T @ (up * place / r + east * to_east + north * to_north)
        for name, mass in others:
            there = motion.position_m(name, from_s + t)
            gap = there - y[:3]
            pull += mass * (gap / np.linalg.norm(gap) ** 3 - there / np.linalg.norm(there) ** 3)
        return np.concatenate([y[3:], pull])

    return rates


def report(rows: list[MotionRow]) -> StudyReport:
    """A row a degree."""
    heads = columns(
        "degree .0f; error_m = off scipy at 1e-13 [m] .3f; "
        "transition = transition off [%] .3f; milliseconds = with transition [ms] .0f; "
        "sigma = left out, an axis [µm/s²] .1f; lasting = lasts [s] .0f"
    )
    lines = tuple(
        (
            row.degree,
            row.error_m,
            100.0 * row.transition,
            row.milliseconds,
            1e6 * row.sigma_m_s2,
            row.lasting_s,
        )
        for row in rows
    )
    title = f"A path at {HEIGHT_M / 1e3:.0f} km over the Moon, an output every 5 minutes"
    return StudyReport((StudyTable(title, heads, lines),))
