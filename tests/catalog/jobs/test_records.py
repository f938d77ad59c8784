"""Records survive the way through bytes; damage never does."""

import msgspec
import numpy as np
import pytest

from catalog.jobs.workspace import DamagedRecordsError, decode_records, encode_records


class Thing(msgspec.Struct):
    cell: int
    name: str
    values: np.ndarray
    pairs: tuple[tuple[float, float], ...] = ()


def things():
    rng = np.random.default_rng(1)
    return [
        Thing(3, "é", rng.random((4, 5)), ((1.5, -2.5),)),
        Thing(2**40, "", np.array([[1, -2]], dtype=np.int16)),
        Thing(-1, "f", np.full((2, 0), np.nan, dtype=np.float32)),
    ]


def test_records_come_back_with_types_and_shapes():
    for before, after in zip(
        things(), decode_records(encode_records(things()), Thing), strict=True
    ):
        assert (after.cell, after.name, after.pairs) == (before.cell, before.name, before.pairs)
        assert after.values.dtype == before.values.dtype
        np.testing.assert_array_equal(after.values, before.values)


def test_equal_records_give_equal_bytes():
    assert encode_records(things()) == encode_records(things())


def test_every_single_flipped_bit_and_every_cut_is_found():
    data = encode_records(things())
    for position in range(len(data)):
        broken = bytearray(data)
        broken[position] ^= 1 << (position % 8)
        with pytest.raises(DamagedRecordsError):
            decode_records(bytes(broken), Thing)
        with pytest.raises(DamagedRecordsError):
            decode_records(data[:position], Thing)


def test_records_of_another_type_are_refused():
    class Other(msgspec.Struct):
        cell: str

    with pytest.raises(DamagedRecordsError):
        decode_records(encode_records(things()), Other)
