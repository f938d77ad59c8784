"""The maps of a catalog's page: which projections show its cells, and which cell each pixel is in.

A catalog of a region gets one stereographic map about its middle. One of a whole body gets an
equal-area map (Mollweide), where every cell takes its due share of the picture, and the two polar
caps in stereographic projection, because there an equal-area map is sheared beyond reading.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pyproj import Proj

from catalog.arrays import FloatArray, Int32Array, IntArray
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import wrap_longitude_deg
from optnav_cli.report.ground import DEGREE, GroundMap
from optnav_cli.report.svg import HALF, WIDE, Plot, number_text

Places = Callable[[ArrayLike, ArrayLike], tuple[FloatArray, FloatArray]]

SHARPNESS = 1.75  # pixels of a picture for each pixel of the page: screens have up to 2
CAP_DEG = 60.0  # latitude of a polar map's rim
THIRD = 310  # width of a drawing of which three stand in a row, px
WIDE_MARGINS, CAP_MARGINS = (0, 0, 10, 10), (0, 0, 0, 0)
RIM_ROOM = 1.005  # of a round map: room for the line around it
MOLLWEIDE = Proj(proj="moll", R=1.0)
HALF_WIDTH, HALF_HEIGHT = 2.0 * np.sqrt(2.0), np.sqrt(2.0)  # of the Mollweide ellipse


@dataclass(frozen=True, eq=False)
class View:
    """One map.

    name     what it shows, in words
    whole    one of the maps of a whole body
    plot     an empty drawing of it, with its graticule
    latlon   (lat, lon) in deg of map coordinates; not finite off the body
    places   map coordinates of (lat, lon) in deg
    outline  map coordinates of the ground's edge (2, n), None for a map that is full of ground
    """

    name: str
    whole: bool
    plot: Callable[[], Plot]
    latlon: Places
    places: Places
    outline: FloatArray | None

    def pixels(self) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude (deg) of the middles of a picture's pixels, (h, w)."""
        plot = self.plot()
        width, height = (round(SHARPNESS * side) for side in plot.inner)
        x = plot.x[0] + (np.arange(width) + 0.5) * (plot.x[1] - plot.x[0]) / width
        y = plot.y[1] - (np.arange(height) + 0.5) * (plot.y[1] - plot.y[0]) / height
        return self.latlon(*np.meshgrid(x, y))


def views(
    grid: CellGrid, ids: IntArray, lat_deg: FloatArray, lon_deg: FloatArray, radius_m: float
) -> list[View]:
    """The maps that suit a catalog's points (n,), at least one: the main map first."""
    lat, lon = corners_deg(grid, ids)
    lat, lon = np.concatenate([lat.ravel(), lat_deg]), np.concatenate([lon.ravel(), lon_deg])
    ground = GroundMap.about(lat, lon, radius_m)
    if not ground.regional:
        return [_whole(), _cap(90.0, radius_m), _cap(-90.0, radius_m)]
    x, y = ground.places(lat, lon)
    return [_region(ground, x, y, WIDE, 620), _region(ground, x, y, HALF, 330)]


def rows_of_pixels(
    grid: CellGrid, ids: IntArray, lat_deg: FloatArray, lon_deg: FloatArray
) -> Int32Array:
    """Row in the ascending `ids` of the cell under each place (...), -1 without one."""
    known = np.isfinite(lat_deg) & np.isfinite(lon_deg)
    cells = grid.cell_of(np.where(known, lat_deg, 0.0), np.where(known, lon_deg, 0.0))
    rows = np.minimum(np.searchsorted(ids, cells), len(ids) - 1)
    return np.where(known & (ids[rows] == cells), rows, -1).astype(np.int32)


def corners_deg(grid: CellGrid, ids: IntArray) -> tuple[FloatArray, FloatArray]:
    """Latitudes and longitudes (n, 4) of the corners of cells."""
    band = np.searchsorted(grid.first_cell, ids, side="right") - 1
    width = 360.0 / grid.cells_in_band[band]
    west = -180.0 + width * (ids - grid.first_cell[band])
    south = -90.0 + grid.step_deg * band
    north = np.minimum(south + grid.step_deg, 90.0)
    # a cell that is a whole cap has its far side elsewhere than at its two equal corners
    lon = np.column_stack([west, west + width / 2.0, west + width, west + width / 2.0])
    lat = np.column_stack([south, south, north, north])
    return lat, wrap_longitude_deg(lon)


def _region(ground: GroundMap, x: FloatArray, y: FloatArray, width: int, height: int) -> View:
    return View(
        "the region, north up" if abs(ground.centre_deg[0]) < 89.0 else "the pole",
        False,
        lambda: ground.plot(x, y, width, height),
        ground.latlon,
        ground.places,
        None,
    )


def _whole() -> View:
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    outline = np.array([HALF_WIDTH * np.cos(angle), HALF_HEIGHT * np.sin(angle)])

    def latlon(x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        lon, lat = MOLLWEIDE(np.asarray(x, np.float64), np.asarray(y, np.float64), inverse=True)
        return np.asarray(lat), np.asarray(lon)

    def places(lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[FloatArray, FloatArray]:
        x, y = MOLLWEIDE(np.asarray(lon_deg, np.float64), np.asarray(lat_deg, np.float64))
        return np.asarray(x), np.asarray(y)

    def plot() -> Plot:
        height = WIDE // 2 + WIDE_MARGINS[2] + WIDE_MARGINS[3]
        x, y = RIM_ROOM * HALF_WIDTH, RIM_ROOM * HALF_HEIGHT
        drawing = Plot(
            (-x, x), (-y, y), width=WIDE, height=height, axes=False, margins=WIDE_MARGINS,
        )  # fmt: skip
        parallel, meridian = np.linspace(-180.0, 180.0, 3), np.linspace(-90.0, 90.0, 61)
        for lat in range(-60, 90, 30):
            drawing.line(*places(np.full(3, float(lat)), parallel), "graticule")
        for lon in range(-150, 180, 30):
            drawing.line(*places(meridian, np.full(61, float(lon))), "graticule")
        for lat in (-60, -30, 30, 60):
            x, y = places(float(lat), 0.0)
            drawing.text(float(x) + 0.02, float(y) + 0.02, _degrees(lat), "halo")
        for lon in range(-150, 180, 30):
            x, y = places(0.0, float(lon))
            drawing.text(float(x) + 0.02, float(y) + 0.02, _degrees(lon), "halo")
        drawing.line(outline[0], outline[1], "rim")
        return drawing

    return View("the whole body, equal-area (Mollweide)", True, plot, latlon, places, outline)


def _cap(pole_deg: float, radius_m: float) -> View:
    ground = GroundMap((pole_deg, 0.0), radius_m, True)
    angle = np.linspace(-180.0, 180.0, 181)
    side = 1.0 if pole_deg > 0.0 else -1.0
    outline = np.array(ground.places(np.full(181, side * CAP_DEG), angle))
    rim = RIM_ROOM * float(np.abs(outline).max())

    def latlon(x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        lat, lon = ground.latlon(x, y)
        outside = side * lat < CAP_DEG
        return np.where(outside, np.nan, lat), np.where(outside, np.nan, lon)

    def plot() -> Plot:
        drawing = Plot(
            (-rim, rim), (-rim, rim), width=THIRD, height=THIRD, axes=False, equal=True,
            margins=CAP_MARGINS,
        )  # fmt: skip
        for lat in (70.0, 80.0):
            drawing.line(*ground.places(np.full(181, side * lat), angle), "graticule")
            x, y = ground.places(side * lat, 45.0)
            drawing.text(float(x), float(y), _degrees(side * lat), "halo", "middle")
        for lon in (-90.0, 0.0, 90.0, 180.0):
            x, y = ground.places(side * 63.0, lon)
            drawing.text(float(x), float(y) - 0.012 * rim, _degrees(lon), "halo", "middle")
        for lon in range(-180, 180, 45):
            lats = np.array([side * CAP_DEG, side * 89.999])
            drawing.line(*ground.places(lats, np.full(2, float(lon))), "graticule")
        drawing.line(outline[0], outline[1], "rim")
        return drawing

    name = "north" if side > 0.0 else "south"
    return View(f"the {name} polar cap, stereographic", True, plot, latlon, ground.places, outline)


def _degrees(value: float) -> str:
    return number_text(float(value)) + DEGREE
