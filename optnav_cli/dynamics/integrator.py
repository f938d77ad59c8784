"""Where a craft will be: its orbit integrated with the derivative by the state it began with."""

import numpy as np
from scipy.integrate import solve_ivp

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.dynamics.forces import Forces
from optnav_cli.reasons import ReasonCode

# 0.1 mm and 0.1 um/s a step, far below any fix; the transition needs fewer digits.
RELATIVE = 1e-10
STATE_TOLERANCE = np.array([1e-4] * 3 + [1e-7] * 3)
TRANSITION_TOLERANCE = 1e-7


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
