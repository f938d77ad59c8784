"""The Lommel-Seeliger law: single scattering in a dark, smooth layer; the on-board reference's."""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel

NORMAL_ALBEDO = 0.12  # the Moon's geometric albedo in V (Allen's Astrophysical Quantities, 4th ed.)


@kernel
def reflectance_scalar(mu0: float, mu: float, albedo: float) -> float:
    """Radiance factor 2 A mu0 / (mu0 + mu); A is what vertical light seen from above returns."""
    if mu0 <= 0.0 or mu <= 0.0:
        return 0.0
    return 2.0 * albedo * mu0 / (mu0 + mu)


def reflectance(
    mu0: ArrayLike, mu: ArrayLike, cos_phase: ArrayLike, albedo: float = NORMAL_ALBEDO
) -> FloatArray:
    """Radiance factor; zero where mu0 <= 0 or mu <= 0.

    mu0, mu    cosines of incidence and emission; shapes broadcast
    cos_phase  only lends its shape: the law without a phase function
    albedo     normal albedo
    """
    a, b, _ = np.broadcast_arrays(
        np.asarray(mu0, np.float64), np.asarray(mu, np.float64), np.asarray(cos_phase, np.float64)
    )
    seen = (a > 0.0) & (b > 0.0)
    out = np.zeros(a.shape)
    np.divide(2.0 * albedo * a, a + b, out=out, where=seen)
    return out
