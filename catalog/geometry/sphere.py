"""Where rays meet a sphere about the origin."""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray


def distance_to_sphere(origin: ArrayLike, directions: ArrayLike, radius: float) -> FloatArray:
    """Distance along unit rays to their first crossing of a sphere, NaN where they miss it.

    origin (3,), directions (..., 3) unit vectors, same frame and unit; returns (...).
    A crossing behind the origin counts as a miss.
    """
    origin = np.asarray(origin, dtype=np.float64)
    along = np.asarray(directions, dtype=np.float64) @ origin
    # (|o|-r)(|o|+r) keeps its digits when the origin is near the sphere
    length = float(np.linalg.norm(origin))
    discriminant = along * along - (length - radius) * (length + radius)
    with np.errstate(invalid="ignore"):
        distance = -along - np.sqrt(discriminant)
    return np.where(distance > 0.0, distance, np.nan)
