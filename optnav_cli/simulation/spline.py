"""Cubic spline through the nodes of a height grid, smooth to the second derivative.

A terrain model shown finer than its posting must not show its posting: cubic convolution has kinks
of curvature at the nodes, which low light makes visible as a grid.
"""

import numba
import numpy as np
from scipy.ndimage import spline_filter

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel, parallel_kernel

MARGIN = 16  # nodes beyond which a border no longer matters: 0.27^16 is below 1e-9


def coefficients(heights: Float32Array) -> FloatArray:
    """Spline coefficients (rows, cols) of a grid without holes."""
    return np.asarray(spline_filter(heights.astype(np.float64), order=3, mode="mirror"))


@kernel
def _weight(t: float) -> float:
    """The cubic B-spline."""
    t = abs(t)
    if t < 1.0:
        return 2.0 / 3.0 - t * t + 0.5 * t * t * t
    return (2.0 - t) ** 3 / 6.0 if t < 2.0 else 0.0


@parallel_kernel
def sample(spline: FloatArray | Float32Array, row: FloatArray, col: FloatArray) -> Float32Array:
    """Heights (float32, shape of `row`) at fractional rows and columns, 2-d arrays.

    Beyond the outer nodes the grid is mirrored about them.
    """
    rows, cols = spline.shape
    out = np.empty(row.shape, np.float32)
    for i in numba.prange(row.shape[0]):
        for j in range(row.shape[1]):
            r, c = int(np.floor(row[i, j])), int(np.floor(col[i, j]))
            total = 0.0
            for p in range(r - 1, r + 3):
                q_row = abs(p) if p < rows else 2 * rows - 2 - p
                weight = _weight(row[i, j] - p)
                line = 0.0
                for q in range(c - 1, c + 3):
                    q_col = abs(q) if q < cols else 2 * cols - 2 - q
                    line += _weight(col[i, j] - q) * spline[q_row, q_col]
                total += weight * line
            out[i, j] = np.float32(total)
    return out
