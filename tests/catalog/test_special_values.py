"""Special pixels of ISIS by the bits of its types."""

import numpy as np
import pytest

from catalog.special_values import ISIS, SpecialValues


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
