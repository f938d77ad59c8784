"""Heights on a graticule: means over the nodes' footprints, as of any points, but much cheaper.

On a cylindrical raster a footprint's rows depend on the latitude alone and its columns on the
longitude alone, so their weights are worked out once a row and once a column. Elsewhere points are
read one by one. A node's height is the same, bit by bit, in whatever part it is read: places are
worked out before the part's own corner is taken off them.
"""

from collections.abc import Callable

import numpy as np

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.geometry.cells import Graticule, Part
from catalog.geometry.kernel import inplace_kernel, kernel
from catalog.terrain.pyramid.pyramid import HeightPyramid, LevelWindows, count_halvings
from catalog.terrain.sampling.footprint import MAX_COLUMNS, MAX_ROWS, add_weights, count_samples

BLOCK = 128  # nodes a side: points are read by whole blocks, for any part


def sample_by_blocks(
    heights: Callable[[FloatArray, FloatArray, float], Float32Array],
    graticule: Graticule,
    part: Part,
    posting_m: float,
) -> Float32Array:
    """Heights (height, width) m of a part from those of points; row 0 south, column 0 west.

    heights  heights of points (latitudes and longitudes, rad) at a posting, m
    """
    out = np.empty((part.height, part.width), np.float32)
    down, along = part.rows // BLOCK, np.mod(part.cols, graticule.columns) // BLOCK
    for band in np.unique(down):
        rows = np.arange(band * BLOCK, (band + 1) * BLOCK)
        lat = np.clip(graticule.lat(rows), -np.pi / 2.0, np.pi / 2.0)
        for turn in np.unique(along):
            cols = np.arange(turn * BLOCK, min((turn + 1) * BLOCK, graticule.columns))
            block = heights(lat[:, None], graticule.lon(cols), posting_m)
            i, j = np.flatnonzero(down == band), np.flatnonzero(along == turn)
            own_rows = part.rows[i] - rows[0]
            own_cols = np.mod(part.cols[j], graticule.columns) - cols[0]
            out[np.ix_(i, j)] = block[np.ix_(own_rows, own_cols)]
    return out


def sample_by_weights(
    base: LevelWindows, pyramid: HeightPyramid, graticule: Graticule, part: Part, rows_wide: float
) -> Float32Array:
    """Heights (height, width) m of a part from a level of a cylindrical raster, NaN for none.

    rows_wide  rows of the level that a footprint is high
    A node whose footprint touches a hole has no height.
    """
    georeference = pyramid.source.georeference
    col0, cols_per_rad, row0, rows_per_rad, period = georeference.parameters
    wide = period / (graticule.columns * base.scale)
    level = base.get_halved(int(count_halvings(wide, base.most_halvings)))
    row = (row0 + rows_per_rad * graticule.lat(part.rows) + 0.5) / level.scale - 0.5
    col = col0 + cols_per_rad * georeference.longitude_sign * graticule.lon(part.cols)
    # of that turn which the raster shows
    col -= np.floor((col - (georeference.shape[1] - 1) / 2.0) / period + 0.5) * period
    col = (col + 0.5) / (level.scale * level.squeeze) - 0.5
    first_row, row_weights = _make_weights(row, rows_wide, MAX_ROWS)
    first_col, col_weights = _make_weights(col, wide / level.squeeze, MAX_COLUMNS)
    out = np.empty((part.height, part.width), np.float32)
    # neighbours in the part may be a turn apart in the raster
    most = 4.0 * wide / level.squeeze + 4.0
    cuts = np.flatnonzero(np.abs(np.diff(first_col)) > most) + 1
    top, height = int(first_row.min()), int(np.ptp(first_row)) + row_weights.shape[1]
    for those in np.split(np.arange(part.width), cuts):
        firsts, weights = first_col[those], col_weights[those]
        left, width = int(firsts.min()), int(np.ptp(firsts)) + weights.shape[1]
        window = level.window(top, left, height, width)
        part_out = out[:, those[0] : those[-1] + 1]
        line = np.empty(width, np.float32)
        _combine(window, first_row - top, row_weights, firsts - left, weights, line, part_out)
    return out


@kernel
def _make_weights(at: FloatArray, wide: float, most: int) -> tuple[IntArray, Float32Array]:
    """First pixel and weights (n, taps) of footprints about places, `wide` pixels wide."""
    samples = count_samples(wide, most)
    taps = int(np.ceil(wide)) + 5
    line = np.zeros(taps + 8)
    first = np.empty(at.size, np.int64)
    out = np.zeros((at.size, taps), np.float32)
    used = 0
    for i in range(at.size):
        first[i], count = add_weights(at[i], wide, samples, line)
        for k in range(count):
            out[i, k] = line[k]
        used = max(used, count)
    return first, out[:, :used].copy()


@inplace_kernel
def _combine(
    window: Float32Array,
    first_row: IntArray,
    row_weights: Float32Array,
    first_col: IntArray,
    col_weights: Float32Array,
    line: Float32Array,
    out: Float32Array,
) -> None:
    """Weighted sums down, in `line` (columns of the window,), then along."""
    taps = col_weights.shape[1]
    for i in range(out.shape[0]):
        line[:] = np.float32(0.0)
        for k in range(row_weights.shape[1]):
            weight, source = row_weights[i, k], window[first_row[i] + k]
            if weight != 0.0:
                for c in range(line.size):
                    line[c] += weight * source[c]
        for j in range(out.shape[1]):
            total = np.float32(0.0)
            start = np.uint64(first_col[j])
            for k in range(np.uint64(taps)):
                total += col_weights[j, k] * line[start + k]
            out[i, j] = total
