"""Special values of raster formats: pixels without a value, and saturated ones.

ISIS reserves the ends of each pixel type (USGS ISIS, SpecialPixel.h): NULL, and the low saturations
LRS and LIS, are no values; HIS and HRS are saturated. They are values as stored, before base and
multiplier. PDS3 and PDS4 labels name theirs by keyword, as numbers or bits; FITS by BLANK and NaN.
"""

import re
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
# PDS Standards Reference 3.8, chapter 12: decimals, with D for E too, and 16#FF# in a base.
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([EeDd][+-]?[0-9]{1,3})?")
_BASED = re.compile(r"([+-]?)([0-9]{1,2})#([+-]?)([0-9A-Za-z]{1,32})#")
_HEXADECIMAL = re.compile(r"0[xX]([0-9A-Fa-f]{1,32})")  # of PDS4
_NOT_FINITE = re.compile(r"[+-]?(nan|inf|infinity)", re.IGNORECASE)


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
        marked: BoolArray = ~(stored >= _convert_type(self.lowest_valid, stored))
        for value in self.missing:
            marked |= stored == _convert_type(value, stored)
        return marked

    def is_saturated(self, stored: NDArray[Any]) -> BoolArray:
        """Mark saturated pixels: bool, of the shape of `stored`."""
        marked: BoolArray = stored > _convert_type(self.highest_valid, stored)
        for value in self.saturated:
            marked |= stored == _convert_type(value, stored)
        return marked


def _convert_type(value: float, stored: NDArray[Any]) -> np.float64 | np.float32:
    """A value as a float type that holds the stored type; a float32 raster's own rounding."""
    return np.float32(value) if stored.dtype == np.float32 else np.float64(value)


def read_number(text: str) -> float | None:
    """Read a number as PDS3, PDS4 and FITS write it, with D for E and 16#FF# too; None for none."""
    if _NUMBER.fullmatch(text):
        return float(text.upper().replace("D", "E"))
    based = _BASED.fullmatch(text)
    if based is None or not 2 <= int(based[2]) <= 16:
        return None
    try:
        value = float(int(based[4], int(based[2])))
    except ValueError:  # a digit that the base does not have
        return None
    return -value if "-" in (based[1], based[3]) else value


def read_stored_value(text: str, dtype: str) -> float | None:
    """Read a constant of a label as a value of the type of its pixels; None for no number.

    Digits in a base without a sign are the bits of a stored value where they can be: 16#8001# is
    -32767 of int16 and 32769 of uint16; eight hexadecimal digits of a real are a float32's bits,
    sixteen a float64's. 0xFF7FFFFB is 16#FF7FFFFB#.
    """
    plain = text.strip("'\" \t")
    if _NOT_FINITE.fullmatch(plain):
        return float(plain)
    plain = _HEXADECIMAL.sub(r"16#\1#", plain) if _HEXADECIMAL.fullmatch(plain) else plain
    value, based = read_number(plain), _BASED.fullmatch(plain)
    if value is None or based is None or based[1] or based[3]:
        return value
    kind, bits = np.dtype(dtype), int(based[4], int(based[2]))
    if kind.kind == "f" and based[2] == "16" and len(based[4]) in (8, 16):
        size = len(based[4]) // 2
        return float(np.array(bits, f"u{size}").view(f"f{size}"))
    full = 1 << 8 * kind.itemsize
    return float(bits - full) if kind.kind == "i" and full // 2 <= bits < full else float(bits)


def _decode_isis_real(bits: int) -> float:
    return float(np.array(bits, np.uint32).view(np.float32))


# By the names of numpy's types. Values of bytes are two alone: 0 is NULL, 255 saturated.
ISIS = {
    "uint8": SpecialValues(missing=(0.0,), saturated=(255.0,)),
    "int16": SpecialValues((-32768.0, -32767.0, -32766.0), (-32765.0, -32764.0)),
    "uint16": SpecialValues((0.0, 1.0, 2.0), (65534.0, 65535.0)),
    "int32": SpecialValues((-8388613.0, -8388612.0, -8388611.0), (-8388610.0, -8388609.0)),
    "uint32": SpecialValues((0.0, 1.0, 2.0), (4294967294.0, 4294967295.0)),
    "float32": SpecialValues(
        tuple(_decode_isis_real(0xFF7FFFFB + step) for step in range(3)),
        tuple(_decode_isis_real(0xFF7FFFFE + step) for step in range(2)),
    ),
}
