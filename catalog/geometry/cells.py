"""Grids over the whole sphere: the cells that a catalog's points lie in, and nodes on parallels.

Band k of the cells (from the south) has max(1, round(360 cos(mid-latitude) / step)) cells, so that
cells keep about the same area. A step of 1 degree gives 41 252 cells, the number of control points
of Zhukov (2025), chapter 3. A cell's number follows from latitude and longitude by arithmetic.

The nodes of a graticule lie in places that are fixed for the whole sphere, so that any part of it
has the same nodes.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray, IntArray
from catalog.geometry.latlon import wrap_longitude_deg


@dataclass(frozen=True)
class CellGrid:
    """Cells of about `step_deg` x `step_deg`, numbered from the south, eastward from -180.

    Raises ValueError for a step outside (0, 90] degrees.
    """

    step_deg: float

    def __post_init__(self) -> None:
        if not 0.0 < self.step_deg <= 90.0:
            raise ValueError(f"cell step {self.step_deg}° is not within (0, 90]")

    @cached_property
    def bands(self) -> int:
        """Number of latitude bands; the last may be narrower when the step does not divide 180."""
        return int(np.ceil(180.0 / self.step_deg - 1e-9))

    @cached_property
    def cells_in_band(self) -> IntArray:
        """(bands,) number of cells of each band."""
        south = -90.0 + self.step_deg * np.arange(self.bands)
        north = np.minimum(south + self.step_deg, 90.0)
        middle = np.radians((south + north) / 2.0)
        counts = np.rint(360.0 * np.cos(middle) / self.step_deg)
        cells: IntArray = np.maximum(1, counts).astype(np.int64)
        return cells

    @cached_property
    def first_cell(self) -> IntArray:
        """(bands + 1,) number of the first cell of each band; the last entry is the total."""
        return np.concatenate([[0], np.cumsum(self.cells_in_band)]).astype(np.int64)

    @property
    def total(self) -> int:
        """Number of cells on the whole sphere."""
        return int(self.first_cell[-1])

    def find_cells(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> IntArray:
        """Cell numbers of points; longitudes of any turn."""
        lat = np.clip(np.asarray(lat_deg, dtype=np.float64), -90.0, 90.0)
        band = np.clip(((lat + 90.0) / self.step_deg).astype(np.int64), 0, self.bands - 1)
        count = self.cells_in_band[band]
        turn = (wrap_longitude_deg(lon_deg) + 180.0) / 360.0
        column = np.minimum((turn * count).astype(np.int64), count - 1)
        number: IntArray = self.first_cell[band] + column
        return number

    def find_band(self, cell: int) -> int:
        """Latitude band of a cell number."""
        return int(self.find_bands(np.array([cell]))[0])

    def find_bands(self, cells: IntArray) -> IntArray:
        """(n,) latitude bands of cell numbers."""
        bands: IntArray = np.searchsorted(self.first_cell, cells, side="right") - 1
        return bands

    def bounds_deg(self, cell: int) -> tuple[float, float, float, float]:
        """West, south, east, north of a cell (deg, west in [-180, 180))."""
        west, south, east, north = self.compute_bounds_deg(np.array([cell]))[:, 0].tolist()
        return west, south, east, north

    def compute_bounds_deg(self, cells: IntArray) -> FloatArray:
        """(4, n) the same of many cells."""
        bands = self.find_bands(cells)
        count = self.cells_in_band[bands]
        south = -90.0 + self.step_deg * bands
        west = -180.0 + 360.0 * (cells - self.first_cell[bands]) / count
        north = np.minimum(south + self.step_deg, 90.0)
        return np.stack([west, south, west + 360.0 / count, north])

    def centre_deg(self, cell: int) -> tuple[float, float]:
        """Latitude and longitude (deg) of a cell's middle; the pole for a cell that is a cap."""
        west, south, east, north = self.bounds_deg(cell)
        if east - west >= 360.0:
            return (90.0, 0.0) if north >= 90.0 else (-90.0, 0.0)
        return (south + north) / 2.0, float(wrap_longitude_deg((west + east) / 2.0))

    def find_cells_within(self, lat_deg: float, lon_deg: float, radius_deg: float) -> IntArray:
        """Numbers of all cells that may hold a point within `radius_deg` (a superset), sorted."""
        south, north = lat_deg - radius_deg, lat_deg + radius_deg
        # the pole itself would fall into a band beyond the last
        first = min(max(0, int((south + 90.0) / self.step_deg)), self.bands - 1)
        last = min(self.bands - 1, int((north + 90.0) / self.step_deg))
        parts = [np.empty(0, dtype=np.int64)]
        # widest in longitude where the circle touches its meridians: sin(dlon) = sin(r)/cos(lat)
        sine = np.sin(np.radians(min(radius_deg, 90.0)))
        cosine = np.cos(np.radians(lat_deg))
        all_round = north >= 90.0 or south <= -90.0 or sine >= cosine
        half = 180.0 if all_round else float(np.degrees(np.arcsin(sine / cosine))) + 1e-9
        for band in range(first, last + 1):
            count = int(self.cells_in_band[band])
            start = int(self.first_cell[band])
            if half >= 180.0:
                parts.append(np.arange(start, start + count))
                continue
            low = int(np.floor((lon_deg - half + 180.0) / 360.0 * count))
            high = int(np.floor((lon_deg + half + 180.0) / 360.0 * count))
            parts.append(start + np.arange(low, min(high, low + count - 1) + 1) % count)
        return np.unique(np.concatenate(parts)).astype(np.int64)

    def find_cells_in_bbox(self, west: float, south: float, east: float, north: float) -> IntArray:
        """Cells whose middle lies in a box (deg), sorted; west > east crosses ±180°."""
        cells = [np.empty(0, dtype=np.int64)]
        width = (east - west) % 360.0
        if width == 0.0 and east != west:
            width = 360.0
        for band in range(self.bands):
            band_south = -90.0 + self.step_deg * band
            middle = (band_south + min(band_south + self.step_deg, 90.0)) / 2.0
            if not south <= middle <= north:
                continue
            count = int(self.cells_in_band[band])
            lon = -180.0 + 360.0 * (np.arange(count) + 0.5) / count
            cells.append(self.first_cell[band] + np.flatnonzero(np.mod(lon - west, 360.0) <= width))
        return np.concatenate(cells).astype(np.int64)


class Graticule(NamedTuple):
    """Rows from the south pole on, columns eastward from -180°, nodes half a spacing within.

    row_angle  rad between rows
    columns    in a full turn
    """

    row_angle: float
    columns: int

    @property
    def column_angle(self) -> float:
        """Longitude between columns, rad."""
        return 2.0 * np.pi / self.columns

    def lat(self, row: IntArray) -> FloatArray:
        """Latitude (rad) of rows."""
        return np.asarray((row + 0.5) * self.row_angle - np.pi / 2.0, dtype=np.float64)

    def lon(self, col: IntArray) -> FloatArray:
        """East longitude (rad, -180° to 180°) of columns of any turn: the same in every turn."""
        return (np.mod(col, self.columns) + 0.5) * self.column_angle - np.pi


class Part(NamedTuple):
    """A rectangle of a graticule's nodes: first row (southmost) and column, how many of each."""

    row: int
    col: int
    height: int
    width: int

    @property
    def rows(self) -> IntArray:
        """(height,) numbers of the rows."""
        return np.arange(self.row, self.row + self.height)

    @property
    def cols(self) -> IntArray:
        """(width,) numbers of the columns."""
        return np.arange(self.col, self.col + self.width)
