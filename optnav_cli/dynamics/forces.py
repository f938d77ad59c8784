"""Gravity on a craft near a body, and its orbit: point mass, J2, C22, tides; and what is left.

Accelerations come with their gradient, for the variational equations. What the two field terms
leave out is known in size only: by Kaula's rule (Kaula, "Theory of Satellite Geodesy", 1966) the
normalised coefficients of degree n are about kaula / n^2. A craft meets it as noise that changes
while it flies over a wavelength. At 100 km over the Moon it is 0.8 mm/s^2, the neglected sunlight
pressure 1e-4 of that. About a moon near its planet the planet's tide is the larger force, and what
is wrong with it lasts: at 300 km from Phobos 0.03 of 30 mm/s^2.

A body whose file has no [gravity] is taken for its ellipsoid at even density. That gives Mars' J2
to 20 %, Phobos' to 4 %; what is left out then begins with degree 2, of the size that Kaula's rule
has on a body of such gravity.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, GravityField, load_body
from catalog.bodies.ephemeris import SUN_GM_M3_S2, Ephemeris, Neighbour
from catalog.errors import NoSolutionError
from optnav_cli.reasons import ReasonCode

# The degrees summed by Kaula's rule; the field falls off with height, so the last hardly matter.
DEGREES = np.arange(3.0, 121.0)
# Whose tides count beside the Sun's.
_NEIGHBOURS: dict[str, tuple[Neighbour, ...]] = {"moon": ("earth",), "earth": ("moon",)}
# Kaula's rule on the Earth, where it was found; elsewhere rock carries hills by the weight that
# they have there (the same source), but a body of rubble is no more uneven than Eros.
EARTH_KAULA = 1e-5
EARTH_GRAVITY_M_S2 = 9.8
MAX_KAULA = 0.1
# 0.1 mm and 0.1 um/s a step, far below any fix; the transition needs fewer digits.
RELATIVE = 1e-10
STATE_TOLERANCE = np.array([1e-4] * 3 + [1e-7] * 3)
TRANSITION_TOLERANCE = 1e-7


@dataclass(frozen=True, eq=False)
class Unmodelled:
    """The acceleration left out: its size, 1 sigma an axis, m/s^2, and for how long it lasts, s."""

    sigma_m_s2: float
    lasting_s: float

    @property
    def spectral_density(self) -> float:
        """Of the white noise that moves a craft as far in the long run, m^2/s^3 an axis."""
        return 2.0 * self.sigma_m_s2**2 * self.lasting_s


class Forces:
    """Accelerations about one body, inertial axes, origin at its centre."""

    def __init__(self, motion: Ephemeris) -> None:
        """motion  of the body; its file may leave [gravity] out, see above."""
        body = motion.body
        self.motion = motion
        self.gm = body.gm_m3_s2
        self._field = body.gravity or even_field(body)
        self._degrees = np.append(2.0, DEGREES) if body.gravity is None else DEGREES
        self._radius_m = self._field.radius_km * 1e3
        j2, c22 = self._field.j2, self._field.c22
        # V = GM R^2 x'Ax / r^5 holds both terms: x and y of the equator, z of the pole
        self._shape = np.array([j2 / 2.0 + 3.0 * c22, j2 / 2.0 - 3.0 * c22, -j2])
        planet: tuple[Neighbour, ...] = () if body.orbit is None else (body.orbit.around,)
        self._neighbours: list[tuple[Neighbour, float]] = [
            (name, load_body(name).gm_m3_s2) for name in (*_NEIGHBOURS.get(body.name, ()), *planet)
        ]
        self._neighbours.append(("sun", SUN_GM_M3_S2))
        self._tide_error = self.planet_rate = 0.0  # the rate: rad/s of the body's own orbit
        if body.orbit is not None:
            square = load_body(body.orbit.around).gm_m3_s2
            square /= (1e3 * body.orbit.semi_major_axis_km) ** 3
            self.planet_rate = float(np.sqrt(square))
            # along the line to the planet, where its tide is strongest
            self._tide_error = 2.0 * body.orbit.tide_error * square

    def acceleration(self, tdb_s: float, position_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Acceleration (3,), m/s^2, and its derivative (3, 3) by position at an inertial place."""
        pull, gradient = _point_mass(self.gm, position_m)
        turn = self.motion.body_from_inertial(tdb_s)
        flat, flat_gradient = self._flattening(turn @ position_m)
        pull = pull + turn.T @ flat
        gradient = gradient + turn.T @ flat_gradient @ turn
        for name, gm in self._neighbours:
            there = self.motion.position_m(name, tdb_s)
            # the body falls to its neighbour too: only the difference moves the craft about it
            tide, tide_gradient = _point_mass(gm, position_m - there)
            pull = pull + tide - gm * there / float(np.linalg.norm(there)) ** 3
            gradient = gradient + tide_gradient
        return pull, gradient

    def unmodelled(self, position_m: FloatArray) -> Unmodelled:
        """What the forces here leave out at a place, by Kaula's rule."""
        distance = float(np.linalg.norm(position_m))
        n = self._degrees
        share = (n + 1.0) * (2.0 * n + 1.0) ** 2 * (self._field.kaula / n**2) ** 2
        share = share * (self._radius_m / max(distance, self._radius_m)) ** (2.0 * n)
        sigma = self.gm / distance**2 * float(np.sqrt(share.sum() / 3.0))
        degree = float((share * n).sum() / share.sum())
        return Unmodelled(sigma, distance / (float(np.sqrt(self.gm / distance)) * degree))

    def tide_error_m_s2(self, position_m: FloatArray) -> float:
        """Of a planet's tide: what is wrong with it for hours, 1 sigma an axis; 0 without one."""
        return self._tide_error * float(np.linalg.norm(position_m))

    def _flattening(self, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """J2 and C22 at a body-fixed place: gradient and second derivative of V above."""
        r = float(np.linalg.norm(place))
        factor = self.gm * self._radius_m**2
        bent = self._shape * place
        q = float(place @ bent)
        pull = factor * (2.0 * bent / r**5 - 5.0 * q * place / r**7)
        mixed = np.outer(bent, place)
        second = 2.0 * np.diag(self._shape) / r**5 - 10.0 * (mixed + mixed.T) / r**7
        second = second - 5.0 * q * np.eye(3) / r**7 + 35.0 * q * np.outer(place, place) / r**9
        return pull, factor * second


def even_field(body: Body) -> GravityField:
    """The field of a body's ellipsoid at even density, and Kaula's rule for a body so heavy."""
    x, y, z = body.radii_m
    radius, gravity = body.radius_m, body.gm_m3_s2 / body.radius_m**2
    return GravityField(
        j2=(x**2 + y**2 - 2.0 * z**2) / (10.0 * radius**2),
        c22=(x**2 - y**2) / (20.0 * radius**2),
        radius_km=radius / 1e3,
        kaula=min(EARTH_KAULA * (EARTH_GRAVITY_M_S2 / gravity) ** 2, MAX_KAULA),
    )


def _point_mass(gm: float, offset_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pull (3,) of a point mass on what lies `offset_m` from it, and its derivative (3, 3)."""
    r = float(np.linalg.norm(offset_m))
    pull = -gm * offset_m / r**3
    gradient = gm * (3.0 * np.outer(offset_m, offset_m) / r**5 - np.eye(3) / r**3)
    return pull, gradient


class OrbitMotion:
    """Motion without thrust about a body; states are inertial position (m) and velocity (m/s)."""

    def __init__(self, forces: Forces) -> None:
        self._forces = forces

    def propagate(
        self, state: FloatArray, from_s: float, to_s: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """States (n, 6) at other times, and their derivatives (n, 6, 6) by the first.

        state (6,) at from_s; to_s (n,) before or after it, in any order, TDB s.
        Raises NoSolutionError when the path cannot be followed, as into the body's centre.
        """
        since = np.asarray(to_s, dtype=np.float64) - from_s
        states = np.tile(np.asarray(state, dtype=np.float64), (len(since), 1))
        transitions = np.tile(np.eye(6), (len(since), 1, 1))
        for side in (since > 0.0, since < 0.0):
            if side.any():
                times, place = np.unique(since[side], return_inverse=True)
                order = slice(None, None, -1 if times[0] < 0.0 else 1)
                path = self._path(state, from_s, times[order])[:, order]
                states[side] = path[:6].T[place]
                transitions[side] = path[6:].T.reshape(-1, 6, 6)[place]
        return states, transitions

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
        """Of a circular orbit through a place, m/s."""
        return float(np.sqrt(self._forces.gm / np.linalg.norm(position_m)))

    def radian_s(self, position_m: FloatArray) -> float:
        """How long a circular orbit there, or the body's own about its planet, takes a radian, s.

        The shorter of both rules: far from a small moon its planet bends the path.
        """
        own = self._forces.gm / float(np.linalg.norm(position_m)) ** 3
        return float(1.0 / np.sqrt(own + self._forces.planet_rate**2))

    def _path(self, state: FloatArray, from_s: float, since: FloatArray) -> FloatArray:
        """(42, n) state and transition, row by row, at times after (or before) the first."""

        def rates(t: float, y: FloatArray) -> FloatArray:
            pull, gradient = self._forces.acceleration(from_s + t, y[:3])
            transition = y[6:].reshape(6, 6)
            turned = np.concatenate([transition[3:], gradient @ transition[:3]])
            return np.concatenate([y[3:6], pull, turned.ravel()])

        start = np.concatenate([state, np.eye(6).ravel()])
        tolerance = np.concatenate([STATE_TOLERANCE, np.full(36, TRANSITION_TOLERANCE)])
        found = solve_ivp(
            rates, (0.0, since[-1]), start, "DOP853", since, rtol=RELATIVE, atol=tolerance
        )
        if not found.success or not np.isfinite(found.y).all():
            raise NoSolutionError(
                f"the orbit cannot be followed for {since[-1]:.0f} s", ReasonCode.NO_SOLUTION
            )
        states: FloatArray = found.y
        return states
