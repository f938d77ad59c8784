"""The on-board model of motion beside a moon, with its variational equations.

Source: Tuchin, thesis (2010), equations (5)-(6): the elliptic problem of Hill in the moon's orbital
frame, the true anomaly v as time, lengths in those of the orbit. It drops the second order of the
planet's tide, the flattening of both and the moon's C22: 50 m and 5 cm/s after 30 min from 61 km.
The ground uses the difference of two paths (`qso_motion`).
"""

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.ephemeris import compute_mean_anomaly, solve_kepler_equation
from catalog.geometry.kernel import kernel
from optnav_cli.orbit.qso.motion import MoonMotion

MAX_STEP = 0.01  # rad of true anomaly, 44 s: the fourth-order step leaves 1e-6 m in 30 min


@kernel
def _rates(v: float, y: FloatArray, e: float, mu: float, out: FloatArray) -> None:
    """Derivative by the anomaly of (42,): x, x', and their transition, row by row; (5)."""
    rho = 1.0 / (1.0 + e * np.cos(v))
    squared = y[0] * y[0] + y[1] * y[1] + y[2] * y[2]
    cube = rho * mu / (squared * np.sqrt(squared))
    for i in range(3):
        out[i] = y[3 + i]
        out[3 + i] = -cube * y[i]
    out[3] += 2.0 * y[4] + 3.0 * rho * y[0]
    out[4] -= 2.0 * y[3]
    out[5] -= y[2]  # rho (e cos v + 1) = 1
    gradient = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            gradient[i, j] = 3.0 * cube / squared * y[i] * y[j]
        gradient[i, i] -= cube
    gradient[0, 0] += 3.0 * rho
    gradient[2, 2] -= 1.0
    for j in range(6):
        for i in range(3):
            out[6 + 6 * i + j] = y[6 + 6 * (3 + i) + j]
            value = 0.0
            for k in range(3):
                value += gradient[i, k] * y[6 + 6 * k + j]
            out[6 + 6 * (3 + i) + j] = value
        out[6 + 18 + j] += 2.0 * y[6 + 24 + j]
        out[6 + 24 + j] -= 2.0 * y[6 + 18 + j]


@kernel
def _fly(start: FloatArray, anomalies: FloatArray, most: float, e: float, mu: float) -> FloatArray:
    """States (n, 42) at true anomalies (n,) by steps of Runge and Kutta's fourth order."""
    out = np.empty((anomalies.size, 42))
    y, at = start.copy(), np.empty(42)
    k1, k2, k3, k4 = np.empty(42), np.empty(42), np.empty(42), np.empty(42)
    out[0] = y
    for n in range(1, anomalies.size):
        span = anomalies[n] - anomalies[n - 1]
        steps = max(int(np.ceil(abs(span) / most)), 1)
        h = span / steps
        for step in range(steps):
            v = anomalies[n - 1] + step * h
            _rates(v, y, e, mu, k1)
            at[:] = y + 0.5 * h * k1
            _rates(v + 0.5 * h, at, e, mu, k2)
            at[:] = y + 0.5 * h * k2
            _rates(v + 0.5 * h, at, e, mu, k3)
            at[:] = y + h * k3
            _rates(v + h, at, e, mu, k4)
            y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        out[n] = y
    return out


class OnboardMotion:
    """Motion by (5); states (6,) are place and velocity in the turning frame, m and m/s."""

    def __init__(self, motion: MoonMotion) -> None:
        orbit, pair = motion.orbit, motion.pair
        self._motion = motion
        self.e = orbit.eccentricity
        self.p = 1e3 * orbit.semi_major_axis_km * (1.0 - self.e**2)
        # the area integral of the frame's own turning, which is that of the moon's mean motion
        a = 1e3 * orbit.semi_major_axis_km
        self.c = motion.mean_motion * a**2 * float(np.sqrt(1.0 - self.e**2))
        self.mu = pair.moon_gm / (pair.planet_gm + pair.moon_gm)

    def anomaly(self, tdb_s: FloatArray) -> FloatArray:
        """True anomalies (n,), rad, rising with time, of the moon in its orbit."""
        mean = compute_mean_anomaly(self._motion.orbit, tdb_s)
        mean = mean - 2.0 * np.pi * np.floor(mean[0] / (2.0 * np.pi))
        eccentric = solve_kepler_equation(mean, self.e)
        flat = self.e / (1.0 + np.sqrt(1.0 - self.e**2))
        # the anomaly less the eccentric one never passes a half turn: no jumps
        ahead = np.arctan2(flat * np.sin(eccentric), 1.0 - flat * np.cos(eccentric))
        anomaly: FloatArray = eccentric + 2.0 * ahead
        return anomaly

    def propagate(self, state: FloatArray, tdb_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States (n, 6) and transitions (n, 6, 6) at times (n,); the first is the start."""
        v = self.anomaly(tdb_s)
        scales = np.stack([self._scale(anomaly) for anomaly in v])  # (n, 6, 6): state of (x, x')
        start = np.concatenate([np.linalg.solve(scales[0], state), np.eye(6).ravel()])
        flown = _fly(start, v, MAX_STEP, self.e, self.mu)
        states = np.einsum("nij,nj->ni", scales, flown[:, :6])
        turned = scales @ flown[:, 6:].reshape(-1, 6, 6) @ np.linalg.inv(scales[0])
        return states, turned

    def _scale(self, v: float) -> FloatArray:
        """(6, 6): place and velocity of x and x', (6)."""
        rho = 1.0 / (1.0 + self.e * np.cos(v))
        scale = np.zeros((6, 6))
        scale[:3, :3] = self.p * rho * np.eye(3)
        scale[3:, 3:] = self.c / self.p / rho * np.eye(3)
        scale[3:, :3] = self.c / self.p * self.e * np.sin(v) * np.eye(3)
        return scale


def turning_state(motion: MoonMotion, tdb_s: float, state: FloatArray) -> FloatArray:
    """An inertial state (6,) in the turning frame, the velocity against the frame."""
    turning = motion.turning_from_inertial(np.array([tdb_s]))[0]
    rate, _ = motion.turning_rates(tdb_s)
    position = turning @ state[:3]
    speed = turning @ state[3:] - np.cross([0.0, 0.0, rate], position)
    return np.concatenate([position, speed])
