"""The count at which a picture's pixels are full, found where nothing states it.

Ours. A sensor of 12 or 14 bits in a container of 16 clips its pixels far below what the container
holds. The clipped pixels then share the highest count, or the highest few after a lossy
compression: far more pixels than the counts just below, where a smooth histogram thins out.
"""

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import FloatArray, IntArray

MIN_FULL_PX = 5  # pixels that share the highest count: fewer do so by chance
LEVELS_BELOW = 8  # counts below the full one that together hold fewer pixels where it is clipped
MAX_BELOW_SHARE = 0.5  # of the clipped pixels, in those counts
# Lossy compression spreads clipped pixels over so many counts, each with this share of the highest.
SPREAD_LEVELS, MIN_SPREAD_SHARE = 3, 0.2
# Pixels above the clipped count, per pixel at it: hot pixels, and marks that were drawn later.
MAX_ABOVE_SHARE = 1e-3


def find_full_scale(values: NDArray[np.generic]) -> float | None:
    """Find the count that clipped pixels share; None where the highest counts thin out smoothly.

    values  of pixels that have one, of any shape and real type
    """
    levels, many = _count_upper_levels(values)
    if len(levels) < 2:
        return None
    above = np.cumsum(many[::-1])[::-1] - many
    highest = np.flatnonzero((many >= MIN_FULL_PX) & (above <= MAX_ABOVE_SHARE * many))
    if not highest.size:
        return None
    top = int(highest[-1])
    quantum = _find_quantum(levels)
    low = top
    while (
        low > 0
        and top - low < SPREAD_LEVELS
        and many[low - 1] >= MIN_SPREAD_SHARE * many[top]
        and levels[low] - levels[low - 1] < 1.5 * quantum
    ):
        low -= 1
    near = (levels < levels[low]) & (levels > levels[low] - (LEVELS_BELOW + 0.5) * quantum)
    clipped = int(many[low : top + 1].sum())
    return None if many[near].sum() > MAX_BELOW_SHARE * clipped else float(levels[low])


def _count_upper_levels(values: NDArray[np.generic]) -> tuple[FloatArray, IntArray]:
    """Different values in rising order and how many pixels have each; of the upper half alone."""
    flat = values.ravel()
    if values.dtype.kind == "u" and values.dtype.itemsize <= 2:
        many = np.bincount(flat)
        counts = np.flatnonzero(many)
        counts = counts[counts > 0.5 * (counts[0] + counts[-1])]
        return counts.astype(np.float64), many[counts].astype(np.int64)
    numbers = flat.astype(np.float64)
    middle = 0.5 * (float(numbers.min()) + float(numbers.max()))
    levels, many = np.unique(numbers[numbers > middle], return_counts=True)
    return levels, many.astype(np.int64)


def _find_quantum(levels: FloatArray) -> float:
    """The step that values are whole multiples of, as 257 of 8 bits that were spread over 16."""
    steps = np.diff(levels)
    if (steps == np.rint(steps)).all() and steps.max() < 2**53:
        return float(np.gcd.reduce(steps.astype(np.int64)))
    return float(steps.min())
