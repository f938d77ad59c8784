"""How bright the true ground is from place to place: a map of the body, and 1/f noise.

Each octave of the noise changes brightness by the same share, as albedo of the Moon does: 3-7 % rms
an octave from 2.7 to 21 km (LROC colour map of 2025, decoded). Below a map's pixels that share is
what the map's own finest octave has there: in the LROC map 3.5 % over most maria, 6 % over much of
the highlands.
"""

import logging
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
from rasterio.enums import ColorInterp

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.correlation.filters import filter_low_pass
from catalog.errors import ConfigError, DataError
from catalog.geometry.grid import sample_bicubic
from catalog.geometry.kernel import parallel_kernel
from catalog.geometry.latlon import latlon_from_xyz
from catalog.rasters import TERRAIN, handle_read_errors, open_raster
from catalog.rendering.rays.scene import Reflectivity
from catalog.terrain.dem.file import find_nodata_range, read_georeference, resolve_path
from catalog.terrain.dem.label import read_map_label
from catalog.terrain.dem.validity import Validity, list_unused_bands
from catalog.terrain.synthetic import fractal
from optnav_cli.simulation.sections import AlbedoMapSettings, TruthSettings

log = logging.getLogger(__name__)

SHARE = 0.05  # rms an octave, where no map tells
AROUND_PIXELS = 8.0  # sigma of the ground over which a map's finest octave is taken
MAX_SPACING_M, MIN_SPACING_M = 60e3, 10.0  # spacings of the noise where no map is
FINER_THAN_MAP = 2.0  # the longest wave of the noise below a map, in its pixels
ALBEDO_STREAM = 1 << 41
MAX_MAP_PIXELS = 64_000_000
PARTS = 8  # of a row of pixels, for several cores
MIN_FACTOR, MAX_FACTOR = 0.3, 3.0


class Albedo:
    """Brightness of the ground over its mean.

    Raises ConfigError or DataError for a map that cannot be used.
    """

    def __init__(self, settings: TruthSettings, body: Body) -> None:
        self._map = AlbedoMap(settings.albedo_map, body) if settings.albedo_map else None
        largest = FINER_THAN_MAP * self._map.posting_m if self._map else MAX_SPACING_M
        count = 1 + int(np.ceil(np.log2(largest / MIN_SPACING_M)))
        spacing = largest / 2.0 ** np.arange(count, dtype=np.float64)
        amplitude = np.full(count, SHARE / fractal.RMS_NOISE)
        self._noise = fractal.Octaves(0, spacing, amplitude, body.radius_m)

    def factors(self, seed: int, directions: FloatArray, sizes_m: FloatArray) -> Float32Array:
        """Brightness (n,) of ground at unit directions (n, 3), body frame, over the mean.

        seed     of the noise
        sizes_m  (n,) of the pixels on the ground
        """
        logs = np.zeros(len(directions))
        noise = self._noise._replace(seed=seed + ALBEDO_STREAM)
        _add_octaves(logs, noise, directions, sizes_m)
        if self._map is None:
            relative: FloatArray = np.exp(logs)
        else:
            brightness, share = self._map.with_share(directions)
            relative = brightness * np.exp(logs * (share / SHARE))
        return np.clip(relative, MIN_FACTOR, MAX_FACTOR).astype(np.float32)

    def on_body(self, seed: int, body_from_scene: FloatArray) -> Reflectivity:
        """Return it for a scene in a turned frame, (3, 3)."""

        def reflectivity(directions: FloatArray, sizes_m: FloatArray) -> Float32Array:
            return self.factors(seed, directions @ body_from_scene.T, sizes_m)

        return reflectivity


class AlbedoMap:
    """A brightness map over its mean, and what its finest octave holds; 1 and SHARE outside."""

    def __init__(self, settings: AlbedoMapSettings, body: Body) -> None:
        path = resolve_path(settings.path, Path.cwd())
        dataset = open_raster(path, TERRAIN, "check `albedo_map` in [truth]")
        with dataset, handle_read_errors(path):
            rows, cols = dataset.shape
            if rows * cols > MAX_MAP_PIXELS:
                raise DataError(
                    f"{path}: has {rows} x {cols} pixels; wanted up to {MAX_MAP_PIXELS} as an "
                    "albedo_map: reduce it with gdal_translate -outsize"
                )
            self._place = None
            if settings.extent_deg:
                self._extent = _extent(path, settings.extent_deg)
            else:
                self._place = _placed(path, body, dataset)
            values = _brightness(path, dataset, settings.coding)
            for remark in list_unused_bands(dataset, _bands(dataset), "brightness"):
                log.warning("%s: %s", path, remark)
        mean = float(np.nanmean(values)) if np.isfinite(values).any() else 0.0
        if not mean > 0.0:
            raise DataError(f"{path}: holds no brightness above 0; name another albedo_map")
        self._values = values / np.float32(mean)
        if self._place is None:
            self.posting_m = float(np.radians(self._extent[3] - self._extent[1])) / rows
            self.posting_m *= body.radius_m
        else:
            self.posting_m = self._place.row_angle * body.radius_m

    @cached_property
    def _shares(self) -> Float32Array:
        return finest_share(self._values)

    def at(self, directions: FloatArray) -> FloatArray:
        """Brightness (n,) at unit directions (n, 3)."""
        return _sampled(self._values, 1.0, *self._pixels(directions))

    def with_share(self, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Brightness (n,) at unit directions (n, 3), and its rms change in the finest octave."""
        pixels = self._pixels(directions)
        return _sampled(self._values, 1.0, *pixels), _sampled(self._shares, SHARE, *pixels)

    def _pixels(self, directions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Rows and columns (n,) within the map, and whether the directions are."""
        lat, lon, _ = latlon_from_xyz(directions)
        rows, cols = self._values.shape
        if self._place is not None:
            col, row = self._place.pixel_from_latlon(lat, lon)
            if self._place.wraps:
                col = np.mod(col, cols)
        else:
            west, south, east, north = np.radians(self._extent)
            row = (north - lat) / (north - south) * rows - 0.5
            col = np.mod(lon - west, 2.0 * np.pi) / (east - west) * cols - 0.5
        # within half a pixel of an edge the outermost one counts
        inside = (row >= -0.5) & (row <= rows - 0.5) & (col >= -0.5) & (col <= cols - 0.5)
        return np.clip(row, 0.0, rows - 1.0), np.clip(col, 0.0, cols - 1.0), inside


def _sampled(
    values: Float32Array, elsewhere: float, row: FloatArray, col: FloatArray, inside: BoolArray
) -> FloatArray:
    """Values (n,) of a map at rows and columns; `elsewhere` outside of it and in its holes."""
    sampled: FloatArray = sample_bicubic(values, row, col).astype(np.float64)
    sampled[~inside | ~np.isfinite(sampled)] = elsewhere
    return sampled


def finest_share(brightness: Float32Array) -> Float32Array:
    """Rms (n, m) about each pixel of what the finest octave changes of a brightness (n, m).

    Of its logarithm less the means over 2 x 2 pixels, which of 1/f noise is one octave.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(brightness)
    logs[~np.isfinite(logs)] = np.nan
    square: Float32Array = np.square(logs - cv2.blur(logs, (2, 2))).astype(np.float32)
    shares: Float32Array = np.sqrt(filter_low_pass(square, AROUND_PIXELS))
    return shares


def _placed(path: Path, body: Body, dataset: Any) -> Any:
    remedy = "state its edges: extent_deg = [west, south, east, north] in albedo_map of [truth]"
    if dataset.crs is None or dataset.transform.is_identity:
        raise DataError(f"{path}: says neither its coordinate system nor its edges; {remedy}")
    return read_georeference(path, None, None, body, dataset, remedy)


def _extent(path: Path, edges: tuple[float, float, float, float]) -> tuple[float, ...]:
    west, south, east, north = edges
    if not (south < north and west < east <= west + 360.0):
        raise ConfigError(
            f"[truth] albedo_map extent_deg is {list(edges)} for {path}; "
            "wanted west, south, east, north with west below east, at most 360 deg of longitude"
        )
    return edges


def _bands(dataset: Any) -> int:
    """Bands that hold brightness: three of a colour map, else the first."""
    return 3 if dataset.count >= 3 and dataset.colorinterp[2] != ColorInterp.alpha else 1


def _brightness(path: Path, dataset: Any, coding: str) -> Float32Array:
    """Read linear brightness (rows, cols), of three bands their mean; NaN where there is none.

    sRGB is decoded by IEC 61966-2-1.
    """
    bands, label = range(1, _bands(dataset) + 1), read_map_label(path, dataset)
    total = np.zeros(dataset.shape, np.float32)
    for band in bands:
        raw = dataset.read(band)
        values = raw.astype(np.float32)
        if coding == "srgb":
            full = np.iinfo(raw.dtype).max if raw.dtype.kind in "iu" else 1.0
            values = np.clip(values / np.float32(full), 0.0, 1.0)
            curve = ((values + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
            values = np.where(values <= 0.04045, values / np.float32(12.92), curve)
        low, high = find_nodata_range(label.nodata, str(raw.dtype))
        valid = Validity.read(dataset, band, label.special).valid(dataset, raw, band)
        stored = raw.astype(np.float64)  # the bounds may lie beyond a float32
        values[~valid | ((stored >= low) & (stored <= high))] = np.nan
        total += values / np.float32(len(bands))
    return total


@parallel_kernel
def _add_octaves(
    out: FloatArray, octaves: fractal.Octaves, directions: FloatArray, sizes_m: FloatArray
) -> None:
    for part in numba.prange(PARTS):
        first, last = part * out.size // PARTS, (part + 1) * out.size // PARTS
        for octave in range(octaves.spacing.size):
            state = fractal.make_octave_state(octaves.seed, octave)
            scale = octaves.radius / octaves.spacing[octave]
            length = fractal.WAVELENGTH * octaves.spacing[octave]
            for i in range(first, last):
                share = length / sizes_m[i] - 2.0
                if share <= 0.0:
                    continue
                x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
                value = fractal.evaluate_noise(state, x * scale, y * scale, z * scale)
                out[i] += octaves.amplitude[octave] * min(share, 1.0) * value
