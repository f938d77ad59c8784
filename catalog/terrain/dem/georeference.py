"""Where a latitude and longitude fall in a raster.

Equidistant cylindrical, geographic and polar stereographic rasters have closed forms (Snyder,
USGS PP 1395, sphere), because a PROJ transformer costs milliseconds to make and cannot be called
from a compiled loop. A closed form is used only where it agrees with PROJ at the raster's own
corners; any other projection goes through PROJ.

Coordinate systems of rasters, brought to east longitudes from the body's own meridian.

A projected map's x is an easting whatever its longitudes count: under a label of west longitudes
the picture still has east on the right, and only the central meridian is a west longitude (USGS
ISIS, TProjection.cpp, PositiveWest). The x of a map in degrees is a longitude itself.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pyproj
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel

# a, b, c, d, e, f: x = a col + b row + c, y = d col + e row + f at the corner of a pixel
Steps = tuple[float, float, float, float, float, float]

CYLINDRICAL, POLAR, OTHER = 0, 1, 2
# A raster whose columns miss a full turn by less than this (columns) is taken as going all the way
# round: writers round a posting to a centimetre, which is 1e-3 of a column over the whole turn.
WRAP_TOLERANCE = 0.02
# Closed forms must give PROJ's pixels this closely (columns); rounding alone leaves 1e-8.
AGREEMENT = 1e-3


@dataclass(frozen=True)
class Georeference:
    """The map from latitude and east longitude (rad) to fractional columns and rows.

    Whole numbers are pixel centres. kind and parameters drive the compiled form:
    cylindrical (col0, cols per rad, row0, rows per rad, period in columns, 0 if rotated);
    polar (pole sign, col of the pole, row of the pole, 2 R k0 / posting, lon0).
    longitude_sign is -1 for a map whose longitudes count westward.
    axes_squared is (c/a)^2 of a map whose latitudes are geodetic: tan of the planetocentric one is
    so many times theirs, on the ellipsoid. At a height h latitudes are off by the flattening times
    h sin 2 lat: 3 m for each km on the Earth.
    """

    wkt: str
    affine: Steps
    shape: tuple[int, int]
    longitude_sign: float
    kind: int
    parameters: tuple[float, ...]
    row_angle: float  # rad of ground between neighbouring rows
    column_angle: float  # the same between columns, at the equator for a cylindrical raster
    turn: float = 0.0  # a full turn of longitude in x; 0 where x does not count longitude
    axes_squared: float = 1.0

    @property
    def period(self) -> float:
        """Columns in a full turn of longitude; 0 where columns are not meridians."""
        return self.parameters[4] if self.kind == CYLINDRICAL else 0.0

    @property
    def ellipsoid_m(self) -> tuple[float, float]:
        """Semi-major and semi-minor axis of the map's ellipsoid."""
        ellipsoid = pyproj.CRS.from_wkt(self.wkt).ellipsoid
        if ellipsoid is None:
            raise ValueError("it has no ellipsoid")
        return float(ellipsoid.semi_major_metre), float(ellipsoid.semi_minor_metre)

    @property
    def wraps(self) -> bool:
        """Whether the last column's eastern neighbour is the first column."""
        return self.period > 0.0 and abs(self.period - self.shape[1]) <= WRAP_TOLERANCE

    def find_pole(self, row_edge: float, tolerance: float) -> int:
        """+1, -1 or 0: the pole that lies on the raster's edge at a row (a half-integer)."""
        if not self.wraps or self.shape[1] % 2:
            return 0
        _, _, row0, rows_per_rad, _ = self.parameters
        lat = (row_edge - row0) / rows_per_rad
        near = abs(abs(lat) - np.pi / 2.0) * abs(rows_per_rad) <= tolerance
        return int(np.sign(lat)) if near else 0

    @cached_property
    def _transformers(self) -> tuple[pyproj.Transformer, pyproj.Transformer]:
        crs = pyproj.CRS.from_wkt(self.wkt)
        geodetic = crs.geodetic_crs
        if geodetic is None:
            raise ValueError("the CRS has no geographic base")
        forward = pyproj.Transformer.from_crs(geodetic, crs, always_xy=True)
        backward = pyproj.Transformer.from_crs(crs, geodetic, always_xy=True)
        return forward, backward

    def __getstate__(self) -> dict[str, Any]:
        # transformers do not travel between processes; they are made again on first use
        return {k: v for k, v in self.__dict__.items() if k != "_transformers"}

    def pixel_from_latlon(self, lat: ArrayLike, lon: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Fractional (col, row) of planetocentric latitudes and east longitudes (rad).

        Columns of a cylindrical raster lie in [-0.5, period - 0.5): any turn of longitude is right.
        Points that the projection cannot show give NaN.
        """
        lat, lon = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (lat, lon)))
        if self.kind == OTHER:
            return self._project_by_proj(lat, lon)
        col, row = np.empty(lat.size), np.empty(lat.size)
        flat = np.ascontiguousarray(lat).ravel(), np.ascontiguousarray(lon).ravel()
        _compute_pixels(self.kind, np.array(self.parameters), self.longitude_sign, *flat, col, row)
        return col.reshape(lat.shape), row.reshape(lat.shape)

    def _project_by_proj(self, lat: FloatArray, lon: FloatArray) -> tuple[FloatArray, FloatArray]:
        forward, _ = self._transformers
        if self.axes_squared != 1.0:
            lat = np.arctan2(np.sin(lat), self.axes_squared * np.cos(lat))
        x, y = forward.transform(np.degrees(lon) * self.longitude_sign, np.degrees(lat))
        # PROJ gives infinities for points that the projection cannot show
        shown = np.isfinite(x) & np.isfinite(y)
        a, b, c, d, e, f = self.affine
        x, y = np.where(shown, x, np.nan) - c, np.where(shown, y, np.nan) - f
        if self.turn:
            # PROJ keeps longitudes within half a turn; a raster may lie a turn further on
            middle = (a * self.shape[1] + b * self.shape[0]) / 2.0
            x = x - np.round((x - middle) / self.turn) * self.turn
        determinant = a * e - b * d
        return (e * x - b * y) / determinant - 0.5, (a * y - d * x) / determinant - 0.5

    def latlon_from_pixel(self, col: ArrayLike, row: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Latitude and east longitude (rad, of any turn) of fractional columns and rows."""
        _, backward = self._transformers
        a, b, c, d, e, f = self.affine
        col, row = np.asarray(col, dtype=np.float64) + 0.5, np.asarray(row, dtype=np.float64) + 0.5
        lon_deg, lat_deg = backward.transform(a * col + b * row + c, d * col + e * row + f)
        lat = np.radians(lat_deg)
        if self.axes_squared != 1.0:
            lat = np.arctan2(self.axes_squared * np.sin(lat), np.cos(lat))
        return lat, np.radians(lon_deg) * self.longitude_sign

    def columns_per_posting(self, row_scale: float, lat: FloatArray) -> FloatArray:
        """Columns that a ground length of `row_scale` rows spans at latitudes (rad)."""
        ratio = row_scale * self.row_angle / self.column_angle
        if self.kind != CYLINDRICAL and not self.turn:
            return np.full(lat.shape, ratio)
        return np.asarray(ratio / np.maximum(np.cos(lat), 1e-9))


def iterate_column_spans(
    col0: int, width: int, cols: int, wraps: bool, tile: int | None = None
) -> Iterator[tuple[int, int, int]]:
    """The parts of a window's columns that a raster of `cols` columns has.

    col0, width  first column of the window, of any turn where the raster wraps, and their number
    tile         no part crosses a multiple of it
    Yields a part's place in the window, its first column in the raster and its width.
    """
    at = 0
    while at < width:
        col = col0 + at
        if wraps:
            col %= cols
        elif col < 0:
            at = -col0
            continue
        if col >= cols:
            return
        count = min(width - at, cols - col)
        if tile is not None:
            count = min(count, tile - col % tile)
        yield at, col, count
        at += count


def make_georeference(
    wkt: str, affine: Steps, shape: tuple[int, int], longitude_sign: float, radius_m: float
) -> Georeference:
    """The georeference of a raster: closed form where one fits, PROJ otherwise.

    affine     the raster's steps and corner, in the CRS's unit
    radius_m   the body's radius, for grid spacings on the ground
    Raises ValueError for a CRS without a geographic base.
    """
    crs = pyproj.CRS.from_wkt(wkt)
    form = _find_closed_form(crs, affine)
    kind, parameters = form if form is not None else (OTHER, ())
    if kind == CYLINDRICAL:
        column_angle, row_angle = 1.0 / abs(parameters[1]), 1.0 / abs(parameters[3])
    else:
        unit = crs.axis_info[0].unit_conversion_factor  # m or rad a CRS unit
        per = 1.0 if crs.is_geographic else radius_m
        column_angle = float(np.hypot(affine[0], affine[3])) * unit / per
        row_angle = float(np.hypot(affine[1], affine[4])) * unit / per
    turn = _measure_turn_in_x(crs)
    made = Georeference(
        wkt, affine, shape, longitude_sign, kind, parameters, row_angle, column_angle, turn
    )
    if kind != OTHER and not _is_in_agreement(made):
        return make_proj_georeference(made)
    return made


def make_proj_georeference(closed: Georeference) -> Georeference:
    """Return the georeference with every point sent through PROJ, which checks closed forms."""
    return replace(closed, kind=OTHER, parameters=())


def make_geodetic_georeference(closed: Georeference) -> Georeference:
    """Return the georeference of a map on a flattened ellipsoid, through PROJ."""
    semi_major, semi_minor = closed.ellipsoid_m
    return replace(make_proj_georeference(closed), axes_squared=(semi_minor / semi_major) ** 2)


def _measure_turn_in_x(crs: pyproj.CRS) -> float:
    """Measure the x of a full turn of longitude, CRS units; 0 for other than plate carree maps."""
    unit = float(crs.axis_info[0].unit_conversion_factor)
    if crs.is_geographic:
        return 2.0 * np.pi / unit
    operation, ellipsoid = crs.coordinate_operation, crs.ellipsoid
    if operation is None or ellipsoid is None:
        return 0.0
    if not operation.method_name.startswith("Equidistant Cylindrical"):
        return 0.0
    values = {p.name: float(p.value) * p.unit_conversion_factor for p in operation.params}
    lat_ts = values.get("Latitude of 1st standard parallel", 0.0)
    return float(2.0 * np.pi * ellipsoid.semi_major_metre * np.cos(lat_ts) / unit)


def _find_closed_form(crs: pyproj.CRS, affine: Steps) -> tuple[int, tuple[float, ...]] | None:
    a, b, c, d, e, f = affine
    if b != 0.0 or d != 0.0:
        return None
    if crs.is_geographic:
        unit = crs.axis_info[0].unit_conversion_factor  # rad a CRS unit
        rows, turn = 1.0 / (unit * e), float(2.0 * np.pi / abs(unit * a))
        return CYLINDRICAL, (-c / a - 0.5, 1.0 / (unit * a), -f / e - 0.5, rows, turn)
    operation, ellipsoid = crs.coordinate_operation, crs.ellipsoid
    if operation is None or ellipsoid is None or ellipsoid.inverse_flattening != 0.0:
        return None
    radius = ellipsoid.semi_major_metre
    unit = crs.axis_info[0].unit_conversion_factor  # m a CRS unit
    values = {p.name: float(p.value) * p.unit_conversion_factor for p in operation.params}
    east, north = values.get("False easting", 0.0), values.get("False northing", 0.0)
    if operation.method_name.startswith("Equidistant Cylindrical"):
        lat_ts = values.get("Latitude of 1st standard parallel", 0.0)
        lat0 = values.get("Latitude of natural origin", 0.0)
        lon0 = values.get("Longitude of natural origin", 0.0)
        per_rad = radius * np.cos(lat_ts) / unit
        col0 = (east / unit - per_rad * lon0 - c) / a - 0.5
        row0 = (north / unit - radius / unit * lat0 - f) / e - 0.5
        period = 2.0 * np.pi * per_rad / abs(a)
        numbers = col0, per_rad / a, row0, radius / unit / e, period
        return CYLINDRICAL, tuple(float(number) for number in numbers)
    if "Stereographic" in operation.method_name and a == -e:
        polar = _read_polar(values)
        if polar is None:
            return None
        sign, lon0, scale = polar
        col_pole, row_pole = (east / unit - c) / a - 0.5, (north / unit - f) / e - 0.5
        return POLAR, (sign, col_pole, row_pole, 2.0 * radius * scale / unit / a, lon0)
    return None


def _read_polar(values: dict[str, float]) -> tuple[float, float, float] | None:
    """Pole sign, central longitude and scale at the pole, in any of the ways a CRS states them."""
    if "Latitude of standard parallel" in values:  # variants B and C
        lat = values["Latitude of standard parallel"]
        scale = (1.0 + float(np.sin(abs(lat)))) / 2.0
    elif abs(abs(values.get("Latitude of natural origin", 0.0)) - np.pi / 2.0) < 1e-12:
        lat = values["Latitude of natural origin"]
        scale = values.get("Scale factor at natural origin", 1.0)
    else:
        return None
    lon0 = values.get("Longitude of natural origin", values.get("Longitude of origin", 0.0))
    return float(np.sign(lat)), lon0, scale


def _is_in_agreement(made: Georeference) -> bool:
    """Whether the closed form lands on PROJ's pixels over the raster."""
    rows, cols = made.shape
    row, col = np.meshgrid(np.linspace(0.1, 0.9, 3) * rows, np.linspace(0.1, 0.9, 5) * cols)
    lat, lon = made.latlon_from_pixel(col, row)
    back_col, back_row = made.pixel_from_latlon(lat, lon)
    off = back_col - col
    if made.period:
        off = off - np.round(off / made.period) * made.period
    return bool(np.all(np.abs(off) < AGREEMENT) and np.all(np.abs(back_row - row) < AGREEMENT))


@kernel
def _compute_pixels(
    kind: int,
    p: FloatArray,
    longitude_sign: float,
    lat: FloatArray,
    lon: FloatArray,
    col: FloatArray,
    row: FloatArray,
) -> None:
    for i in range(lat.size):
        east = lon[i] * longitude_sign
        if kind == 0:
            c = p[0] + p[1] * east + 0.5
            # the column of [-0.5, period - 0.5) that shows this meridian
            col[i] = c - np.floor(c / p[4]) * p[4] - 0.5
            row[i] = p[2] + p[3] * lat[i]
        else:
            sign, dlon = p[0], east - p[4]
            distance = p[3] * np.tan(np.pi / 4.0 - sign * lat[i] / 2.0)
            col[i] = p[1] + distance * np.sin(dlon)
            # rows count southward in the map: y grows upward
            row[i] = p[2] + sign * distance * np.cos(dlon)


GEOIDS = ("geoid", "selenoid", "gravity", "mean sea level", "egm", "orthometric")


def orient_eastward(wkt: str, affine: Steps, west: bool) -> tuple[str, Steps, float]:
    """Bring a coordinate system to east longitudes from 0, without its vertical part.

    affine  the raster's steps and corner, in the unit of the coordinate system
    west    the longitudes that the file states count westward
    Returns WKT, steps, and -1 where x itself counts westward, else 1.
    Raises ValueError for heights above a geoid, depths, westings and meridians that cannot be
    turned.
    """
    stated = pyproj.CRS.from_wkt(wkt)
    crs = _extract_horizontal(stated)
    directions = [axis.direction for axis in crs.axis_info]
    if crs.is_projected and "west" in directions:
        raise ValueError("its x counts westward; reproject it to eastings with gdalwarp")
    west = west or (crs.is_geographic and "west" in directions)
    meridian = crs.prime_meridian
    turn = 0.0
    if meridian is not None:
        turn = float(meridian.longitude) * float(meridian.unit_conversion_factor)
    if not west and turn == 0.0:
        return (wkt if crs == stated else crs.to_wkt()), affine, 1.0
    turned = pyproj.CRS.from_json_dict(
        _rotate_longitudes(crs.to_json_dict(), math.degrees(turn), west)
    )
    if not crs.is_geographic:
        return turned.to_wkt(), affine, 1.0
    sign = -1.0 if west else 1.0
    a, b, c, d, e, f = affine
    return turned.to_wkt(), (a, b, c + sign * turn / _get_radians_per_unit(crs), d, e, f), sign


def _extract_horizontal(crs: pyproj.CRS) -> pyproj.CRS:
    """The part of a system that says where a pixel lies; the vertical one must be plain heights."""
    if crs.is_compound and len(crs.sub_crs_list) > 1:
        crs, vertical = crs.sub_crs_list[:2]
        if any(word in vertical.name.lower() for word in GEOIDS):
            raise ValueError(f"its heights count from a geoid, '{vertical.name}'; convert them")
        if [axis.direction for axis in vertical.axis_info] == ["down"]:
            raise ValueError(f"its values are depths, '{vertical.name}'; negate them")
    if crs.is_bound and crs.source_crs is not None:
        crs = crs.source_crs
    return crs.to_2d() if crs.is_geographic and len(crs.axis_info) > 2 else crs


def _get_radians_per_unit(crs: pyproj.CRS) -> float:
    """Radians in a unit of a map in degrees."""
    return float(crs.axis_info[0].unit_conversion_factor)


def _rotate_longitudes(crs: dict[str, Any], turn_deg: float, west: bool) -> dict[str, Any]:
    """A system in PROJJSON with its longitudes eastward from 0."""
    base = crs.get("base_crs", crs)
    for datum in (base.get("datum"), base.get("datum_ensemble")):
        if datum is not None:
            datum.pop("prime_meridian", None)
    for axis in crs["coordinate_system"]["axis"]:
        axis["direction"] = axis["direction"].replace("west", "east")
    longitudes = [
        parameter
        for parameter in crs.get("conversion", {}).get("parameters", [])
        if parameter["name"].startswith("Longitude of")
    ]
    if "base_crs" in crs and not longitudes:
        raise ValueError("its projection has no central meridian; reproject it with gdalwarp")
    for parameter in longitudes:
        unit = parameter.get("unit", "degree")
        per_deg = 1.0 if unit == "degree" else 1.0 / math.degrees(unit["conversion_factor"])
        east = -parameter["value"] if west else parameter["value"]
        parameter["value"] = east + turn_deg * per_deg
    crs.pop("id", None)
    return crs
