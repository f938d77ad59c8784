"""Forces on a craft near a body, and its orbit: gravity field, tides, sunlight, thrust; the rest.

By itself the terms of the body's file and tides; [forces] of a file asks for more. What the field
leaves out is known in size only: by Kaula's rule (Kaula, "Theory of Satellite Geodesy", 1966) the
normalised coefficients of degree n are about kaula / n^2. A craft meets it as noise that changes
while it flies over a wavelength. With J2 and C22 alone it is 0.8 mm/s^2 at 100 km over the Moon,
the neglected sunlight pressure 1e-4 of that. About a moon near its planet the planet's tide is the
larger force, and what is wrong with it lasts: at 300 km from Phobos 0.03 of 30 mm/s^2.

A body whose file has no [gravity] is taken for its ellipsoid at even density. That gives Mars' J2
to 20 %, Phobos' to 4 %; what is left out then begins with degree 2, of the size that Kaula's rule
has on a body of such gravity.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray, IntArray
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import SUN_GM_M3_S2, Ephemeris, Neighbour
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.dynamics.gravity_field import (
    even_field,
    kaula_by_gravity,
    named_field,
    oblate_field,
)
from optnav_cli.dynamics.gravity_kernel import GRADIENT_DEGREE, harmonic_tables
from optnav_cli.dynamics.orbit_integrator import (
    FOLLOWED,
    TOO_DEEP,
    acceleration,
    follow,
    follow_legs,
    slopes,
)
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from optnav_cli.dynamics.orbit_tables import ArcTables, ArcWorld
from optnav_cli.reasons import ReasonCode

# The last degree summed by Kaula's rule; the field falls off with height: the last hardly matter.
LAST_DEGREE, BEYOND_FIELD = 120, 50
# Above it coefficients without stated errors have those of [forces] field_error.
SURE_DEGREE = 20
# Whose tides count beside the Sun's.
NEIGHBOURS: dict[str, tuple[Neighbour, ...]] = {"moon": ("earth",), "earth": ("moon",)}
OBLATE = ForcesSettings(degree=2)  # what predictions between pictures need
ACCELERATION, SUNLIGHT, THRUST = "acceleration", "srp", "thrust_"
# Of the Moon's principal axes against its mean-Earth axes, about z, y, x in turn: DE421, as
# TKFRAME_31007_ANGLES of NAIF's moon_080317.tf. DE440's differ by 0.3".
PRINCIPAL_ARCSEC = (67.92, 78.56, 0.30)


@dataclass(frozen=True, eq=False)
class Unmodelled:
    """The acceleration left out: its size, 1 sigma an axis, m/s^2, and for how long it lasts, s."""

    sigma_m_s2: float
    lasting_s: float

    @property
    def spectral_density(self) -> float:
        """Density of white noise that moves a craft as far in the long run, m^2/s^3 per axis."""
        return 2.0 * self.sigma_m_s2**2 * self.lasting_s


class Forces:
    """Accelerations about one body, inertial axes, origin at its centre."""

    def __init__(
        self, motion: Ephemeris, settings: ForcesSettings = OBLATE, beside: Path = Path()
    ) -> None:
        """Prepare the forces that move a craft.

        motion  of the body; its file may leave [gravity] out, see above
        beside  the folder that the field's file is looked for from

        Raises DataError for a field that is not there, whole or of this body, ConfigError for
        thrust at impossible times.
        """
        body = motion.body
        settings.check()
        self.motion, self.settings = motion, settings
        self.gm = body.gm_m3_s2
        self._gravity = body.gravity or even_field(body)
        field = named_field(body, settings, beside)
        self.field = field or oblate_field(self._gravity, f"gravity of {body.name}'s file")
        self._radius_m = self._gravity.radius_km * 1e3
        self._tables = harmonic_tables(self.field, min(self.field.degree, GRADIENT_DEGREE))
        kaula = self._gravity.kaula
        self._kaula = kaula_by_gravity(body) if kaula is None else kaula
        self._left_out = self._coefficients_left_out(
            whole=field is not None, known=field is not None or bool(body.gravity)
        )
        planet: tuple[Neighbour, ...] = () if body.orbit is None else (body.orbit.around,)
        names: list[Neighbour] = [*NEIGHBOURS.get(body.name, ()), *planet]
        bodies = [load_body(name) for name in names]
        self._gms = np.array([*(other.gm_m3_s2 for other in bodies), SUN_GM_M3_S2])
        self._radii_m = np.array([*(other.radius_m for other in bodies), 0.0])
        turn = np.eye(3)
        if settings.field_frame == "principal_axes":
            turn = _principal_from_mean_earth()
        self._arcs = ArcTables(motion, [*names, "sun"], turn)
        self._thrusts = [(*arc.times_s, np.array(arc.acceleration_m_s2)) for arc in settings.thrust]
        self._tide_error = self.planet_rate = 0.0  # the rate: rad/s of the body's own orbit
        if body.orbit is not None:
            square = load_body(body.orbit.around).gm_m3_s2
            square /= (1e3 * body.orbit.semi_major_axis_km) ** 3
            self.planet_rate = float(np.sqrt(square))
            # along the line to the planet, where its tide is strongest
            self._tide_error = 2.0 * body.orbit.tide_error * square

    def values(self) -> dict[str, FloatArray]:
        """Return the parameters that may be estimated, by name, as the settings state them.

        "acceleration" along R, N, B, m/s^2; "srp", area over mass times reflectivity, m^2/kg;
        "thrust_1", the acceleration along R, N, B of the first arc of thrust.
        """
        sunlight = self.settings.sunlight
        parameters = {
            ACCELERATION: np.zeros(3),
            SUNLIGHT: np.array([0.0 if sunlight is None else sunlight.strength_m2_kg]),
        }
        return parameters | {f"{THRUST}{k}": arc[2] for k, arc in enumerate(self._thrusts, start=1)}

    def world(
        self, from_s: float, last_s: float, sunlight: float, *, sees_sunlight: bool
    ) -> ArcWorld:
        """All that moves a craft from one time to another, as the kernels take it."""
        start, pieces = self._arcs.span(min(from_s, last_s), max(from_s, last_s))
        pulls, gradients = self._tables
        rotations, turns, places = pieces
        return ArcWorld(
            self.gm,
            self.field.radius_m,
            pulls,
            gradients,
            start - from_s,
            self._arcs.spacing_s,
            rotations,
            turns,
            places,
            self._gms,
            self._radii_m,
            self.motion.body.radius_m,
            sunlight,
            sees_sunlight or sunlight != 0.0,
        )

    @cached_property
    def switches(self) -> FloatArray:
        """When arcs of thrust begin and end, TDB s, in order."""
        return np.unique([time for arc in self._thrusts for time in arc[:2]])

    def burning(self, tdb_s: float) -> list[str]:
        """Names of the arcs of thrust that a time lies in."""
        arcs = enumerate(self._thrusts, start=1)
        return [f"{THRUST}{k}" for k, (start, end, _) in arcs if start < tdb_s < end]

    def acceleration(self, tdb_s: float, position_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Acceleration (3,), m/s^2, and its derivative (3, 3) by position at an inertial place.

        Without thrust; the derivative is that of the field's lower degrees.
        """
        state = np.concatenate([position_m, np.zeros(3)])
        sunlight = float(self.values()[SUNLIGHT][0])
        pull, slope, none = np.empty(3), np.empty((3, 10)), np.zeros(3)
        world = self.world(tdb_s, tdb_s, sunlight, sees_sunlight=False)
        acceleration(0.0, state, none, world, pull)
        slopes(0.0, state, none, world, slope)
        return pull, slope[:, :3]

    def unmodelled(self, position_m: FloatArray) -> Unmodelled:
        """Estimate the forces left out at a place, by Kaula's rule and the field's errors."""
        sigmas, lasting = self._unmodelled(np.array([np.linalg.norm(position_m)]))
        return Unmodelled(float(sigmas[0]), float(lasting[0]))

    def densities(self, positions_m: FloatArray) -> FloatArray:
        """(n,) spectral densities of what is left out at places (n, 3); see `Unmodelled`."""
        sigmas, lasting = self._unmodelled(np.linalg.norm(positions_m, axis=1))
        spectral: FloatArray = 2.0 * sigmas**2 * lasting
        return spectral

    def _unmodelled(self, distances_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        n, _, pulls = self._left_out
        falls = self._radius_m / np.maximum(distances_m, self._radius_m)
        share = pulls * falls[:, None] ** (2.0 * n)
        total = share.sum(axis=1)
        degrees = (share * n).sum(axis=1) / total
        lasting = distances_m / (np.sqrt(self.gm / distances_m) * degrees)
        return self.gm / distances_m**2 * np.sqrt(total / 3.0), lasting

    def unmodelled_speed(self, position_m: FloatArray) -> float:
        """1 sigma, m/s, of a circular orbit's speed by the potential left out; see `unmodelled`."""
        distance = float(np.linalg.norm(position_m))
        n, sizes, _ = self._left_out
        share = (2.0 * n + 1.0) * sizes**2
        share = share * (self._radius_m / max(distance, self._radius_m)) ** (2.0 * n)
        return float(np.sqrt(self.gm / distance * share.sum()))

    def tide_error_m_s2(self, positions_m: FloatArray) -> FloatArray:
        """(...) of a planet's tide at places (..., 3): what is wrong with it for hours, 1 sigma an
        axis; 0 without one."""
        error: FloatArray = self._tide_error * np.linalg.norm(positions_m, axis=-1)
        return error

    def _coefficients_left_out(
        self, *, known: bool, whole: bool = True
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Degrees, the rms of their coefficients' errors and their shares of the pull squared.

        All of a coefficient is an error above the field's degree.

        whole  whether the field has all orders of its degrees; otherwise zonal ones from degree 3
        known  whether the field is the body's own, so that degree 2 is in it
        """
        top = self.field.degree
        n = np.arange(3.0 if known else 2.0, max(LAST_DEGREE, top + BEYOND_FIELD) + 1.0)
        sizes = self._kaula / n**2
        inside = n <= top
        if not known:
            pass  # the ellipsoid's degree 2 is a guess: all of it may be wrong
        elif not whole:
            zonal = self.field.c[n[inside].astype(int), 0] != 0.0
            sizes[inside] *= np.sqrt(1.0 - zonal / (2.0 * n[inside] + 1.0))
        elif self.field.errors is not None:
            sizes[inside] = self.field.errors[n[inside].astype(int)]
        else:
            sizes[inside] *= np.where(n[inside] > SURE_DEGREE, self.settings.field_error, 0.0)
        kept = sizes > 0.0
        n, sizes = n[kept], sizes[kept]
        return n, sizes, (n + 1.0) * (2.0 * n + 1.0) ** 2 * sizes**2


def _principal_from_mean_earth() -> FloatArray:
    """Rotation (3, 3): mean Earth = Rx(-a) Ry(-b) Rz(-c) of principal axes, turns of the axes."""
    z, y, x = (angle * ARCSEC for angle in PRINCIPAL_ARCSEC)
    # scipy turns vectors: axes turned by -c are vectors turned by +c
    principal: FloatArray = Rotation.from_euler("zyx", [z, y, x]).as_matrix()
    return principal.T


class OrbitMotion:
    """Motion about a body; states are inertial position (m) and velocity (m/s)."""

    def __init__(self, forces: Forces, values: Mapping[str, FloatArray] | None = None) -> None:
        """values  of forces other than the settings', by the names of `Forces.values`."""
        self._forces = forces
        self._values = forces.values() | dict(values or {})

    def with_values(self, values: Mapping[str, FloatArray]) -> "OrbitMotion":
        """Return this motion with other values of some parameters."""
        return OrbitMotion(self._forces, self._values | dict(values))

    @property
    def values(self) -> dict[str, FloatArray]:
        """Values of the parameters of the forces, by name."""
        return dict(self._values)

    def propagate(
        self, state: FloatArray, from_s: float, to_s: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """States (n, 6) at other times, and their derivatives (n, 6, 6) by the first.

        state (6,) at from_s; to_s (n,) before or after it, in any order, TDB s.
        Raises NoSolutionError when the path cannot be followed, as into the body's centre.
        """
        states, transitions, _ = self.partials(state, from_s, to_s, ())
        return states, transitions

    def partials(
        self, state: FloatArray, from_s: float, to_s: FloatArray, parameters: Sequence[str]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Propagate as `propagate` does, with derivatives (n, 6, p) by parameters of the forces.

        parameters  names of `Forces.values`; their components follow each other
        """
        columns = self._columns(parameters)
        first = np.zeros(6 + 6 * (6 + len(columns[0])))
        first[:6] = state
        first[6:].reshape(6, -1)[:, :6] = np.eye(6)
        paths = self._paths(first, from_s, to_s, columns)
        derivatives = paths[:, 6:].reshape(len(paths), 6, -1)
        return paths[:, :6], derivatives[:, :, :6], derivatives[:, :, 6:]

    def legs(
        self,
        states: FloatArray,
        from_s: FloatArray,
        to_s: FloatArray,
        counts: IntArray,
        parameters: Sequence[str],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Propagate as `partials` does, from each of states (n, 6) at times (n,).

        to_s    (m,) times of one leg after the other, ever later;  counts  (n,) how many each has
        """
        columns = self._columns(parameters)
        first = np.zeros((len(states), 6 + 6 * (6 + len(columns[0]))))
        first[:, :6] = states
        first[:, 6:].reshape(len(states), 6, -1)[:, :, :6] = np.eye(6)
        if len(self._forces.switches):
            parts = np.split(to_s, np.cumsum(counts)[:-1])
            paths = np.concatenate(
                [
                    self._path(start, float(since), to - since, columns)
                    for start, since, to in zip(first, from_s, parts, strict=True)
                ]
            )
        else:
            paths = self._legs(first, from_s, (to_s, counts), columns)
        derivatives = paths[:, 6:].reshape(len(paths), 6, -1)
        return paths[:, :6], derivatives[:, :, :6], derivatives[:, :, 6:]

    def states(self, state: FloatArray, from_s: float, to_s: FloatArray) -> FloatArray:
        """Propagate without the derivatives, in five sixths of the time of `propagate`."""
        return self._paths(state, from_s, to_s, self._columns(()))

    def _paths(
        self,
        first: FloatArray,
        from_s: float,
        to_s: FloatArray,
        columns: tuple[IntArray, list[str]],
    ) -> FloatArray:
        """(n, k) of a path from `first` (k,) to times in any order, to either side."""
        since = np.asarray(to_s, dtype=np.float64) - from_s
        paths = np.empty((len(since), len(first)))
        paths[:] = first
        for side in (since > 0.0, since < 0.0):
            if len(since) == 1 and side[0]:
                paths = self._path(first, from_s, since, columns)
            elif side.any():
                times, index = np.unique(since[side], return_inverse=True)
                order = slice(None, None, -1 if times[0] < 0.0 else 1)
                path = self._path(first, from_s, times[order], columns)[order]
                paths[side] = path[index]
        return paths

    def noise(self, state: FloatArray, seconds: float) -> FloatArray:
        """Covariance (6, 6) that the forces left out add in a time.

        The rough field as white acceleration, the error of a planet's tide as a steady one.
        """
        t = abs(seconds)
        density = self._forces.unmodelled(state[:3]).spectral_density
        steady = self._forces.tide_error_m_s2(state[:3]) ** 2
        block = density * np.array([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]])
        block += steady * np.array([[t**4 / 4.0, t**3 / 2.0], [t**3 / 2.0, t**2]])
        if seconds < 0.0:
            block[0, 1] = block[1, 0] = -block[0, 1]
        return np.kron(block, np.eye(3)).astype(np.float64)

    def circular_speed(self, position_m: FloatArray) -> float:
        """Return the speed of a circular orbit through a place, m/s."""
        return float(np.sqrt(self._forces.gm / np.linalg.norm(position_m)))

    def radian_s(self, position_m: FloatArray) -> float:
        """Return the time per radian of a circular orbit there, or of the body's own orbit, s.

        The shorter of both rules: far from a small moon its planet bends the path.
        """
        return float(self.radians_s(position_m[None])[0])

    def radians_s(self, positions_m: FloatArray) -> FloatArray:
        """Return `radian_s` (n,) of places (n, 3)."""
        squared_rates = self._forces.gm / np.linalg.norm(positions_m, axis=1) ** 3
        durations: FloatArray = 1.0 / np.sqrt(squared_rates + self._forces.planet_rate**2)
        return durations

    def _columns(self, parameters: Sequence[str]) -> tuple[IntArray, list[str]]:
        """List for each component of parameters its direction and its parameter."""
        kinds: list[int] = []
        owners: list[str] = []
        for name in parameters:
            size = len(self._values[name])
            kinds += [3] if name == SUNLIGHT else list(range(size))
            owners += [name] * size
        return np.array(kinds, dtype=np.int64), owners

    def _path(
        self,
        first: FloatArray,
        from_s: float,
        since: FloatArray,
        columns: tuple[IntArray, list[str]],
    ) -> FloatArray:
        """(n, k) of a path from `first` (k,) to times ever farther to one side."""
        times = np.ascontiguousarray(since)  # one kind of array to compile
        last = float(since[-1])
        kinds, owners = columns
        switches = self._forces.switches
        if len(switches):
            stops = switches - from_s
            stops = stops[(stops * last > 0.0) & (abs(stops) < abs(last))]
            times = np.union1d(since, stops)
            times = times[np.argsort(abs(times))]
        thrusts, acting = np.empty((len(times), 3)), np.empty((len(times), len(kinds)), np.int64)
        thrusts[:], acting[:] = self._values[ACCELERATION], kinds
        if len(switches):
            lasting = np.array([not name.startswith(THRUST) for name in owners], dtype=bool)
            middles = 0.5 * (times + np.concatenate([[0.0], times[:-1]]))
            for number, middle in enumerate(middles):
                burning = self._forces.burning(from_s + float(middle))
                thrusts[number] += sum((self._values[name] for name in burning), np.zeros(3))
                on = lasting | np.isin(owners, burning)
                acting[number] = np.where(on, kinds, -1)
        world, out = self._world(from_s, last, owners), np.empty((len(times), len(first)))
        _check(follow(first, 0.0, times, (thrusts, acting), world, out), out, last)
        return out[np.isin(times, since)] if len(switches) else out

    def _legs(
        self,
        first: FloatArray,
        from_s: FloatArray,
        to_s: tuple[FloatArray, IntArray],
        columns: tuple[IntArray, list[str]],
    ) -> FloatArray:
        """(m, k) of paths from each of `first` (n, k), without arcs of thrust."""
        begin, (kinds, owners) = float(from_s[0]), columns
        since, counts = to_s[0] - begin, to_s[1]
        thrusts, acting = np.empty((len(since), 3)), np.empty((len(since), len(kinds)), np.int64)
        thrusts[:], acting[:] = self._values[ACCELERATION], kinds
        last = float(since[-1])
        world, out = self._world(begin, last, owners), np.empty((len(since), first.shape[1]))
        forces = thrusts, acting
        _check(follow_legs(first, from_s - begin, (since, counts), forces, world, out), out, last)
        return out

    def _world(self, from_s: float, last_s: float, owners: list[str]) -> ArcWorld:
        sunlight = float(self._values[SUNLIGHT][0])
        lit = SUNLIGHT in owners
        return self._forces.world(from_s, from_s + last_s, sunlight, sees_sunlight=lit)


def _check(outcome: int, path: FloatArray, last_s: float) -> None:
    """Raise NoSolutionError for a path that could not be followed."""
    if outcome != FOLLOWED or not np.isfinite(path).all():
        why = ": it meets the body" if outcome == TOO_DEEP else ""
        raise NoSolutionError(
            f"the orbit cannot be followed for {last_s:.0f} s{why}", ReasonCode.NO_SOLUTION
        )
