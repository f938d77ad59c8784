"""How like the real ground a made one is: slopes and spectrum against GLD100's own 118 m crop.

The crop (Tycho, 38-48 S, 343-355 E) and the model come from one product: their pixels nest.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import rasterio

from catalog.arrays import FloatArray
from catalog.config import resource

# Lower edges of the octaves of wavelength that are compared, m.
OCTAVES_M = (237.0, 474.0, 948.0, 1896.0, 3792.0)


class Statistics(NamedTuple):
    """rms_slope_deg at the posting; octaves_m (n,) rms height of OCTAVES_M, mean of two ways."""

    rms_slope_deg: float
    octaves_m: FloatArray


class Crop(NamedTuple):
    """Real heights (m), the first row and column on the whole-Moon raster, latitudes (rad)."""

    heights: FloatArray
    row: int
    col: int
    lat: FloatArray
    posting_m: float


def real_crop() -> Crop:
    """The bundled crop, cut to whole pixels of the 32 px/deg model."""
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as source:
        posting = float(source.transform.a)
        rows = round(np.pi * 1737400.0 / posting)
        row = round(rows / 2.0 - source.transform.f / posting)
        col = round(source.transform.c / posting)
        top, left = -row % 8, -col % 8
        heights = source.read(1)[top:, left:]
    heights = heights[: heights.shape[0] // 8 * 8, : heights.shape[1] // 8 * 8]
    row, col = row + top, col + left
    lat = np.pi / 2.0 - (row + 0.5 + np.arange(heights.shape[0])) * np.pi / rows
    return Crop(heights.astype(np.float64), row, col, lat, posting)


def fits(raster: Path, crop: Crop) -> bool:
    """Whether a raster has the crop's pixels."""
    with rasterio.open(raster) as source:
        return abs(float(source.transform.a) - crop.posting_m) < 1e-3 * crop.posting_m


def crop_of(raster: Path, crop: Crop) -> FloatArray:
    """The same place of a whole-Moon raster of the same posting."""
    with rasterio.open(raster) as source:
        window = rasterio.windows.Window(crop.col, crop.row, *crop.heights.shape[::-1])
        return np.asarray(source.read(1, window=window), dtype=np.float64)


def statistics(heights: FloatArray, crop: Crop) -> Statistics:
    """Of heights on the crop's grid."""
    step_x = crop.posting_m * np.cos(crop.lat)[1:-1, None]
    north = (heights[2:, 1:-1] - heights[:-2, 1:-1]) / (2.0 * crop.posting_m)
    east = (heights[1:-1, 2:] - heights[1:-1, :-2]) / (2.0 * step_x)
    slope = np.degrees(np.arctan(np.sqrt(np.mean(north**2 + east**2))))
    middle = slice(len(heights) // 2 - 64, len(heights) // 2 + 64)
    across = float(crop.posting_m * np.cos(crop.lat[middle].mean()))
    powers = _octaves(heights.T, crop.posting_m) + _octaves(heights[middle], across)
    return Statistics(float(slope), np.sqrt(powers / 2.0))


def _octaves(lines: FloatArray, posting_m: float) -> FloatArray:
    """Mean square heights of the octaves along lines (n, length), detrended and tapered."""
    length = lines.shape[1]
    ramp = np.linspace(-1.0, 1.0, length)
    lines = lines - lines.mean(axis=1, keepdims=True)
    lines = lines - np.outer(lines @ ramp / (ramp @ ramp), ramp)
    taper = np.hanning(length)
    spectrum = np.abs(np.fft.rfft(lines * taper, axis=1)) ** 2
    power = 2.0 * spectrum.mean(axis=0) / (length * (taper @ taper))
    frequency = np.fft.rfftfreq(length, posting_m)
    return np.array(
        [power[(frequency <= 1.0 / low) & (frequency > 0.5 / low)].sum() for low in OCTAVES_M]
    )


def table(real: Statistics, made: Statistics) -> str:
    """Both side by side, for people."""
    lines = [f"  {'':28}{'real':>9}{'made':>9}"]
    lines.append(
        f"  {'rms slope at 118 m, deg':28}{real.rms_slope_deg:9.2f}{made.rms_slope_deg:9.2f}"
    )
    for low, a, b in zip(OCTAVES_M, real.octaves_m, made.octaves_m):
        lines.append(f"  {f'rms height {low:.0f}-{2 * low:.0f} m, m':28}{a:9.2f}{b:9.2f}")
    return "\n".join(lines)
