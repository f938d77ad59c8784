"""Slopes of ground on a base: the angle by which ground rises over a distance.

Dangerous for a lander are slopes above 7 deg on a base of 3 m, critical those above 15 deg (B. S.
Zhukov, Autonomous optical navigation near the Moon and small bodies, thesis summary, ch. 4).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.errors import DataError, NothingToDoError
from catalog.geometry.kernel import kernel
from catalog.geometry.latlon import xyz_from_latlon
from catalog.terrain.dem.source import DemSource
from catalog.terrain.dem.validity import HeightSample

DANGEROUS_DEG, CRITICAL_DEG = 7.0, 15.0
BASE_M = 3.0  # the feet of a lander stand so far apart
STRIP_PIXELS = 4_000_000  # of a model, held at once
MAX_COLUMNS = 1_000_000
BIN_DEG = 0.01  # of the histogram that shares are counted from
LATTICE = 33  # places along a row where the size of a pixel is found; it is linear in between


@kernel
def _measure_rise(
    heights: Float32Array, row: int, col: int, down: int, right: int, offset: float
) -> float:
    """Height ahead less height behind of a node, `offset` postings along (down, right) each."""
    near = int(offset)
    share = offset - near
    ahead = (1.0 - share) * heights[row + near * down, col + near * right]
    behind = (1.0 - share) * heights[row - near * down, col - near * right]
    if share > 0.0:
        near += 1
        ahead += share * heights[row + near * down, col + near * right]
        behind += share * heights[row - near * down, col - near * right]
    return float(ahead - behind)


@kernel
def _compute_components(
    heights: Float32Array,
    step_x: Float32Array,
    step_y: Float32Array,
    base: float,
    out: Float32Array,
) -> None:
    rows, cols = heights.shape
    for i in range(rows):
        for j in range(cols):
            # bilinear heights closer than a posting lie on the line through the neighbours
            x, y = max(0.5 * base / step_x[i, j], 1.0), max(0.5 * base / step_y[i, j], 1.0)
            right, down = math.ceil(x), math.ceil(y)
            if right > j or j + right >= cols or down > i or i + down >= rows:
                out[0, i, j] = out[1, i, j] = np.nan
                continue
            out[0, i, j] = _measure_rise(heights, i, j, 0, 1, x) / (2.0 * x * step_x[i, j])
            out[1, i, j] = -_measure_rise(heights, i, j, 1, 0, y) / (2.0 * y * step_y[i, j])


def compute_slope_components(
    heights: Float32Array,
    step_x_m: float | Float32Array,
    step_y_m: float | Float32Array,
    base_m: float = BASE_M,
) -> Float32Array:
    """Rises over distances (2, rows, cols), tangents: along the columns, and against the rows.

    heights             (rows, cols) m, NaN for no data
    step_x_m, step_y_m  between columns and between rows, of all pixels or of each (rows, cols)
    base_m              heights are taken half of it to either side, bilinearly, but not closer than
                        a posting; NaN where one of them is missing
    Raises ValueError for a base or steps that are not positive.
    """
    shape = heights.shape
    step_x, step_y = (
        np.ascontiguousarray(np.broadcast_to(np.asarray(step, np.float32), shape))
        for step in (step_x_m, step_y_m)
    )
    if not (base_m > 0.0 and (step_x > 0.0).all() and (step_y > 0.0).all()):
        raise ValueError("a base and distances of pixels must be positive")
    out = np.empty((2, *shape), np.float32)
    grid = np.ascontiguousarray(heights, dtype=np.float32)
    _compute_components(grid, step_x, step_y, float(base_m), out)
    return out


def convert_to_degrees(components: Float32Array) -> Float32Array:
    """Slopes (rows, cols), deg, from their two components."""
    degrees: Float32Array = np.degrees(np.arctan(np.hypot(components[0], components[1])))
    return degrees


@dataclass
class SlopeSummary:
    """The distribution of a terrain model's slopes; shares are of the area that has a slope.

    base_m   on which they were taken: that of the shortest one possible where it was shorter
    area_m2  that has a slope;  covered  its share of the raster
    """

    base_m: float
    area_m2: float = 0.0
    whole_m2: float = 0.0
    squares: float = 0.0
    histogram: FloatArray = field(default_factory=lambda: np.zeros(round(90.0 / BIN_DEG) + 1))

    def add(self, degrees: Float32Array, areas_m2: Float32Array) -> None:
        """Count slopes (rows, cols), deg, NaN for none, by the areas of their pixels."""
        known = np.isfinite(degrees)
        known_slopes, areas = degrees[known].astype(np.float64), areas_m2[known].astype(np.float64)
        self.whole_m2 += float(areas_m2.sum(dtype=np.float64))
        self.area_m2 += float(areas.sum())
        self.squares += float((areas * known_slopes**2).sum())
        bins: IntArray = np.floor(known_slopes / BIN_DEG).astype(np.int64)
        self.histogram += np.bincount(bins, areas, self.histogram.size)

    @property
    def covered(self) -> float:
        return self.area_m2 / self.whole_m2

    @property
    def rms_deg(self) -> float:
        return math.sqrt(self.squares / self.area_m2)

    def share_above(self, degrees: float) -> float:
        """The share of the area whose slope is at least this."""
        return float(self.histogram[round(degrees / BIN_DEG) :].sum()) / self.area_m2

    def quantile_deg(self, share: float) -> float:
        """The slope that this share of the area does not exceed."""
        total = np.cumsum(self.histogram)
        return float(np.searchsorted(total, share * total[-1]) + 1) * BIN_DEG


def measure_pixels(source: DemSource, rows: IntArray) -> tuple[Float32Array, Float32Array]:
    """Distances (len(rows), cols), m, from each pixel of some rows to the next column and row."""
    cols = source.shape[1]
    at = np.unique(np.linspace(0, cols - 1, LATTICE).round())
    row, col = np.meshgrid(rows.astype(np.float64), at, indexing="ij")

    def place(d_col: float, d_row: float) -> FloatArray:
        lat, lon = source.georeference.latlon_from_pixel(col + d_col, row + d_row)
        return xyz_from_latlon(lat, lon, source.body.radius_m)

    sizes = []
    for along in ((0.5, 0.0), (0.0, 0.5)):
        lengths = np.linalg.norm(place(*along) - place(-along[0], -along[1]), axis=-1)
        full = np.array([np.interp(np.arange(cols), at, line) for line in lengths])
        sizes.append(np.maximum(full, 1e-3).astype(np.float32))
    return sizes[0], sizes[1]


def iterate_slopes(source: DemSource, base_m: float = BASE_M) -> Iterator[tuple[int, Float32Array]]:
    """First row and slopes (rows, cols), deg, NaN for none, of one strip after another.

    The size of a pixel is found on the body's sphere at each place of the map.
    Raises DataError for a base that is no small part of the model, a model too wide to be held and,
    after the last strip, heights that the body cannot have.
    """
    rows, cols = source.shape
    if cols > MAX_COLUMNS:
        raise DataError(
            f"{source.path}: has {cols} columns; wanted up to {MAX_COLUMNS}: cut it with "
            "gdal_translate -projwin"
        )
    if base_m > 0.5 * source.posting_m * min(rows, cols):
        raise DataError(
            f"{source.path}: is {source.posting_m * min(rows, cols):.6g} m across; a base of "
            f"{base_m:g} m is more than half of it: name a shorter --base-m"
        )
    many, sample = max(1, STRIP_PIXELS // cols), HeightSample(source.shape)
    lowest, highest = np.inf, -np.inf
    for top in range(0, rows, many):
        bottom = min(top + many, rows)
        sizes = measure_pixels(source, np.arange(top, bottom))
        reach = 1 + math.ceil(0.5 * base_m / float(sizes[1].min()))
        first, last = max(top - reach, 0), min(bottom + reach, rows)
        heights = source.read_window(first, 0, last - first, cols)
        known = heights[np.isfinite(heights)]
        lowest = min(lowest, float(known.min(initial=np.inf)))
        highest = max(highest, float(known.max(initial=-np.inf)))
        sample.add(heights[top - first : bottom - first])
        wider = measure_pixels(source, np.arange(first, last))
        slopes = convert_to_degrees(compute_slope_components(heights, *wider, base_m))
        yield top, slopes[top - first : bottom - first]
    if lowest <= highest:
        source.check_sample(sample.heights)
        source.check_heights(lowest, highest)


def summarise_slopes(
    source: DemSource, base_m: float = BASE_M
) -> tuple[SlopeSummary, Float32Array]:
    """Summarise the slopes of a model; also return all of them (rows, cols), deg, NaN for none.

    Raises NothingToDoError where no pixel has one: holes beside all heights.
    """
    summary = SlopeSummary(max(base_m, 2.0 * source.posting_m))
    all_slopes = np.full(source.shape, np.nan, np.float32)
    for top, slopes in iterate_slopes(source, base_m):
        all_slopes[top : top + len(slopes)] = slopes
        across, down = measure_pixels(source, np.arange(top, top + len(slopes)))
        summary.add(slopes, across * down)
    if not summary.area_m2:
        raise NothingToDoError(
            f"{source.path}: no pixel has heights on both sides, half a base of "
            f"{summary.base_m:g} m away; fill its holes or name a shorter --base-m"
        )
    return summary, all_slopes
