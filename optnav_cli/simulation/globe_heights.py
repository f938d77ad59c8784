"""The heights of a whole body as smooth functions, at its model's own posting and coarser ones."""

from pathlib import Path

import numba
import numpy as np
from scipy.ndimage import spline_filter

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.errors import ConfigError
from catalog.geometry.kernel import kernel, parallel_kernel
from catalog.terrain.dem.source import DemSettings, DemSource

SPLINE_MARGIN = 16  # nodes beyond which a border no longer matters: 0.27^16 is below 1e-9


def spline_coefficients(heights: Float32Array) -> FloatArray:
    """Spline coefficients (rows, cols) of a grid without holes."""
    return np.asarray(spline_filter(heights.astype(np.float64), order=3, mode="mirror"))


@kernel
def _weight(t: float) -> float:
    """The cubic B-"""
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


MIN_ROWS = 90  # no level is coarser than 2 degrees


def read_globe(settings: DemSettings, body: Body) -> Float32Array:
    """Heights (n, 2n) of a model of the whole body, m above its sphere, float32.

    Pixel centres lie half a step inside the poles, the first column half a step east of longitude
    0; holes take the mean height.
    Raises ConfigError for a model that does not cover the body in equal steps, DataError for a file
    that cannot be read.
    """
    source = DemSource.open(settings, Path.cwd(), body)
    rows, cols = source.shape
    if cols != 2 * rows or not source.wraps:
        raise ConfigError(
            f"{settings.path}: the [globe] model has {rows} x {cols} pixels and does not cover "
            "the body in equal steps of latitude and longitude; name one that does"
        )
    heights = source.read_window(0, 0, rows, cols)
    col, _ = source.pixel_from_latlon(np.array([0.0]), np.array([0.0]))
    heights = np.roll(heights, -round(float(col[0]) + 0.5), axis=1)
    filled = np.where(np.isfinite(heights), heights, np.nanmean(heights))
    return np.asarray(filled, dtype=np.float32)


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
        """How often the model is halved for a grid of this posting: its level is about as fine."""
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
