"""The coarse relief of a whole body, which shapes its horizon seen from space.

Every cell has a mean and a greatest height: means make an unbiased surface, greatest heights bound
how far that surface can rise above the horizon between them. `relief_of_dem` makes one of a
terrain model; a catalog may carry one.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel


@dataclass(frozen=True, eq=False)
class GlobalRelief:
    """Heights of a whole body on a latitude-longitude grid whose values are of areas.

    heights      (n, 2n) float32, mean height of a cell, m above the reference sphere; no NaN
    max_heights  (n, 2n) float32, its highest place, m: at least the mean
    radius_m     of the reference sphere
    source       the terrain models that it was made from
    error_m      stated error of the model that shows most of it (`TerrainErrorModel`); None: none

    Row 0 lies half a step south of the north pole, column 0 half a step east of longitude -180.
    """

    heights: Float32Array
    max_heights: Float32Array
    radius_m: float
    source: str
    error_m: float | None = None

    @property
    def step_rad(self) -> float:
        """Angle between rows, and between columns."""
        return float(np.pi / self.heights.shape[0])

    @property
    def posting_m(self) -> float:
        """Ground distance of neighbouring rows."""
        return self.step_rad * self.radius_m

    @cached_property
    def span_m(self) -> float:
        """From the lowest mean height to the highest."""
        return float(np.ptp(self.heights))

    def heights_at(self, lat: ArrayLike, lon: ArrayLike) -> FloatArray:
        """Heights (...) m between the cells' means, at latitudes and east longitudes (rad)."""
        lat, lon = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (lat, lon)))
        heights = np.empty(lat.size)
        _interpolate_heights(self.heights, np.ravel(lat), np.ravel(lon), heights)
        return heights.reshape(lat.shape)


@kernel
def interpolate_relief(grid: Float32Array, lat: float, lon: float) -> float:
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
def _interpolate_heights(
    grid: Float32Array, lat: FloatArray, lon: FloatArray, found: FloatArray
) -> None:
    for i in range(lat.size):
        found[i] = interpolate_relief(grid, lat[i], lon[i])
