"""Opening a terrain model file and finding where it lies, with a header's possible errors."""

import os
import warnings
from pathlib import Path
from typing import Any, Literal

import rasterio
from rasterio.errors import NotGeoreferencedWarning, RasterioError, RasterioIOError

from catalog.bodies.body import Body
from catalog.config import resource
from catalog.errors import ConfigError, DataError
from catalog.terrain.dem.georeference import Georeference, georeference

# A CRS made for another body is off by tens of percent; spheres of one body differ by less.
RADIUS_TOLERANCE = 0.01

Units = Literal["m", "km", "dm", "cm"]
STATED_UNITS: dict[Units, tuple[str, ...]] = {
    "m": ("m", "meter", "metre", "meters", "metres"),
    "km": ("km", "kilometer", "kilometre", "kilometers", "kilometres"),
    "dm": ("dm", "decimeter", "decimetre", "decimeters", "decimetres"),
    "cm": ("cm", "centimeter", "centimetre", "centimeters", "centimetres"),
}

BUNDLED = "bundled:"  # a path that begins so names a file of the package's own data
SHARED = "shared:"  # one that begins so, a file in the folder that SHARED_FOLDER names
SHARED_FOLDER = "OPTNAV_SHARED_DATA"


def path_of(name: str, base_dir: Path) -> Path:
    """The file that a config names: beside the config, among the data that travel along, or shared.

    Raises ConfigError for a shared or shipped file that is not there.
    """
    if name.startswith(SHARED):
        folder = os.environ.get(SHARED_FOLDER)
        if not folder:
            raise ConfigError(
                f"'{name}' lies in the folder that the environment variable {SHARED_FOLDER} names, "
                "which is not set; set it, or write the file's own path"
            )
        path = Path(folder).resolve() / name.removeprefix(SHARED)
        if not path.is_file():
            raise ConfigError(
                f"'{name}' is not there: {SHARED_FOLDER} is {folder}, and {path} is no file"
            )
        return path
    if name.startswith(BUNDLED):
        return resource(f"data/{name.removeprefix(BUNDLED)}")
    return base_dir / name


def label_of(path: Path) -> Path:
    """The file that GDAL opens for a product: a PDS3 image's detached label."""
    if path.suffix.lower() == ".img":
        for suffix in (".LBL", ".lbl", ".Lbl"):
            if path.with_suffix(suffix).is_file():
                return path.with_suffix(suffix)
    return path


def open_raster(path: Path) -> Any:
    """A rasterio dataset. Raises DataError for what is missing, empty or no raster."""
    if not path.exists():
        raise DataError(f"{path}: there is no such file; check `path` in its [[dem]] section")
    if path.is_dir():
        raise DataError(f"{path}: is a folder; name a raster file")
    if path.stat().st_size == 0:
        raise DataError(f"{path}: is empty; get the file again")
    try:
        with warnings.catch_warnings():
            # a file without a place on the map gets an error of our own, with a remedy
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            return rasterio.open(path)
    except RasterioIOError as error:
        remedy = "wanted a raster that GDAL reads (GeoTIFF, PDS3, PDS4, ISIS cube, VRT)"
        if path.suffix.lower() == ".img":
            remedy = f"a PDS3 image needs its label {path.with_suffix('.LBL').name} beside it"
        raise DataError(f"{path}: cannot be opened ({gdal_reason(error)}); {remedy}") from None


def gdal_reason(error: BaseException) -> str:
    """GDAL's own words, which rasterio keeps as the cause of its error."""
    deepest: BaseException = error
    while deepest.__cause__ is not None:
        deepest = deepest.__cause__
    return str(deepest).strip().rstrip(".")


def file_units(path: Path, dataset: Any) -> Units:
    """Units that the band states, metres when it states none. Raises DataError for foreign ones."""
    stated = (dataset.units[0] or "").strip()
    if not stated:
        return "m"
    for units, names in STATED_UNITS.items():
        if stated.lower() in names:
            return units
    raise DataError(
        f"{path}: its values are in '{stated}'; wanted one of {', '.join(STATED_UNITS)}: convert "
        "it, or set `units` in its [[dem]] section if the file is wrong"
    )


def place_of(
    path: Path, crs_override: str | None, longitude: str, body: Body, dataset: Any
) -> Georeference:
    """The raster's georeference. Raises DataError for no CRS, another body or no geotransform."""
    remedy = 'set `crs` in its [[dem]] section, for example crs = "IAU_2015:30100"'
    try:
        crs = rasterio.CRS.from_user_input(crs_override) if crs_override else dataset.crs
    except (RasterioError, ValueError) as error:
        raise DataError(f"{path}: crs = '{crs_override}' is not known to PROJ ({error})") from None
    if not crs:
        raise DataError(f"{path}: has no coordinate system; {remedy}")
    if dataset.transform.is_identity:
        raise DataError(f"{path}: has no place on the map (no geotransform); georeference it")
    sign = -1.0 if longitude == "west" else 1.0
    try:
        affine = (*dataset.transform,)[:6]
        place = georeference(crs.to_wkt(), affine, dataset.shape, sign, body.radius_m)
        semi_major, semi_minor = place.ellipsoid_m
    except (RasterioError, ValueError) as error:
        raise DataError(
            f"{path}: its coordinate system cannot be used ({error}); {remedy}"
        ) from None
    largest = max(body.radius_m, *body.radii_m)
    smallest = min(body.radius_m, *body.radii_m)
    slack = 1.0 + RADIUS_TOLERANCE
    if not smallest / slack <= semi_major <= largest * slack:
        raise DataError(
            f"{path}: its coordinate system is for a body of {semi_major / 1e3:.1f} km radius, "
            f"{body.name} has {body.radius_m / 1e3:.1f} km; check [body] name, or {remedy}"
        )
    if abs(semi_major - semi_minor) > 1e-6 * semi_major:
        raise DataError(
            f"{path}: its coordinate system is on a flattened ellipsoid; wanted a sphere "
            "(planetocentric latitudes): reproject it with gdalwarp"
        )
    return place
