"""Symmetric 3 x 3 matrices in compiled code."""

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel


@kernel
def inverse_of(m: FloatArray) -> FloatArray:
    """Inverse of a symmetric 3 x 3 matrix by cofactors; NaN when it is singular."""
    out = np.empty((3, 3))
    a = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    b = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
    c = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
    det = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
    size = m[0, 0] * m[1, 1] * m[2, 2]
    scale = 1.0 / det if det > 1e-14 * size else np.nan
    out[0, 0], out[0, 1], out[0, 2] = a * scale, b * scale, c * scale
    out[1, 0], out[1, 1] = out[0, 1], (m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]) * scale
    out[1, 2] = (m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]) * scale
    out[2, 0], out[2, 1] = out[0, 2], out[1, 2]
    out[2, 2] = (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]) * scale
    return out


@kernel
def mirrored(upper: FloatArray) -> FloatArray:
    """A symmetric matrix (3, 3) whose upper triangle is filled, with the lower one too."""
    for k in range(3):
        for m in range(k):
            upper[k, m] = upper[m, k]
    return upper
