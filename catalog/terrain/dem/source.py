"""One terrain model file, whatever GDAL reads: its grid, its units, its heights.

rasterio neither applies scales and offsets nor distinguishes heights from radii; both are
decided here, once, and stated. A window comes out as metres above the reference sphere.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray
from rasterio.enums import ColorInterp
from rasterio.windows import Window

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.errors import DataError
from catalog.geometry.grid import sample_bicubic
from catalog.rasters import TERRAIN, handle_read_errors, open_raster, reopen_raster
from catalog.terrain.dem.file import (
    RADIUS_TOLERANCE,
    Conversion,
    find_label,
    find_nodata_range,
    read_georeference,
    read_units,
    resolve_path,
)
from catalog.terrain.dem.georeference import Georeference, iterate_column_spans
from catalog.terrain.dem.label import MapLabel, read_map_label
from catalog.terrain.dem.validity import HeightSample, Validity, find_shared_end, list_unused_bands

log = logging.getLogger(__name__)

METRES = {"m": 1.0, "km": 1000.0, "dm": 0.1, "cm": 0.01}
PROBES = 5  # windows a side that are read to distinguish radii from heights
PROBE_SIZE = 32
# A raster this wide whose heights span less than this is in kilometres, not in metres: the
# smoothest lunar mare has more relief over such a distance.
SUSPICIOUS_EXTENT_M = 50e3
SUSPICIOUS_RELIEF_M = 25.0
# Heights above another sphere than the body's are shifted. Spheres in use for one body differ by
# less than this share of its radius; those of irregular bodies differ by more.
MAX_DATUM_SHIFT = 5e-3
MIN_DATUM_SHIFT_M = 0.01  # below it the shift is rounding of a radius, not worth a word
ITSELF = "the file itself"  # the section of a file that a command line names
MAX_WINDOW = 100_000_000  # heights that are read for places asked at once
MARGIN = 4  # pixels about those places, for the interpolation


class DemSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One [[dem]] section of a build config.

    path       relative to the config file; "bundled:NAME" is a file that travels with optnav
    priority   1 is used first; higher numbers fill what it leaves empty
    feather_km over which it fades into those below, inside its edge and about its holes; 0: it ends
               in a hard edge
    heights    "height" above the reference sphere or "radius" from the body's centre; without it
               values near the body's radius are taken as radii
    scale, offset, nodata  override the file's own; height = value * scale + offset, in `units`
    units      of the scaled values; without it the file's own, else metres
    longitude  "west" for a map whose longitudes count westward: x of a map in degrees, the central
               meridian of a projected one, whose x is an easting; without it as its label says
    crs        for a file without one (or with a wrong one): a code, WKT or a PROJ string
    """

    path: str
    priority: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 1
    feather_km: Annotated[float, msgspec.Meta(ge=0.0, le=1e5)] = 0.0
    heights: Literal["height", "radius"] | None = None
    scale: float | None = None
    offset: float | None = None
    nodata: float | None = None
    units: Literal["m", "km", "dm", "cm"] | None = None
    longitude: Literal["east", "west"] | None = None
    crs: str | None = None


@lru_cache(maxsize=1024)
def report_once(path: Path, words: str) -> None:
    """Report what a file says; files are opened again for each piece of work."""
    log.warning("%s: %s", path, words)


@dataclass
class DemSource:
    """An opened terrain model. Not safe across threads: each opens its own (`reopen`).

    section  where its settings stand, for errors
    """

    path: Path
    settings: DemSettings
    body: Body
    georeference: Georeference
    convert: Conversion
    heights: str
    units: str
    dtype: str
    block_shape: tuple[int, int]
    section: str
    validity: Validity = field(default_factory=Validity)
    _dataset: Any = None

    @classmethod
    def open(
        cls,
        settings: DemSettings,
        base_dir: Path,
        body: Body,
        section: str = "its [[dem]] section",
        remedy: str | None = None,
    ) -> "DemSource":
        """Open a file and settle its grid and units from its header and a few probes.

        section  where the settings stand, for errors
        remedy   for a file that is not there; by default its path is to be checked there too
        Raises DataError for a file that is missing, unreadable, without a usable CRS, of another
        body, or with values that cannot be heights; the whole file is read later, when averaged.
        """
        path = find_label(resolve_path(settings.path, base_dir))
        dataset = open_raster(path, TERRAIN, remedy or f"check `path` in {section}")
        try:
            with handle_read_errors(path):
                return cls._read_header(path, settings, body, dataset, section)
        except BaseException:
            dataset.close()
            raise

    @classmethod
    def open_alone(cls, path: Path, body: Body, nodata: float | None = None) -> "DemSource":
        """Open a file that a command line names: no section could state more of it; see `open`."""
        settings = DemSettings(str(path), nodata=nodata)
        return cls.open(settings, Path.cwd(), body, ITSELF, "check the path")

    @classmethod
    def _read_header(
        cls, path: Path, settings: DemSettings, body: Body, dataset: Any, section: str
    ) -> "DemSource":
        if dataset.count < 1 or min(dataset.shape) < 4:
            raise DataError(f"{path}: {dataset.shape[0]} x {dataset.shape[1]} pixels; not a DEM")
        dtype = str(dataset.dtypes[0])
        if dataset.colorinterp[0] in (ColorInterp.red, ColorInterp.palette):
            raise DataError(f"{path}: is a colour picture, not a DEM; name a raster of heights")
        if np.dtype(dtype).kind not in "iuf":
            raise DataError(f"{path}: pixels are {dtype}; wanted whole or real numbers")
        remedy = f'set `crs` in {section}, for example crs = "IAU_2015:30100"'
        label = read_map_label(path, dataset)
        longitude = settings.longitude or label.longitude
        georeference = read_georeference(path, settings.crs, longitude, body, dataset, remedy)
        units = settings.units or read_units(path, dataset.units[0] or label.unit, section)
        factor = METRES[units]
        scale = settings.scale if settings.scale is not None else float(dataset.scales[0])
        offset = settings.offset if settings.offset is not None else float(dataset.offsets[0])
        if scale == 0.0 or not np.isfinite([scale * factor, offset * factor]).all():
            raise DataError(
                f"{path}: scale is {scale:g}, offset {offset:g}; set `scale` and `offset` in "
                f"{section}"
            )
        nodata = settings.nodata if settings.nodata is not None else label.nodata
        convert = Conversion(scale * factor, offset * factor, *find_nodata_range(nodata, dtype))
        validity = Validity.read(dataset, special=label.special)
        for remark in (*list_unused_bands(dataset, 1, "heights"), *label.remarks):
            report_once(path, remark)
        block = tuple(dataset.block_shapes[0])
        source = cls(
            path,
            settings,
            body,
            georeference,
            convert,
            "height",
            units,
            validity.stored_type(dtype),
            block,
            section,
            validity,
            dataset,
        )
        source._settle_radius(source._read_probe(), offset_given=offset * factor)
        if source.heights == "height" and settings.offset is None:
            source._settle_datum(label)
        return source

    def _read_probe(self) -> FloatArray:
        """Values of a few small windows spread over the raster, m, without no-data."""
        rows, cols = self.shape
        height, width = min(PROBE_SIZE, rows), min(PROBE_SIZE, cols)
        parts = []
        for row in np.linspace(0, rows - height, PROBES).astype(int):
            for col in np.linspace(0, cols - width, PROBES).astype(int):
                part = self.read_window(int(row), int(col), height, width)
                parts.append(part[np.isfinite(part)])
        return np.concatenate(parts).astype(np.float64)

    def _settle_radius(self, probe: FloatArray, offset_given: float) -> None:
        """Decide between height and radius, and take the body's radius off a radius."""
        lo, hi = self.body.plausible_heights_m
        radius = self.body.radius_m
        if self.settings.heights is not None:
            self.heights = self.settings.heights
        elif probe.size:
            near = radius + lo <= float(probe.min()) and float(probe.max()) <= radius + hi
            # bodies whose relief rivals their radius: heights and radii overlap, the offset decides
            self.heights = "radius" if near and float(probe.min()) > hi else "height"
        elif abs(offset_given - radius) < RADIUS_TOLERANCE * radius:
            self.heights = "radius"
        if self.heights == "radius":
            self.convert = self.convert._replace(offset_m=self.convert.offset_m - radius)

    def _settle_datum(self, label: MapLabel) -> None:
        """Bring heights above the map's sphere to the body's. Raises DataError for far ones.

        An `offset` that the settings state says what heights count from.
        """
        remedy = f'set heights = "radius" in {self.section} if they are radii, or convert them'
        if label.is_flattened:
            equatorial, polar = label.axes_m
            raise DataError(
                f"{self.path}: has heights above an ellipsoid of {equatorial / 1e3:.10g} and "
                f"{polar / 1e3:.10g} km; wanted heights above a sphere: {remedy}"
            )
        sphere, radius = self.georeference.ellipsoid_m[0], self.body.radius_m
        shift = sphere - radius
        words = f"has heights above a sphere of {sphere / 1e3:.10g} km"
        if abs(shift) > MAX_DATUM_SHIFT * radius:
            raise DataError(
                f"{self.path}: {words}, {self.body.name} has {radius / 1e3:.10g}; wanted a "
                f"difference of at most {MAX_DATUM_SHIFT * radius:.6g} m: {remedy}, or state "
                f"`offset`, what is added to them to count from {radius / 1e3:.10g} km"
            )
        if abs(shift) >= MIN_DATUM_SHIFT_M:
            words += f"; {shift:+.6g} m bring them to the body's, {radius / 1e3:.10g} km"
            report_once(self.path, words)
        self.convert = self.convert._replace(offset_m=self.convert.offset_m + shift)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.georeference.shape

    @property
    def files(self) -> tuple[Path, ...]:
        """All files that the terrain model is read from: a label and its image, parts of a VRT."""
        with self._reading() as dataset:
            return tuple(sorted(Path(name) for name in dataset.files))

    @property
    def posting_m(self) -> float:
        """Ground distance of neighbouring rows."""
        return self.georeference.row_angle * self.body.radius_m

    @property
    def wraps(self) -> bool:
        """Whether the raster goes all the way round."""
        return self.georeference.wraps

    def pixel_from_latlon(self, lat: ArrayLike, lon: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Fractional (col, row) of latitudes and east longitudes (rad)."""
        return self.georeference.pixel_from_latlon(lat, lon)

    def latlon_bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north (rad) around the raster; east - west is 2 pi if it wraps."""
        rows, cols = self.shape
        along = np.linspace(-0.5, cols - 0.5, 65)
        down = np.linspace(-0.5, rows - 0.5, 65)
        col = np.concatenate([along, along, np.full(65, -0.5), np.full(65, cols - 0.5)])
        row = np.concatenate([np.full(65, -0.5), np.full(65, rows - 0.5), down, down])
        if self.georeference.period:
            lat, _ = self.georeference.latlon_from_pixel(np.full(65, (cols - 1) / 2.0), down)
            _, lon = self.georeference.latlon_from_pixel([(cols - 1) / 2.0], [(rows - 1) / 2.0])
            half = np.pi * min(1.0, cols / self.georeference.period)
            return float(lon[0] - half), float(lat.min()), float(lon[0] + half), float(lat.max())
        lat, lon = self.georeference.latlon_from_pixel(col, row)
        south, north = float(np.nanmin(lat)), float(np.nanmax(lat))
        for pole in (np.pi / 2.0, -np.pi / 2.0):
            c, r = self.georeference.pixel_from_latlon(np.array([pole]), np.array([0.0]))
            if -0.5 <= c[0] <= cols - 0.5 and -0.5 <= r[0] <= rows - 0.5:
                return (-np.pi, min(south, pole), np.pi, max(north, pole))
        middle = self.georeference.latlon_from_pixel([(cols - 1) / 2.0], [(rows - 1) / 2.0])[1][0]
        offset = np.mod(lon - middle + np.pi, 2.0 * np.pi) - np.pi
        return float(middle + offset.min()), south, float(middle + offset.max()), north

    def read_window(self, row0: int, col0: int, height: int, width: int) -> Float32Array:
        """Heights (height, width) of pixels, m above the reference sphere, NaN for none.

        Columns wrap when the raster goes all the way round; beyond its edges all is NaN.
        Raises DataError for a damaged file.
        """
        rows, cols = self.shape
        out = np.full((height, width), np.nan, dtype=np.float32)
        top, bottom = max(row0, 0), min(row0 + height, rows)
        if bottom <= top:
            return out
        for at, col, count in iterate_column_spans(col0, width, cols, self.wraps):
            raw = self.read_raw(top, col, bottom - top, count)
            out[top - row0 : bottom - row0, at : at + count] = self.convert(raw)
        return out

    def heights_at(self, lat: ArrayLike, lon: ArrayLike) -> Float32Array:
        """Heights of places (rad), m above the reference sphere, bicubic; NaN where it has none.

        Raises DataError for a damaged file, and for places too far apart to be read at once.
        """
        col, row = self.pixel_from_latlon(lat, lon)
        rows, cols = self.shape
        if self.wraps:
            col = np.mod(col, cols)
        inside = np.isfinite(col) & (row > -0.5) & (row < rows - 0.5)
        inside &= (col > -0.5) & (col < cols - (0.0 if self.wraps else 0.5))
        sampled = np.full(np.shape(col), np.nan, dtype=np.float32)
        if not inside.any():
            return sampled
        spans = []
        for at, limit, wraps in ((row[inside], rows, False), (col[inside], cols, self.wraps)):
            first, last = int(at.min()) - MARGIN, int(at.max()) + MARGIN + 2
            if not wraps:  # what lies beyond an edge would be a hole
                first, last = max(first, 0), min(last, limit)
            spans.append((first, last - first))
        (top, high), (left, wide) = spans
        if high * wide > MAX_WINDOW:
            raise DataError(
                f"{self.path}: {high} x {wide} of its heights are asked for at once; name a "
                "coarser model"
            )
        window = self.read_window(top, left, high, wide)
        self.check_window(window)
        sampled[inside] = sample_bicubic(window, row[inside] - top, col[inside] - left)
        return sampled

    def read_raw(self, row: int, col: int, height: int, width: int) -> NDArray[Any]:
        """Counts as they are stored; the window must lie inside. Raises DataError.

        Those of a file with a mask, or with special values, are real numbers, NaN where the file
        has none.
        """
        window = Window(col, row, width, height)
        with self._reading(f"rows {row}-{row + height - 1} ") as dataset:
            return self.validity.mark_missing(dataset, dataset.read(1, window=window), 1, window)

    @contextmanager
    def _reading(self, what: str = "") -> Iterator[Any]:
        if self._dataset is None:
            self._dataset = reopen_raster(self.path, TERRAIN)
        with handle_read_errors(self.path, what=what):
            yield self._dataset

    def reopen(self) -> "DemSource":
        """Return a copy of the source with its own file handle."""
        return type(self)(**{**self.__getstate__(), "_dataset": None})

    def close(self) -> None:
        """Let go of the file; it opens again when read."""
        if self._dataset is not None:
            self._dataset.close()
            self._dataset = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_dataset": None}

    def check_sample(self, heights: Float32Array) -> None:
        """Refuse heights (n,), m, in which one value stands for no data without a tag.

        A `nodata` that the settings state settles it. Raises DataError with the value to state.
        """
        end = find_shared_end(heights, self.posting_m)
        if end is None or self.settings.nodata is not None:
            return
        stored = (end.height - self.convert.offset_m) / self.convert.scale_m
        nodata_text = f"{round(stored, 3 if abs(stored) < 1e6 else None):.10g}"
        remedy = f"state nodata = {nodata_text} in {self.section}"
        if self.section == ITSELF:
            remedy = (
                f"mark it: gdal_translate -a_nodata {nodata_text} (slopes and hazard take --nodata)"
            )
        raise DataError(
            f"{self.path}: {end.share:.2g} of its pixels share the "
            f"{'lowest' if end.lowest else 'highest'} height, {end.height:.6g} m, {end.gap:.6g} m "
            f"{'below' if end.lowest else 'above'} all others; wanted ground: if it stands for no "
            f"data, {remedy}; if it is ground, state another value as nodata"
        )

    def check_window(self, heights: Float32Array) -> None:
        """Refuse a window of heights that cannot be this body's, as `check_sample` and more."""
        sample = HeightSample(heights.shape)
        sample.add(heights)
        known = sample.heights
        if known.size:
            self.check_sample(known)
            self.check_range(float(known.min()), float(known.max()))

    def check_heights(self, lowest: float, highest: float) -> None:
        """Refuse heights (m, of the whole file) that this body cannot have; name the likely cause.

        Raises DataError.
        """
        self.check_range(lowest, highest)
        rows, cols = self.shape
        extent = min(rows * self.georeference.row_angle, cols * self.georeference.column_angle)
        wide = extent * self.body.radius_m > SUSPICIOUS_EXTENT_M
        if self.settings.units is None and wide and highest - lowest < SUSPICIOUS_RELIEF_M:
            raise DataError(
                f"{self.path}: heights run from {lowest:.6g} to {highest:.6g} m: too flat for "
                f"{extent * self.body.radius_m / 1e3:.0f} km of ground; are these km? "
                f'set units = "km" in {self.section} (or "m" if they are metres)'
            )

    def check_range(self, lowest: float, highest: float) -> None:
        """Refuse heights, m, beyond those of the body. Raises DataError with the likely cause."""
        lo, hi = self.body.plausible_heights_m
        range_text = f"{self.path}: heights run from {lowest:.6g} to {highest:.6g} m"
        limits = f"on {self.body.name} they lie between {lo:.6g} and {hi:.6g} m"
        if lowest < lo or highest > hi:
            radius = self.body.radius_m
            remedy = f"check `units`, `scale`, `offset` and `nodata` in {self.section}"
            other: Literal["m", "km"] = "m" if self.units == "km" else "km"
            ratio = METRES[other] / METRES[self.units]
            if lo <= lowest * ratio and highest * ratio <= hi:
                remedy = f'are these {other}? set units = "{other}" in {self.section}'
            if lo <= lowest - radius and highest - radius <= hi:
                remedy = f'these are radii: set heights = "radius" in {self.section}'
            raise DataError(f"{range_text}; {limits}; {remedy}")
