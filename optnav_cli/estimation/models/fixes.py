"""Positions at several times as measurements of an orbit's state: position and velocity."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.estimation.least_squares import Linearisation, linearised


class OrbitModel(Protocol):
    """The motion without thrust, see `optnav_cli.dynamics.integrator`."""

    def propagate(
        self, state: FloatArray, from_s: float, to_s: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """States (n, 6) and transitions (n, 6, 6) at other times."""

    def noise(self, state: FloatArray, seconds: float) -> FloatArray:
        """Covariance (6, 6) that unmodelled forces add in a time."""


class FixesModel:
    """Positions (n, 3), m, inertial, with covariances (n, 3, 3), at times (n,), TDB s.

    The state (6,) is that at the last of them. What the orbit leaves out widens an old position by
    the time since.
    """

    def __init__(
        self,
        orbit: OrbitModel,
        times: FloatArray,
        positions: Sequence[FloatArray],
        covariances: Sequence[FloatArray],
    ) -> None:
        self._orbit, self._times = orbit, times
        self._positions, self._covariances = np.stack(positions), np.stack(covariances)

    def linearise(self, state: FloatArray) -> Linearisation:
        """The positions on the orbit of a state (6,)."""
        last = float(self._times[-1])
        states, transitions = self._orbit.propagate(state, last, self._times)
        drift = [self._orbit.noise(state, time - last)[:3, :3] for time in self._times]
        weights = np.linalg.inv(self._covariances + drift).astype(np.float64)
        return linearised(self._positions - states[:, :3], transitions[:, :3], weights)
