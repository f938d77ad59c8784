"""How far from the axis a distortion polynomial can be trusted: up to where it folds back."""

import math

import numpy as np

from catalog.arrays import FloatArray

# A distortion polynomial fitted to a real lens says nothing at 84 degrees from the axis.
LARGEST_TANGENT = 10.0
_RADII = 4000  # the edge is found to a part in 4000 of LARGEST_TANGENT, then refined
_AZIMUTHS = 72


def brown_limit(coefficients: tuple[float, ...]) -> float:
    """Squared tangent of the off-axis angle up to which the Brown model is one to one.

    coefficients  k1 k2 p1 p2 k3;  returns infinity without distortion.
    """
    if not any(coefficients):
        return math.inf
    low, high = 0.0, LARGEST_TANGENT
    for _ in range(3):
        radii = np.linspace(low, high, _RADII)
        folded = np.flatnonzero(_least_determinant(radii, coefficients) <= 0.0)
        if folded.size == 0:
            return high * high
        # folded[0] > 0: on the axis the determinant is 1, at `low` it was positive
        low, high = float(radii[folded[0] - 1]), float(radii[folded[0]])
    return low * low


def _least_determinant(radii: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    """Smallest Jacobian determinant of the distortion over all azimuths, at each radius."""
    k1, k2, p1, p2, k3 = coefficients
    azimuth = np.linspace(0.0, 2.0 * np.pi, _AZIMUTHS, endpoint=False)
    a, b = radii[:, None] * np.cos(azimuth), radii[:, None] * np.sin(azimuth)
    s = (radii * radii)[:, None]
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    slope = 2.0 * (k1 + s * (2.0 * k2 + 3.0 * s * k3))
    xx = radial + slope * a * a + 2.0 * p1 * b + 6.0 * p2 * a
    yy = radial + slope * b * b + 6.0 * p1 * b + 2.0 * p2 * a
    xy = slope * a * b + 2.0 * p1 * a + 2.0 * p2 * b
    # Both eigenvalues must be positive; past a double fold the determinant is positive again.
    determinant = np.where(xx + yy > 0.0, xx * yy - xy * xy, -1.0)
    return np.asarray(determinant.min(axis=1))


def fisheye_limit(coefficients: tuple[float, ...]) -> float:
    """Off-axis angle, rad, up to which the Kannala-Brandt radius grows; pi at most.

    coefficients  k1 k2 k3 k4
    """
    k1, k2, k3, k4 = coefficients
    roots = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    real = roots.real[(np.abs(roots.imag) < 1e-12 * np.abs(roots)) & (roots.real > 0.0)]
    return float(min(np.pi, np.sqrt(real.min()))) if real.size else float(np.pi)
