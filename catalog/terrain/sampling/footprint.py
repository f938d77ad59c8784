"""Heights of points from one level of a raster, each the mean over the point's footprint.

Points are sorted to the windows read for them. Toward the poles of a cylindrical map, where
columns lie closer, columns are averaged two and two until two or three samples span a footprint.
"""

from typing import NamedTuple

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray, Int8Array, IntArray
from catalog.geometry.grid import cubic_weights, interpolate_bicubic, sample_rows
from catalog.geometry.kernel import kernel
from catalog.terrain.pyramid.pyramid import LevelWindows, count_halvings
from catalog.terrain.sampling.map_nodes import Pixels

# Columns averaged into one node. Beyond it (the last postings about a pole) samples are spread:
# rasters are oversampled there, so neighbours in a row have the same height.
MAX_COLUMNS = 64
MAX_ROWS = 16  # the same of rows: more only where a posting is far coarser than the last level


MAX_AVERAGED = 8.0  # columns of a footprint beyond which nodes are not taken row by row

MAX_APART = 1.03  # rows of a window between places where it is sampled along a row of nodes


class Corner(NamedTuple):
    """Where a window of a level lies in the raster.

    per_row, per_col  rows and columns of the level in one of the raster
    row0, col0        first row and column of the window, of the level
    """

    per_row: float
    per_col: float
    row0: int
    col0: int


class Footprint(NamedTuple):
    """The size of footprints, rows and columns of the level.

    rows_wide      height
    columns_wide   width where the column scale is 1
    widest         columns of the whole turn
    largest_scale  largest column scale of the points
    """

    rows_wide: float
    columns_wide: float
    widest: float
    largest_scale: float


@kernel
def average_footprints(
    window: Float32Array,
    pixels: Pixels,
    chosen: IntArray,
    corner: Corner,
    footprint: Footprint,
    out: Float32Array,
) -> None:
    """Means of cubic samples over the footprints of the chosen points.

    A footprint below 1.5 pixels is one sample: the level was chosen to fit.
    """
    rows, cols, column_scale = pixels
    per_row, per_col, row0, col0 = corner
    rows_wide, columns_wide, widest, largest_scale = footprint
    down = count_samples(rows_wide, MAX_ROWS)
    along = count_samples(min(largest_scale * columns_wide, widest), MAX_COLUMNS)
    if down == 1 and along == 1:
        for i in chosen:
            row = (rows[i] + 0.5) * per_row - 0.5 - row0
            col = (cols[i] + 0.5) * per_col - 0.5 - col0
            # a place that the raster's projection cannot show is NaN; others lie well inside
            value = _interpolate_cubic(window, row, col) if row == row and col == col else np.nan
            out[i] = value if value == value else interpolate_bicubic(window, row, col)
        return
    row_weights, col_weights = np.zeros(2 * MAX_ROWS + 8), np.zeros(2 * MAX_COLUMNS + 8)
    for i in chosen:
        row = (rows[i] + 0.5) * per_row - 0.5 - row0
        col = (cols[i] + 0.5) * per_col - 0.5 - col0
        wide = min(column_scale[i] * columns_wide, widest)
        along = count_samples(wide, MAX_COLUMNS)
        if down == 1 and along == 1:
            out[i] = _sample_once(window, row, col)
            continue
        if not (row == row and col == col):  # a place that the raster's projection cannot show
            out[i] = np.nan
            continue
        # samples further apart than two pixels leave pixels between them: nothing to add up
        if rows_wide > 2.0 * MAX_ROWS or wide > 2.0 * MAX_COLUMNS:
            out[i] = _average_valid(window, row, col, rows_wide, wide, down, along)
            continue
        # cubic weights of all samples of the footprint, added up: it is separable
        first_row, rows_used = add_weights(row, rows_wide, down, row_weights)
        rows_used += -rows_used % 4  # further weights are zeros
        first_col, cols_used = add_weights(col, wide, along, col_weights)
        total = np.nan
        if (
            first_row >= 0
            and first_row + rows_used <= window.shape[0]
            and first_col >= 0
            and first_col + cols_used <= window.shape[1]
        ):
            total = 0.0
            for a in range(0, rows_used, 4):
                total += _sum_four_rows(
                    window, first_row + a, row_weights, a, first_col, cols_used, col_weights
                )
        if total != total:
            total = _average_valid(window, row, col, rows_wide, wide, down, along)
        out[i] = total


@kernel
def average_along_rows(
    window: Float32Array,
    pixels: Pixels,
    size: int,
    corner: Corner,
    footprint: Footprint,
    out: Float32Array,
) -> bool:
    """`average_footprints` of all nodes of a map grid, size a row, at a third of its time.

    The footprints of a row are as wide as that of its middle. NaN where a hole is touched. False
    where rows of nodes run across those of the window, or footprints are too large.
    """
    rows, cols, column_scale = pixels
    per_row, per_col, row0, col0 = corner
    rows_wide, columns_wide, widest, largest_scale = footprint
    if count_samples(rows_wide, MAX_ROWS) > 1 or size < 2:
        return False
    if largest_scale * columns_wide > min(MAX_AVERAGED, widest / 4.0):
        return False
    shape = rows.size // size, size
    wide = column_scale.reshape(shape)[:, size // 2] * columns_wide
    # a row is known where it crosses columns: on the ground, hardly farther apart than rows are
    apart = rows_wide / max(wide.min(), 1e-9)
    steepest = np.sqrt(max(MAX_APART**2 - apart * apart, MAX_APART**2 - 1.0))
    # the other way where the raster counts columns westward
    way = 1 if cols[size - 1] > cols[0] else -1
    return sample_rows(
        window,
        rows.reshape(shape)[:, ::way],
        cols.reshape(shape)[:, ::way],
        (per_row, 0.5 * per_row - 0.5 - row0, per_col, 0.5 * per_col - 0.5 - col0),
        wide,
        steepest,
        out.reshape(shape)[:, ::way],
    )


@kernel
def count_samples(wide: float, most: int) -> int:
    """Samples over a footprint some pixels wide."""
    return int(min(max(1.0, np.floor(wide + 0.5)), most))


@kernel
def _sample_once(window: Float32Array, row: float, col: float) -> float:
    """One cubic sample; bilinear beside holes and borders, NaN outside."""
    if 1.0 <= row < window.shape[0] - 2.0 and 1.0 <= col < window.shape[1] - 2.0:
        value = _interpolate_cubic(window, row, col)
        if value == value:
            return value
    return interpolate_bicubic(window, row, col)


@kernel
def _interpolate_cubic(window: Float32Array, row: float, col: float) -> float:
    """Cubic convolution where all sixteen neighbours are inside; NaN beside a hole."""
    r, c = np.uint64(row - 1.0), np.uint64(col - 1.0)
    a, b, d, e = cubic_weights(row - np.floor(row))
    step = np.uint64(1)
    r1, r2, r3 = r + step, r + step + step, r + step + step + step
    c1, c2, c3 = c + step, c + step + step, c + step + step + step
    # down first: four columns side by side
    v0 = a * window[r, c] + b * window[r1, c] + d * window[r2, c] + e * window[r3, c]
    v1 = a * window[r, c1] + b * window[r1, c1] + d * window[r2, c1] + e * window[r3, c1]
    v2 = a * window[r, c2] + b * window[r1, c2] + d * window[r2, c2] + e * window[r3, c2]
    v3 = a * window[r, c3] + b * window[r1, c3] + d * window[r2, c3] + e * window[r3, c3]
    a, b, d, e = cubic_weights(col - np.floor(col))
    return float(a * v0 + b * v1 + d * v2 + e * v3)


@kernel
def add_weights(at: float, wide: float, samples: int, out: FloatArray) -> tuple[int, int]:
    """Mean weights of cubics spread over a footprint; the first pixel and the number of them."""
    share = 1.0 / samples
    first = int(np.floor(at + (0.5 * share - 0.5) * wide)) - 1
    used = int(np.floor(at + ((samples - 0.5) * share - 0.5) * wide)) + 3 - first
    for k in range(used + 3):
        out[np.uint64(k)] = 0.0
    for k in range(samples):
        centre = at + ((k + 0.5) * share - 0.5) * wide
        node0 = np.floor(centre)
        start = np.uint64(int(node0) - 1 - first)
        for weight in cubic_weights(centre - node0):
            out[start] += weight * share
            start += np.uint64(1)
    return first, used


@kernel
def _sum_four_rows(
    window: Float32Array,
    row: int,
    row_weights: FloatArray,
    a: int,
    col: int,
    cols_used: int,
    col_weights: FloatArray,
) -> float:
    """Weighted sum over four rows from `row` on, whose weights are those from place `a` on."""
    # unsigned: an index that cannot count from the end needs no test
    step = np.uint64(1)
    w, r, c = np.uint64(a), np.uint64(row), np.uint64(col)
    w0, w1 = row_weights[w], row_weights[w + step]
    w2, w3 = row_weights[w + step + step], row_weights[w + step + step + step]
    r1, r2, r3 = r + step, r + step + step, r + step + step + step
    total = 0.0
    for k in range(cols_used):
        b = np.uint64(k)
        at = c + b
        total += col_weights[b] * (
            w0 * window[r, at] + w1 * window[r1, at] + w2 * window[r2, at] + w3 * window[r3, at]
        )
    return total


@kernel
def _average_valid(
    window: Float32Array,
    row: float,
    col: float,
    rows_wide: float,
    wide: float,
    down: int,
    along: int,
) -> float:
    """Average the samples that have a height; NaN where that is less than half."""
    total, valid = 0.0, 0
    for r in range(down):
        at_row = row + ((r + 0.5) / down - 0.5) * rows_wide
        for c in range(along):
            value = interpolate_bicubic(window, at_row, col + ((c + 0.5) / along - 0.5) * wide)
            if value == value:
                total += value
                valid += 1
    return total / valid if valid > 0 and 2 * valid >= down * along else np.nan


# A window larger than this (pixels, 64 MB) is cut into pieces: scattered points must not pull the
# whole raster into memory.
MAX_WINDOW = 16 << 20
PIECE = 512  # pixels a side of the raster that pieces are sorted by


def sample_level(
    base: LevelWindows, pixels: Pixels, rows_wide: float, size: int = 0
) -> Float32Array:
    """Heights (n) float32, NaN for none, of places in the whole raster from one of its levels.

    base       the level's windows
    rows_wide  rows of the level that a footprint is high
    size       nodes a row where the places are the rows of a map grid, else 0
    """
    out = np.full(pixels.row.size, np.nan, dtype=np.float32)
    if base.pyramid.source.wraps and not base.wraps:
        # a level of a raster whose columns cannot be halved evenly ends where the raster does
        period = base.period * base.scale
        pixels = pixels._replace(col=pixels.col - np.floor((pixels.col + 0.5) / period) * period)
    if not out.size:
        return out
    extent = _measure_extent(*pixels)
    inside = _is_inside(base, extent)
    if inside and not (size and _sample_along_rows(base, pixels, extent, rows_wide, size, out)):
        chosen = np.arange(out.size)
    else:  # nodes beside holes are left, or places outside the raster are not looked up
        wanted = np.isnan(out) if inside else _mark_inside(base, pixels, rows_wide)
        chosen = np.flatnonzero(wanted)
        if not chosen.size:
            return out
        extent = _measure_chosen_extent(*pixels, chosen)
    fewest, most = (count_halvings(wide * rows_wide, base.most_halvings) for wide in extent[4:])
    if fewest == most:
        _sample_in_pieces(base.get_halved(fewest), pixels, chosen, extent, rows_wide, out)
        return out
    halvings = _count_halvings(pixels.column_scale, rows_wide, base.most_halvings)
    for count in range(fewest, most + 1):
        those = chosen[halvings[chosen] == count]
        if those.size:
            extent = _measure_chosen_extent(*pixels, those)
            _sample_in_pieces(base.get_halved(count), pixels, those, extent, rows_wide, out)
    return out


Extent = tuple[float, float, float, float, float, float]


def _is_inside(base: LevelWindows, extent: Extent) -> bool:
    """Whether all points lie in the raster."""
    rows, cols = base.raster_shape
    top, bottom, left, right, _, _ = extent
    if not (top >= -0.5 and bottom <= rows - 0.5):
        return False
    return base.wraps or (left >= -0.5 and right <= cols - 0.5)


def _mark_inside(base: LevelWindows, pixels: Pixels, rows_wide: float) -> BoolArray:
    rows, cols = base.raster_shape
    inside = (pixels.row >= -0.5) & (pixels.row <= rows - 0.5)
    if not base.wraps:
        half = pixels.column_scale * (rows_wide * base.scale / 2.0)
        inside &= (pixels.col >= -0.5 - half) & (pixels.col <= cols - 0.5 + half)
    return inside


def _sample_along_rows(
    base: LevelWindows,
    pixels: Pixels,
    extent: Extent,
    rows_wide: float,
    size: int,
    out: Float32Array,
) -> bool:
    """Sample all nodes of a map grid, row by row; False where they must be taken one by one."""
    level = base.get_halved(int(count_halvings(extent[4] * rows_wide, base.most_halvings)))
    row0, col0, height, width = _bound_window(level, rows_wide, extent)
    if height * width > MAX_WINDOW:
        return False
    corner, footprint = _locate_window(level, rows_wide, extent, row0, col0)
    window = level.window(row0, col0, height, width)
    return bool(average_along_rows(window, pixels, size, corner, footprint, out))


def _locate_window(
    level: LevelWindows, rows_wide: float, extent: Extent, row0: int, col0: int
) -> tuple[Corner, Footprint]:
    """Locate a window from (row0, col0) on in the raster; also the size of footprints in it."""
    period = level.period or np.inf
    return (
        Corner(1.0 / level.scale, 1.0 / (level.scale * level.squeeze), row0, col0),
        Footprint(rows_wide, rows_wide / level.squeeze, period, extent[5]),
    )


def _sample_in_pieces(
    level: LevelWindows,
    pixels: Pixels,
    chosen: IntArray,
    extent: Extent,
    rows_wide: float,
    out: Float32Array,
) -> None:
    """Sample through one window, or through one for each part of the raster that is touched."""
    _, _, height, width = _bound_window(level, rows_wide, extent)
    if height * width <= MAX_WINDOW:
        _sample_window(level, pixels, chosen, extent, rows_wide, out)
        return
    row = pixels.row[chosen] / (PIECE * level.scale)
    col = pixels.col[chosen] / (PIECE * level.scale * level.squeeze)
    key = np.floor(row) * 1e6 + np.floor(col)
    order = np.argsort(key, kind="stable")
    for those in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        extent = _measure_chosen_extent(*pixels, chosen[those])
        _sample_window(level, pixels, chosen[those], extent, rows_wide, out)


def _bound_window(
    level: LevelWindows, rows_wide: float, extent: Extent
) -> tuple[int, int, int, int]:
    """First row, first column, height and width of the window that all footprints need."""
    top, bottom, left, right, _, column_scale = extent
    along = level.scale * level.squeeze
    half = rows_wide / 2.0 + 2.0  # two more pixels for the cubic's neighbours
    wide = min(column_scale * rows_wide / level.squeeze, level.period or np.inf) / 2.0 + 2.0
    row0 = int(np.floor((top + 0.5) / level.scale - 0.5 - half))
    row1 = int(np.ceil((bottom + 0.5) / level.scale - 0.5 + half))
    col0 = int(np.floor((left + 0.5) / along - 0.5 - wide))
    col1 = int(np.ceil((right + 0.5) / along - 0.5 + wide))
    return row0, col0, row1 - row0 + 1, col1 - col0 + 1


def _sample_window(
    level: LevelWindows,
    pixels: Pixels,
    chosen: IntArray,
    extent: Extent,
    rows_wide: float,
    out: Float32Array,
) -> None:
    row0, col0, height, width = _bound_window(level, rows_wide, extent)
    average_footprints(
        level.window(row0, col0, height, width),
        pixels,
        chosen,
        *_locate_window(level, rows_wide, extent, row0, col0),
        out,
    )


@kernel
def _find_range(values: FloatArray) -> tuple[float, float]:
    """Least and greatest of values (n); NaN does not count, but for a first one."""
    lanes = 64  # side by side, so that comparisons need not wait for each other
    low, high = np.full(lanes, values[0]), np.full(lanes, values[0])
    for begin in range(0, values.size, lanes):
        part = values[begin : begin + lanes]
        for j in range(part.size):
            low[j] = part[j] if part[j] < low[j] else low[j]
            high[j] = part[j] if part[j] > high[j] else high[j]
    return low.min(), high.max()


@kernel
def _measure_extent(row: FloatArray, col: FloatArray, column_scale: FloatArray) -> Extent:
    """`_measure_chosen_extent` of all points."""
    return (*_find_range(row), *_find_range(col), *_find_range(column_scale))


@kernel
def _measure_chosen_extent(
    row: FloatArray, col: FloatArray, column_scale: FloatArray, chosen: IntArray
) -> Extent:
    """Least and largest row, column and column scale of the chosen points."""
    i = chosen[0]
    top, bottom = row[i], row[i]
    left, right = col[i], col[i]
    narrow, wide = column_scale[i], column_scale[i]
    for i in chosen:
        top, bottom = min(top, row[i]), max(bottom, row[i])
        left, right = min(left, col[i]), max(right, col[i])
        narrow, wide = min(narrow, column_scale[i]), max(wide, column_scale[i])
    return top, bottom, left, right, narrow, wide


@kernel
def _count_halvings(column_scale: FloatArray, rows_wide: float, most: int) -> Int8Array:
    """Count the halvings of columns for each point."""
    out = np.empty(column_scale.size, np.int8)
    for i in range(column_scale.size):
        out[i] = count_halvings(column_scale[i] * rows_wide, most)
    return out
