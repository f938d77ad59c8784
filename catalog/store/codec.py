"""Height grids as compressed bytes.

A grid of heights becomes counts (int16, -32768 = no data) with value = offset + step * count. The
counts, read as unsigned 16-bit numbers, are differenced along rows and then along columns, both
modulo 65536: what is left is what the plane through the west, north and north-west neighbours
does not predict. Residuals r (signed) are folded to 2r for r >= 0 and -2r - 1 for r < 0, and
split into a plane of high bytes followed by a plane of low bytes. The two planes are one
Zstandard frame, each in its own block, so that each gets its own entropy table: on lunar terrain
this is 4 % smaller than one block and a third of the plain counts.

The kernels (residuals.py) are imported where they are called: `catalog info`, which reads no patch,
need not wait for the compiler to load.
"""

import threading
from dataclasses import dataclass

import numpy as np
import zstandard

from catalog.arrays import ByteArray, Float32Array, Int16Array
from catalog.errors import DataError
from catalog.store.records import compute_checksum
from catalog.store.schema import NO_DATA_COUNT

MAX_COUNT = 32767
MAX_SIZE = 4096  # nodes a side; refuses to allocate gigabytes for a damaged size
MIN_STEP, MAX_HEIGHT = 1e-12, 1e9  # m: beyond these float32 heights lose their metres
# The residuals are noise to a dictionary coder: level 19 saves 2 % for 90 times the work.
ZSTD_LEVEL = 1


class _OfThread(threading.local):
    """Making one costs more than its work on a patch, and threads must not share one."""

    def __init__(self) -> None:
        parameters = zstandard.ZstdCompressionParameters.from_level(
            ZSTD_LEVEL, write_content_size=False, write_checksum=False, write_dict_id=False
        )
        self.compressor = zstandard.ZstdCompressor(compression_params=parameters)
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=2 * MAX_SIZE * MAX_SIZE)


_of_thread = _OfThread()


@dataclass(frozen=True)
class Encoded:
    """A grid as it is stored: value = offset + step * count at each of size x size nodes."""

    size: int
    step: float
    offset: float
    data: bytes

    @classmethod
    def parse_row(
        cls, size: object, step: object, offset: object, data: object
    ) -> "Encoded | None":
        """The grid of a row's columns; None where they are not of their types: damaged."""
        if not (isinstance(size, int) and 0 < size < 2**31 and isinstance(data, bytes)):
            return None
        if not (isinstance(step, float) and isinstance(offset, float)):
            return None
        if not (MIN_STEP < step < MAX_HEIGHT and abs(offset) < MAX_HEIGHT):
            return None
        return cls(size, step, offset, data)

    def columns(self, header: bytes) -> tuple[int, float, float, int, bytes]:
        """The end of a row: size, step, offset, checksum and data."""
        return self.size, self.step, self.offset, compute_checksum(header, self.data), self.data


def quantise(heights: Float32Array, step: float) -> tuple[Int16Array, float, float]:
    """Counts of a grid together with the step and the offset that they are in.

    heights (n, n), NaN for no data; step: wanted height step, same unit. Where the relief does
    not fit 65535 steps the step is doubled until it does. The offset is the middle of the range,
    rounded to whole steps.
    """
    values = np.asarray(heights, dtype=np.float64)
    known = np.isfinite(values)
    complete = bool(known.all())
    seen = values if complete else values[known]
    if not seen.size:
        return np.full(values.shape, NO_DATA_COUNT, dtype=np.int16), step, 0.0
    low, high = float(seen.min()), float(seen.max())
    while (high - low) / step > 2 * MAX_COUNT - 2:
        step *= 2.0
    offset = float(np.rint((low + high) / 2.0 / step) * step) + 0.0  # + 0.0 makes -0.0 a 0.0
    counts = np.rint(((values if complete else np.where(known, values, offset)) - offset) / step)
    if not complete:
        counts = np.where(known, counts, NO_DATA_COUNT)
    return counts.astype(np.int16), step, offset


def encode_counts(counts: Int16Array) -> bytes:
    """Compress a square grid of counts."""
    from catalog.store.residuals import planes_from_counts

    nodes = counts.size
    planes = np.empty(2 * nodes, dtype=np.uint8)
    planes_from_counts(np.ascontiguousarray(counts), planes)
    raw = planes.tobytes()
    compressor = _of_thread.compressor.compressobj()
    high = compressor.compress(raw[:nodes]) + compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    return high + compressor.compress(raw[nodes:]) + compressor.flush()


def encode(heights: Float32Array, step: float) -> tuple[Encoded, Int16Array]:
    """Compress a square grid of heights; returns the counts too, for the content digest."""
    counts, step, offset = quantise(heights, step)
    return Encoded(counts.shape[0], step, offset, encode_counts(counts)), counts


def _decode_planes(data: bytes, size: int) -> ByteArray:
    if not 0 < size <= MAX_SIZE:
        raise DataError(f"a patch of {size} nodes a side; wanted 1..{MAX_SIZE}")
    expected = 2 * size * size
    try:
        # a frame that states another size would be given as much memory as it asks for
        if zstandard.frame_content_size(data) not in (-1, expected):
            raise DataError(f"compressed heights state another size than {expected} bytes")
        raw = _of_thread.decompressor.decompress(data, max_output_size=expected)
    except zstandard.ZstdError as error:
        raise DataError(f"compressed heights cannot be unpacked: {error}") from None
    if len(raw) != expected:
        raise DataError(f"compressed heights hold {len(raw)} bytes; wanted {expected}")
    return np.frombuffer(raw, dtype=np.uint8)


def decode_counts(data: bytes, size: int) -> Int16Array:
    """Counts (size, size) of compressed bytes. Raises DataError when they do not unpack."""
    from catalog.store.residuals import counts_from_planes

    counts = np.empty((size, size), dtype=np.int16)
    counts_from_planes(_decode_planes(data, size), counts)
    return counts


def decode(encoded: Encoded) -> Float32Array:
    """Heights (size, size), float32, NaN for no data. Raises DataError when they do not unpack."""
    from catalog.store.residuals import heights_from_planes

    planes = _decode_planes(encoded.data, encoded.size)
    shape = (encoded.size, encoded.size)
    heights = np.empty(shape, dtype=np.float32)
    counts = np.empty(shape, dtype=np.int16)
    heights_from_planes(planes, encoded.step, encoded.offset, counts, heights)
    return heights
