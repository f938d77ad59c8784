"""Orthoimages and mosaics: brightness on a map, read as terrain models are.

A value is scaled so that the brightest pixels are as high as the pixels are wide: overviews round
to a share of the posting, whatever the unit of the file.
"""

from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import rasterio
from rasterio.enums import ColorInterp

from catalog.arrays import Float32Array
from catalog.bodies.body import Body
from catalog.errors import DataError
from catalog.geometry.ellipsoid import project_to_surface
from catalog.geometry.latlon import xyz_from_latlon
from catalog.rasters import encode_geotiff
from catalog.terrain.dem.file import Conversion, find_nodata_range, read_georeference
from catalog.terrain.dem.label import read_map_label
from catalog.terrain.dem.source import DemSettings, DemSource, report_once
from catalog.terrain.dem.validity import Validity, find_shared_end, list_unused_bands

BRIGHT_PERCENTILE = 99.0
ELLIPSOID_NODES = 64  # a side: bicubic between them a spheroid is right to millimetres
MAX_ELLIPSOID_DEG = 0.25
NO_HEIGHT = -1e9  # no node has it
BORDER_DEG = 1.0  # of it beyond the image: the coarsest patches reach out


class ImageSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[[image]]: an orthoimage or mosaic, whose brightness is the template.

    path     relative to the config file; `nodata` and `crs` override the file's own
    error_m  1 sigma per axis of its places on the ground, common to a region
    """

    path: str
    nodata: float | None = None
    crs: str | None = None
    error_m: Annotated[float, msgspec.Meta(ge=0.0, le=1e6)] = 0.0

    @property
    def settings(self) -> DemSettings:
        """The keys that say how it is read."""
        return DemSettings(self.path, nodata=self.nodata, crs=self.crs, units="m")


class ImageSource(DemSource):
    """An opened image, whose "heights" are brightness. Not safe across threads."""

    @classmethod
    def _read_header(
        cls, path: Path, settings: DemSettings, body: Body, dataset: Any, section: str
    ) -> "ImageSource":
        if dataset.count < 1 or min(dataset.shape) < 4:
            rows, cols = dataset.shape
            raise DataError(f"{path}: {rows} x {cols} pixels; wanted an image of 4 x 4 or more")
        dtype = str(dataset.dtypes[0])
        if np.dtype(dtype).kind not in "iuf" or dataset.colorinterp[0] == ColorInterp.palette:
            raise DataError(
                f"{path}: pixels are {dtype}, {dataset.colorinterp[0].name}; wanted brightness in "
                "whole or real numbers: expand a palette with gdal_translate -expand gray"
            )
        remedy = f'set `crs` in {section}, for example crs = "EPSG:4326"'
        label = read_map_label(path, dataset)
        georeference = read_georeference(
            path, settings.crs, label.longitude, body, dataset, remedy, geodetic=True
        )
        nodata = settings.nodata if settings.nodata is not None else label.nodata
        convert = Conversion(1.0, 0.0, *find_nodata_range(nodata, dtype))
        validity = Validity.read(dataset, special=label.special)
        for remark in (*list_unused_bands(dataset, 1, "brightness"), *label.remarks):
            report_once(path, remark)
        block = tuple(dataset.block_shapes[0])
        stored = validity.stored_type(dtype)
        kinds = "brightness", "m", stored, block, section, validity, dataset
        source = cls(path, settings, body, georeference, convert, *kinds)
        probe = source._read_probe()
        bright = float(np.percentile(probe, BRIGHT_PERCENTILE)) if probe.size else 0.0
        if not bright > 0.0:
            raise DataError(
                f"{path}: its brightness is {bright:g} and less at {probe.size} probed pixels; "
                f"wanted light: check `nodata` in {section}"
            )
        source.convert = convert._replace(scale_m=source.posting_m / bright)
        return source

    def check_sample(self, heights: Float32Array) -> None:
        """Refuse brightness (n,) in which one value stands for no data without a tag."""
        end = find_shared_end(heights, self.posting_m)
        if end is None or self.settings.nodata is not None:
            return
        stored = f"{end.height / self.convert.scale_m:.10g}"
        raise DataError(
            f"{self.path}: {end.share:.2g} of its pixels share one brightness, {stored}, apart "
            "from all others: holes without a mask have borders that look like ground; state "
            f"nodata = {stored} in {self.section}, or another value if it is ground"
        )

    def check_heights(self, lowest: float, highest: float) -> None:
        """Refuse an image without contrast."""
        if not highest > lowest:
            raise DataError(f"{self.path}: all its pixels are equally bright; name another image")


def encode_ellipsoid(image: DemSource) -> bytes:
    """A terrain model of the body's ellipsoid about an image: a GeoTIFF, m above its sphere."""
    body = image.body
    west, south, east, north = np.degrees(image.latlon_bounds())
    south, north = max(south - BORDER_DEG, -90.0), min(north + BORDER_DEG, 90.0)
    wide = min(east - west + 2.0 * BORDER_DEG, 360.0)
    west = (west + east - wide) / 2.0
    cols, rows = (
        max(ELLIPSOID_NODES, int(np.ceil(span / MAX_ELLIPSOID_DEG)))
        for span in (wide, north - south)
    )
    across, down = wide / cols, (north - south) / rows
    lon = np.radians(west + across * (np.arange(cols) + 0.5))
    lat = np.radians(north - down * (np.arange(rows) + 0.5))
    directions = xyz_from_latlon(lat[:, None], lon[None, :], 1.0)
    heights = np.linalg.norm(project_to_surface(directions, body.radii_m), axis=-1) - body.radius_m
    profile = {
        "crs": rasterio.CRS.from_proj4(f"+proj=longlat +R={body.radius_m} +no_defs"),
        "transform": rasterio.Affine(across, 0.0, west, 0.0, -down, north),
        "nodata": NO_HEIGHT,
    }
    return encode_geotiff({"heights": heights.astype(np.float32)}, profile, unit="m")
