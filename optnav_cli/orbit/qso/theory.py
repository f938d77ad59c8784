"""The averaged theory of quasi-satellite orbits, and the first guess that it gives.

Source: Tuchin, thesis (Keldysh Institute, Moscow 2010), chapter 1, equations (1)-(4); the plane
elliptic problem of Hill. Units are Hill's: lengths L = r (GM of the moon / GM of the planet)^(1/3),
the planet's distance r being that of the time, and the planet's true anomaly v in place of time.
The craft runs backwards on an ellipse of semi-axes A/2 and A, whose centre runs on one of a and 2 a
with the phase xi to the craft: x = a cos(th + xi) + A/2 cos th, y = -2 a sin(th + xi) - A sin th,
th = v + phi. At xi = pi both are one ellipse of De/2 and De, De = A - 2 a.

Two misprints of the source are corrected: phi' of (2) has a minus sign, and (1) is the integral
itself, not over 2 pi.
"""

import numpy as np
from scipy.special import ellipk

from catalog.arrays import FloatArray

K = float(ellipk(0.75))  # the complete elliptic integral of modulus sqrt(3)/2
KAPPA = 2.0  # the ratio of the axes of the centre's ellipse
MIN_A = float((256.0 * K / (5.0 * np.pi)) ** (1.0 / 3.0))  # (4): below it (3) has no real root
MIN_DE = 0.5 * MIN_A  # there both roots of (3) meet at A/4
_STEP = 1e-5


def integral(a: float, xi: float, big_a: float, kappa: float = KAPPA) -> float:
    """The integral of 1/r over a turn, (1), by complete elliptic integrals."""
    w1, w2 = np.sin(xi), np.cos(xi)
    c0 = 0.625 * big_a**2 + 0.5 * a**2 * (1.0 + kappa**2) + big_a * a * (kappa + 0.5) * w2
    c1 = -0.75 * big_a**2 - big_a * a * (2.0 * kappa - 1.0) * w2
    c1 = 0.5 * (c1 + a**2 * (1.0 - kappa**2) * (w2**2 - w1**2))
    c2 = big_a * a * (1.0 - 2.0 * kappa) * w1 + 2.0 * a**2 * (1.0 - kappa**2) * w1 * w2
    d = np.hypot(c1, -0.5 * c2)
    return float(4.0 / np.sqrt(c0 + d) * ellipk(2.0 * d / (c0 + d)))


def averaged_rates(a: float, xi: float, big_a: float) -> FloatArray:
    """Rates (4,) of a, xi, A and phi by the anomaly, (2)."""

    def slope(of_a: float, of_xi: float, of_big: float) -> float:
        ahead = integral(a + of_a, xi + of_xi, big_a + of_big)
        return (ahead - integral(a - of_a, xi - of_xi, big_a - of_big)) / (2.0 * _STEP)

    by_a, by_xi, by_big = slope(_STEP, 0.0, 0.0), slope(0.0, _STEP, 0.0), slope(0.0, 0.0, _STEP)
    inner = -by_xi / (a * KAPPA * np.pi)
    phase = (4.0 / big_a * by_big + 2.0 / (a * KAPPA) * by_a) / (2.0 * np.pi)
    phase += -1.0 + 0.75 / KAPPA
    return np.array([inner, phase, -2.0 * by_xi / (big_a * np.pi), -2.0 * by_big / (big_a * np.pi)])


def inner_axes(big_a: float) -> tuple[float, float]:
    """The roots a of (3) for an A: that of quasi-satellite orbits, and the larger one.

    Raises ValueError below the bound (4).
    """
    if big_a < MIN_A:
        raise ValueError(f"A = {big_a:.4g}: (3) has no real root below {MIN_A:.4g}")
    root = np.sqrt(max(big_a**4 / 16.0 - 16.0 * K * big_a / (5.0 * np.pi), 0.0)) / big_a
    return float(big_a / 4.0 - root), float(big_a / 4.0 + root)


def axes_of(de: float) -> tuple[float, float]:
    """The axes a and A of the least drift whose path has the semi-axes De/2 and De, by (3)."""
    a = float((np.sqrt(de**2 + 256.0 * K / (5.0 * np.pi * de)) - de) / 4.0)
    return a, de + 2.0 * a


def phase_rate(de: float) -> float:
    """phi' of that path: how much faster than the moon the craft goes round, less 1."""
    _, big_a = axes_of(de)
    return 8.0 * K / (np.pi * big_a * de**2)


def first_guess(direction: float, distance: float) -> FloatArray:
    """Position and velocity (4,) x, y, x', y' in the turning frame at a place of the path.

    direction  of the place, rad, from x (away from the planet) to y (along the moon's motion)
    distance   from the moon; both units Hill's, the velocity by the true anomaly, osculating:
               that of the free path, (A/2) n at -y. The ellipse's own is 8 % less and falls in.
    """
    cosine, sine = np.cos(direction), np.sin(direction)
    de = distance * float(np.hypot(2.0 * cosine, sine))
    a, big_a = axes_of(de)
    # x = De/2 cos th, y = -De sin th
    theta = np.arctan2(-distance * sine / de, 2.0 * distance * cosine / de)
    along = (1.5 * a - big_a) * np.cos(theta)
    return np.array([distance * cosine, distance * sine, -0.5 * big_a * np.sin(theta), along])
