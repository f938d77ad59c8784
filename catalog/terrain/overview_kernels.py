"""What is taken from the counts of a terrain model as they pass by, in compiled code.

scale, offset                   m by counts
lowest_valid, nodata, nodata32  which counts are data, see `is_height`
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import BoolArray, Float32Array
from catalog.geometry.kernel import kernel
from catalog.terrain.conversion import is_height


@kernel
def extremes(
    raw: NDArray[Any],
    scale: float,
    offset: float,
    lowest_valid: float,
    nodata: float,
    nodata32: float,
) -> tuple[float, float, int, int]:
    """Lowest and highest height, number of valid and of all values."""
    lowest, highest, valid = np.inf, -np.inf, 0
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            value = float(raw[i, j])
            if is_height(value, lowest_valid, nodata, nodata32):
                height = value * scale + offset
                lowest, highest = min(lowest, height), max(highest, height)
                valid += 1
    return lowest, highest, valid, raw.size


@kernel
def mark_holes(
    raw: NDArray[Any],
    lowest_valid: float,
    nodata: float,
    nodata32: float,
    block: int,
    whole: BoolArray,
) -> None:
    """Clear the blocks that have a pixel without data."""
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            if not is_height(float(raw[i, j]), lowest_valid, nodata, nodata32):
                whole[i // block, j // block] = False


@kernel
def halve_raw(
    raw: NDArray[Any],
    scale: float,
    offset: float,
    lowest_valid: float,
    nodata: float,
    nodata32: float,
    step: float,
) -> Float32Array:
    """Means of 2 x 2 counts as heights rounded to `step`; at least half of what is there is valid.

    An odd last row or column has fewer than four counts to average.
    """
    rows, cols = raw.shape
    out = np.empty(((rows + 1) // 2, (cols + 1) // 2), np.float32)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total, valid, there = 0.0, 0, 0
            for r in range(2 * i, min(2 * i + 2, rows)):
                for c in range(2 * j, min(2 * j + 2, cols)):
                    value = float(raw[r, c])
                    there += 1
                    if is_height(value, lowest_valid, nodata, nodata32):
                        total += value
                        valid += 1
            if 2 * valid >= there and valid > 0:
                out[i, j] = np.round((total / valid * scale + offset) / step) * step
            else:
                out[i, j] = np.nan
    return out
