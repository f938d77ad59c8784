"""The nearest point on the sphere, found through the grid of cells.

Points lie in their cells and are kept in the order of cell numbers, so that the points of a band
of latitude are sorted by column. The search starts in the query's own cell and goes outward, east
and west along a band, then to the bands north and south, until no cell left can hold anything
nearer. Empty cells cost nothing.
"""

import math

import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.geometry.cells import CellGrid
from catalog.geometry.kernel import kernel

# How far outside its cell a point may lie, deg: rounding to 1e-7 may take it across the border.
CELL_SLACK_DEG = 1e-6


@kernel
def _bound_meridian(degrees: float, cos_lat: float) -> float:
    """Least squared chord from a point to the half of the sphere beyond a meridian."""
    degrees -= CELL_SLACK_DEG
    if degrees <= 0.0:
        return 0.0
    # sin d = cos(lat) sin(dlon) at the foot of the perpendicular; beyond 90 deg the pole is nearest
    sine = cos_lat * (math.sin(math.radians(degrees)) if degrees < 90.0 else 1.0)
    return sine * sine * (1.0 - 1e-9)


@kernel
def _bound_parallel(degrees: float) -> float:
    """Least squared chord across a difference of latitude."""
    degrees -= CELL_SLACK_DEG
    if degrees <= 0.0:
        return 0.0
    half = math.sin(math.radians(degrees) / 2.0)
    return 4.0 * half * half * (1.0 - 1e-9)


@kernel
def _find_nearest_row(
    lat_deg: float,
    lon_deg: float,
    step_deg: float,
    cells_in_band: IntArray,
    first_row: IntArray,
    column: IntArray,
    direction: FloatArray,
) -> int:
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    cos_lat = math.cos(lat)
    x, y, z = cos_lat * math.cos(lon), cos_lat * math.sin(lon), math.sin(lat)
    east_of_start = lon_deg + 180.0
    bands = cells_in_band.size
    home_band = min(max(int((lat_deg + 90.0) / step_deg), 0), bands - 1)
    best, best_row = np.inf, -1
    going_up, going_down = True, True
    for turn in range(2 * bands):
        # own, +1, -1, +2, -2, ...
        distance = (turn + 1) // 2
        up = turn % 2 == 1
        if (up and not going_up) or (not up and not going_down):
            continue
        band = home_band + distance if up else home_band - distance
        gap = band * step_deg - 90.0 - lat_deg if up else lat_deg + 90.0 - (band + 1) * step_deg
        if band < 0 or band >= bands or (turn > 0 and _bound_parallel(gap) > best):
            if up:
                going_up = False
            else:
                going_down = False
            if not going_up and not going_down:
                break
            continue
        low, high = first_row[band], first_row[band + 1]
        rows = high - low
        if rows == 0:
            continue
        count = cells_in_band[band]
        width = 360.0 / count
        home = min(int(east_of_start / width), count - 1)
        into = east_of_start - home * width
        start = low + np.searchsorted(column[low:high], home)
        for side in range(2):
            for k in range(rows):
                if side == 0:  # eastward
                    row = low + (start - low + k) % rows
                    steps = (column[row] - home) % count
                    aside = steps * width - into
                else:
                    row = low + (start - low - 1 - k) % rows
                    steps = (home - column[row]) % count
                    aside = into + (steps - 1) * width
                # the other side comes first to what lies beyond 180 degrees
                if steps > 0 and (aside >= 180.0 or _bound_meridian(aside, cos_lat) > best):
                    break
                dx = direction[row, 0] - x
                dy = direction[row, 1] - y
                dz = direction[row, 2] - z
                chord = dx * dx + dy * dy + dz * dz
                if chord < best or (chord == best and row < best_row):
                    best, best_row = chord, row
    return best_row


class CellIndex:
    """Nearest-point search over points sorted by cell number.

    cells      (n,) cell numbers, ascending, one point a cell
    direction  (n, 3) unit vectors of the points
    """

    def __init__(self, grid: CellGrid, cells: IntArray, direction: FloatArray) -> None:
        first_row = np.searchsorted(cells, grid.first_cell).astype(np.int64)
        band = np.searchsorted(grid.first_cell, cells, side="right") - 1
        column = np.asarray(cells - grid.first_cell[band], dtype=np.int64)
        bands = float(grid.step_deg), grid.cells_in_band, first_row
        self._tables = *bands, column, np.ascontiguousarray(direction)

    def find_nearest_row(self, lat_deg: float, lon_deg: float) -> int:
        """Row of the nearest point, -1 when there is none; lat in [-90, 90], lon in [-180, 180)."""
        return int(_find_nearest_row(lat_deg, lon_deg, *self._tables))
