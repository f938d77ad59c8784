"""Windows of a pyramid level that go on across ±180° and the poles; tiles in a bounded cache."""

from collections import OrderedDict

import numpy as np
from numpy.typing import NDArray

from catalog.terrain.pyramid import HeightPyramid

HeightGrid = NDArray[np.float32]

TILE = 256  # pixels a side; whole tiles of the overviews
CACHE_BYTES = 128 << 20  # 512 tiles: a ring of a 92 160-column raster about a pole, and some more
POLE_TOLERANCE = 0.02  # rows by which a raster's edge may miss the pole and still be mirrored there


class TileCache:
    """The tiles used last, over all pyramids of a mosaic, up to a number of bytes."""

    def __init__(self, limit_bytes: int = CACHE_BYTES) -> None:
        self.limit_bytes = limit_bytes
        self.held_bytes = 0
        self._tiles: OrderedDict[tuple[int, int, int, int], HeightGrid] = OrderedDict()

    def tile(
        self, index: int, pyramid: HeightPyramid, level: int, down: int, along: int
    ) -> HeightGrid:
        """Tile (down, along) of a level; shorter at the raster's far edges."""
        key = (index, level, down, along)
        found = self._tiles.get(key)
        if found is not None:
            self._tiles.move_to_end(key)
            return found
        rows, cols = pyramid.shape(level)
        row, col = down * TILE, along * TILE
        made = pyramid.read(level, row, col, min(TILE, rows - row), min(TILE, cols - col))
        self._tiles[key] = made
        self.held_bytes += made.nbytes
        while self.held_bytes > self.limit_bytes and len(self._tiles) > 1:
            _, dropped = self._tiles.popitem(last=False)
            self.held_bytes -= dropped.nbytes
        return made


class LevelWindows:
    """One level of a pyramid as an endless sheet."""

    def __init__(self, index: int, pyramid: HeightPyramid, level: int, cache: TileCache) -> None:
        self.index, self.pyramid, self.level, self.cache = index, pyramid, level, cache
        self.shape = pyramid.shape(level)
        place = pyramid.source.place
        self.scale = 2.0**level
        self.period = place.period / self.scale
        rows, cols = self.shape
        whole = place.wraps and cols << level == place.shape[1]
        # mirroring needs an edge exactly at the pole and a column half a turn away
        even = whole and cols % 2 == 0 and rows << level == place.shape[0]
        self.wraps = whole
        self.mirrors_top = even and place.reaches_pole(-0.5, POLE_TOLERANCE) != 0
        self.mirrors_bottom = even and place.reaches_pole(place.shape[0] - 0.5, POLE_TOLERANCE) != 0

    def window(self, row0: int, col0: int, height: int, width: int) -> HeightGrid:
        """Heights (height, width); NaN where the sheet has none.

        Rows beyond a pole are those of the meridian on its other side.
        """
        rows, cols = self.shape
        out = np.full((height, width), np.nan, dtype=np.float32)
        top = min(max(-row0, 0), height)
        bottom = max(min(rows - row0, height), top)
        self._fill(out[top:bottom], row0 + top, col0)
        if top > 0 and self.mirrors_top:
            # row -1 is row 0 seen from the other side
            mirrored = np.full((top, width), np.nan, dtype=np.float32)
            self._fill(mirrored, -(row0 + top - 1) - 1, col0 + cols // 2)
            out[:top] = mirrored[::-1]
        if bottom < height and self.mirrors_bottom:
            beyond = height - bottom
            mirrored = np.full((beyond, width), np.nan, dtype=np.float32)
            self._fill(mirrored, 2 * rows - (row0 + height), col0 + cols // 2)
            out[bottom:] = mirrored[::-1]
        return out

    def _fill(self, out: HeightGrid, row0: int, col0: int) -> None:
        """Copy from tiles into `out`, whose rows lie inside the raster; columns wrap."""
        rows, cols = self.shape
        height, width = out.shape
        at = 0
        while at < width:
            col = col0 + at
            if self.wraps:
                col %= cols
            elif col < 0:
                at = -col0
                continue
            if col >= cols:
                return
            along, inner = divmod(col, TILE)
            count = min(width - at, TILE - inner, cols - col)
            row = max(row0, 0)
            while row < min(row0 + height, rows):
                down, inner_row = divmod(row, TILE)
                lines = min(row0 + height - row, TILE - inner_row, rows - row)
                tile = self.cache.tile(self.index, self.pyramid, self.level, down, along)
                out[row - row0 : row - row0 + lines, at : at + count] = tile[
                    inner_row : inner_row + lines, inner : inner + count
                ]
                row += lines
            at += count
