"""The relief that a catalog carries as a GeoTIFF, for GIS programs and GDAL's tools."""

from pathlib import Path

import rasterio
from rasterio.errors import RasterioError
from rasterio.transform import Affine

from catalog.errors import DataError, OutputError
from catalog.store.partial import replacing
from catalog.store.reader import Catalog
from catalog.store.schema import srs_of

DESCRIPTION = "optnav relief"  # what begins a file that we wrote, and may therefore write again
ENDINGS = (".tif", ".tiff")
BANDS = ("mean height, m", "highest place, m")


def export_relief(catalog: Catalog, path: Path) -> int:
    """Write means and tops as the bands of a GeoTIFF on the body's sphere; returns its rows.

    Raises DataError for a catalog without a relief or with a damaged one, OutputError for a place
    that cannot be written or an existing file that is no such export.
    """
    relief = catalog.relief()
    if relief is None:
        raise DataError(
            f"{catalog.path}: carries no relief; name a terrain model of the whole body as "
            "[relief] dem of its build config and build it again"
        )
    rows = len(relief.heights)
    step = 180.0 / rows
    profile = {
        "driver": "GTiff",
        "height": rows,
        "width": 2 * rows,
        "count": len(BANDS),
        "dtype": "float32",
        "crs": rasterio.CRS.from_wkt(srs_of(catalog.meta.body, catalog.meta.radius_m)[4]),
        "transform": Affine(step, 0.0, -180.0, 0.0, -step, 90.0),
        "tiled": True,
        "compress": "deflate",
        "predictor": 3,
    }
    with replacing(path, _is_ours) as partial:
        try:
            with rasterio.open(partial, "w", **profile) as file:
                file.update_tags(TIFFTAG_IMAGEDESCRIPTION=f"{DESCRIPTION}: {relief.source}")
                file.units = ("m",) * len(BANDS)
                for band, (name, grid) in enumerate(zip(BANDS, (relief.heights, relief.tops)), 1):
                    file.write(grid, band)
                    file.set_band_description(band, name)
        except RasterioError as error:
            raise OutputError(f"{path}: cannot be written ({error}); free some space") from None
    return rows


def _is_ours(path: Path) -> bool:
    try:
        with rasterio.open(path) as file:
            return str(file.tags().get("TIFFTAG_IMAGEDESCRIPTION", "")).startswith(DESCRIPTION)
    except RasterioError:
        return False
