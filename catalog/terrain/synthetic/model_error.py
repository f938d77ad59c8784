"""The error of a terrain model at all scales: what true ground has and a model of it lacks.

A model of a real body is wrong at every wavelength, most where the ground is steep, and below a
resolution that is far coarser than its posting it holds nothing of the ground. Here the error is a
random field of octaves (`fractal`), fitted to the rms of its means over boxes and scaled by
the slope of the ground about a place. Its finest octaves are the relief that the model has lost.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter
from scipy.optimize import nnls

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.grid import sample_bicubic
from catalog.geometry.latlon import Lattice, xyz_from_latlon
from catalog.terrain.error_model import ErrorSpectrum
from catalog.terrain.synthetic import fractal

# rms of means of one octave of noise, amplitude and spacing 1, over squares of these sides; found
# by sampling 100 000 squares, and held by a test. Farther out it falls as 1 over the side.
BOX_SIDES = (0.0, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
BOX_RMS = (fractal.RMS_NOISE, 0.1904, 0.1856, 0.1684, 0.1239, 0.0675, 0.0344, 0.0174)
HURST = 0.95  # of the octaves finer than the smallest box; see `SyntheticRelief`
SLOPE_BASE_M = 1900.0  # over which the slope is measured that errors grow with
SLOPE_REACH_M = 6000.0  # standard deviation of the neighbourhood whose rms slope counts
STREAM = 1 << 40  # keeps the noise apart from that of relief with the same seed


def fit_octaves(
    spectrum: ErrorSpectrum, seed: int, smallest_m: float, radius_m: float
) -> fractal.Octaves:
    """Noise with a spectrum, down to a smallest lattice spacing."""
    boxes = 1e3 * np.array(spectrum.box_km)
    # of the waves that are twice as long as the smallest box and so just show in it
    first = 2.0 * boxes[0] / fractal.WAVELENGTH
    coarse = first * 2.0 ** np.arange(1, 2 + np.ceil(np.log2(boxes[-1] / boxes[0])))
    count = max(1, 1 + int(np.floor(np.log2(first / smallest_m))))
    fine = first / 2.0 ** np.arange(count)
    # the fine ones stand in a fixed proportion, as relief of a power law does
    shape = (fine / fine[0]) ** HURST
    fine_power = (interpolate_box_rms(boxes, fine) ** 2 @ shape**2)[:, None]
    parts = np.concatenate([fine_power, interpolate_box_rms(boxes, coarse) ** 2], axis=1)
    # between shares of the variance and metres: small boxes, whose error is large, count more
    weights = np.array(spectrum.rms_m) ** -1.0
    power, _ = nnls(parts * weights[:, None], np.array(spectrum.rms_m) ** 2 * weights)
    spacing = np.concatenate([coarse[::-1], fine])
    amplitude = np.sqrt(np.concatenate([power[:0:-1], power[0] * shape**2]))
    held = amplitude > 0.0
    return fractal.Octaves(seed + STREAM, spacing[held], amplitude[held], radius_m)


def interpolate_box_rms(boxes_m: FloatArray, spacing_m: FloatArray) -> FloatArray:
    """Rms (boxes, octaves) of means over squares of octaves of amplitude 1."""
    sides = boxes_m[:, None] / spacing_m
    inner = np.interp(sides, BOX_SIDES, BOX_RMS)
    outer = BOX_RMS[-1] * BOX_SIDES[-1] / np.maximum(sides, BOX_SIDES[-1])
    rms: FloatArray = np.where(sides > BOX_SIDES[-1], outer, inner)
    return rms


def map_rms_slope(heights: Float32Array, row_m: float, column_m: ArrayLike) -> Float32Array:
    """Rms slope about each node of a grid (rows, cols).

    row_m, column_m  distance of neighbouring rows; of columns, one for all or one a row
    """
    holes = ~np.isfinite(heights)
    filled = np.where(holes, np.nanmean(heights) if not holes.all() else 0.0, heights)
    down, along = np.gradient(filled.astype(np.float64))
    widths = np.broadcast_to(np.asarray(column_m, np.float64), heights.shape[:1])[:, None]
    square = (down / row_m) ** 2 + (along / widths) ** 2
    # nodes beside a hole have no slope of their own
    known = (~holes).astype(np.float64)
    reach = SLOPE_REACH_M / row_m, SLOPE_REACH_M / float(np.median(widths))
    total = gaussian_filter(square * known, reach, mode="nearest")
    weight = gaussian_filter(known, reach, mode="nearest")
    slopes: Float32Array = np.sqrt(total / np.maximum(weight, 1e-6)).astype(np.float32)
    return slopes


@dataclass(frozen=True, eq=False)
class SlopeMap:
    """Rms slopes on a grid of latitudes and longitudes.

    slopes               (rows, cols), rows southward
    north, west          rad, the first node;  step_lat, step_lon  rad
    Beyond its edges the nearest node counts; longitudes are taken on the turn of its middle.
    """

    @classmethod
    def measure_globe(cls, heights: Float32Array, radius_m: float) -> "SlopeMap":
        """Slopes of a body; heights (n, 2n) as `ground.make_whole_sphere` takes them."""
        rows, cols = heights.shape
        block = max(1, round(SLOPE_BASE_M * rows / (np.pi * radius_m)))
        while rows % block or cols % block:
            block -= 1
        parts = heights.reshape(rows // block, block, cols // block, block)
        mean = parts.mean(axis=(1, 3), dtype=np.float32)
        step = np.pi / len(mean)
        lat = 0.5 * np.pi - step * (0.5 + np.arange(len(mean)))
        # a few columns from the other side, so that the seam does not show
        m = min(8, mean.shape[1])
        wide = np.concatenate([mean[:, -m:], mean, mean[:, :m]], axis=1)
        slopes = map_rms_slope(wide, step * radius_m, step * radius_m * np.cos(lat))
        inner = np.ascontiguousarray(slopes[:, m - 2 : slopes.shape[1] - m + 2])
        return cls(inner, float(lat[0]), -1.5 * step, step, step)

    slopes: Float32Array
    north: float
    west: float
    step_lat: float
    step_lon: float

    def sample(self, lat: FloatArray, lon: FloatArray) -> FloatArray:
        """Rms slopes at places, 2-d arrays, rad."""
        rows, cols = self.slopes.shape
        middle = self.west + 0.5 * (cols - 1) * self.step_lon
        east = np.mod(lon - middle + np.pi, 2.0 * np.pi) - np.pi + middle - self.west
        row = np.clip((self.north - lat) / self.step_lat, 0.0, rows - 1.0)
        col = np.clip(east / self.step_lon, 0.0, cols - 1.0)
        sampled: FloatArray = sample_bicubic(self.slopes, row, col).astype(np.float64)
        return sampled


@dataclass(frozen=True, eq=False)
class ModelError:
    """Heights to add to a model for the true ground.

    smallest_m  finest spacing of the noise: below it other relief begins
    slopes      of the ground; the same error everywhere without
    For one seed the ground is the same wherever and however it is sampled.
    """

    seed: int
    spectrum: ErrorSpectrum
    smallest_m: float
    radius_m: float
    slopes: SlopeMap

    @cached_property
    def _octaves(self) -> fractal.Octaves:
        return fit_octaves(self.spectrum, self.seed, self.smallest_m, self.radius_m)

    def window(
        self, north: float, west: float, step_lat: float, step_lon: float, rows: int, cols: int
    ) -> Float32Array:
        """Heights to add (rows, cols), m, on a grid of latitudes and longitudes.

        north, west         rad  the first node; rows run south, columns east
        step_lat, step_lon  rad
        """
        lat = north - step_lat * np.arange(rows, dtype=np.float64)
        lon = west + step_lon * np.arange(cols, dtype=np.float64)
        out = np.zeros((rows, cols), np.float32)
        noise = fractal.select_resolved(self._octaves, self.radius_m * step_lat)
        fractal.add_noise_window(out, noise, lat, lon)
        return self._scale_by_slope(out, *np.meshgrid(lat, lon, indexing="ij"))

    def turned_window(self, body_from_grid: FloatArray, grid: Lattice) -> Float32Array:
        """Heights to add (rows, cols), m, on a grid in a turned frame.

        body_from_grid  (3, 3) rotation from the grid's frame to the body's
        """
        lat, lon = grid.lat, grid.lon
        out = np.zeros((grid.rows, grid.cols), np.float32)
        noise = fractal.select_resolved(self._octaves, self.radius_m * grid.step)
        fractal.add_noise_turned(out, noise, lat, lon, body_from_grid)
        for top in range(0, grid.rows, 256):  # places of all nodes at once would be gigabytes
            part = slice(top, top + 256)
            x = xyz_from_latlon(lat[part, None], lon[None, :], 1.0) @ body_from_grid.T
            places = np.arcsin(np.clip(x[..., 2], -1.0, 1.0)), np.arctan2(x[..., 1], x[..., 0])
            out[part] = self._scale_by_slope(out[part], *places)
        return out

    def _scale_by_slope(
        self, noise: Float32Array, lat: FloatArray, lon: FloatArray
    ) -> Float32Array:
        scaled: Float32Array = (noise * self.spectrum.factor(self.slopes.sample(lat, lon))).astype(
            np.float32
        )
        return scaled
