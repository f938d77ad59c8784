"""The seam of a terrain model with those below it: how much it counts, by distance from its edge.

A model counts nothing up to one block from a pixel without data or from its border, then more and
more, in proportion, and wholly from `feather_km` further in. Two models that differ by a bias so
meet in a slope of at most bias / feather, instead of a step.

Distances are taken between blocks of pixels, a block counting as empty when any of its pixels is;
they are worked out tile by tile with as much room about a tile as a feather reaches, so that they
do not depend on where one looks from.
"""

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray, IntArray
from catalog.geometry.kernel import kernel
from catalog.terrain.pyramid.overviews import WHOLE_BLOCK
from catalog.terrain.pyramid.pyramid import HeightPyramid, TileCache, find_mirrored_poles
from catalog.terrain.sampling.map_nodes import Pixels

TILE = 64  # blocks a side
FEW_TILES = 16  # so many are looked at whole before points are sorted by them
BLOCKS_ACROSS = 32  # blocks grow until a feather is no more of them wide


class Feather:
    """The weight of one source of a mosaic."""

    def __init__(self, index: int, pyramid: HeightPyramid, cache: TileCache) -> None:
        georeference = pyramid.source.georeference
        self.index, self.georeference, self.cache = index, georeference, cache
        self.wide_m = 1e3 * pyramid.source.settings.feather_km
        self.block = WHOLE_BLOCK
        while self.wide_m > BLOCKS_ACROSS * self.block * pyramid.source.posting_m:
            self.block *= 2
        self.block_m = self.block * pyramid.source.posting_m
        self.reach = int(np.ceil(self.wide_m / self.block_m)) + 2
        self.mirrors = find_mirrored_poles(georeference)
        self.hole_free = self._find_hole_free_blocks(pyramid)
        cols = self.hole_free.shape[1]
        self.turn = georeference.period / self.block if georeference.wraps else 0.0
        self.even = cols % 2 == 0 and cols * self.block == georeference.shape[1]

    def _find_hole_free_blocks(self, pyramid: HeightPyramid) -> BoolArray:
        """Which blocks have all their pixels."""
        known = pyramid.load_hole_free_blocks()
        factor = self.block // WHOLE_BLOCK
        rows, cols = known.shape
        # what a last block lacks is there where the raster goes on, beyond it is nothing
        wanted = -(-rows // factor) * factor - rows, -(-cols // factor) * factor - cols
        known = np.pad(known, ((0, wanted[0]), (0, wanted[1])), constant_values=True)
        blocks = known.reshape(known.shape[0] // factor, factor, known.shape[1] // factor, factor)
        hole_free = np.asarray(blocks.all(axis=(1, 3)))
        if self.georeference.shape[0] % self.block and not self.mirrors[1]:
            hole_free[-1] = False
        if self.georeference.shape[1] % self.block and not self.georeference.wraps:
            hole_free[:, -1] = False
        return hole_free

    def weights(self, pixels: Pixels) -> FloatArray:
        """Weights (n), 0 to 1, of places (at least one) inside the raster."""
        row = (pixels.row + 0.5) / self.block - 0.5
        col = (pixels.col + 0.5) / self.block - 0.5
        if self.turn:
            col = col - np.floor((col + 0.5) / self.turn) * self.turn
        down, along = row // TILE, col // TILE
        span = [int(end) for line in (down, along) for end in (line.min(), line.max() + 1)]
        tiles = [(i, j) for i in range(*span[:2]) for j in range(*span[2:])]
        # far inside, where most of a model lies, nothing is to be looked up point by point
        full = self.wide_m + self.block_m
        if len(tiles) <= FEW_TILES and all(self._tile(*at).min() >= full for at in tiles):
            return np.ones(row.size)
        key = down * 1e6 + along
        order = np.argsort(key, kind="stable")
        out = np.empty(row.size)
        for those in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
            at = int(down[those[0]]), int(along[those[0]])
            inner = row[those] - at[0] * TILE, col[those] - at[1] * TILE
            out[those] = _interpolate_linear(self._tile(*at), *inner)
        return np.clip((out - self.block_m) / self.wide_m, 0.0, 1.0)

    def _tile(self, down: int, along: int) -> Float32Array:
        key = self.index, -1, down, along
        return self.cache.get(key, lambda: self._measure_distances(down, along))

    def _measure_distances(self, down: int, along: int) -> Float32Array:
        """Distances (TILE + 1, TILE + 1), m, to the next block that is not whole, to the reach."""
        longest = self.reach * self.block_m
        row0 = down * TILE - self.reach
        rows = row0 + np.arange(TILE + 1 + 2 * self.reach)
        width = self._measure_column_m(rows)
        # meridians crowd: more columns are within reach toward a pole
        most = self.hole_free.shape[1] // 2 + 1
        room = int(min(most, np.ceil(longest / max(float(width.min()), 1e-3))))
        cols = along * TILE - room + np.arange(TILE + 1 + 2 * room)
        hole_free = self._take_hole_free(rows, cols)
        if hole_free.all():
            return np.full((TILE + 1, TILE + 1), longest, np.float32)
        return _measure_hole_distances(
            hole_free, width, self.block_m, self.reach, room, TILE + 1, longest
        )

    def _measure_column_m(self, rows: IntArray) -> FloatArray:
        """Ground width (m) of a block in rows of blocks; rows beyond a pole are those before it."""
        height = self.hole_free.shape[0]
        inside = np.where(rows < 0, -1 - rows, rows)
        inside = np.clip(np.where(inside >= height, 2 * height - 1 - inside, inside), 0, height - 1)
        middle = np.zeros(rows.size)
        if not self.georeference.period:
            return np.full(rows.size, self.block_m) / self.georeference.columns_per_posting(
                1.0, middle
            )
        lat, _ = self.georeference.latlon_from_pixel(middle, (inside + 0.5) * self.block - 0.5)
        return self.block_m / self.georeference.columns_per_posting(1.0, lat)

    def _take_hole_free(self, rows: IntArray, cols: IntArray) -> BoolArray:
        """Which blocks are whole, going on round the body and over its poles."""
        height, width = self.hole_free.shape
        above, below = rows < 0, rows >= height
        over = np.where(above, -1 - rows, np.where(below, 2 * height - 1 - rows, rows))
        there = (over >= 0) & (over < height)
        there &= ~above | (self.mirrors[0] and self.even)
        there &= ~below | (self.mirrors[1] and self.even)
        at = cols[None, :] + np.where(above | below, width // 2, 0)[:, None]
        if self.turn:
            at = np.mod(at, width)
        inside = there[:, None] & (at >= 0) & (at < width)
        inner = self.hole_free[np.clip(over, 0, height - 1)[:, None], np.clip(at, 0, width - 1)]
        hole_free: BoolArray = inner & inside
        return hole_free


@kernel
def _measure_hole_distances(
    whole: BoolArray,
    width: FloatArray,
    height: float,
    reach: int,
    room: int,
    size: int,
    longest: float,
) -> Float32Array:
    """Distances of the middle (size, size) blocks to the next that is not whole.

    Along a row first, then over rows: exact for equal blocks (Pythagoras); where rows differ in
    width the way along a row is measured in the row that it ends in.
    """
    rows, cols = whole.shape
    along = np.empty((rows, cols))
    for i in range(rows):
        last = np.inf
        for j in range(cols):
            last = last + width[i] if whole[i, j] else 0.0
            along[i, j] = last
        last = np.inf
        for j in range(cols - 1, -1, -1):
            last = last + width[i] if whole[i, j] else 0.0
            along[i, j] = min(along[i, j], last)
    out = np.empty((size, size), np.float32)
    for i in range(size):
        for j in range(size):
            best = longest * longest
            for k in range(2 * reach + 1):
                down = (k - reach) * height
                side = along[i + k, j + room]
                best = min(best, down * down + side * side)
            out[i, j] = np.sqrt(best)
    return out


@kernel
def _interpolate_linear(tile: Float32Array, row: FloatArray, col: FloatArray) -> FloatArray:
    """Linear interpolation inside a tile."""
    out = np.empty(row.size)
    for i in range(row.size):
        r = min(max(int(row[i]), 0), tile.shape[0] - 2)
        c = min(max(int(col[i]), 0), tile.shape[1] - 2)
        y, x = row[i] - r, col[i] - c
        top = (1.0 - x) * tile[r, c] + x * tile[r, c + 1]
        bottom = (1.0 - x) * tile[r + 1, c] + x * tile[r + 1, c + 1]
        out[i] = (1.0 - y) * top + y * bottom
    return out
