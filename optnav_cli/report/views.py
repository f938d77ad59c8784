"""Maps of reports: projections of places, graticules, which cell each pixel is in, and colours.

A catalog of a region gets one stereographic map about its middle. One of a whole body gets an
equal-area map (Mollweide), where every cell takes its due share of the picture, and the two polar
caps in stereographic projection, because there an equal-area map is sheared beyond reading.

Colours of maps and their legends are distinct for colour-blind people. Values: viridis, bright for
good. Reasons: the palette of Okabe and Ito.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import ArrayLike
from pyproj import Proj

from catalog.arrays import ByteArray, FloatArray, Int32Array, IntArray
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import (
    angular_distance,
    latlon_from_xyz,
    wrap_longitude_deg,
    xyz_from_latlon,
)
from catalog.geometry.projection import Stereographic
from optnav_cli.report.svg import HALF, WIDE, Plot, PlotAxis, find_span, format_number

MAX_RADIUS_DEG = 50.0  # beyond, a plain grid of longitude and latitude takes over
STEPS_DEG = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0)
LABEL_ROOM_PX = 45.0
WHOLE_HEIGHT = 496  # makes a degree as high as it is wide, at a plot's full width
DEGREE = "\N{DEGREE SIGN}"
Places = Callable[[ArrayLike, ArrayLike], tuple[FloatArray, FloatArray]]
SHARPNESS = 1.75  # pixels of a picture for each pixel of the page: screens have up to 2
CAP_DEG = 60.0  # latitude of a polar map's rim
THIRD = 310  # width of a drawing of which three stand in a row, px
WIDE_MARGINS, CAP_MARGINS = (0, 0, 10, 10), (0, 0, 0, 0)
RIM_ROOM = 1.005  # of a round map: room for the line around it
MOLLWEIDE = Proj(proj="moll", R=1.0)
HALF_WIDTH, HALF_HEIGHT = 2.0 * np.sqrt(2.0), np.sqrt(2.0)  # of the Mollweide ellipse
USABLE = "#0072b2"
REASON_COLOURS = (
    "#ffffff",
    "#d55e00",
    "#cc79a7",
    "#000000",
    "#f0e442",
    "#009e73",
    "#56b4e9",
    "#8c564b",
)
SOURCE_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#f0e442")
OTHER = "#8a8f98"
OUTER_PERCENT = 0.5  # of the values at either end that may share the last colour
STEPS = 64  # colours of a map: as many as eyes distinguish, few enough for small pictures
MIN_RELATIVE_SPAN = 1e-6
WORTH_A_LOG = 8.0  # highest over lowest value, from which a logarithm shows more


@dataclass(frozen=True, eq=False)
class GroundMap:
    """Map projection from latitude and longitude (deg) to map coordinates.

    Stereographic about the middle of the places, in km, so that poles and ±180° are nothing
    special; for places all over a body longitude and latitude themselves.
    """

    centre_deg: tuple[float, float]
    radius_m: float
    regional: bool

    @classmethod
    def fit(cls, lat_deg: ArrayLike, lon_deg: ArrayLike, radius_m: float) -> "GroundMap":
        """Choose a map that suits these places (n,), at least one."""
        lat, lon = np.radians(lat_deg), np.radians(lon_deg)
        middle = xyz_from_latlon(lat, lon, 1.0).reshape(-1, 3).mean(axis=0)
        lat0, lon0, _ = latlon_from_xyz(middle)
        reach = np.degrees(np.max(angular_distance(lat0, lon0, lat, lon)))
        regional = bool(reach <= MAX_RADIUS_DEG)
        centre = (float(np.degrees(lat0)), float(np.degrees(lon0))) if regional else (0.0, 0.0)
        return cls(centre, radius_m, regional)

    def places(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Project places (...) to map coordinates x, y."""
        lat, lon = np.asarray(lat_deg, np.float64), np.asarray(lon_deg, np.float64)
        if not self.regional:
            return wrap_longitude_deg(lon), lat
        lat0, lon0 = np.radians(self.centre_deg)
        directions = xyz_from_latlon(np.radians(lat), np.radians(lon), 1.0)
        x, y = Stereographic(lat0, lon0, self.radius_m).xy_from_xyz(directions)
        return x / 1e3, y / 1e3

    def latlon(self, x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Convert map coordinates x, y (...) to latitude and longitude (deg)."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        if not self.regional:
            return y, x
        lat0, lon0 = np.radians(self.centre_deg)
        lat, lon = Stereographic(lat0, lon0, self.radius_m).latlon(1e3 * x, 1e3 * y)
        return np.degrees(lat), np.degrees(lon)

    def plot(self, x: ArrayLike, y: ArrayLike, width: int = WIDE, height: int = 600) -> Plot:
        """Plot an empty map that holds the map coordinates x, y (n,), with its graticule."""
        if not self.regional:
            lon = PlotAxis((-180.0, 180.0), "longitude, deg")
            lat = PlotAxis((-90.0, 90.0), "latitude, deg")
            return Plot(lon, lat, width=width, height=WHOLE_HEIGHT, equal=True)
        lat0, lon0 = (format_number(round(v, 2)) + DEGREE for v in self.centre_deg)
        x_ends, y_ends = find_span(x, 0.04), find_span(y, 0.04)
        west, east = Plot(x_ends, y_ends, width=width, height=height, equal=True).x
        words = f"stereographic about {lat0}, {lon0}; the map is {east - west:.0f} km wide"
        x_axis = PlotAxis(x_ends, words)
        plot = Plot(x_axis, y_ends, width=width, height=height, equal=True, axes=False)
        self._draw_graticule(plot)
        return plot

    def _draw_graticule(self, plot: Plot) -> None:
        """Draw lines with numbers where they enter the map, unless another number is near."""
        km_per_deg = np.radians(self.radius_m) / 1e3
        reach = max(plot.x[1] - plot.x[0], plot.y[1] - plot.y[0]) / 2.0 / km_per_deg
        step = next((s for s in STEPS_DEG if s >= reach / 2.5), STEPS_DEG[-1])
        lat0, lon0 = self.centre_deg
        lats = np.arange(np.floor((lat0 - 2 * reach) / step), (lat0 + 2 * reach) / step + 1) * step
        lats = lats[np.abs(lats) < 90.0]
        narrowing = max(np.cos(np.radians(min(abs(lat0) + reach, 89.0))), 0.05)
        lon_step = next((s for s in STEPS_DEG if s >= reach / 2.5 / narrowing), 30.0)
        half = min(2 * reach / narrowing, 180.0)
        first_lon, last_lon = np.floor((lon0 - half) / lon_step), (lon0 + half) / lon_step
        lons = np.arange(first_lon, last_lon + 1) * lon_step
        along = np.linspace(-1.0, 1.0, 61)
        reachable = np.clip(lat0 + 2 * reach * along, -89.9, 89.9)
        lines = [(lat, np.full(61, lat), lon0 + half * along) for lat in lats]
        wrapped = np.unique(wrap_longitude_deg(lons))
        lines += [(lon, reachable, np.full(61, lon)) for lon in wrapped]
        taken: list[FloatArray] = []
        for value, lat, lon in lines:
            x, y = self.places(lat, lon)
            plot.line(x, y, "faint thin")
            entry = _find_entry(plot, x, y)
            if entry is None:
                continue
            at = np.array([float(plot.px(entry[0])), float(plot.py(entry[1]))])
            if all(np.linalg.norm(at - other) > LABEL_ROOM_PX for other in taken):
                taken.append(at)
                plot.text(*entry, format_number(round(float(value), 3)) + DEGREE, "place")


def _find_entry(plot: Plot, x: FloatArray, y: FloatArray) -> tuple[float, float] | None:
    """Find where a line crosses the map's left edge or, if nowhere, its lower one; a bit inside."""
    shift = 0.008 * (plot.x[1] - plot.x[0])
    for along, other, edge, limits, left in (
        (x, y, plot.x[0], plot.y, True),
        (y, x, plot.y[0], plot.x, False),
    ):
        for k in np.flatnonzero((along[:-1] - edge) * (along[1:] - edge) < 0.0):
            share = (edge - along[k]) / (along[k + 1] - along[k])
            where = float(other[k] + share * (other[k + 1] - other[k]))
            room = 0.04 * (limits[1] - limits[0])
            if limits[0] + room < where < limits[1] - room:
                return (edge + shift, where) if left else (where + shift, edge + shift)
    return None


@dataclass(frozen=True, eq=False)
class MapView:
    """One map.

    name     what it shows, in words
    whole    one of the maps of a whole body
    plot     an empty drawing of it, with its graticule
    latlon   (lat, lon) in deg of map coordinates; not finite off the body
    places   map coordinates of (lat, lon) in deg
    outline  map coordinates of the ground's edge (2, n), None for a map that is full of ground
    """

    name: str
    of_body: bool
    plot: Callable[[], Plot]
    latlon: Places
    places: Places
    outline: FloatArray | None

    def pixels(self) -> tuple[FloatArray, FloatArray]:
        """Compute latitude and longitude (deg) of the middles of a picture's pixels, (h, w)."""
        plot = self.plot()
        width, height = (round(SHARPNESS * side) for side in plot.inner)
        x = plot.x[0] + (np.arange(width) + 0.5) * (plot.x[1] - plot.x[0]) / width
        y = plot.y[1] - (np.arange(height) + 0.5) * (plot.y[1] - plot.y[0]) / height
        return self.latlon(*np.meshgrid(x, y))


def choose_views(
    grid: CellGrid, ids: IntArray, lat_deg: FloatArray, lon_deg: FloatArray, radius_m: float
) -> list[MapView]:
    """Choose the maps that suit a catalog's points (n,), at least one: the main map first."""
    lat, lon = compute_corners(grid, ids)
    lat, lon = np.concatenate([lat.ravel(), lat_deg]), np.concatenate([lon.ravel(), lon_deg])
    ground = GroundMap.fit(lat, lon, radius_m)
    if not ground.regional:
        return [_make_mollweide(), _make_cap(90.0, radius_m), _make_cap(-90.0, radius_m)]
    x, y = ground.places(lat, lon)
    return [_make_region(ground, x, y, WIDE, 620), _make_region(ground, x, y, HALF, 330)]


def find_rows(
    grid: CellGrid, ids: IntArray, lat_deg: FloatArray, lon_deg: FloatArray
) -> Int32Array:
    """Find the row in the ascending `ids` of the cell under each place (...), -1 without one."""
    known = np.isfinite(lat_deg) & np.isfinite(lon_deg)
    cells = grid.find_cells(np.where(known, lat_deg, 0.0), np.where(known, lon_deg, 0.0))
    rows = np.minimum(np.searchsorted(ids, cells), len(ids) - 1)
    return np.where(known & (ids[rows] == cells), rows, -1).astype(np.int32)


def compute_corners(grid: CellGrid, ids: IntArray) -> tuple[FloatArray, FloatArray]:
    """Compute latitudes and longitudes (n, 4) of the corners of cells."""
    band = np.searchsorted(grid.first_cell, ids, side="right") - 1
    width = 360.0 / grid.cells_in_band[band]
    west = -180.0 + width * (ids - grid.first_cell[band])
    south = -90.0 + grid.step_deg * band
    north = np.minimum(south + grid.step_deg, 90.0)
    # a cell that is a whole cap has its far side elsewhere than at its two equal corners
    lon = np.column_stack([west, west + width / 2.0, west + width, west + width / 2.0])
    lat = np.column_stack([south, south, north, north])
    return lat, wrap_longitude_deg(lon)


def _make_region(
    ground: GroundMap, x: FloatArray, y: FloatArray, width: int, height: int
) -> MapView:
    name = "the region, north up" if abs(ground.centre_deg[0]) < 89.0 else "the pole"
    plot = partial(ground.plot, x, y, width, height)
    return MapView(name, False, plot, ground.latlon, ground.places, None)


def _make_mollweide() -> MapView:
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    outline = np.array([HALF_WIDTH * np.cos(angle), HALF_HEIGHT * np.sin(angle)])

    def latlon(x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        lon, lat = MOLLWEIDE(np.asarray(x, np.float64), np.asarray(y, np.float64), inverse=True)
        return lat, lon

    def places(lat_deg: ArrayLike, lon_deg: ArrayLike) -> tuple[FloatArray, FloatArray]:
        x, y = MOLLWEIDE(np.asarray(lon_deg, np.float64), np.asarray(lat_deg, np.float64))
        return x, y

    def plot() -> Plot:
        height = WIDE // 2 + WIDE_MARGINS[2] + WIDE_MARGINS[3]
        x, y = RIM_ROOM * HALF_WIDTH, RIM_ROOM * HALF_HEIGHT
        ends = (-x, x), (-y, y)
        drawing = Plot(*ends, width=WIDE, height=height, axes=False, margins=WIDE_MARGINS)
        parallel, meridian = np.linspace(-180.0, 180.0, 3), np.linspace(-90.0, 90.0, 61)
        lats, lons = np.arange(-60.0, 90.0, 30.0), np.arange(-150.0, 180.0, 30.0)
        for lat in lats:
            drawing.line(*places(np.full(3, lat), parallel), "graticule")
        for lon in lons:
            drawing.line(*places(meridian, np.full(61, lon)), "graticule")
        for lat, lon in [(lat, 0.0) for lat in lats if lat] + [(0.0, lon) for lon in lons]:
            x, y = places(lat, lon)
            drawing.text(float(x) + 0.02, float(y) + 0.02, _format_degrees(lat or lon), "halo")
        drawing.line(outline[0], outline[1], "rim")
        return drawing

    return MapView("the whole body, equal-area (Mollweide)", True, plot, latlon, places, outline)


def _make_cap(pole_deg: float, radius_m: float) -> MapView:
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
        ends = (-rim, rim)
        drawing = Plot(ends, ends, width=THIRD, height=THIRD, axes=False, margins=CAP_MARGINS)
        for lat in (70.0, 80.0):
            drawing.line(*ground.places(np.full(181, side * lat), angle), "graticule")
            x, y = ground.places(side * lat, 45.0)
            drawing.text(float(x), float(y), _format_degrees(side * lat), "halo", "middle")
        for lon in (-90.0, 0.0, 90.0, 180.0):
            x, y = ground.places(side * 63.0, lon)
            drawing.text(float(x), float(y) - 0.012 * rim, _format_degrees(lon), "halo", "middle")
        for lon in range(-180, 180, 45):
            lats = np.array([side * CAP_DEG, side * 89.999])
            drawing.line(*ground.places(lats, np.full(2, float(lon))), "graticule")
        drawing.line(outline[0], outline[1], "rim")
        return drawing

    name = "north" if side > 0.0 else "south"
    return MapView(
        f"the {name} polar cap, stereographic", True, plot, latlon, ground.places, outline
    )


def _format_degrees(value: float) -> str:
    return format_number(float(value)) + DEGREE


@dataclass(frozen=True)
class Scale:
    """Colours of values from `low` to `high`.

    more_is_better  which end is bright
    log             colours and axes follow the logarithm; what is not positive counts as `low`
    """

    low: float
    high: float
    more_is_better: bool
    log: bool = False

    @classmethod
    def fit(cls, values: FloatArray, more_is_better: bool, log: bool = False) -> "Scale":
        """Fit a scale to finite values (n,), at least one; the outermost values may lie beyond.

        log  allows a logarithmic one, which is taken where the values span much
        """
        ends = [OUTER_PERCENT, 100.0 - OUTER_PERCENT]
        positive = values[values > 0.0]
        if log and positive.size:
            low, high = (float(v) for v in np.percentile(positive, ends))
            if high > WORTH_A_LOG * low:
                return cls(low, high, more_is_better, True)
        low, high = (float(v) for v in np.percentile(values, ends))
        if high - low <= MIN_RELATIVE_SPAN * max(abs(high), 1.0):
            margin = max(0.1 * abs(high), 0.05)
            low, high = low - margin, high + margin
        return cls(low, high, more_is_better)

    def map_to_axis(self, values: FloatArray) -> FloatArray:
        """Map values to an axis: themselves, or their common logarithm."""
        values = np.asarray(values, np.float64)
        return np.log10(np.maximum(values, self.low)) if self.log else values

    def bgr(self, values: FloatArray) -> ByteArray:
        """Colours (n, 3) of finite values (n,)."""
        return self._bgr(self.map_to_axis(values))

    def _bgr(self, along: FloatArray) -> ByteArray:
        low, high = self.map_to_axis(np.array([self.low, self.high]))
        share = np.clip((along - low) / (high - low), 0.0, 1.0)
        share = share if self.more_is_better else 1.0 - share
        step = np.minimum((share * STEPS).astype(np.int64), STEPS - 1)
        places = np.rint((step + 0.5) / STEPS * 255.0).astype(np.uint8)
        coloured = cv2.applyColorMap(places.reshape(-1, 1), cv2.COLORMAP_VIRIDIS)
        colours: ByteArray = coloured.reshape(-1, 3)
        return colours

    def css(self, along: FloatArray) -> list[str]:
        """CSS colours of places (n,) on the axis."""
        return [f"#{r:02x}{g:02x}{b:02x}" for b, g, r in self._bgr(along).tolist()]


def blend(css: str, share: float, gray: float) -> str:
    """Blend a colour over a gray (0..255) that it covers by a share."""
    mixed = (
        round(share * channel + (1.0 - share) * gray) for channel in reversed(parse_colour(css))
    )
    return "#" + "".join(f"{channel:02x}" for channel in mixed)


def parse_colour(css: str) -> tuple[int, int, int]:
    """Parse "#rrggbb" to blue, green, red."""
    red, green, blue = (int(css[i : i + 2], 16) for i in (1, 3, 5))
    return blue, green, red
