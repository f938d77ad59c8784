"""McEwen's lunar-Lambert law: Lommel-Seeliger near full Moon, more Lambert-like as phase grows.

Source: A. S. McEwen, Icarus 92 (1991) 298; the Moon's coefficients of L are those of the USGS
program ISIS (class LunarLambertMcEwen, written by McEwen): L = 1 - 0.019 g + 0.242e-3 g^2
- 1.46e-6 g^3 with g in degrees.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel


@kernel
def lunar_weight(cos_phase: float) -> float:
    """Share L of the Lommel-Seeliger term.

    Beyond 103 deg of phase the cubic is negative, and would make ground that faces the Sun dark;
    there L is held at 0, pure Lambert (ours).
    """
    g = math.degrees(math.acos(min(max(cos_phase, -1.0), 1.0)))
    return max(1.0 + g * (-0.019 + g * (0.242e-3 - 1.46e-6 * g)), 0.0) if g < 110.0 else 0.0


@kernel
def reflectance_scalar(mu0: float, mu: float, cos_phase: float, albedo: float) -> float:
    """Radiance factor A (2 L mu0 / (mu0 + mu) + (1 - L) mu0)."""
    if mu0 <= 0.0 or mu <= 0.0:
        return 0.0
    weight = lunar_weight(cos_phase)
    return albedo * (2.0 * weight * mu0 / (mu0 + mu) + (1.0 - weight) * mu0)


@kernel
def _reflectance_flat(
    mu0: FloatArray, mu: FloatArray, cos_phase: FloatArray, albedo: float
) -> FloatArray:
    out = np.empty(mu0.size)
    for i in range(mu0.size):
        out[i] = reflectance_scalar(mu0[i], mu[i], cos_phase[i], albedo)
    return out


def reflectance(
    mu0: ArrayLike, mu: ArrayLike, cos_phase: ArrayLike, albedo: float = 0.12
) -> FloatArray:
    """Radiance factor; zero where mu0 <= 0 or mu <= 0.

    mu0, mu, cos_phase  cosines of incidence, emission and phase; shapes broadcast
    albedo              normal albedo
    """
    a, b, c = np.broadcast_arrays(
        np.asarray(mu0, np.float64), np.asarray(mu, np.float64), np.asarray(cos_phase, np.float64)
    )
    flat = _reflectance_flat(
        np.ascontiguousarray(a).ravel(),
        np.ascontiguousarray(b).ravel(),
        np.ascontiguousarray(c).ravel(),
        albedo,
    )
    return flat.reshape(a.shape)
