"""A catalog's relief, or a patch of a point, as a GeoTIFF that GDAL and QGIS know the place of."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.io import MemoryFile
from rasterio.transform import Affine

from catalog.arrays import Float32Array
from catalog.control_point import ControlPoint
from catalog.errors import DataError
from catalog.files import replacing_file
from catalog.inspect.export import PATCH_NAME, patch_of
from catalog.rasters import OWN, open_raster
from catalog.store.geopackage import srs_of
from catalog.store.manifest import CatalogMeta
from catalog.store.reader import Catalog

ENDINGS = (".tif", ".tiff")
RELIEF_NAME = "optnav relief"  # begins the description of a file of ours, as PATCH_NAME does
DESCRIPTION = "TIFFTAG_IMAGEDESCRIPTION"


def export_relief(catalog: Catalog, path: Path) -> int:
    """Write means and tops as the bands of a GeoTIFF on the body's sphere; returns its rows.

    Raises DataError for a catalog without a relief or with a damaged one, OutputError for a place
    that cannot be written or an existing file that is no such export.
    """
    relief = catalog.relief()
    if relief is None:
        raise DataError(
            f"{catalog.path}: carries no relief; name a terrain model of the whole body as "
            "[relief] dem of its build config and build it again, or name a point with --point to "
            "write its patch"
        )
    rows = len(relief.heights)
    step = 180.0 / rows
    place = {
        "crs": rasterio.CRS.from_wkt(srs_of(catalog.meta.body, catalog.meta.radius_m)[4]),
        "transform": Affine(step, 0.0, -180.0, 0.0, -step, 90.0),
        "tiled": True,
    }
    bands = {"mean height, m": relief.heights, "highest place, m": relief.max_heights}
    _write(path, bands, place, {DESCRIPTION: f"{RELIEF_NAME}: {relief.source}"})
    return rows


def export_patch_heights(catalog: Catalog, point_id: int, level: int, path: Path) -> int:
    """Write the heights of a point's patch, a pixel a node, as a GeoTIFF; returns nodes a side.

    Its system is the stereographic projection of the body's sphere that is centred on the point, or
    the plane that touches the body below it. Nodes without ground are NaN, which is its nodata.
    Raises DataError for a point or level that is not there, OutputError as `export_relief`.
    """
    point, patch = patch_of(catalog, point_id, level)
    half = patch.posting_m * patch.size / 2.0
    place = {
        "crs": rasterio.CRS.from_wkt(_patch_system(catalog.meta, point)),
        "transform": Affine(patch.posting_m, 0.0, -half, 0.0, -patch.posting_m, half),
        "nodata": np.nan,
    }
    words = f"{PATCH_NAME} {point_id} level {level}: {point.source}"
    above = "sphere" if catalog.meta.planes is None else "plane"
    bands = {f"height above the {above}, m": patch.heights_m}
    _write(path, bands, place, {DESCRIPTION: words, "AREA_OR_POINT": "Point"})
    return patch.size


def _patch_system(meta: CatalogMeta, point: ControlPoint) -> str:
    """The map projection of a point's patches, as WKT."""
    axes = 'UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
    if meta.planes is not None:  # no projection of a sphere: heights move a point across the plane
        name = f"Plane that touches the ellipsoid of {meta.body} below control point {point.id}"
        if point.vertical_deg is not None:
            name = f"Plane of the ground of {meta.body} at control point {point.id}"
        return f'LOCAL_CS["{name}",{axes}'
    sphere = srs_of(meta.body, meta.radius_m)[4]
    return (
        f'PROJCS["{meta.body.capitalize()}, stereographic about control point {point.id}",{sphere},'
        f'PROJECTION["Stereographic"],PARAMETER["latitude_of_origin",{point.lat_deg!r}],'
        f'PARAMETER["central_meridian",{point.lon_deg!r}],PARAMETER["scale_factor",1],'
        f'PARAMETER["false_easting",0],PARAMETER["false_northing",0],{axes}'
    )


def _write(
    path: Path,
    bands: Mapping[str, Float32Array],
    place: Mapping[str, Any],
    tags: Mapping[str, str],
) -> None:
    """Write grids as bands, with their descriptions; all of them are metres."""
    height, width = next(iter(bands.values())).shape
    profile = {"driver": "GTiff", "dtype": "float32", "compress": "deflate", "predictor": 3}
    profile |= {"height": height, "width": width, "count": len(bands), **place}
    # in the memory first: GDAL takes no name that is not UTF-8, and tells no full disk from damage
    with replacing_file(path, _is_ours) as partial, MemoryFile() as memory:
        with memory.open(**profile) as file:
            file.update_tags(**tags)
            file.units = ("m",) * len(bands)
            for band, (text, grid) in enumerate(bands.items(), 1):
                file.write(grid, band)
                file.set_band_description(band, text)
        partial.write_bytes(memory.getbuffer())


def _is_ours(path: Path) -> bool:
    try:
        with open_raster(path, OWN) as file:
            return str(file.tags().get(DESCRIPTION, "")).startswith((RELIEF_NAME, PATCH_NAME))
    except DataError:
        return False
