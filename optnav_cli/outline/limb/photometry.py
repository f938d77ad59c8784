"""Brightness across the limb of a sphere, seen through a blur.

Inside the limb, x px from it, a sphere's emission cosine is mu = sqrt(2 x / r) (first order, r the
distance in px over which the surface turns), so brightness just inside is a power series in
sqrt(x), whatever the law; the blur of each power is a function of the distance in blur widths,
tabulated once. A step alone, the same edge without the series, is found 0.1 px and more away.
"""

import math
from functools import cache

import numpy as np
from scipy.special import ndtr

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel
from catalog.photometry.laws import LUNAR_HAPKE

POWERS = 5  # x^0, x^1/2, ..., x^2
LOWEST, HIGHEST, STEP = -8.0, 24.0, 0.02  # of the distance in blur widths
# Depths, px, at which the law is drawn before the series is fitted to it.
NODES_PX = np.array([0.0, 0.05, 0.2, 0.5, 1.0, 1.6, 2.4, 3.4, 4.6, 6.0])


@cache
def get_power_table() -> FloatArray:
    """Table (n, POWERS): integral of x^(k/2) over x > 0 under a unit Gaussian about t.

    t from LOWEST to HIGHEST by STEP.
    """
    t = np.arange(round((HIGHEST - LOWEST) / STEP) + 1) * STEP + LOWEST
    # x = u^2 makes the half powers smooth, so that the trapezoid rule converges at once
    du = 0.004
    u = np.arange(0.0, 6.2, du)
    weight = np.exp(-0.5 * (u[None] ** 2 - t[:, None]) ** 2) / math.sqrt(2.0 * math.pi)
    table = np.empty((len(t), POWERS))
    for k in range(POWERS):
        values = weight * (2.0 * u ** (k + 1))
        table[:, k] = (values.sum(axis=1) - 0.5 * values[:, 0]) * du
    table[:, 0] = ndtr(t)
    return table


@kernel
def evaluate_blurred_law(
    table: FloatArray, shares: FloatArray, t: float, sigma: float
) -> tuple[float, float]:
    """Brightness of a law behind the blur, and its derivative by the distance, by `power_table`.

    shares (POWERS,)  of the powers at a distance of sigma, the width of the blur, px
    t                 distance inside the edge in blur widths
    """
    last = table.shape[0] - 1
    row_position = (min(max(t, LOWEST), HIGHEST) - LOWEST) / STEP
    index = min(int(row_position), last - 1)
    # unsigned: no index counts from the end
    row, next_row = np.uint64(index), np.uint64(index + 1)
    low, high = 0.0, 0.0
    for k in range(POWERS):
        low += shares[k] * table[row, np.uint64(k)]
        high += shares[k] * table[next_row, np.uint64(k)]
    return low + (row_position - index) * (high - low), (high - low) / (STEP * sigma)


def fit_series(brightness: FloatArray) -> FloatArray:
    """Coefficients (n, POWERS) of the powers of sqrt(x) through brightness (n, NODES_PX)."""
    powers = NODES_PX[:, None] ** (0.5 * np.arange(POWERS))
    return brightness @ np.linalg.pinv(powers).T


def compute_limb_laws(
    normal: FloatArray,
    ray: FloatArray,
    sun: FloatArray | None,
    angle: float,
    rad_per_px: FloatArray,
    cos_mid_phase: float = 1.0,
) -> FloatArray:
    """Series (3, n, POWERS) of three brightness laws inside each point of a limb.

    normal, ray  (n, 3) outward surface normals and unit rays at the limb
    sun          (3,)   unit vector to the Sun, the same frame; None where it is not known
    angle        half angle of the limb's cone, rad;  rad_per_px (n,) along the limb's normal
    cos_mid_phase  cosine of phase at the body's centre
    With the Sun: Hapke's with the Moon's parameters, Lommel-Seeliger and Lambert, among which
    bodies without an atmosphere lie. Without it: a constant, and changes with the emission cosine.
    """
    impact = np.sin(angle - rad_per_px[:, None] * NODES_PX) / math.sin(angle)
    mu = np.sqrt(np.maximum(1.0 - impact**2, 0.0))
    if sun is None:
        return np.stack([fit_series(law) for law in (np.ones_like(mu), 1.0 + mu, 1.0 + mu**2)])
    # the surface turns toward the camera by arcsin mu; the change of the ray is second to it
    cos_phase = -(ray @ sun)[:, None]
    mu0 = np.sqrt(1.0 - mu**2) * (normal @ sun)[:, None] + mu * cos_phase
    return np.stack(
        [fit_series(law) for law in evaluate_three_laws(mu0, mu, cos_phase, cos_mid_phase)]
    )


def evaluate_three_laws(
    mu0: FloatArray, mu: FloatArray, cos_phase: FloatArray, cos_mid_phase: float
) -> list[FloatArray]:
    """Brightness by Hapke, Lommel-Seeliger and Lambert, each 1 where incidence equals emission.

    mu0, mu, cos_phase  cosines of incidence, emission, phase; shapes broadcast
    cos_mid_phase       at the body's centre, where the laws are made equal
    """
    # the laws at the limb itself are their limits there
    # The ground's slopes have a sine of about 0.1: at the limb no face is seen flatter, so a rough
    # body's limb is darker than a smooth one's. Without it edges over the Moon lie 0.01-0.02 px too
    # deep and scatter twice as much from picture to picture where pixels are below 1 km.
    mu0, mu = np.maximum(mu0, 1e-4), np.sqrt(mu**2 + 0.1**2)
    mirror = math.sqrt(max(0.5 * (1.0 + cos_mid_phase), 1e-4))
    standard = float(LUNAR_HAPKE(mirror, mirror, cos_mid_phase))
    return [LUNAR_HAPKE(mu0, mu, cos_phase) / standard, 2.0 * mu0 / (mu0 + mu), mu0 / mirror]
