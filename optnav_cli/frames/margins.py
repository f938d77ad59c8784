"""Margins of a picture that hold one constant value: the mask of a sensor, lines that were lost.

Ours. Vidicon cameras and resampled pictures have margins, straight or ragged, and lost lines have
blocks, of one dark value. They are told from a sky without noise in two ways: the sky that the
picture shows has other values; or bright ground ends at a margin's straight edge from one pixel to
the next, which no limb does, for limbs are blurred.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import BoolArray, ByteArray, FloatArray

# Of one value along a row or column: noise makes no such run; odd, so that it has a middle.
RUN_PX = 33
# Dark is what lies so near to the margin's value, of the way to bright ground.
DARK_SHARE = 0.25
# The sky that is no margin: so much of the picture; of it so few pixels have the margin's value,
# and so many lie so near to its middle. Dark ground at a terminator spreads evenly over dark.
MIN_SKY_SHARE, MAX_SAME_SHARE, MIN_FLAT_SHARE, FLAT_SHARE = 0.02, 0.02, 0.6, 0.04
# Along a margin's straight edge so much of the first line is bright, and so bright by the fourth.
MIN_LIT_SHARE, MIN_STEP_SHARE, BEHIND_PX = 0.5, 0.7, 3
STEP = 7  # between the pixels that levels are measured from


def find_margins(values: NDArray[np.generic], missing: BoolArray | None) -> BoolArray | None:
    """Mark margins and lost lines of one dark value; None where none are.

    values   (h, w) counts;  missing  (h, w) pixels that are known to have no value
    """
    if min(values.shape) <= RUN_PX:
        return None
    inside = np.ones(values[::STEP, ::STEP].shape, np.bool_)
    if missing is not None:
        inside = ~missing[::STEP, ::STEP]
    sample = values[::STEP, ::STEP][inside].astype(np.float64)
    if sample.size == 0:
        return None
    low, bright = (float(level) for level in np.quantile(sample, (0.01, 0.995)))
    for value in _list_candidates(values, float(sample.min())):
        if not value <= low + 0.1 * (bright - low) < bright:
            continue
        dark = value + DARK_SHARE * (bright - value)
        same = np.asarray(values == value)
        if missing is not None:
            same &= ~missing
        margin = _find_straight(values, same, dark)
        if _is_no_sky(sample[sample != value], sample.size, dark, bright - value):
            margin |= _find_ragged(values, same, sample.size, dark, bright - value)
        if margin.any():
            return margin
    return None


def _list_candidates(values: NDArray[np.generic], lowest: float) -> list[float]:
    """The lowest value, and those of several corners and middles of the border, darkest first."""
    height, width = values.shape
    rows, columns = (0, height // 2, height - 1), (0, width // 2, width - 1)
    places = [float(values[r, c]) for r in rows for c in columns if (r, c) != (rows[1], columns[1])]
    several = {value for value in places if places.count(value) > 1}
    return sorted(several | {lowest})[:2]


def _find_straight(values: NDArray[np.generic], same: BoolArray, dark: float) -> BoolArray:
    """Whole lines at the border of one value, behind which bright ground begins at once."""
    margin = np.zeros(same.shape, np.bool_)
    for marked, lines, shown in _iterate_sides(same, values, margin):
        full = np.asarray(marked.all(axis=1), np.bool_)
        count = len(full) if full.all() else int(np.argmin(full))
        if not 0 < count < len(full) - BEHIND_PX:
            continue
        first = lines[count].astype(np.float64)
        behind = lines[count + BEHIND_PX].astype(np.float64)
        lit = first > dark
        if lit.mean() > MIN_LIT_SHARE and np.median(first[lit]) > MIN_STEP_SHARE * np.median(
            behind[lit]
        ):
            shown[:count] = True
    return margin


def _iterate_sides(
    same: BoolArray, values: NDArray[np.generic], margin: BoolArray
) -> Iterator[tuple[BoolArray, NDArray[np.generic], BoolArray]]:
    """Views of three pictures, the lines of each side of the border first."""
    for turned in ((same, values, margin), (same.T, values.T, margin.T)):
        yield turned
        yield turned[0][::-1], turned[1][::-1], turned[2][::-1]


def _find_ragged(
    values: NDArray[np.generic], same: BoolArray, count: int, dark: float, span: float
) -> BoolArray:
    """Pixels in long runs of one value along rows or columns that are not the sky."""
    pixels: ByteArray = same.astype(np.uint8)
    runs = np.zeros_like(pixels)
    for shape in ((1, RUN_PX), (RUN_PX, 1)):
        opened = cv2.morphologyEx(
            pixels,
            cv2.MORPH_OPEN,
            np.ones(shape, np.uint8),
            borderType=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
        runs |= np.asarray(opened, np.uint8)
    margin: BoolArray = (runs & pixels) > 0
    left = values[::STEP, ::STEP][~margin[::STEP, ::STEP]].astype(np.float64)
    return margin if _is_no_sky(left, count, dark, span) else np.zeros(same.shape, np.bool_)


def _is_no_sky(left: FloatArray, count: int, dark: float, span: float) -> bool:
    """Whether pixels beside a margin (n,), of a sample of a count, show a sky of other values."""
    value = dark - DARK_SHARE * span
    sky = left[left < dark]
    if sky.size < MIN_SKY_SHARE * count:
        return False
    flat = np.abs(sky - np.median(sky)) < FLAT_SHARE * span
    return bool(
        (np.abs(sky - value) < 1e-9 * max(span, 1.0)).mean() < MAX_SAME_SHARE
        and flat.mean() > MIN_FLAT_SHARE
    )
