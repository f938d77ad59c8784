"""Heights of points from one level of a raster, each the mean over the point's footprint.

Points are sorted to the windows that are read for them; `footprint_means` takes the means. Toward
the poles of a cylindrical map columns crowd. A point there reads the rows of its level with
columns averaged two and two as often as its footprint is wide, so that two or three samples do
wherever it lies.
"""

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray, Int8Array, IntArray
from catalog.geometry.kernel import kernel
from catalog.terrain.footprint_means import means_over_footprints
from catalog.terrain.level_window import LevelWindows, halvings_for
from catalog.terrain.map_nodes import Pixels

# A window larger than this (pixels, 64 MB) is cut into pieces: scattered points must not pull the
# whole raster into memory.
LARGEST_WINDOW = 16 << 20
PIECE = 512  # pixels a side of the raster that pieces are sorted by


def sample_level(base: LevelWindows, pixels: Pixels, rows_wide: float) -> Float32Array:
    """Heights (n) float32, NaN for none, of places in the whole raster from one of its levels.

    base       the level's windows
    rows_wide  rows of the level that a footprint is high
    """
    out = np.full(pixels.row.size, np.nan, dtype=np.float32)
    if base.pyramid.source.wraps and not base.wraps:
        # a level of a raster whose columns cannot be halved evenly ends where the raster does
        period = base.period * base.scale
        pixels = pixels._replace(col=pixels.col - np.floor((pixels.col + 0.5) / period) * period)
    chosen = np.arange(pixels.row.size)
    if chosen.size and not _inside(base, _extent(*pixels, chosen)):
        chosen = np.flatnonzero(_inside_each(base, pixels, rows_wide))
    if not chosen.size:
        return out
    extent = _extent(*pixels, chosen)
    fewest, most = (halvings_for(wide * rows_wide, base.most_halvings) for wide in extent[4:])
    if fewest == most:
        _in_pieces(base.halved(fewest), pixels, chosen, rows_wide, out)
        return out
    halvings = _halvings(pixels.crowding, rows_wide, base.most_halvings)
    for count in range(fewest, most + 1):
        those = chosen[halvings[chosen] == count]
        if those.size:
            _in_pieces(base.halved(count), pixels, those, rows_wide, out)
    return out


Extent = tuple[float, float, float, float, float, float]


def _inside(base: LevelWindows, extent: Extent) -> bool:
    """Whether all points lie in the raster."""
    rows, cols = base.raster_shape
    top, bottom, left, right, _, _ = extent
    if not (top >= -0.5 and bottom <= rows - 0.5):
        return False
    return base.wraps or (left >= -0.5 and right <= cols - 0.5)


def _inside_each(base: LevelWindows, pixels: Pixels, rows_wide: float) -> BoolArray:
    rows, cols = base.raster_shape
    inside = (pixels.row >= -0.5) & (pixels.row <= rows - 0.5)
    if not base.wraps:
        half = pixels.crowding * (rows_wide * base.scale / 2.0)
        inside &= (pixels.col >= -0.5 - half) & (pixels.col <= cols - 0.5 + half)
    return np.asarray(inside)


def _in_pieces(
    sheet: LevelWindows, pixels: Pixels, chosen: IntArray, rows_wide: float, out: Float32Array
) -> None:
    """Sample through one window, or through one for each part of the raster that is touched."""
    _, _, height, width = _bounds(sheet, rows_wide, _extent(*pixels, chosen))
    if height * width <= LARGEST_WINDOW:
        _through_window(sheet, pixels, chosen, rows_wide, out)
        return
    row = pixels.row[chosen] / (PIECE * sheet.scale)
    col = pixels.col[chosen] / (PIECE * sheet.scale * sheet.squeeze)
    key = np.floor(row) * 1e6 + np.floor(col)
    order = np.argsort(key, kind="stable")
    for those in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        _through_window(sheet, pixels, chosen[those], rows_wide, out)


def _bounds(sheet: LevelWindows, rows_wide: float, extent: Extent) -> tuple[int, int, int, int]:
    """First row, first column, height and width of the window that all footprints need."""
    top, bottom, left, right, _, crowding = extent
    along = sheet.scale * sheet.squeeze
    half = rows_wide / 2.0 + 2.0  # two more pixels for the cubic's neighbours
    wide = min(crowding * rows_wide / sheet.squeeze, sheet.period or np.inf) / 2.0 + 2.0
    row0 = int(np.floor((top + 0.5) / sheet.scale - 0.5 - half))
    row1 = int(np.ceil((bottom + 0.5) / sheet.scale - 0.5 + half))
    col0 = int(np.floor((left + 0.5) / along - 0.5 - wide))
    col1 = int(np.ceil((right + 0.5) / along - 0.5 + wide))
    return row0, col0, row1 - row0 + 1, col1 - col0 + 1


def _through_window(
    sheet: LevelWindows, pixels: Pixels, chosen: IntArray, rows_wide: float, out: Float32Array
) -> None:
    extent = _extent(*pixels, chosen)
    row0, col0, height, width = _bounds(sheet, rows_wide, extent)
    means_over_footprints(
        sheet.window(row0, col0, height, width),
        pixels.row,
        pixels.col,
        pixels.crowding,
        chosen,
        1.0 / sheet.scale,
        1.0 / (sheet.scale * sheet.squeeze),
        row0,
        col0,
        rows_wide,
        rows_wide / sheet.squeeze,
        sheet.period or np.inf,
        extent[5],
        out,
    )


@kernel
def _extent(row: FloatArray, col: FloatArray, crowding: FloatArray, chosen: IntArray) -> Extent:
    """Least and largest row, column and crowding of the chosen points."""
    i = chosen[0]
    top, bottom = row[i], row[i]
    left, right = col[i], col[i]
    narrow, wide = crowding[i], crowding[i]
    for i in chosen:
        top, bottom = min(top, row[i]), max(bottom, row[i])
        left, right = min(left, col[i]), max(right, col[i])
        narrow, wide = min(narrow, crowding[i]), max(wide, crowding[i])
    return top, bottom, left, right, narrow, wide


@kernel
def _halvings(crowding: FloatArray, rows_wide: float, most: int) -> Int8Array:
    """How often columns are halved for each point."""
    out = np.empty(crowding.size, np.int8)
    for i in range(crowding.size):
        out[i] = halvings_for(crowding[i] * rows_wide, most)
    return out
