"""What the plane through three neighbours does not predict of counts, and back; see codec.py."""

import numpy as np

from catalog.arrays import ByteArray, Float32Array, Int16Array
from catalog.geometry.kernel import kernel
from catalog.store.schema import NO_DATA_COUNT


@kernel
def planes_from_counts(counts: Int16Array, planes: ByteArray) -> None:
    """Fill the planes of high and of low bytes (2 n²,) of counts (n, n)."""
    rows, cols = counts.shape
    nodes = rows * cols
    for i in range(rows):
        for j in range(cols):
            residual = np.int64(counts[i, j])
            if i > 0:
                residual -= counts[i - 1, j]
            if j > 0:
                residual -= counts[i, j - 1]
                if i > 0:
                    residual += counts[i - 1, j - 1]
            # into the signed 16-bit range, as the reader's arithmetic is modulo 65536
            residual = ((residual + 32768) & 65535) - 32768
            folded = 2 * residual if residual >= 0 else -2 * residual - 1
            planes[i * cols + j] = folded >> 8
            planes[nodes + i * cols + j] = folded & 255


@kernel
def counts_from_planes(planes: ByteArray, counts: Int16Array) -> None:
    """Fill counts (n, n) from their planes."""
    # three plain loops a row: all but the running sum work on many nodes at once
    rows, cols = counts.shape
    nodes = rows * cols
    line = np.empty(cols, np.int32)
    for i in range(rows):
        high = planes[i * cols : (i + 1) * cols]
        low = planes[nodes + i * cols : nodes + (i + 1) * cols]
        for j in range(cols):
            folded = (np.int32(high[j]) << 8) | np.int32(low[j])
            line[j] = (folded >> 1) ^ -(folded & 1)
        along_row = np.int32(0)
        for j in range(cols):
            along_row += line[j]
            line[j] = along_row
        # storing as int16 keeps the low 16 bits: the arithmetic modulo 65536
        if i == 0:
            for j in range(cols):
                counts[0, j] = line[j]
        else:
            for j in range(cols):
                counts[i, j] = line[j] + counts[i - 1, j]


@kernel
def heights_from_planes(
    planes: ByteArray, step: float, offset: float, counts: Int16Array, heights: Float32Array
) -> None:
    """Fill counts and heights (n, n) from the planes of the counts."""
    counts_from_planes(planes, counts)
    rows, cols = counts.shape
    for i in range(rows):
        for j in range(cols):
            count = counts[i, j]
            heights[i, j] = np.nan if count == NO_DATA_COUNT else offset + step * count
