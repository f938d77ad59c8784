"""Counts of a raster file to metres above the reference sphere."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import Float32Array
from catalog.geometry.kernel import kernel


class Conversion(NamedTuple):
    """Raw counts to metres above the reference sphere: count * scale_m + offset_m.

    nodata        the count of pixels without data, NaN for none
    lowest_valid  counts below it are no data
    """

    scale_m: float
    offset_m: float
    nodata: float
    lowest_valid: float

    def __call__(self, raw: NDArray[Any]) -> Float32Array:
        """Heights (float32, m) of counts (rows, cols) of any number type; NaN for no data."""
        out = np.empty(raw.shape, dtype=np.float32)
        _convert(np.ascontiguousarray(raw), self, out)
        return out

    def average_columns(self, raw: NDArray[Any], many: int, out: Float32Array) -> None:
        """Mean heights over `many` counts of a row; at least half of them must be valid.

        raw (rows, cols); out (rows, at least cols / many rounded up)
        """
        _average(np.ascontiguousarray(raw), many, self, out)


# of overviews, which hold heights
HEIGHTS = Conversion(1.0, 0.0, math.nan, -math.inf)


@kernel
def is_height(value: float, convert: Conversion) -> bool:
    """Whether a count is data: finite, not below the lowest and not the no-data value.

    A float file's no-data tag may have lost digits on its way through text: it also counts as the
    nearest float32.
    """
    if not (value >= convert.lowest_valid and abs(value) < np.inf):
        return False
    return value != convert.nodata and value != np.float64(np.float32(convert.nodata))


@kernel
def _convert(raw: NDArray[Any], convert: Conversion, out: Float32Array) -> None:
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            value = float(raw[i, j])
            valid = is_height(value, convert)
            out[i, j] = value * convert.scale_m + convert.offset_m if valid else np.nan


@kernel
def _average(raw: NDArray[Any], many: int, convert: Conversion, out: Float32Array) -> None:
    cols = raw.shape[1]
    for i in range(raw.shape[0]):
        for k in range((cols + many - 1) // many):
            total, valid = 0.0, 0
            end = min((k + 1) * many, cols)
            for j in range(k * many, end):
                value = float(raw[i, j])
                if is_height(value, convert):
                    total += value
                    valid += 1
            enough = valid > 0 and 2 * valid >= end - k * many
            out[i, k] = total / valid * convert.scale_m + convert.offset_m if enough else np.nan
