"""Means of cubic samples of a window over the footprints of points, in compiled code."""

import numpy as np

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.geometry.grid import bicubic_at, cubic_weights
from catalog.geometry.kernel import kernel

# Columns averaged into one node. Beyond it (the last postings about a pole) samples are spread:
# rasters are oversampled there, so neighbours in a row say the same.
MOST_COLUMNS = 64
MOST_ROWS = 16  # the same of rows: more only where a posting is far coarser than the last level


@kernel
def means_over_footprints(
    window: Float32Array,
    rows: FloatArray,
    cols: FloatArray,
    crowding: FloatArray,
    chosen: IntArray,
    per_row: float,
    per_col: float,
    row0: int,
    col0: int,
    rows_wide: float,
    crowding_wide: float,
    widest: float,
    most_crowding: float,
    out: Float32Array,
) -> None:
    """Means of cubic samples over footprints of `rows_wide` rows and crowding-wide columns.

    A footprint below 1.5 pixels is one sample: the level was chosen to fit.
    """
    down = samples_across(rows_wide, MOST_ROWS)
    single = (
        down == 1 and samples_across(min(most_crowding * crowding_wide, widest), MOST_COLUMNS) == 1
    )
    if single:
        for i in chosen:
            row = (rows[i] + 0.5) * per_row - 0.5 - row0
            col = (cols[i] + 0.5) * per_col - 0.5 - col0
            # a place that the raster's projection cannot show is NaN; others lie well inside
            value = _cubic(window, row, col) if row == row and col == col else np.nan
            out[i] = value if value == value else bicubic_at(window, row, col)
        return
    row_weights, col_weights = np.zeros(2 * MOST_ROWS + 8), np.zeros(2 * MOST_COLUMNS + 8)
    for i in chosen:
        row = (rows[i] + 0.5) * per_row - 0.5 - row0
        col = (cols[i] + 0.5) * per_col - 0.5 - col0
        wide = min(crowding[i] * crowding_wide, widest)
        along = samples_across(wide, MOST_COLUMNS)
        if down == 1 and along == 1:
            out[i] = _single(window, row, col)
            continue
        if not (row == row and col == col):  # a place that the raster's projection cannot show
            out[i] = np.nan
            continue
        # samples further apart than two pixels leave pixels between them: nothing to add up
        if rows_wide > 2.0 * MOST_ROWS or wide > 2.0 * MOST_COLUMNS:
            out[i] = _mean_of_what_is_there(window, row, col, rows_wide, wide, down, along)
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
                total += _four_rows(
                    window, first_row + a, row_weights, a, first_col, cols_used, col_weights
                )
        if total != total:
            total = _mean_of_what_is_there(window, row, col, rows_wide, wide, down, along)
        out[i] = total


@kernel
def samples_across(wide: float, most: int) -> int:
    """Samples over a footprint some pixels wide."""
    return int(min(max(1.0, np.floor(wide + 0.5)), most))


@kernel
def _single(window: Float32Array, row: float, col: float) -> float:
    """One cubic sample; bilinear beside holes and borders, NaN outside."""
    if 1.0 <= row < window.shape[0] - 2.0 and 1.0 <= col < window.shape[1] - 2.0:
        value = _cubic(window, row, col)
        if value == value:
            return value
    return bicubic_at(window, row, col)


@kernel
def _cubic(window: Float32Array, row: float, col: float) -> float:
    """Cubic convolution where all sixteen neighbours are inside; NaN beside a hole."""
    r, c = np.uint64(row - 1.0), np.uint64(col - 1.0)
    a, b, d, e = cubic_weights(row - np.floor(row))
    one = np.uint64(1)
    r1, r2, r3 = r + one, r + one + one, r + one + one + one
    c1, c2, c3 = c + one, c + one + one, c + one + one + one
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
        place = at + ((k + 0.5) * share - 0.5) * wide
        whole = np.floor(place)
        start = np.uint64(int(whole) - 1 - first)
        for weight in cubic_weights(place - whole):
            out[start] += weight * share
            start += np.uint64(1)
    return first, used


@kernel
def _four_rows(
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
    one = np.uint64(1)
    w, r, c = np.uint64(a), np.uint64(row), np.uint64(col)
    w0, w1 = row_weights[w], row_weights[w + one]
    w2, w3 = row_weights[w + one + one], row_weights[w + one + one + one]
    r1, r2, r3 = r + one, r + one + one, r + one + one + one
    total = 0.0
    for k in range(cols_used):
        b = np.uint64(k)
        at = c + b
        total += col_weights[b] * (
            w0 * window[r, at] + w1 * window[r1, at] + w2 * window[r2, at] + w3 * window[r3, at]
        )
    return total


@kernel
def _mean_of_what_is_there(
    window: Float32Array,
    row: float,
    col: float,
    rows_wide: float,
    wide: float,
    down: int,
    along: int,
) -> float:
    """The same mean over the samples that have a height; NaN where that is less than half."""
    total, valid = 0.0, 0
    for r in range(down):
        at_row = row + ((r + 0.5) / down - 0.5) * rows_wide
        for c in range(along):
            value = bicubic_at(window, at_row, col + ((c + 0.5) / along - 0.5) * wide)
            if value == value:
                total += value
                valid += 1
    return total / valid if valid > 0 and 2 * valid >= down * along else np.nan
