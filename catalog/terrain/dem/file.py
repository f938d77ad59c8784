"""The header of a terrain model file, checked: units, georeference, body.

And what makes metres above the reference sphere of its counts.
"""

import math
import os
import re
from decimal import Decimal
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import rasterio
from numpy.typing import NDArray
from pyproj.exceptions import ProjError
from rasterio.errors import RasterioError

from catalog.arrays import Float32Array
from catalog.bodies.body import Body
from catalog.config import BUNDLED, resource
from catalog.errors import ConfigError, DataError
from catalog.geometry.kernel import kernel
from catalog.terrain.dem.georeference import (
    Georeference,
    make_geodetic_georeference,
    make_georeference,
    orient_eastward,
)
from catalog.terrain.dem.label import read_map_label

# A CRS made for another body is off by tens of percent; spheres of one body differ by less.
RADIUS_TOLERANCE = 0.01
MIN_POSTING_M = 1e-3
MAX_SHAPE_ERROR = 1e-5  # of an ellipsoid's axes: ellipsoids of the Earth differ by less
# Of a map, rad: two turns of longitude, or a polar map to the other pole, are beyond any model.
MAX_EXTENT = 4.0 * np.pi
MAX_CRS = 20_000  # letters
MIN_ROUNDED = 100.0  # no-data values nearer to 0 mean nothing but themselves, whatever their digits
_CRS = re.compile(
    r"(EPSG|ESRI|OGC|IAU(_\d{4})?):\w+$|urn:ogc:def:crs:[\w.:-]+$|\+\w|"
    r"(GEOG|GEOD|GEOC|PROJ|COMPD_|BOUND|COMPOUND)(CS|CRS)\s*\[",
    re.I,
)
# what makes PROJ read a file
_GRIDS = re.compile(r"grids|://|\bfile=|parameterfile|\+init|\+catalog|=pipeline", re.I)

Units = Literal["m", "km", "dm", "cm"]
STATED_UNITS: dict[Units, tuple[str, ...]] = {
    "m": ("m", "meter", "metre", "meters", "metres"),
    "km": ("km", "kilometer", "kilometre", "kilometers", "kilometres"),
    "dm": ("dm", "decimeter", "decimetre", "decimeters", "decimetres"),
    "cm": ("cm", "centimeter", "centimetre", "centimeters", "centimetres"),
}

NO_UNITS = ("", "N/A", "UNK", "NULL", "NONE")  # of labels

SHARED = "shared:"  # a path that begins so is a file in the folder that SHARED_FOLDER names
SHARED_FOLDER = "OPTNAV_SHARED_DATA"


def resolve_path(name: str, base_dir: Path) -> Path:
    """The file that a config names: beside the config, among the data that travel along, or shared.

    Raises ConfigError for a shared or shipped file that is not there, and for what is no path.
    """
    if "\0" in name:
        raise ConfigError(f"{name!r:.60} is no path of a file; a path holds no NUL")
    if name.startswith(SHARED):
        folder = os.environ.get(SHARED_FOLDER)
        if not folder:
            raise ConfigError(
                f"'{name}' lies in the folder that the environment variable {SHARED_FOLDER} names, "
                "which is not set; set it, or write the file's own path"
            )
        path = Path(os.path.realpath(folder)) / name.removeprefix(SHARED)
        if not path.is_file():
            raise ConfigError(
                f"'{name}' is not there: {SHARED_FOLDER} is {folder}, and {path} is no file"
            )
        return path
    if name.startswith(BUNDLED):
        return resource(f"data/{name.removeprefix(BUNDLED)}")
    return base_dir / name


def find_label(path: Path) -> Path:
    """The file that GDAL opens for a product: a PDS3 image's detached label."""
    if path.suffix.lower() == ".img":
        for suffix in (".LBL", ".lbl", ".Lbl"):
            if path.with_suffix(suffix).is_file():
                return path.with_suffix(suffix)
    return path


def read_units(path: Path, stated: str, section: str) -> Units:
    """Units that a file states, metres when it states none. Raises DataError for foreign ones.

    section  where other ones could be set
    """
    stated = stated.strip("'\" ")
    if stated.upper() in NO_UNITS:
        return "m"
    for units, names in STATED_UNITS.items():
        if stated.lower() in names:
            return units
    raise DataError(
        f"{path}: its values are in '{stated}'; wanted one of {', '.join(STATED_UNITS)}: convert "
        f"it, or set `units` in {section} if the file is wrong"
    )


def parse_crs(text: str) -> Any:
    """The coordinate system that a text states: a code, WKT or a PROJ string.

    GDAL would also take the name of a file or a server. Raises ValueError.
    """
    stated = text.strip()
    if not _CRS.match(stated) or _GRIDS.search(stated) or len(stated) > MAX_CRS:
        raise ValueError('wanted a code as "IAU_2015:30100", WKT, or a PROJ string without files')
    return rasterio.CRS.from_user_input(stated)


def read_georeference(
    path: Path,
    crs_override: str | None,
    longitude: str | None,
    body: Body,
    dataset: Any,
    remedy: str,
    *,
    geodetic: bool = False,
) -> Georeference:
    """The raster's georeference. Raises DataError for no CRS, another body or no geotransform.

    longitude  "west" where those that the file states count westward; None: as its label says
    remedy     for a file without a CRS, or with one that cannot be used
    geodetic   whether maps on the body's own flattened ellipsoid are read: those of brightness
    """
    longitude = longitude or read_map_label(path, dataset).longitude
    try:
        crs = parse_crs(crs_override) if crs_override is not None else dataset.crs
    except (RasterioError, ValueError) as error:
        raise DataError(f"{path}: crs = '{crs_override}' is not known to PROJ ({error})") from None
    if not crs:
        raise DataError(f"{path}: has no coordinate system; {remedy}")
    if dataset.transform.is_identity:
        raise DataError(f"{path}: has no place on the map (no geotransform); georeference it")
    affine = (*dataset.transform,)[:6]
    a, b, _, d, e, _ = affine
    if not (np.isfinite(affine).all() and abs(a * e - b * d) > 1e-12 * max(a * a, e * e, b * b)):
        raise DataError(
            f"{path}: its pixels have no size by its geotransform ({', '.join(map(str, affine))}); "
            "georeference it anew with gdal_translate -a_ullr"
        )
    try:
        if _GRIDS.search(crs.to_wkt()):
            raise ValueError("it names a file of grid shifts")
        wkt, affine, sign = orient_eastward(crs.to_wkt(), affine, longitude == "west")
        placed = make_georeference(wkt, affine, dataset.shape, sign, body.radius_m)
        semi_major, semi_minor = placed.ellipsoid_m
    except (RasterioError, ProjError, ValueError) as error:
        raise DataError(
            f"{path}: its coordinate system cannot be used ({error}); {remedy}"
        ) from None
    if not MIN_POSTING_M < min(placed.row_angle, placed.column_angle) * body.radius_m < np.inf:
        raise DataError(
            f"{path}: its pixels are {placed.column_angle * body.radius_m:.3g} x "
            f"{placed.row_angle * body.radius_m:.3g} m; wanted over {MIN_POSTING_M:g} m: "
            "correct its geotransform"
        )
    extent = placed.shape[1] * placed.column_angle, placed.shape[0] * placed.row_angle
    if max(extent) > MAX_EXTENT:
        raise DataError(
            f"{path}: spans {np.degrees(extent[0]):.3g} x {np.degrees(extent[1]):.3g} deg of the "
            f"body; wanted up to {np.degrees(MAX_EXTENT):g}: correct its size or geotransform"
        )
    largest = max(body.radius_m, *body.radii_m)
    smallest = min(body.radius_m, *body.radii_m)
    slack = 1.0 + RADIUS_TOLERANCE
    if not smallest / slack <= semi_major <= largest * slack:
        raise DataError(
            f"{path}: its coordinate system is for a body of {semi_major / 1e3:.1f} km radius, "
            f"{body.name} has {body.radius_m / 1e3:.1f} km; check [body] name, or {remedy}"
        )
    if abs(semi_major - semi_minor) > 1e-6 * semi_major:
        is_body = abs(semi_minor / semi_major - body.radii_m[2] / body.radii_m[0]) < MAX_SHAPE_ERROR
        if geodetic and is_body:
            return make_geodetic_georeference(placed)
        raise DataError(
            f"{path}: its coordinate system is on a flattened ellipsoid, of {semi_major:.10g} and "
            f"{semi_minor:.10g} m, whose latitudes are geodetic; heights of {body.name} count from "
            f"a sphere of {body.radius_m:.10g} m and latitudes from its centre: convert both with "
            f"PROJ (gdalwarp by itself leaves them as they are): {_describe_pipeline(placed, body)}"
        )
    return placed


def _describe_pipeline(place: Georeference, body: Body) -> str:
    """The PROJ pipeline from degrees and heights on an ellipsoid to those on the body's sphere.

    Through x, y, z, so that no approximation is in it.
    """
    semi_major, semi_minor = place.ellipsoid_m
    return (
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=cart +a={semi_major:.12g} +b={semi_minor:.12g} "
        f"+step +inv +proj=cart +R={body.radius_m:.12g} "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )


class Conversion(NamedTuple):
    """Raw counts to metres above the reference sphere: count * scale_m + offset_m.

    first_nodata, last_nodata  counts from the one to the other are no data, NaN for none; see
                               `find_nodata_range`
    """

    scale_m: float
    offset_m: float
    first_nodata: float
    last_nodata: float

    def __call__(self, raw: NDArray[Any]) -> Float32Array:
        """Heights (float32, m) of counts (rows, cols) of any number type; NaN for no data."""
        out = np.empty(raw.shape, dtype=np.float32)
        _convert(np.ascontiguousarray(raw), self, out)
        return out

    def average_columns(self, raw: NDArray[Any], many: int, out: Float32Array) -> None:
        """Mean heights over `many` counts of a row; at least half of them must be valid.

        raw (rows, cols); out (rows, at least cols / many rounded up)
        """
        _average(np.ascontiguousarray(raw), many, self, out)


# of overviews, which hold heights
HEIGHTS = Conversion(1.0, 0.0, math.nan, math.nan)


def find_nodata_range(nodata: float | None, dtype: str) -> tuple[float, float]:
    """Lowest and highest count that a no-data value means; NaN twice for none.

    A float file's no-data value may have lost digits on its way through text. One that is no
    exact binary number means the nearest float32, and all counts that round to it at the digits
    that it has: -3.40282e+38 is the lowest float32, -3.40282346...e+38.
    """
    if nodata is None or not math.isfinite(nodata):
        return math.nan, math.nan
    values = [nodata]
    if np.dtype(dtype).kind == "f":
        with np.errstate(over="ignore"):
            single = np.float32(nodata)
        values += [float(single)] if np.isfinite(single) else []
        # GDAL gives the nearest float32, whose shortest text has the digits that were written
        written = Decimal(str(single) if float(single) == nodata else repr(nodata)).normalize()
        if written != Decimal(nodata) and abs(nodata) >= MIN_ROUNDED:
            half = 0.5 * 10.0 ** int(written.as_tuple().exponent)
            values += [nodata - half, nodata + half]
    return min(values), max(values)


@kernel
def is_height(value: float, convert: Conversion) -> bool:
    """Whether a count is data: finite and not a no-data value."""
    if not abs(value) < np.inf:
        return False
    return not (value >= convert.first_nodata and value <= convert.last_nodata)


@kernel
def _convert(raw: NDArray[Any], convert: Conversion, out: Float32Array) -> None:
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            value = float(raw[i, j])
            valid = is_height(value, convert)
            out[i, j] = value * convert.scale_m + convert.offset_m if valid else np.nan


@kernel
def _average(raw: NDArray[Any], many: int, convert: Conversion, out: Float32Array) -> None:
    cols = raw.shape[1]
    for i in range(raw.shape[0]):
        for k in range((cols + many - 1) // many):
            total, valid = 0.0, 0
            end = min((k + 1) * many, cols)
            for j in range(k * many, end):
                value = float(raw[i, j])
                if is_height(value, convert):
                    total += value
                    valid += 1
            enough = valid > 0 and 2 * valid >= end - k * many
            out[i, k] = total / valid * convert.scale_m + convert.offset_m if enough else np.nan
