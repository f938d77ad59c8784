"""Sampling of regular grids, with NaN for no data."""

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel


@kernel
def cubic_weights(t: float) -> tuple[float, float, float, float]:
    """Weights of the four neighbours for cubic convolution with a = -1/2 (Keys 1981)."""
    t2, t3 = t * t, t * t * t
    return (
        -0.5 * t + t2 - 0.5 * t3,
        1.0 - 2.5 * t2 + 1.5 * t3,
        0.5 * t + 2.0 * t2 - 1.5 * t3,
        -0.5 * t2 + 0.5 * t3,
    )


@kernel
def bilinear(grid: Float32Array, row: float, col: float) -> float:
    """Value between four nodes; the place must lie inside."""
    r = min(max(int(row), 0), grid.shape[0] - 2)
    c = min(max(int(col), 0), grid.shape[1] - 2)
    y, x = row - r, col - c
    upper = grid[r, c] + x * (grid[r, c + 1] - grid[r, c])
    lower = grid[r + 1, c] + x * (grid[r + 1, c + 1] - grid[r + 1, c])
    return float(upper + y * (lower - upper))


@kernel
def _bilinear_at(grid: Float32Array, row: float, col: float) -> float:
    rows, cols = grid.shape
    # half a cell beyond the outer nodes still belongs to the outer pixels
    if not (-0.5 <= row <= rows - 0.5 and -0.5 <= col <= cols - 0.5):
        return np.nan
    row = min(max(row, 0.0), rows - 1.0)
    col = min(max(col, 0.0), cols - 1.0)
    r = min(int(row), max(rows - 2, 0))
    c = min(int(col), max(cols - 2, 0))
    dr, dc = row - r, col - c
    r2, c2 = min(r + 1, rows - 1), min(c + 1, cols - 1)
    total = weight = 0.0
    for rr, wr in ((r, 1.0 - dr), (r2, dr)):
        for cc, wc in ((c, 1.0 - dc), (c2, dc)):
            w = wr * wc
            if w > 0.0:
                value = grid[rr, cc]
                if value == value:
                    total += w * value
                    weight += w
    # a hole is a hole: at least half of the weight must be real data
    if weight < 0.5:
        return np.nan
    return total / weight


@kernel
def bicubic_at(grid: Float32Array, row: float, col: float) -> float:
    """Cubic convolution at one place; bilinear at the border and beside holes; NaN outside."""
    rows, cols = grid.shape
    if not (1.0 <= row < rows - 2.0 and 1.0 <= col < cols - 2.0):
        return _bilinear_at(grid, row, col)
    r, c = int(row), int(col)
    wr, wc = cubic_weights(row - r), cubic_weights(col - c)
    total = 0.0
    for i in range(4):
        line = 0.0
        for j in range(4):
            line += wc[j] * grid[r - 1 + i, c - 1 + j]
        total += wr[i] * line
    if total != total:
        return _bilinear_at(grid, row, col)
    return total


@kernel
def _sample_flat(grid: Float32Array, row: FloatArray, col: FloatArray) -> Float32Array:
    out = np.empty(row.size, np.float32)
    for i in range(row.size):
        out[i] = bicubic_at(grid, row[i], col[i])
    return out


def sample_bicubic(grid: Float32Array, row: FloatArray, col: FloatArray) -> Float32Array:
    """Values (float32, shape of `row`) of a grid at fractional rows and columns; NaN outside."""
    row = np.ascontiguousarray(row, dtype=np.float64)
    col = np.ascontiguousarray(col, dtype=np.float64)
    grid = np.ascontiguousarray(grid, dtype=np.float32)
    return _sample_flat(grid, row.ravel(), col.ravel()).reshape(row.shape)
