"""Lambert's law: equally bright from everywhere."""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel


@kernel
def reflectance_scalar(mu0: float, mu: float, albedo: float) -> float:
    """Radiance factor A mu0, zero when the Sun or the camera is below the surface."""
    if mu0 <= 0.0 or mu <= 0.0:
        return 0.0
    return albedo * mu0


def reflectance(
    mu0: ArrayLike, mu: ArrayLike, cos_phase: ArrayLike, albedo: float = 0.12
) -> FloatArray:
    """Radiance factor; zero where mu0 <= 0 or mu <= 0.

    mu0, mu    cosines of incidence and emission; shapes broadcast
    cos_phase  only lends its shape
    albedo     normal albedo
    """
    a, b, _ = np.broadcast_arrays(
        np.asarray(mu0, np.float64), np.asarray(mu, np.float64), np.asarray(cos_phase, np.float64)
    )
    return np.where((a > 0.0) & (b > 0.0), albedo * a, 0.0)
