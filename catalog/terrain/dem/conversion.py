"""Counts of a raster file to metres above the reference sphere."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import Float32Array
from catalog.geometry.kernel import kernel


@dataclass(frozen=True)
class Conversion:
    """Raw counts to metres above the reference sphere: count * scale_m + offset_m."""

    scale_m: float
    offset_m: float
    nodata: float | None
    lowest_valid: float

    @property
    def limits(self) -> tuple[float, float, float]:
        """What `is_height` asks a count against: lowest valid, no-data twice (NaN for none).

        A float file's no-data tag may have lost digits on its way through text: it also counts
        as the nearest float32.
        """
        nodata = math.nan if self.nodata is None else float(self.nodata)
        return self.lowest_valid, nodata, float(np.float32(nodata))

    def __call__(self, raw: NDArray[Any]) -> Float32Array:
        """Heights (float32, m) of counts (rows, cols) of any number type; NaN for no data."""
        out = np.empty(raw.shape, dtype=np.float32)
        _convert(np.ascontiguousarray(raw), self.scale_m, self.offset_m, *self.limits, out)
        return out

    def average_columns(self, raw: NDArray[Any], many: int, out: Float32Array) -> None:
        """Mean heights over `many` counts of a row; at least half of them must be valid.

        raw (rows, cols); out (rows, at least cols / many rounded up)
        """
        _average(np.ascontiguousarray(raw), many, self.scale_m, self.offset_m, *self.limits, out)


# of overviews, which hold heights
HEIGHTS = Conversion(1.0, 0.0, None, -math.inf)


@kernel
def is_height(value: float, lowest_valid: float, nodata: float, nodata32: float) -> bool:
    """Whether a count is data: finite, not below the lowest and not the no-data value."""
    return value >= lowest_valid and value != nodata and value != nodata32 and abs(value) < np.inf


@kernel
def _convert(
    raw: NDArray[Any],
    scale: float,
    offset: float,
    lowest_valid: float,
    nodata: float,
    nodata32: float,
    out: Float32Array,
) -> None:
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            value = float(raw[i, j])
            if is_height(value, lowest_valid, nodata, nodata32):
                out[i, j] = value * scale + offset
            else:
                out[i, j] = np.nan


@kernel
def _average(
    raw: NDArray[Any],
    many: int,
    scale: float,
    offset: float,
    lowest_valid: float,
    nodata: float,
    nodata32: float,
    out: Float32Array,
) -> None:
    cols = raw.shape[1]
    for i in range(raw.shape[0]):
        for k in range((cols + many - 1) // many):
            total, valid = 0.0, 0
            end = min((k + 1) * many, cols)
            for j in range(k * many, end):
                value = float(raw[i, j])
                if is_height(value, lowest_valid, nodata, nodata32):
                    total += value
                    valid += 1
            enough = valid > 0 and 2 * valid >= end - k * many
            out[i, k] = total / valid * scale + offset if enough else np.nan
