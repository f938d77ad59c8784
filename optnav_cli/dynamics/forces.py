"""Gravity on a craft near a body: point mass, J2, C22, tides of the neighbours; and what is left.

Accelerations come with their gradient, for the variational equations. What the two field terms
leave out is known in size only: by Kaula's rule (Kaula, "Theory of Satellite Geodesy", 1966) the
normalised coefficients of degree n are about kaula / n^2. A craft meets it as noise that changes
while it flies over a wavelength. At 100 km over the Moon it is 0.8 mm/s^2, the neglected sunlight
pressure 1e-4 of that.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from catalog.bodies.body import load_body
from catalog.bodies.motion import SUN_GM_M3_S2, BodyMotion, Neighbour
from catalog.errors import ConfigError

FloatArray = NDArray[np.float64]

# The degrees summed by Kaula's rule; the field falls off with height, so the last hardly matter.
DEGREES = np.arange(3.0, 121.0)
_NEIGHBOURS: dict[str, tuple[Neighbour, ...]] = {
    "moon": ("earth", "sun"),
    "earth": ("moon", "sun"),
    "mars": ("sun",),
}


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

    def __init__(self, motion: BodyMotion) -> None:
        """Raises ConfigError for a body without a gravity field in its file."""
        body = motion.body
        if body.gravity is None:
            raise ConfigError(
                f"body {body.name} has no [gravity] in its file, so orbits about it cannot be "
                "predicted; add j2, c22, radius_km and kaula"
            )
        self.motion = motion
        self.gm = body.gm_m3_s2
        self._field = body.gravity
        self._radius_m = body.gravity.radius_km * 1e3
        j2, c22 = body.gravity.j2, body.gravity.c22
        # V = GM R^2 x'Ax / r^5 holds both terms: x and y of the equator, z of the pole
        self._shape = np.array([j2 / 2.0 + 3.0 * c22, j2 / 2.0 - 3.0 * c22, -j2])
        self._neighbours = [
            (name, SUN_GM_M3_S2 if name == "sun" else load_body(name).gm_m3_s2)
            for name in _NEIGHBOURS[body.sun]
        ]

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
        n = DEGREES
        share = (n + 1.0) * (2.0 * n + 1.0) ** 2 * (self._field.kaula / n**2) ** 2
        share = share * (self._radius_m / max(distance, self._radius_m)) ** (2.0 * n)
        sigma = self.gm / distance**2 * float(np.sqrt(share.sum() / 3.0))
        degree = float((share * n).sum() / share.sum())
        speed = np.sqrt(self.gm / distance)
        return Unmodelled(sigma, distance / (float(speed) * degree))

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


def _point_mass(gm: float, offset_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pull (3,) of a point mass on what lies `offset_m` from it, and its derivative (3, 3)."""
    r = float(np.linalg.norm(offset_m))
    pull = -gm * offset_m / r**3
    gradient = gm * (3.0 * np.outer(offset_m, offset_m) / r**5 - np.eye(3) / r**3)
    return pull, gradient
