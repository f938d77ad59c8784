"""Rotations: scalar-first quaternions of files, small rotation vectors, RNB axes."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.geometry.vectors import unit

ARCSEC = np.pi / 648000.0  # rad


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
