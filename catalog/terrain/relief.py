"""The coarse relief of a whole body: what shapes its horizon seen from space.

Every cell knows its mean height and its highest one: means make an unbiased surface, tops bound
how far that surface can stand up against the sky between them.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from catalog.bodies.body import Body
from catalog.errors import DataError
from catalog.geometry.kernel import kernel
from catalog.progress import SilentProgress
from catalog.terrain.relief_sums import CellSums, Layer
from catalog.terrain.source import DemSettings, DemSource

FloatArray = NDArray[np.float64]
HeightGrid = NDArray[np.float32]

ROWS = 2880  # 16 a degree: 1.9 km of lunar ground, as fine as a horizon asks for
LEAST_COVERAGE = 0.99  # of the sphere; the rest is filled from its surroundings


@dataclass(frozen=True, eq=False)
class GlobalRelief:
    """Heights of a whole body on a latitude-longitude grid whose values stand for areas.

    heights  (n, 2n) float32, mean height of a cell, m above the reference sphere; no NaN
    tops     (n, 2n) float32, its highest place, m: at least the mean
    radius_m of the reference sphere
    source   the terrain models that it was made from

    Row 0 lies half a step south of the north pole, column 0 half a step east of longitude -180.
    """

    heights: HeightGrid
    tops: HeightGrid
    radius_m: float
    source: str

    @property
    def step_rad(self) -> float:
        """Angle between rows, and between columns."""
        return float(np.pi / self.heights.shape[0])

    @property
    def posting_m(self) -> float:
        """Ground distance of neighbouring rows."""
        return self.step_rad * self.radius_m

    def heights_at(self, lat: ArrayLike, lon: ArrayLike) -> FloatArray:
        """Heights (...) m between the cells' means, at latitudes and east longitudes (rad)."""
        lat, lon = np.broadcast_arrays(
            np.asarray(lat, dtype=np.float64), np.asarray(lon, dtype=np.float64)
        )
        found = np.empty(lat.size)
        _heights(self.heights, np.ravel(lat), np.ravel(lon), found)
        return found.reshape(lat.shape)


def relief_from_dem(source: DemSource, rows: int | None = None) -> GlobalRelief:
    """The relief of a terrain model that shows the whole body, read once, window by window.

    rows  of the relief; without it the model's own, but no more than ROWS
    Raises DataError for a damaged file, one of a part of the body or with impossible heights.
    """
    sums = CellSums(rows or rows_of(source.place.row_angle))
    sums.lay_under(layer_of(source), SilentProgress())
    if np.isfinite(sums.lowest_m):
        source.check_heights(sums.lowest_m, sums.highest_m)
    if sums.coverage < LEAST_COVERAGE:
        raise DataError(
            f"{source.path}: shows {100.0 * sums.coverage:.3g} % of {source.body.name}; a relief "
            f"wants {100.0 * LEAST_COVERAGE:g} %: name a terrain model of the whole body"
        )
    return finished(sums, source.body.radius_m, source.path.name)


def layer_of(source: DemSource) -> Layer:
    """All of a terrain model at its own posting."""
    return Layer(source.place, 0, source.shape, source.block_shape, source.read_window)


def rows_of(row_angle: float) -> int:
    """Rows of the relief of a terrain model with so much of latitude (rad) between its rows."""
    return min(ROWS, round(np.pi / row_angle))


def finished(sums: CellSums, radius_m: float, source: str) -> GlobalRelief:
    """The relief of sums over nearly all cells; holes are filled."""
    sums.fill()
    # a mean rounded to float32 may pass the pixels that it is of
    return GlobalRelief(sums.means, np.maximum(sums.tops, sums.means), radius_m, source)


@lru_cache(maxsize=2)
def load_relief(path: str, body: Body) -> GlobalRelief:
    """The relief of a terrain model file, "bundled:NAME" for one that travels with optnav.

    A process that asks again gets the same one. Raises DataError.
    """
    source = DemSource.open(DemSettings(path=path), Path(), body)
    try:
        return relief_from_dem(source)
    finally:
        source.close()


@kernel
def relief_height(grid: HeightGrid, lat: float, lon: float) -> float:
    """The height between the four nearest cells (n, 2n) of a place (rad).

    Columns go on across +-180 deg, rows across the poles to the opposite meridian.
    """
    rows, cols = grid.shape
    y = (np.pi / 2.0 - lat) * (rows / np.pi) - 0.5
    x = (lon + np.pi) * (rows / np.pi) - 0.5
    top, left = int(np.floor(y)), int(np.floor(x))
    down, along = y - top, x - left
    height = 0.0
    for i in range(2):
        row, shift = top + i, 0
        if row < 0:
            row, shift = -row - 1, rows
        elif row >= rows:
            row, shift = 2 * rows - row - 1, rows
        weight = down if i else 1.0 - down
        west = grid[row, (left + shift) % cols]
        east = grid[row, (left + 1 + shift) % cols]
        height += weight * (west + along * (east - west))
    return height


@kernel
def _heights(grid: HeightGrid, lat: FloatArray, lon: FloatArray, found: FloatArray) -> None:
    for i in range(lat.size):
        found[i] = relief_height(grid, lat[i], lon[i])
