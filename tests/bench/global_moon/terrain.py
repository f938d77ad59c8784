"""The whole Moon at 118 m: a raster of full size from the 32 px/deg model, with relief added.

GLD100 at 256 px/deg holds hardly more than the model of 948 m says, and what more it holds is known
from its Tycho crop (`likeness.py` compares). So the ground is made in two parts:

- The model's pixels are area means. The cubic spline whose means over the pixels are those means
  restores what averaging took: on the crop an rms slope of 10.69°, where the real one is 10.72° and
  plain bicubic interpolation has 10.28°.
- Gradient noise in three dimensions, read on the sphere, is added at the wavelengths where the crop
  has more power than that spline. It has no seam, no poles and no direction. It is stronger on
  rough ground, as on the crop: 2 m + 0.031 of the model's second difference.

No craters are stamped: those below 1 km do not show in GLD100, and larger ones are in the model.
Made by bands, so memory does not grow with the raster; the same on any number of cores.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numba
import numpy as np
import rasterio
from rasterio.windows import Window
from scipy import ndimage

from catalog.arrays import Float32Array, Int16Array
from catalog.files import hash_file, replace_file, write_work_file
from catalog.geometry.kernel import kernel, parallel_kernel
from catalog.terrain.synthetic import fractal

FORMAT = 1  # another number: rasters made before are made anew
SEED = 1
NODATA = -32768
TILE = 256  # pixels; uncompressed, so that hillshade is timed and not a decompressor
# Lattice spacings and amplitudes of the added noise (m), fitted to the crop's power between 237 m
# and 2.7 km. The longer one is what the model's 1.9 km of two pixels cannot hold.
SPACINGS_M, AMPLITUDES_M = (1200.0, 300.0), (26.0, 7.5)
# Strength of the relief a spline misses against the rms second difference of the model's columns,
# m: a straight line through windows of the crop (correlation 0.64), 1 at the crop's own roughness.
GAIN_FLAT, GAIN_ROUGH, CROP_ROUGHNESS_M = 1.98, 0.031, 68.0
ROUGHNESS_ROWS = 15  # of the model, over which that is averaged: 14 km
HALO = 24  # rows: the spline's filter falls to 1e-10, and the averages fit in


class Recipe(msgspec.Struct, frozen=True):
    """All that a raster follows from, and its length; kept beside it."""

    format: int
    seed: int
    factor: int
    spacings_m: tuple[float, ...]
    amplitudes_m: tuple[float, ...]
    source_sha256: str
    rows: int
    cols: int
    bytes: int = 0


class Ground:
    """The model with relief below it: `factor` pixels of it to one of the model, a side.

    Raises ValueError for a model that is not the whole sphere without holes.
    """

    def __init__(self, source: Path, factor: int, seed: int = SEED) -> None:
        self.source, self.factor, self.seed = source, factor, seed
        with rasterio.open(source) as model:
            self.profile: dict[str, Any] = {"crs": model.crs, "transform": model.transform}
            self._model = model.read(1)
            nodata = model.nodata
        rows, cols = self._model.shape
        if cols != 2 * rows or (nodata is not None and (self._model == nodata).any()):
            raise ValueError(f"{source}: {rows} x {cols} is no whole sphere, or it has holes")
        self.shape = rows * factor, cols * factor
        # metres a pixel of an equidistant cylindrical map
        self.posting_m = float(self.profile["transform"].a) / factor
        self.radius_m = self.posting_m * self.shape[0] / np.pi
        # octaves that would be too fine for the pixels are left out
        seen = [s * fractal.WAVELENGTH >= 2.0 * self.posting_m for s in SPACINGS_M]
        self.spacings = np.array(SPACINGS_M)[seen]
        self.amplitudes = np.array(AMPLITUDES_M)[seen]

    def window(self, row: int, col: int, height: int, width: int) -> Int16Array:
        """Heights, m; columns of any turn, rows of the raster."""
        noise = np.zeros((height, width), np.float32)
        rows, cols = self.shape
        lat = np.pi / 2.0 - (row + 0.5 + np.arange(height)) * np.pi / rows
        lon = (col + 0.5 + np.arange(width)) % cols * (2.0 * np.pi / cols)
        octaves = fractal.Octaves(self.seed, self.spacings, self.amplitudes, self.radius_m)
        fractal.add_noise_window(noise, octaves, lat, lon)
        first = int(np.floor((row + 0.5) / self.factor - 0.5)) - 1
        last = int(np.floor((row + height - 0.5) / self.factor - 0.5)) + 2
        heights, gains = self._model_rows(first, last + 1)
        out = np.empty((height, width), np.int16)
        _compose(heights, gains, noise, row - first * self.factor, col, self.factor, out)
        return out

    def _model_rows(self, first: int, end: int) -> tuple[Float32Array, Float32Array]:
        """Spline coefficients of the heights, and the relief's gains, for whole model rows."""
        rows, cols = self._model.shape
        index = np.arange(first - HALO, end + HALO)
        # beyond a pole the meridian half a turn away goes on
        over = (index < 0) | (index >= rows)
        index = np.where(
            index < 0, -1 - index, np.where(index >= rows, 2 * rows - 1 - index, index)
        )
        means = self._model[index].astype(np.float64)
        means[over] = np.roll(means[over], cols // 2, axis=1)
        # The mean of a cubic spline over a pixel is a quartic spline's value at its middle, so
        # the quartic's filter gives the cubic's coefficients.
        spline = ndimage.spline_filter1d(means, order=4, axis=1, mode="grid-wrap")
        spline = ndimage.spline_filter1d(spline, order=4, axis=0, mode="mirror")
        second = np.zeros_like(means)
        second[1:-1] = (means[2:] - 2.0 * means[1:-1] + means[:-2]) ** 2
        second = ndimage.uniform_filter1d(second, ROUGHNESS_ROWS, axis=0)[HALO:-HALO]
        for i, line in enumerate(second):
            across = np.abs(np.cos(np.pi * (0.5 - (first + i + 0.5) / rows)))
            wide = int(min(cols / 2, ROUGHNESS_ROWS / max(across, 1e-6)))
            second[i] = ndimage.uniform_filter1d(line, wide, mode="wrap")
        gains = GAIN_FLAT + GAIN_ROUGH * np.sqrt(np.maximum(second, 0.0))
        gains /= GAIN_FLAT + GAIN_ROUGH * CROP_ROUGHNESS_M
        return spline[HALO:-HALO].astype(np.float32), gains.astype(np.float32)


def make(
    source: Path, target: Path, factor: int, tell: Callable[[str], None] = lambda _: None
) -> bool:
    """Write the raster, whole or not at all; False when it is there already, by the same recipe."""
    ground = Ground(source, factor)
    recipe = Recipe(
        FORMAT,
        ground.seed,
        factor,
        tuple(ground.spacings.tolist()),
        tuple(ground.amplitudes.tolist()),
        hash_file(source),
        *ground.shape,
    )
    if is_made(target, recipe):
        return False
    rows, cols = ground.shape
    west, north = ground.profile["transform"].c, ground.profile["transform"].f
    step = ground.posting_m
    recipe_path(target).unlink(missing_ok=True)  # never an old recipe beside a new raster
    with replace_file(target, lambda _: True) as partial:
        with rasterio.open(
            partial, "w", driver="GTiff", bigtiff="yes", tiled=True, blockxsize=TILE,
            blockysize=TILE, height=rows, width=cols, count=1, dtype="int16", nodata=NODATA,
            crs=ground.profile["crs"],
            transform=rasterio.Affine(step, 0.0, west, 0.0, -step, north),
        ) as raster:  # fmt: skip
            for row in range(0, rows, TILE):
                height = min(TILE, rows - row)
                raster.write(
                    ground.window(row, 0, height, cols), 1, window=Window(0, row, cols, height)
                )
                tell(f"{(row + height) / rows:4.0%}")
        recipe = msgspec.structs.replace(recipe, bytes=partial.stat().st_size)
    write_work_file(recipe_path(target), msgspec.json.format(msgspec.json.encode(recipe)))
    return True


def recipe_path(target: Path) -> Path:
    """Where the recipe of a raster is kept."""
    return target.with_suffix(".json")


def is_made(target: Path, recipe: Recipe) -> bool:
    """Whether a raster is there, by this recipe and as long as when it was written."""
    try:
        found = msgspec.json.decode(recipe_path(target).read_bytes(), type=Recipe)
        size = target.stat().st_size
    except (OSError, msgspec.MsgspecError):
        return False
    return found == msgspec.structs.replace(recipe, bytes=size)


@kernel
def _weights(t: float, out: Float32Array) -> None:
    """Cubic spline weights of the four coefficients about a place t past the second."""
    out[0] = (1.0 - t) ** 3 / 6.0
    out[1] = (4.0 - 6.0 * t * t + 3.0 * t**3) / 6.0
    out[2] = (1.0 + 3.0 * t + 3.0 * t * t - 3.0 * t**3) / 6.0
    out[3] = t**3 / 6.0


@parallel_kernel
def _compose(
    heights: Float32Array, gains: Float32Array, noise: Float32Array, row: int, col: int,
    factor: int, out: Int16Array,
) -> None:  # fmt: skip
    """Spline plus gain times noise, rounded to metres.

    heights, gains  (n, cols) coefficients of whole model rows
    row, col        of the first pixel, in pixels from the first of those rows and from column 0
    """
    cols = heights.shape[1]
    for i in numba.prange(out.shape[0]):
        weights = np.empty(4, np.float32)
        at = (row + i + 0.5) / factor - 0.5
        r = int(np.floor(at))
        _weights(at - r, weights)
        height_row, gain_row = np.zeros(cols, np.float32), np.zeros(cols, np.float32)
        for k in range(4):
            for c in range(cols):
                height_row[c] += weights[k] * heights[r - 1 + k, c]
                gain_row[c] += weights[k] * gains[r - 1 + k, c]
        phases = np.empty((factor, 4), np.float32)
        for p in range(factor):
            t = (p + 0.5) / factor - 0.5
            _weights(t - np.floor(t), phases[p])
        for j in range(out.shape[1]):
            c, p = (col + j) // factor, (col + j) % factor
            # the first half of a pixel lies between it and the one before
            c -= 1 if 2 * p + 1 < factor else 0
            height, gain = np.float32(0.0), np.float32(0.0)
            for k in range(4):
                source = (c - 1 + k) % cols
                height += phases[p, k] * height_row[source]
                gain += phases[p, k] * gain_row[source]
            out[i, j] = np.int16(np.rint(height + gain * noise[i, j]))
