"""Special pixels of ISIS by the bits of its types."""

import numpy as np
import pytest

from catalog.special_values import ISIS, SpecialValues, read_stored_value


def test_real_specials_are_the_lowest_floats_in_the_order_of_their_bits() -> None:
    bits = np.arange(0xFF7FFFFA, 0xFF800000, dtype=np.uint32).view(np.float32)
    special = ISIS["float32"]
    assert special.is_missing(bits).tolist() == [False, True, True, True, False, False]
    assert special.is_saturated(bits).tolist() == [False, False, False, False, True, True]


def test_long_specials_have_the_bits_of_the_real_ones() -> None:
    bits = np.arange(0xFF7FFFFA, 0xFF800000, dtype=np.uint32).view(np.int32)
    special = ISIS["int32"]
    assert special.is_missing(bits).tolist() == [False, True, True, True, False, False]
    assert special.is_saturated(bits).tolist() == [False, False, False, False, True, True]


@pytest.mark.parametrize("kind", ISIS)
def test_nothing_is_both_missing_and_saturated(kind: str) -> None:
    special = ISIS[kind]
    values = np.array([*special.missing, *special.saturated, 100]).astype(kind)
    assert not (special.is_missing(values) & special.is_saturated(values)).any()
    assert not special.is_missing(values)[-1]


def test_nan_is_missing_and_bounds_hold() -> None:
    special = SpecialValues(missing=(7.0,), lowest_valid=-5.0, highest_valid=9.0)
    values = np.array([np.nan, -6.0, 7.0, 8.0, 10.0])
    assert special.is_missing(values).tolist() == [True, True, True, False, False]
    assert special.is_saturated(values).tolist() == [False, False, False, False, True]


@pytest.mark.parametrize(
    ("text", "dtype", "stored"),
    [
        ("-32768", "int16", -32768.0),
        ("'255'", "uint8", 255.0),
        ("-1.5D2", "float32", -150.0),
        ("16#FF#", "uint8", 255.0),
        ("16#FF#", "int8", -1.0),
        ("16#8001#", "int16", -32767.0),
        ("16#8001#", "uint16", 32769.0),
        ("16#8001#", "int32", 32769.0),
        ("-16#7FFF#", "int16", -32767.0),
        ("16#-7FFF#", "int16", -32767.0),
        ("2#1000000000000000#", "int16", -32768.0),
        ("0xFF7FFFFB", "int32", -8388613.0),
        ("16#FF7FFFFB#", "uint32", 4286578683.0),
        ("16#FF7FFFFB#", "float32", ISIS["float32"].missing[0]),
        ("0xff7ffffb", "float32", ISIS["float32"].missing[0]),
        ("16#FF7FFFFB#", "float64", ISIS["float32"].missing[0]),
        ("16#FFEFFFFFFFFFFFFF#", "float64", -1.7976931348623157e308),
        ("16#20#", "float32", 32.0),
        ("16#FF7FFFFB#", "int16", 4286578683.0),
        ("-inf", "float32", -np.inf),
        ("-INF!", "float32", None),
        ("2#12#", "uint8", None),
        ("1_0", "uint8", None),
        ("", "uint8", None),
    ],
)
def test_constants_of_labels_are_values_of_the_stored_type(
    text: str, dtype: str, stored: float | None
) -> None:
    assert read_stored_value(text, dtype) == stored
