"""Heights as compressed counts."""

import numpy as np
import pytest
import rasterio
import zstandard

from catalog.arrays import Float32Array, FloatArray
from catalog.config import resource
from catalog.errors import DataError
from catalog.store.codec import (
    MAX_COUNT,
    Encoded,
    decode,
    decode_counts,
    encode,
)
from catalog.store.schema import NO_DATA_COUNT

BYTES_A_POINT = 36_000  # 41 252 points in 1.5 GB


def tycho(size: int) -> Float32Array:
    """A square of the bundled Tycho DEM, central peak and floor, m."""
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as source:
        window = rasterio.windows.Window(1400, 1200, size, size)
        return source.read(1, window=window).astype(np.float32)


def as_the_text_says(encoded: Encoded) -> FloatArray:
    """A decoder written from the description alone, with nothing of ours."""
    size = encoded.size
    raw = zstandard.ZstdDecompressor().decompress(encoded.data, max_output_size=2 * size * size)
    planes = np.frombuffer(raw, np.uint8).reshape(2, size, size).astype(np.int64)
    folded = planes[0] * 256 + planes[1]
    residual = np.where(folded % 2 == 1, -(folded + 1) // 2, folded // 2)
    counts = np.cumsum(np.cumsum(residual, axis=0), axis=1) % 65536
    counts = np.where(counts >= 32768, counts - 65536, counts)
    heights = encoded.offset + encoded.step * counts
    return np.where(counts == -32768, np.nan, heights)


@pytest.mark.parametrize("step", [0.5, 1.0, 0.01])
def test_heights_come_back_within_half_a_step(step: float) -> None:
    heights = tycho(80)
    encoded, _ = encode(heights, step)
    assert encoded.step == step
    # float32 itself resolves 0.0002 m at 3 km
    assert np.abs(decode(encoded) - heights).max() <= step / 2 + 2.5e-4


def test_holes_stay_holes_and_do_not_touch_their_neighbours() -> None:
    heights = tycho(64)
    heights[5:20, 30:] = np.nan
    heights[0, 0] = np.nan
    back = decode(encode(heights, 0.5)[0])
    assert np.array_equal(np.isnan(back), np.isnan(heights))
    assert np.nanmax(np.abs(back - heights)) <= 0.25 + 2.5e-4


def test_the_written_description_is_enough_to_decode() -> None:
    heights = tycho(80)
    heights[40:, :7] = np.nan
    encoded, _ = encode(heights, 0.5)
    expected = as_the_text_says(encoded)
    assert np.array_equal(decode(encoded), expected.astype(np.float32), equal_nan=True)


def test_counts_and_heights_agree() -> None:
    encoded, counts = encode(tycho(33), 0.5)
    assert np.array_equal(decode_counts(encoded.data, encoded.size), counts)
    heights = (encoded.offset + encoded.step * counts.astype(np.float64)).astype(np.float32)
    assert np.array_equal(decode(encoded), heights)


def test_the_step_doubles_until_the_relief_fits() -> None:
    heights = np.linspace(-9000.0, 10000.0, 32 * 32, dtype=np.float32).reshape(32, 32)
    encoded, counts = encode(heights, 0.1)  # 190 000 steps do not fit, 47 500 do
    assert encoded.step == 0.4
    assert np.abs(counts).max() <= MAX_COUNT
    assert np.abs(decode(encoded) - heights).max() <= 0.2 + 1e-3


def test_random_counts_of_the_whole_range_round_trip() -> None:
    """Residuals beyond 16 bits wrap around; noise over the whole range meets every case."""
    rng = np.random.default_rng(3)
    heights = rng.uniform(-32766.0, 32766.0, (48, 48)).astype(np.float32).round()
    heights[rng.random((48, 48)) < 0.1] = np.nan
    encoded, _ = encode(heights, 1.0)
    assert encoded.step == 1.0
    assert np.array_equal(decode(encoded), heights, equal_nan=True)


@pytest.mark.parametrize("value", [np.nan, 0.0, -1234.5])
def test_a_level_patch_is_a_few_bytes(value: float) -> None:
    heights = np.full((80, 80), value, dtype=np.float32)
    encoded, _ = encode(heights, 0.5)
    assert np.array_equal(decode(encoded), heights, equal_nan=True)
    assert len(encoded.data) < 100


def test_no_data_count_is_outside_the_range_of_heights() -> None:
    assert NO_DATA_COUNT < -MAX_COUNT


def test_the_same_heights_give_the_same_bytes() -> None:
    assert encode(tycho(80), 0.5)[0] == encode(tycho(80), 0.5)[0]


@pytest.mark.parametrize(
    ("data", "size"),
    [(b"", 8), (b"no frame at all", 8), (zstandard.compress(b"short"), 8), (b"", 0), (b"", 10**9)],
)
def test_bytes_that_are_no_patch_are_refused(data: bytes, size: int) -> None:
    with pytest.raises(DataError):
        decode(Encoded(size, 0.5, 0.0, data))


def test_a_point_on_rough_highland_fits_its_share_of_the_file() -> None:
    """Five levels of 80 nodes about Tycho, the roughest ground that the Moon has at this scale."""
    ground = tycho(1280)
    total = 0
    for level in range(5):
        wide = 80 * 2**level
        middle = ground[640 - wide // 2 : 640 + wide // 2, 640 - wide // 2 : 640 + wide // 2]
        means = middle.reshape(80, 2**level, 80, 2**level).mean(axis=(1, 3))
        total += len(encode(means.astype(np.float32), 0.5)[0].data)
    assert total < BYTES_A_POINT
