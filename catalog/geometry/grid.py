"""Sampling of regular grids, with NaN for no data.

Compiled points of the stereographic map stand here, too; see projection.py.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.geometry.kernel import inplace_kernel, kernel


class _RowWork(NamedTuple):
    """Arrays that rows are sampled in.

    line, past, base  by column of the grid: samples, rows past the base, the row before
    fall, rows, cols  by place: rows a column to the next, row and column
    at, over, target  by place: the column before, columns past it, means
    """

    line: Float32Array
    past: Float32Array
    base: IntArray
    fall: FloatArray
    rows: FloatArray
    cols: FloatArray
    at: NDArray[np.uint32]
    over: Float32Array
    target: Float32Array


@inplace_kernel
def cubic_weights(t: float) -> tuple[float, float, float, float]:
    """Weights of the four neighbours for cubic convolution with a = -1/2 (Keys 1981)."""
    t2, t3 = t * t, t * t * t
    return (
        -0.5 * t + t2 - 0.5 * t3,
        1.0 - 2.5 * t2 + 1.5 * t3,
        0.5 * t + 2.0 * t2 - 1.5 * t3,
        -0.5 * t2 + 0.5 * t3,
    )


@inplace_kernel
def _interpolate_columns(
    grid: Float32Array,
    base: IntArray,
    past: Float32Array,
    span: tuple[int, int],
    line: Float32Array,
) -> bool:
    """Fill columns first to last of a line with samples `past` rows after base; False: outside."""
    half, unity, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    three_halves, five_halves = np.float32(1.5), np.float32(2.5)
    first, last = span
    height = grid.shape[0]
    begin = first
    while begin <= last:
        # columns that the row crosses between the same two of the grid
        r, end = base[begin], begin + 1
        while end <= last and base[end] == r:
            end += 1
        if r < 1 or r > height - 3:
            return False
        above, upper, lower, below = grid[r - 1], grid[r], grid[r + 1], grid[r + 2]
        for k in range(np.uint64(begin), np.uint64(end)):
            x = past[k]
            xx = x * x
            xxx = xx * x
            outer = (xx - half * (x + xxx)) * above[k] + half * (xxx - xx) * below[k]
            inner = (unity + three_halves * xxx - five_halves * xx) * upper[k]
            line[k] = outer + (inner + (half * x + two * xx - three_halves * xxx) * lower[k])
        begin = end
    return True


@inplace_kernel
def _average_along_line(
    line: Float32Array,
    cols: FloatArray,
    width: float,
    samples: int,
    work: _RowWork,
    out: Float32Array,
) -> None:
    """Fill means (n,) of samples of a line over a width about columns (n,)."""
    half, unity, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    three_halves, five_halves = np.float32(1.5), np.float32(2.5)
    size = cols.size
    at, over, target = work.at, work.over, work.target
    for j in range(size):
        target[j] = np.float32(0.0)
    share = np.float32(1.0 / samples)
    for s in range(samples):
        aside = ((s + 0.5) / samples - 0.5) * width - 1.0
        for j in range(size):
            col = cols[j] + aside
            at[j] = np.uint32(col)
            over[j] = np.float32(col - at[j])
        for j in range(size):
            i = np.uint64(at[j])
            x = over[j]
            xx = x * x
            xxx = xx * x
            outer = (xx - half * (x + xxx)) * line[i]
            outer += half * (xxx - xx) * line[i + np.uint64(3)]
            inner = (unity + three_halves * xxx - five_halves * xx) * line[i + np.uint64(1)]
            inner += (half * x + two * xx - three_halves * xxx) * line[i + np.uint64(2)]
            target[j] += share * (outer + inner)
    for j in range(size):
        out[j] = target[j]


@kernel
def sample_rows(
    grid: Float32Array,
    row: FloatArray,
    col: FloatArray,
    fit: tuple[float, float, float, float],
    wide: FloatArray,
    steepest: float,
    out: Float32Array,
) -> bool:
    """Means of cubic samples over footprints about places in rows.

    row, col  (m, n) of the places, along each of which columns rise
    fit       a, b, c, d: of the grid they are a row + b, c col + d
    wide      (m,) columns that the footprints of a row are wide, a sample for each
    steepest  rows that a row of places may cross a column
    out       (m, n)

    The grid is sampled down its columns where a row crosses them, then that line along. Values
    are those of `cubic_weights` but for single precision (1e-7 of them) and for the row's slope
    times what a cubic misses between columns. NaN where a hole is touched. False, with some rows
    made, where a row leaves the grid or crosses it too steeply.
    """
    width, size = grid.shape[1], col.shape[1]
    work = _RowWork(
        np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.int64),
        np.empty(size - 1), np.empty(size), np.empty(size),
        np.empty(size, np.uint32), np.empty(size, np.float32), np.empty(size, np.float32),
    )  # fmt: skip
    return _sample_each_row(grid, row, col, fit, wide, steepest, work, out)


@inplace_kernel
def _sample_each_row(
    grid: Float32Array,
    row: FloatArray,
    col: FloatArray,
    fit: tuple[float, float, float, float],
    wide: FloatArray,
    steepest: float,
    work: _RowWork,
    out: Float32Array,
) -> bool:
    """`sample_rows` in given arrays."""
    width, size = grid.shape[1], col.shape[1]
    line, past, base = work.line, work.past, work.base
    fall, rows, cols = work.fall, work.rows, work.cols
    per_row, row0, per_col, col0 = fit
    for m in range(out.shape[0]):
        for j in range(size):
            rows[j] = row[m, j] * per_row + row0
            cols[j] = col[m, j] * per_col + col0
        samples = max(1, int(wide[m] + 0.5))
        reach = 0.5 * wide[m] * (samples - 1) / samples
        first, last = int(np.floor(cols[0] - reach)) - 1, int(cols[size - 1] + reach) + 2
        if not (first >= 0 and last < width):
            return False
        steep = 0
        for j in range(size - 1):
            step = cols[j + 1] - cols[j]
            fall[j] = (rows[j + 1] - rows[j]) / step
            steep += 0 if (step > 0.0) & (abs(fall[j]) <= steepest) else 1
        if steep:
            return False
        c = first
        for j in range(size - 1):
            # columns beyond the outer places lie on the lines of these
            end = last + 1 if j == size - 2 else int(cols[j + 1]) + 1
            while c < end:
                crossed = rows[j] + (c - cols[j]) * fall[j]
                base[c] = int(crossed)
                past[c] = np.float32(crossed - base[c])
                c += 1
        if not _interpolate_columns(grid, base, past, (first, last), line):
            return False
        _average_along_line(line, cols, wide[m], samples, work, out[m])
    return True


@inplace_kernel
def interpolate_bilinear(grid: Float32Array, row: float, col: float) -> float:
    """Value between four nodes; the place must lie inside."""
    r = min(max(int(row), 0), grid.shape[0] - 2)
    c = min(max(int(col), 0), grid.shape[1] - 2)
    y, x = row - r, col - c
    upper = grid[r, c] + x * (grid[r, c + 1] - grid[r, c])
    lower = grid[r + 1, c] + x * (grid[r + 1, c + 1] - grid[r + 1, c])
    return float(upper + y * (lower - upper))


@inplace_kernel
def _interpolate_near_holes(grid: Float32Array, row: float, col: float) -> float:
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


@inplace_kernel
def interpolate_bicubic(grid: Float32Array, row: float, col: float) -> float:
    """Cubic convolution at one place; bilinear at the border and beside holes; NaN outside."""
    rows, cols = grid.shape
    if not (1.0 <= row < rows - 2.0 and 1.0 <= col < cols - 2.0):
        return _interpolate_near_holes(grid, row, col)
    r, c = int(row), int(col)
    wr, wc = cubic_weights(row - r), cubic_weights(col - c)
    total = 0.0
    for i in range(4):
        line = 0.0
        for j in range(4):
            line += wc[j] * grid[r - 1 + i, c - 1 + j]
        total += wr[i] * line
    if total != total:
        return _interpolate_near_holes(grid, row, col)
    return total


@kernel
def _sample_flat(grid: Float32Array, row: FloatArray, col: FloatArray) -> Float32Array:
    out = np.empty(row.size, np.float32)
    for i in range(row.size):
        out[i] = interpolate_bicubic(grid, row[i], col[i])
    return out


def sample_bicubic(grid: Float32Array, row: FloatArray, col: FloatArray) -> Float32Array:
    """Values (float32, shape of `row`) of a grid at fractional rows and columns; NaN outside."""
    row = np.ascontiguousarray(row, dtype=np.float64)
    col = np.ascontiguousarray(col, dtype=np.float64)
    grid = np.ascontiguousarray(grid, dtype=np.float32)
    return _sample_flat(grid, row.ravel(), col.ravel()).reshape(row.shape)


@kernel
def compute_map_points(
    x: FloatArray, y: FloatArray, height: FloatArray, radius: float, body_from_local: FloatArray
) -> FloatArray:
    """Body-fixed points (n, 3) of a stereographic map, in one pass; see `local_directions`."""
    out = np.empty((x.size, 3))
    m = body_from_local
    for i in range(x.size):
        u, v = x[i] / (2.0 * radius), y[i] / (2.0 * radius)
        squared = u * u + v * v
        reach = (radius + height[i]) / (1.0 + squared)
        east, north, up = 2.0 * u * reach, 2.0 * v * reach, (1.0 - squared) * reach
        for k in range(3):
            out[i, k] = m[k, 0] * east + m[k, 1] * north + m[k, 2] * up
    return out


@kernel
def compute_node_points(
    offsets: FloatArray, heights: Float32Array, radius: float, body_from_local: FloatArray
) -> FloatArray:
    """Compute points (n, n, 3) of the nodes of a centred grid; offsets (n,) of its columns."""
    size = offsets.size
    out = np.empty((size, size, 3))
    m = body_from_local
    for i in range(size):
        v = -offsets[i] / (2.0 * radius)
        for j in range(size):
            u = offsets[j] / (2.0 * radius)
            squared = u * u + v * v
            reach = (radius + heights[i, j]) / (1.0 + squared)
            east, north, up = 2.0 * u * reach, 2.0 * v * reach, (1.0 - squared) * reach
            for k in range(3):
                out[i, j, k] = m[k, 0] * east + m[k, 1] * north + m[k, 2] * up
    return out
