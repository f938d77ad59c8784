"""Motion over the intervals of an arc: states, transitions, noise and derivatives by parameters."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import msgspec
import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.config import load_toml, resource
from catalog.geometry.rotations import rnb_axes
from catalog.geometry.vectors import unit
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.orbit.fit.settings import NoiseSettings

# Noise of longer intervals is added up piece by piece: below it 1 % of its covariance is left out.
MAX_PIECE_RAD = 0.2
MAX_PIECES = 20_000
RADIAL = 1e-12  # share of the motion across the vertical below which it is vertical
FILE = "configs/models/orbit.toml"


@dataclass(frozen=True, eq=False)
class ArcStep:
    """From one node to the next.

    state (6,), transition (6, 6), noise (6, 6); by_parameters (6, p) of force parameters
    """

    state: FloatArray
    transition: FloatArray
    noise: FloatArray
    by_parameters: FloatArray


class OrbitNoiseSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The fitted numbers of FILE, which says what each is."""

    across: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)]
    along: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)]
    local: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)]


@cache
def noise_sizes() -> OrbitNoiseSizes:
    """The sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), OrbitNoiseSizes)


class ArcMotion:
    """The motion of an arc about a body with what the forces leave out."""

    def __init__(
        self,
        forces: Forces,
        noise: NoiseSettings,
        motion: OrbitMotion | None = None,
        sizes: OrbitNoiseSizes | None = None,
    ) -> None:
        """Prepare the motion of a craft along an arc.

        motion  with values of force parameters; without it, as the settings state them
        sizes   of the noise; without them, those that ship
        """
        self.ephemeris = forces.motion
        self.forces = forces
        self._motion = motion or OrbitMotion(forces)
        self._noise = noise
        self.sizes = sizes or noise_sizes()

    def with_forces(self, forces: Forces) -> "ArcMotion":
        """Make the motion by other forces, with the same noise."""
        return ArcMotion(forces, self._noise, None, self.sizes)

    def with_added(self, values: Mapping[str, FloatArray]) -> "ArcMotion":
        """Return the motion with increments of parameters of the forces."""
        if not values:
            return self
        before = self.forces.values()
        changed = {name: before[name] + value for name, value in values.items()}
        moved = self._motion.with_values(changed)
        return ArcMotion(self.forces, self._noise, moved, self.sizes)

    @property
    def is_noisy(self) -> bool:
        """Whether forces that are left out act as noise between nodes."""
        return self._noise.model not in ("none", "mean")

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

    def path(self, state: FloatArray, tdb_s: float, times: FloatArray) -> FloatArray:
        """States (n, 6) at times."""
        return self._motion.states(state, tdb_s, times)

    def partials(
        self, state: FloatArray, tdb_s: float, times: FloatArray, names: Sequence[str]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return `path` and derivatives (n, 6, 6), and (n, 6, p) by named force parameters."""
        return self._motion.partials(state, tdb_s, times, names)

    def radian_s(self, position_m: FloatArray) -> float:
        """Return the time that the motion takes per radian, s."""
        return self._motion.radian_s(position_m)

    def densities(self, positions_m: FloatArray) -> FloatArray:
        """(n, 3) along R, N, B of the white acceleration that stands for what is left out, m^2/s^3.

        positions_m  (n, 3)
        """
        if not self.is_noisy:
            return np.zeros((len(positions_m), 3))
        if self._noise.density_m2_s3 is not None:
            return np.full((len(positions_m), 3), self._noise.density_m2_s3)
        sizes = np.array([self.sizes.across, self.sizes.along, self.sizes.across])
        white_densities: FloatArray = self.forces.densities(positions_m)[:, None] * sizes
        if self.forces.planet_rate:
            steady = self.forces.tide_error_m_s2(positions_m)
            # it turns with the planet, and lasts for a radian of that
            white_densities += 2.0 * steady[:, None] ** 2 / self.forces.planet_rate
        return white_densities

    def local(self, states: FloatArray) -> FloatArray:
        """Covariances (n, 6, 6) of states (n, 6) by what comes and goes with the ground below.

        The potential that the field lacks changes the speed along the motion while the craft is
        over it, and gives it back after: it neither grows nor moves a prediction.
        """
        covariances = np.zeros((len(states), 6, 6))
        if self._noise.model == "white" and self._noise.density_m2_s3 is None:
            for k, state in enumerate(states):
                sigma = self.sizes.local * self.forces.unmodelled_speed(state[:3])
                along = sigma * rnb_of(state)[1]
                covariances[k, 3:, 3:] = np.outer(along, along)
        return covariances

    def step(
        self, state: FloatArray, from_s: float, to_s: float, names: Sequence[str] = ()
    ) -> ArcStep:
        """To another time, with derivatives by force parameters of these names."""
        return self.steps(state[None], np.array([from_s, to_s]), names)[0]

    def steps(
        self, states: FloatArray, times: FloatArray, names: Sequence[str] = ()
    ) -> list[ArcStep]:
        """From states (n, 6), each to the next of times (n + 1,)."""
        spans = np.diff(times)
        if not len(spans):
            return []
        pieces = np.abs(spans) / (MAX_PIECE_RAD * self._motion.radians_s(states[:, :3]))
        counts = np.clip(np.ceil(pieces), 1, MAX_PIECES).astype(np.int64)
        last = np.cumsum(counts) - 1
        number = np.arange(1, last[-1] + 2) - np.repeat(last + 1 - counts, counts)
        seconds = np.repeat(spans / counts, counts)
        ends = np.repeat(times[:-1], counts) + number * seconds
        ends[last] = times[1:]
        flown, transitions, pushed = self._motion.legs(states, times[:-1], ends, counts, names)
        noises = np.zeros((len(spans), 6, 6))
        if self.is_noisy:
            starts = np.concatenate([states[:1], flown[:-1]])
            starts[last + 1 - counts] = states
            noises = self._noises(starts, seconds, transitions, counts)
        return [
            ArcStep(flown[end], transitions[end], noise, pushed[end])
            for end, noise in zip(last, noises, strict=True)
        ]

    def _noises(
        self, starts: FloatArray, seconds: FloatArray, transitions: FloatArray, counts: IntArray
    ) -> FloatArray:
        """Covariances (n, 6, 6) that the white acceleration adds on the way of n steps.

        starts (p, 6), seconds (p,)  of the pieces of all;  transitions  (p, 6, 6) from the start of
        a step to the ends of its pieces, of which it has counts (n,)
        """
        axes = np.array([rnb_of(state) for state in starts])
        densities = self.densities(starts[:, :3])
        added = white(axes.transpose(0, 2, 1) * densities[:, None] @ axes, seconds)
        last = np.cumsum(counts)
        bring = np.repeat(transitions[last - 1], counts, axis=0) @ np.linalg.inv(transitions)
        first = last - counts
        summed: FloatArray = np.add.reduceat(bring @ added @ bring.transpose(0, 2, 1), first)
        return summed


def white(density: FloatArray, seconds: float | FloatArray) -> FloatArray:
    """Covariances (..., 6, 6), m and m/s, of white acceleration over short times (...).

    density  (..., 3, 3)
    """
    seconds = np.asarray(seconds)[..., None, None]
    t = abs(seconds)
    covariance = np.empty((*density.shape[:-2], 6, 6))
    covariance[..., :3, :3], covariance[..., 3:, 3:] = density * (t**3 / 3.0), density * t
    covariance[..., :3, 3:] = covariance[..., 3:, :3] = density * (seconds * t / 2.0)
    return covariance


def rnb_of(state: FloatArray) -> FloatArray:
    """Axes R, N, B (3, 3) of an inertial state; of a radial one any that hold R."""
    (x, y, z), (u, v, w) = state[:3].tolist(), state[3:].tolist()
    # as `rnb_axes`, without numpy's cost for three numbers: a fit needs them thousands of times
    a, b, c = y * w - z * v, z * u - x * w, x * v - y * u
    distance, length = math.hypot(x, y, z), math.hypot(a, b, c)
    if length <= RADIAL * distance * math.hypot(u, v, w):
        up = unit(state[:3])
        return rnb_axes(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    x, y, z = x / distance, y / distance, z / distance
    a, b, c = a / length, b / length, c / length
    return np.array([[x, y, z], [b * z - c * y, c * x - a * z, a * y - b * x], [a, b, c]])
