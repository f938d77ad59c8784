"""Vectors and rotations: directions, angles, distances in sigmas, quaternions, RNB axes.

Quaternions are scalar first, as in files.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray

ARCSEC = np.pi / 648000.0  # rad


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


def rotation_from_quaternion(qw: float, qx: float, qy: float, qz: float) -> Rotation:
    """Rotation of a scalar-first quaternion of any non-zero length.

    Raises ValueError for a quaternion of zero length or with a value that is not finite.
    """
    quaternion = np.array([qw, qx, qy, qz], dtype=np.float64)
    length = float(np.linalg.norm(quaternion))
    if not np.isfinite(length) or length < 1e-12:
        raise ValueError("the quaternion has no direction")
    return Rotation.from_quat(quaternion / length, scalar_first=True)


def quaternion_from_rotation(rotation: Rotation) -> FloatArray:
    """Scalar-first unit quaternion (4,), scalar not negative: one for each attitude."""
    quaternion: FloatArray = rotation.as_quat(canonical=True, scalar_first=True)
    return quaternion


def cross_matrix(vectors: ArrayLike) -> FloatArray:
    """Matrices (..., 3, 3) with cross_matrix(a) @ b = a x b."""
    v = np.asarray(vectors, dtype=np.float64)
    out = np.zeros((*v.shape, 3))
    for row, col, axis in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., row, col], out[..., col, row] = -v[..., axis], v[..., axis]
    return out


def rnb_axes(position: ArrayLike, forward: ArrayLike) -> FloatArray:
    """Axes R, N, B as the rows of a (3, 3) matrix: rnb = axes @ body.

    position (3,), forward (3,): the place and a direction of motion, any lengths, same frame.
    R is along the position, B across the plane of motion, N completes them (forward).
    Raises ValueError when the motion is radial.
    """
    r = unit(position)
    b = np.cross(r, np.asarray(forward, dtype=np.float64))
    length = float(np.linalg.norm(b))
    if length < 1e-12 * float(np.linalg.norm(forward)) or length == 0.0:
        raise ValueError("the motion is radial: no orbit plane")
    b = b / length
    return np.stack([r, np.cross(b, r), b])
