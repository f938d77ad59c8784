"""The heights of a whole body: smooth functions at its model's posting, and the ground of them.

The ground around terrain models is the globe, smooth or with seeded relief below its posting: a
navigator's catalog of the globe knows all of a smooth one; with relief the pictures show there,
too, what no catalog has.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Protocol

import numba
import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import spline_filter

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.cache import Cache
from catalog.errors import ConfigError, DataError
from catalog.geometry.kernel import kernel, parallel_kernel
from catalog.geometry.latlon import Lattice
from catalog.rendering.rays.ground import Ground, make_ground, make_whole_sphere
from catalog.terrain.dem.source import DemSettings, DemSource

SPLINE_MARGIN = 16  # nodes beyond which a border no longer matters: 0.27^16 is below 1e-9
MIN_ROWS = 90  # no level is coarser than 2 degrees
FINER = 2  # nodes of a ground with relief against the globe's posting
CHUNK = 256  # rows made at once
ALL_ROUND = 2.0 * np.pi


def spline_coefficients(heights: Float32Array) -> FloatArray:
    """Spline coefficients (rows, cols) of a grid without holes."""
    spline: FloatArray = spline_filter(heights.astype(np.float64), order=3, mode="mirror")
    return spline


@kernel
def _weight(t: float) -> float:
    """The cubic B-spline, from its middle."""
    t = abs(t)
    if t < 1.0:
        return 2.0 / 3.0 - t * t + 0.5 * t * t * t
    return (2.0 - t) ** 3 / 6.0 if t < 2.0 else 0.0


@parallel_kernel
def sample_spline(
    spline: FloatArray | Float32Array, row: FloatArray, col: FloatArray
) -> Float32Array:
    """Heights (float32, shape of `row`) at fractional rows and columns, 2-d arrays.

    Beyond the outer nodes the grid is mirrored about them.
    """
    rows, cols = spline.shape
    out = np.empty(row.shape, np.float32)
    for i in numba.prange(row.shape[0]):
        for j in range(row.shape[1]):
            r, c = int(np.floor(row[i, j])), int(np.floor(col[i, j]))
            total = 0.0
            for p in range(r - 1, r + 3):
                q_row = abs(p) if p < rows else 2 * rows - 2 - p
                weight = _weight(row[i, j] - p)
                line = 0.0
                for q in range(c - 1, c + 3):
                    q_col = abs(q) if q < cols else 2 * cols - 2 - q
                    line += _weight(col[i, j] - q) * spline[q_row, q_col]
                total += weight * line
            out[i, j] = np.float32(total)
    return out


def read_globe(settings: DemSettings, body: Body) -> Float32Array:
    """Heights (n, 2n) of a model of the whole body, m above its sphere, float32.

    Pixel centres lie half a step inside the poles, the first column half a step east of longitude
    0; holes take the mean height.
    Raises ConfigError for a model that does not cover the body in equal steps, DataError for a file
    that cannot be read or has heights that the body cannot have.
    """
    source = DemSource.open(settings, Path.cwd(), body)
    rows, cols = source.shape
    if cols != 2 * rows or not source.wraps:
        raise ConfigError(
            f"{settings.path}: the [globe] model has {rows} x {cols} pixels and does not cover "
            "the body in equal steps of latitude and longitude; name one that does"
        )
    heights = source.read_window(0, 0, rows, cols)
    known = heights[np.isfinite(heights)]
    if not known.size:
        raise DataError(f"{source.path}: holds no height; name another [globe] model")
    source.check_window(heights)
    col, _ = source.pixel_from_latlon(np.array([0.0]), np.array([0.0]))
    heights = np.roll(heights, -round(float(col[0]) + 0.5), axis=1)
    filled = np.where(np.isfinite(heights), heights, np.nanmean(heights))
    return filled.astype(np.float32)


class GlobeHeights:
    """A body's heights at any place, from its model averaged to the posting that is wanted.

    heights  see `read_globe`
    """

    def __init__(self, heights: Float32Array, radius_m: float) -> None:
        self.radius_m = radius_m
        self.lowest_m, self.highest_m = float(heights.min()), float(heights.max())
        self.posting_m = np.pi * radius_m / heights.shape[0]
        self._means = {0: heights}
        self._splines: dict[int, Float32Array] = {}

    def level_for(self, posting_m: float) -> int:
        """Choose the number of halvings of the model for a grid of this posting."""
        wanted = round(float(np.log2(max(posting_m / self.posting_m, 1.0))))
        rows, most = self._means[0].shape[0], 0
        while rows % 2 == 0 and rows // 2 >= MIN_ROWS:
            rows, most = rows // 2, most + 1
        return min(wanted, most)

    def sample(self, level: int, lat: FloatArray, lon: FloatArray) -> Float32Array:
        """Heights (float32, m) of a level at places; lat, lon 2-d arrays, rad."""
        coefficients = self._coefficients(level)
        step = np.pi / (coefficients.shape[0] - 2 * SPLINE_MARGIN)
        row = (0.5 * np.pi - lat) / step - 0.5 + SPLINE_MARGIN
        col = np.mod(lon, 2.0 * np.pi) / step - 0.5 + SPLINE_MARGIN
        return sample_spline(coefficients, row, col)

    def _coefficients(self, level: int) -> Float32Array:
        """Spline coefficients with margins beyond the poles and the seam, so that neither shows."""
        if level not in self._splines:
            heights, m = self._mean(level), SPLINE_MARGIN
            opposite = np.roll(heights, heights.shape[0], axis=1)
            tall = np.concatenate([opposite[m - 1 :: -1], heights, opposite[: -m - 1 : -1]])
            wide = np.concatenate([tall[:, -m:], tall, tall[:, :m]], axis=1)
            # single precision keeps a millimetre of ten kilometres
            self._splines[level] = spline_filter(wide, order=3, output=np.float32, mode="mirror")
        return self._splines[level]

    def _mean(self, level: int) -> Float32Array:
        if level not in self._means:
            fine = self._mean(level - 1)
            rows, cols = fine.shape
            blocks = fine.reshape(rows // 2, 2, cols // 2, 2)
            self._means[level] = blocks.mean(axis=(1, 3), dtype=np.float32)
        return self._means[level]


class Relief(Protocol):
    """Relief added to the heights of a body; see `SyntheticRelief` and `ModelError`."""

    def turned_window(self, body_from_grid: FloatArray, grid: Lattice) -> Float32Array:
        """Heights to add (rows, cols), m, on a grid in a turned frame."""
        ...


class ReliefSum(NamedTuple):
    """Several reliefs as one."""

    parts: tuple[Relief, ...]

    def turned_window(self, body_from_grid: FloatArray, grid: Lattice) -> Float32Array:
        """The sum of all."""
        out = np.zeros((grid.rows, grid.cols), np.float32)
        for part in self.parts:
            out += part.turned_window(body_from_grid, grid)
        return out


class Cap(NamedTuple):
    """Latitudes and longitudes (rad) that a flight may see; east - west is at most a turn."""

    west: float
    south: float
    east: float
    north: float


WHOLE_BODY = Cap(-np.pi, -0.5 * np.pi, np.pi, 0.5 * np.pi)


def seen_from(positions_m: ArrayLike, lowest_m: float, highest_m: float) -> Cap:
    """Cut the ground to the horizon of a flight, mountains beyond it included.

    positions_m          (n, 3) of the cameras, body frame, m
    lowest_m, highest_m  radii that all ground lies between
    """
    positions = np.asarray(positions_m, dtype=np.float64)
    distance = np.linalg.norm(positions, axis=1)
    reach = np.arccos(np.minimum(lowest_m / distance, 1.0)) + np.arccos(lowest_m / highest_m)
    lat = np.arcsin(positions[:, 2] / distance)
    south, north = float((lat - reach).min()), float((lat + reach).max())
    if max(-south, north) >= 0.5 * np.pi:
        return Cap(-np.pi, max(south, -0.5 * np.pi), np.pi, min(north, 0.5 * np.pi))
    lon = np.arctan2(positions[:, 1], positions[:, 0])
    lon = lon[0] + np.mod(lon - lon[0] + np.pi, ALL_ROUND) - np.pi
    half = np.arcsin(np.sin(reach) / np.cos(lat))
    west, east = float((lon - half).min()), float((lon + half).max())
    if east - west >= ALL_ROUND:
        west, east = -np.pi, np.pi
    return Cap(west, south, east, north)


class WideGround:
    """The globe as grounds all round the body, one a seed.

    heights    of the globe; see `read_globe`
    seam       rad  the longitude where columns begin; away from the scene
    details    relief to add by seed; a seed that is not there sees the globe as it is
    cameras_m  (n, 3) m, body frame, where it is looked at from: what they cannot see stays smooth
    """

    def __init__(
        self,
        heights: Float32Array,
        radius_m: float,
        seam: float,
        details: Mapping[int | None, Relief],
        cameras_m: Sequence[FloatArray] = (),
    ) -> None:
        self._heights, self._radius_m, self._seam = heights, radius_m, seam
        self._details, self._seen = details, WHOLE_BODY
        if details and len(cameras_m):
            lowest, highest = radius_m + float(heights.min()), radius_m + float(heights.max())
            self._seen = seen_from(cameras_m, lowest, highest)
        self._rough: Cache[int | None, Ground] = Cache(1)

    def of(self, seed: int | None) -> Ground:
        """The ground of a seed; the last one is kept."""
        if seed not in self._details:
            return self._bare
        return self._rough.get(seed, lambda: self._roughened(self._details[seed]))

    @cached_property
    def _bare(self) -> Ground:
        return make_whole_sphere(self._heights, self._radius_m, self._seam)

    def _roughened(self, detail: Relief) -> Ground:
        fine = self._fine
        heights, step = fine.heights.copy(), fine.step_lat
        # the rows beyond the poles, a pole's own neighbours twice, stay smooth
        top = max(2, int((fine.north - self._seen.north) / step))
        bottom = min(len(heights) - 2, int(np.ceil((fine.north - self._seen.south) / step)) + 1)
        left, right = self._columns(fine)
        for row in range(top, bottom, CHUNK):
            part = heights[row : min(row + CHUNK, bottom), left:right]
            north, west = fine.north - row * step, fine.west + left * step
            part += detail.turned_window(np.eye(3), Lattice(north, west, step, *part.shape))
        return make_ground(heights, fine.north, fine.west, step, step, self._radius_m)

    def _columns(self, fine: Ground) -> tuple[int, int]:
        """First and last + 1 of the columns with relief: all if they would cross the seam."""
        columns = fine.heights.shape[1]
        left = int(np.mod(self._seen.west - fine.west, ALL_ROUND) / fine.step_lon)
        right = left + int(np.ceil((self._seen.east - self._seen.west) / fine.step_lon)) + 2
        return (left, right) if right <= columns - 4 else (0, columns)

    @cached_property
    def _fine(self) -> Ground:
        """The smooth globe at a finer posting, laid out as `make_whole_sphere` does."""
        rows = FINER * self._heights.shape[0]
        step = np.pi / rows
        shift = np.floor(np.mod(self._seam, ALL_ROUND) / step)
        north, west = 0.5 * np.pi + 1.5 * step, float(shift - 1.5) * step
        splines = GlobeHeights(self._heights, self._radius_m)
        grid = Lattice(north, west, step, rows + 4, 2 * rows + 4)
        heights = np.empty((grid.rows, grid.cols), np.float32)
        for top in range(0, grid.rows, CHUNK):
            places = np.meshgrid(grid.lat[top : top + CHUNK], grid.lon, indexing="ij")
            heights[top : top + CHUNK] = splines.sample(0, *places)
        return make_ground(heights, north, west, step, step, self._radius_m)
