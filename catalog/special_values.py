"""Special values of raster formats: pixels without a value, and saturated ones.

ISIS reserves the ends of each pixel type (USGS ISIS, SpecialPixel.h): NULL, and the low saturations
LRS and LIS, are no values; HIS and HRS are saturated. They are values as stored, before base and
multiplier. PDS3 and PDS4 labels name theirs by keyword, FITS by BLANK and NaN.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import BoolArray

# Keywords of PDS3 (Data Dictionary) and PDS4 (Special_Constants) that name values as stored.
MISSING_KEYWORDS = (
    *("MISSING", "MISSING_CONSTANT", "INVALID_CONSTANT", "NULL_CONSTANT", "CORE_NULL"),
    *("NOT_APPLICABLE_CONSTANT", "UNKNOWN_CONSTANT", "ERROR_CONSTANT", "LOW_REPR_SATURATION"),
    *("LOW_INSTR_SATURATION", "CORE_LOW_REPR_SATURATION", "CORE_LOW_INSTR_SATURATION"),
    *("LOW_REPRESENTATION_SATURATION", "LOW_INSTRUMENT_SATURATION"),
)
SATURATED_KEYWORDS = (
    *("SATURATED_CONSTANT", "HIGH_REPR_SATURATION", "HIGH_INSTR_SATURATION"),
    *("CORE_HIGH_REPR_SATURATION", "CORE_HIGH_INSTR_SATURATION"),
    *("HIGH_REPRESENTATION_SATURATION", "HIGH_INSTRUMENT_SATURATION"),
)


@dataclass(frozen=True)
class SpecialValues:
    """Values as stored that are no measurements.

    missing        stored values of pixels without a value
    saturated      stored values of saturated pixels
    lowest_valid, highest_valid  stored values outside of them are special, too
    """

    missing: tuple[float, ...] = ()
    saturated: tuple[float, ...] = ()
    lowest_valid: float = -np.inf
    highest_valid: float = np.inf

    def is_missing(self, stored: NDArray[Any]) -> BoolArray:
        """Mark pixels without a value: bool, of the shape of `stored`; NaN counts."""
        marked = ~(stored >= _as_type(self.lowest_valid, stored))
        for value in self.missing:
            marked |= stored == _as_type(value, stored)
        return np.asarray(marked, dtype=np.bool_)

    def is_saturated(self, stored: NDArray[Any]) -> BoolArray:
        """Mark saturated pixels: bool, of the shape of `stored`."""
        marked = stored > _as_type(self.highest_valid, stored)
        for value in self.saturated:
            marked |= stored == _as_type(value, stored)
        return np.asarray(marked, dtype=np.bool_)


def _as_type(value: float, stored: NDArray[Any]) -> np.float64 | np.float32:
    """A value as a float type that holds the stored type; a float32 raster's own rounding."""
    return np.float32(value) if stored.dtype == np.float32 else np.float64(value)


def _isis_real(bits: int) -> float:
    return float(np.array(bits, np.uint32).view(np.float32))


# By the names of numpy's types. Values of bytes are two alone: 0 is NULL, 255 saturated.
ISIS = {
    "uint8": SpecialValues(missing=(0.0,), saturated=(255.0,)),
    "int16": SpecialValues((-32768.0, -32767.0, -32766.0), (-32765.0, -32764.0)),
    "uint16": SpecialValues((0.0, 1.0, 2.0), (65534.0, 65535.0)),
    "int32": SpecialValues((-8388613.0, -8388612.0, -8388611.0), (-8388610.0, -8388609.0)),
    "uint32": SpecialValues((0.0, 1.0, 2.0), (4294967294.0, 4294967295.0)),
    "float32": SpecialValues(
        tuple(_isis_real(0xFF7FFFFB + step) for step in range(3)),
        tuple(_isis_real(0xFF7FFFFE + step) for step in range(2)),
    ),
}
