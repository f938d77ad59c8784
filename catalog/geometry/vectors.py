"""Vectors: their directions, axes across them, angles between them, and distances in sigmas."""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray


def unit(vectors: ArrayLike) -> FloatArray:
    """Vectors (..., 3) of any length but zero, brought to length 1."""
    v = np.asarray(vectors, dtype=np.float64)
    # the norm of one vector is summed in another order than those along an axis
    length = np.linalg.norm(v) if v.ndim == 1 else np.linalg.norm(v, axis=-1, keepdims=True)
    directions: FloatArray = v / length
    return directions


def perpendicular_basis(axis: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors u, v (3,) square to a unit axis (3,) and to each other; v = axis x u.

    u is also square to the frame's axis that is farthest from `axis`.
    """
    u = unit(np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]))
    return u, np.cross(axis, u)


def angle_between(one: ArrayLike, other: ArrayLike) -> FloatArray:
    """Angles (...) between vectors (..., 3) of any lengths, rad; accurate from 0 to pi."""
    a, b = np.asarray(one, dtype=np.float64), np.asarray(other, dtype=np.float64)
    angles: FloatArray = np.arctan2(
        np.linalg.norm(np.cross(a, b), axis=-1), np.einsum("...i,...i->...", a, b)
    )
    return angles


def squared_distance(offset: FloatArray, covariance: FloatArray) -> float:
    """Squared Mahalanobis distance: offset (n,) over its covariance (n, n), dimensionless.

    Raises numpy.linalg.LinAlgError for a singular covariance.
    """
    return float(offset @ np.linalg.solve(covariance, offset))
