"""Motion over the intervals of an arc: states, transitions, noise and derivatives by parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.orbit.settings import NoiseSettings

# Noise of longer intervals is added up piece by piece: below it 1 % of its covariance is left out.
MAX_PIECE_RAD = 0.2
MAX_PIECES = 20_000


@dataclass(frozen=True, eq=False)
class ArcStep:
    """From one node to the next.

    state (6,), transition (6, 6), noise (6, 6); by_parameters (6, p) of force parameters
    """

    state: FloatArray
    transition: FloatArray
    noise: FloatArray
    by_parameters: FloatArray


class ArcMotion:
    """The motion of an arc about a body with what the forces leave out."""

    def __init__(
        self, forces: Forces, noise: NoiseSettings, motion: OrbitMotion | None = None
    ) -> None:
        """motion  with values of force parameters; without it, as the settings state them."""
        self.ephemeris = forces.motion
        self.forces = forces
        self._motion = motion or OrbitMotion(forces)
        self._noise = noise

    def with_added(self, values: Mapping[str, FloatArray]) -> "ArcMotion":
        """The same motion with so much more of parameters of the forces."""
        if not values:
            return self
        before = self.forces.values()
        changed = {name: before[name] + value for name, value in values.items()}
        return ArcMotion(self.forces, self._noise, self._motion.with_values(changed))

    @property
    def thrusts(self) -> list[FloatArray]:
        """Covariances (3, 3) of the arcs of thrust, m^2/s^4."""
        return [arc.covariance for arc in self.forces.settings.thrust]

    def carry(
        self, state: FloatArray, tdb_s: float, after_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """A state (6,) so long after a time, and its derivative (6, 6)."""
        states, transitions = self._motion.propagate(state, tdb_s, np.array([tdb_s + after_s]))
        return states[0], transitions[0]

    def path(
        self, state: FloatArray, tdb_s: float, times: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """States (n, 6) at times, and their derivatives (n, 6, 6)."""
        return self._motion.propagate(state, tdb_s, times)

    def radian_s(self, position_m: FloatArray) -> float:
        """How long the motion takes for a radian, s."""
        return self._motion.radian_s(position_m)

    def density(self, position_m: FloatArray) -> float:
        """Of the white acceleration that stands for what is left out, m^2/s^3 an axis."""
        if self._noise.model in ("none", "mean"):
            return 0.0
        if self._noise.density_m2_s3 is not None:
            return self._noise.density_m2_s3
        density = self.forces.unmodelled(position_m).spectral_density
        steady = self.forces.tide_error_m_s2(position_m)
        if steady and self.forces.planet_rate:
            # it turns with the planet, and lasts for a radian of that
            density += 2.0 * steady**2 / self.forces.planet_rate
        return density

    def step(
        self,
        state: FloatArray,
        from_s: float,
        to_s: float,
        names: Sequence[str] = (),
    ) -> ArcStep:
        """To another time, with derivatives by force parameters of these names."""
        transition, noise = np.eye(6), np.zeros((6, 6))
        pushed = np.zeros((6, 0))
        pieces = abs(to_s - from_s) / (MAX_PIECE_RAD * self.radian_s(state[:3]))
        count = min(max(1, int(np.ceil(pieces))), MAX_PIECES)
        times = np.linspace(from_s, to_s, count + 1)
        for start, end in pairwise(times):
            ends = np.array([end])
            density, seconds = self.density(state[:3]), float(end - start)
            states, phis, gammas = self._motion.partials(state, float(start), ends, names)
            state, phi, gamma = states[0], phis[0], gammas[0]
            pushed = phi @ pushed + gamma if pushed.size else gamma
            transition = phi @ transition
            noise = phi @ noise @ phi.T + white(density, seconds)
        return ArcStep(state, transition, noise, pushed)


def white(density: float, seconds: float) -> FloatArray:
    """Covariance (6, 6) of white acceleration over a short time, m and m/s."""
    t = abs(seconds)
    block = density * np.array([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]])
    if seconds < 0.0:
        block[0, 1] = block[1, 0] = -block[0, 1]
    return np.kron(block, np.eye(3)).astype(np.float64)
