"""A sample of a terrain model's heights, and a value in it that stands for no data without a tag.

Such a value is the lowest or the highest, many pixels share it exactly, and a gap parts it from all
ground: -9999 below heights about 0, or 0 above heights about -3000. Ground is continuous: flat
floors, lakes and clipped models share an extreme, too, but heights next to it follow.
"""

from typing import NamedTuple

import numpy as np

from catalog.arrays import Float32Array

SAMPLE_PIXELS = 4_000_000  # of a model; of a larger one every second, third ... of a row and column
MIN_SHARED = 8  # pixels: real heights that stand alone are never equal so often
MIN_OTHERS = 64  # pixels
MIN_LEVELS = 16  # heights that differ: fewer are no ground but a drawing of steps
# Pixels between the value and the ground that are passed: resampling mixes both along borders.
MIXED_OF_SHARED, MIXED_OF_OTHERS = 0.1, 0.01
MIN_GAP_SPREAD = 0.1  # gap over the spread of all other heights
MIN_GAP_STEPS = 4.0  # gap over the usual step from one height to the next: coarse counts have such
# One of three: gap over the posting (56 deg) along all of a border; gap over the spread; or the gap
# to the very next height over the mean step between the TAIL heights that follow it.
MIN_GAP_SLOPE, MIN_GAP_ALL, MIN_GAP_TAIL, TAIL = 1.5, 1.0, 10.0, 32


class SharedEnd(NamedTuple):
    """One lowest or highest height that stands off from the others, m.

    share  of the sampled pixels that have it
    gap    to the others
    """

    height: float
    share: float
    gap: float
    lowest: bool


class HeightSample:
    """Heights, m, of every so many pixels of a model of rows x cols pixels."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.step = int(np.ceil(np.sqrt(max(1.0, shape[0] * shape[1] / SAMPLE_PIXELS))))
        self._parts: list[Float32Array] = []

    def add(self, heights: Float32Array) -> None:
        """Add some of a window (rows, cols) of heights, NaN for none."""
        self.add_thinned(heights[:: self.step, :: self.step])

    def add_thinned(self, heights: Float32Array) -> None:
        """Add all heights of a window that has every `step`-th row and column."""
        self._parts.append(heights[np.isfinite(heights)])

    @property
    def heights(self) -> Float32Array:
        """All that was added, in one row."""
        return np.concatenate(self._parts) if self._parts else np.empty(0, np.float32)


def find_shared_end(heights: Float32Array, posting_m: float) -> SharedEnd | None:
    """Find a value that stands for no data among heights (n,), m; None without one."""
    if heights.size < MIN_SHARED + MIN_OTHERS:
        return None
    for sign in (1.0, -1.0):
        signed = heights * np.float32(sign)
        end = float(signed.min())
        others = signed[signed > end]
        shared = signed.size - others.size
        if shared < MIN_SHARED or others.size < MIN_OTHERS:
            continue
        gap = _measure_gap(end, others, shared, posting_m)
        if gap is not None:
            return SharedEnd(sign * end, shared / signed.size, gap, sign > 0.0)
    return None


def _measure_gap(end: float, others: Float32Array, shared: int, posting_m: float) -> float | None:
    """Gap between an extreme and all others above it, m; None for one that ground may have."""
    mixed = int(min(MIXED_OF_SHARED * shared, MIXED_OF_OTHERS * others.size))
    top = others.size - 1 - int(MIXED_OF_OTHERS * others.size)
    ordered = np.partition(others, (TAIL, mixed, top))
    nearest, spread = float(ordered[mixed]), float(ordered[top]) - float(ordered[mixed])
    gap = nearest - end
    if gap < MIN_GAP_SPREAD * spread:
        return None
    first = float(ordered[: TAIL + 1].min())
    apart = first - end >= MIN_GAP_TAIL * (float(ordered[TAIL]) - first) / TAIL
    apart = apart and first - end >= MIN_GAP_SPREAD * spread
    if not (apart or gap >= MIN_GAP_SLOPE * posting_m or gap >= MIN_GAP_ALL * spread):
        return None
    levels = np.unique(others)
    if levels.size < MIN_LEVELS or gap < MIN_GAP_STEPS * float(np.median(np.diff(levels))):
        return None
    return gap
