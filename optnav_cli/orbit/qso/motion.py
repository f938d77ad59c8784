"""How a craft moves beside a moon: the difference of two paths about the planet.

Axes are inertial, the origin is the moon's centre, which moves as the theory of its file says. The
planet pulls craft and moon, both with its flattening: only the difference is felt. The moon adds
its own field. Left out: the Sun's tide (1e-8 of the planet's) and what the moon's flattening does
to its own orbit (1e-5 of the tide at 60 km from Phobos).

Steps are those of DOP853 (Hairer, Norsett, Wanner, "Solving Ordinary Differential Equations I",
coefficients as scipy has them) of a length that is set before: what depends on time alone is made
once for all flights of a search. 900 s about Phobos leave 1e-4 m in five days at 60 km.
"""

from typing import Literal, NamedTuple

import numpy as np
from scipy.integrate import DOP853

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, load_body
from catalog.bodies.ephemeris import compute_planet_position
from catalog.bodies.epochs import DAY_S
from catalog.bodies.rotation import body_from_inertial
from catalog.errors import ConfigError
from catalog.geometry.kernel import kernel
from optnav_cli.dynamics.gravity_field import HarmonicField
from optnav_cli.dynamics.gravity_kernel import Table, harmonic_tables, pull

STAGES = 12
_A = np.ascontiguousarray(DOP853.A[:STAGES, :STAGES], dtype=np.float64)
_B = np.ascontiguousarray(DOP853.B[:STAGES], dtype=np.float64)
_C = np.ascontiguousarray(DOP853.C[:STAGES], dtype=np.float64)
_RATE_S = 1.0  # half the time over which the turn of the frame is differenced


class FlightTable(NamedTuple):
    """Quantities of time alone, at each stage of each step (n, STAGES, ...).

    steps_s      (n,) lengths
    planet_m     (..., 3) the planet's centre from the moon's
    own_pull     (..., 3) the planet's pull on the moon, m/s^2
    shape        (..., 3, 3) the moon's second degree, inertial axes, see `Forces`
    moon_turn    (..., 3, 3) body_from_inertial of the moon
    """

    steps_s: FloatArray
    planet_m: FloatArray
    own_pull: FloatArray
    shape: FloatArray
    moon_turn: FloatArray


class PairConstants(NamedTuple):
    """Planet and moon as kernels take them; lengths m, m^3/s^2.

    planet_shape  (3, 3) the planet's second degree, inertial axes, times its radius squared
    radius_m      of the moon's field
    field         what `gravity_kernel.pull` sums of it; empty without
    """

    planet_gm: float
    moon_gm: float
    planet_shape: FloatArray
    radius_m: float
    field: Table


Vector = tuple[float, float, float]


@kernel
def _pull(gm: float, shape: FloatArray, x: float, y: float, z: float) -> Vector:
    """Pull of V = gm (1/r + x'Ax / r^5): a point mass and its second degree."""
    squared = x * x + y * y + z * z
    cube = gm / (squared * np.sqrt(squared))
    a = shape[0, 0] * x + shape[0, 1] * y + shape[0, 2] * z
    b = shape[1, 0] * x + shape[1, 1] * y + shape[1, 2] * z
    c = shape[2, 0] * x + shape[2, 1] * y + shape[2, 2] * z
    flat = cube / squared
    radial = cube + 5.0 * flat / squared * (x * a + y * b + z * c)
    twice = 2.0 * flat
    return twice * a - radial * x, twice * b - radial * y, twice * c - radial * z


@kernel
def _add_gradient(gm: float, shape: FloatArray, x: FloatArray, gradient: FloatArray) -> None:
    """Add the derivative (3, 3) of that pull by the place."""
    squared = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
    cube = gm / (squared * np.sqrt(squared))
    flat = cube / squared
    bent = shape @ x
    q = (x[0] * bent[0] + x[1] * bent[1] + x[2] * bent[2]) / squared
    for i in range(3):
        for j in range(3):
            value = 2.0 * shape[i, j] - 10.0 * (bent[i] * x[j] + x[i] * bent[j]) / squared
            value += (35.0 * q + 3.0 * squared) * x[i] * x[j] / squared
            gradient[i, j] += flat * value
        gradient[i, i] -= cube + 5.0 * flat * q


@kernel
def _rates(
    y: FloatArray,
    planet: FloatArray,
    own_pull: FloatArray,
    shape: FloatArray,
    turn: FloatArray,
    pair: PairConstants,
    out: FloatArray,
) -> None:
    """Derivative of a state (6,) or of a state with its transition (42,), row by row."""
    offset = y[0] - planet[0], y[1] - planet[1], y[2] - planet[2]
    far = _pull(pair.planet_gm, pair.planet_shape, offset[0], offset[1], offset[2])
    near = _pull(pair.moon_gm, shape, y[0], y[1], y[2])
    for i in range(3):
        out[i] = y[3 + i]
    out[3] = far[0] + near[0] - own_pull[0]
    out[4] = far[1] + near[1] - own_pull[1]
    out[5] = far[2] + near[2] - own_pull[2]
    if pair.field[1].shape[0] > 0:
        felt = np.empty(3)
        position = turn @ np.array([y[0], y[1], y[2]])
        pull(position, (pair.moon_gm, pair.radius_m), pair.field, felt)
        inertial = turn.T @ felt
        for i in range(3):
            out[3 + i] += inertial[i]
    if y.size == 42:
        gradient = np.zeros((3, 3))
        _add_gradient(pair.planet_gm, pair.planet_shape, np.array(offset), gradient)
        _add_gradient(pair.moon_gm, shape, np.array([y[0], y[1], y[2]]), gradient)
        for j in range(6):
            for i in range(3):
                out[6 + 6 * i + j] = y[6 + 6 * (3 + i) + j]
                value = 0.0
                for k in range(3):
                    value += gradient[i, k] * y[6 + 6 * k + j]
                out[6 + 6 * (3 + i) + j] = value


@kernel
def fly(
    start: FloatArray,
    table: FlightTable,
    pair: PairConstants,
    limits_m: tuple[float, float],
    out: FloatArray,
) -> int:
    """Write states after each step into out (n, k); how many steps were made.

    The flight ends where the distance leaves the limits, m.
    """
    k = start.size
    y, at = start.copy(), np.empty(k)
    rates = np.empty((STAGES, k))
    for n in range(table.steps_s.size):
        h = table.steps_s[n]
        for stage in range(STAGES):
            for i in range(k):
                value = 0.0
                for before in range(stage):
                    value += _A[stage, before] * rates[before, i]
                at[i] = y[i] + h * value
            _rates(
                at,
                table.planet_m[n, stage],
                table.own_pull[n, stage],
                table.shape[n, stage],
                table.moon_turn[n, stage],
                pair,
                rates[stage],
            )
        for i in range(k):
            value = 0.0
            for stage in range(STAGES):
                value += _B[stage] * rates[stage, i]
            y[i] += h * value
            out[n, i] = y[i]
        distance = np.sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
        if not (limits_m[0] < distance < limits_m[1]):
            return n + 1
    return int(table.steps_s.size)


class MoonMotion:
    """Motion beside a moon of a planet; states (6,) inertial, from the moon's centre, m, m/s."""

    def __init__(
        self,
        moon: Body,
        planet_flattening: bool = True,
        field: HarmonicField | Literal["point", "body"] = "body",
    ) -> None:
        """field  of the moon: a point mass, J2 and C22 of its body file, or coefficients.

        Raises ConfigError for a body without an orbit about a planet.
        """
        if moon.orbit is None:
            raise ConfigError(
                f"{moon.name}: its body file has no [orbit] about a planet; name a moon that has "
                "one, such as phobos"
            )
        self.moon, self.orbit = moon, moon.orbit
        self.planet = load_body(moon.orbit.around)
        gravity = moon.gravity if field == "body" else None
        self._diagonal = np.zeros(3)
        if gravity is not None:
            lines = [
                gravity.j2 / 2.0 + 3.0 * gravity.c22,
                gravity.j2 / 2.0 - 3.0 * gravity.c22,
                -gravity.j2,
            ]
            self._diagonal = (gravity.radius_km * 1e3) ** 2 * np.array(lines)
        radius_m, table = 1.0, (np.zeros((0, 0)), np.zeros(0))
        if isinstance(field, HarmonicField):
            radius_m, table = field.radius_m, harmonic_tables(field, field.degree)[0]
        flat = self.planet.gravity if planet_flattening else None
        shape = np.zeros((3, 3))
        if flat is not None:
            pole = body_from_inertial(self.planet, 0.0)[2]
            shape = 0.5 * flat.j2 * (np.eye(3) - 3.0 * np.outer(pole, pole))
            shape *= (flat.radius_km * 1e3) ** 2
        self.pair = PairConstants(self.planet.gm_m3_s2, moon.gm_m3_s2, shape, radius_m, table)

    @property
    def mean_motion(self) -> float:
        """The mean rate at which the moon goes round and turns, rad/s."""
        return float(np.radians(self.moon.rotation.meridian_deg_by_day[1]) / DAY_S)

    def planet_m(self, tdb_s: FloatArray) -> FloatArray:
        """The planet's centre (n, 3) from the moon's, inertial."""
        turns = body_from_inertial(self.moon, tdb_s)
        places = compute_planet_position(self.moon, self.orbit, tdb_s)
        planet: FloatArray = np.einsum("nji,nj->ni", turns.reshape(-1, 3, 3), places)
        return planet

    def turning_from_inertial(self, tdb_s: FloatArray) -> FloatArray:
        """Rotations (n, 3, 3) to the turning frame.

        x from the planet's centre to the moon's, y along the moon's motion, z up.
        """
        x = -self.planet_m(tdb_s)
        x /= np.linalg.norm(x, axis=1)[:, None]
        z = body_from_inertial(self.moon, np.atleast_1d(tdb_s))[:, 2]
        return np.stack([x, np.cross(z, x), z], axis=1)

    def turning_rates(self, tdb_s: float) -> tuple[float, float]:
        """Return rates of the turning frame, rad/s, and of the planet's distance, m/s."""
        times = np.array([tdb_s - _RATE_S, tdb_s + _RATE_S])
        before, after = self.turning_from_inertial(times)
        gone = np.linalg.norm(self.planet_m(times), axis=1)
        angle = float(np.arcsin(before[1] @ after[0]))
        return angle / (2.0 * _RATE_S), float(gone[1] - gone[0]) / (2.0 * _RATE_S)

    def table(self, times: FloatArray) -> FlightTable:
        """For a flight that steps from each of the times (n + 1,), TDB s, to the next."""
        steps = np.diff(times)
        stages = times[:-1, None] + steps[:, None] * _C
        turns = body_from_inertial(self.moon, stages)
        planet = self.planet_m(stages.ravel()).reshape(*stages.shape, 3)
        distance = np.linalg.norm(planet, axis=-1, keepdims=True)
        own_pull = self.pair.planet_gm * planet / distance**3
        if self.pair.planet_shape.any():
            bent = -planet @ self.pair.planet_shape
            q = np.einsum("...i,...i->...", -planet, bent)[..., None]
            flat = 2.0 * bent / distance**5 + 5.0 * q * planet / distance**7
            own_pull = own_pull + self.pair.planet_gm * flat
        shape = np.einsum("...ki,k,...kj->...ij", turns, self._diagonal, turns)
        tables = (np.ascontiguousarray(v) for v in (steps, planet, own_pull, shape, turns))
        return FlightTable(*tables)

    def propagate(
        self, state: FloatArray, times: FloatArray, max_step_s: float, transition: bool = False
    ) -> FloatArray:
        """States (n, 6) at times (n,) from the first on, TDB s; with transitions (n, 42).

        state  (6,) at the first time. Times run on or back. NaN after a path meets the centre.
        """
        gaps = np.diff(times)
        pieces = np.maximum(np.ceil(np.abs(gaps) / max_step_s), 1).astype(np.int64)
        ends = np.concatenate([[0], np.cumsum(pieces)])
        grid = np.interp(np.arange(ends[-1] + 1), ends, times)
        start = np.asarray(state, dtype=np.float64)
        if transition:
            start = np.concatenate([start, np.eye(6).ravel()])
        out: FloatArray = np.full((len(grid), start.size), np.nan)
        out[0] = start
        fly(start, self.table(grid), self.pair, (1.0, 1e12), out[1:])
        asked: FloatArray = out[ends]
        return asked


def split(states: FloatArray) -> tuple[FloatArray, FloatArray]:
    """States (n, 6) and transitions (n, 6, 6) of what `propagate` gives with transitions."""
    return states[:, :6], states[:, 6:].reshape(-1, 6, 6)
