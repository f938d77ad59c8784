"""What a picture of a lit cylinder gives: mean brightness of each column, height of the lit ones.

The lit part is what stands out of the background. Brightness is averaged over the middle half of
its rows, so that the curved ends of the strip do not matter; the height of a column is the distance
between the places where it passes half its brightness.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.estimation.robust import MAD_TO_SIGMA
from optnav_cli.reasons import ReasonCode

SMOOTH_PX = 3  # side of the box that noise is averaged over before the lit part is sought
BRIGHT_PX = 60  # the brightness of the lit part is that of its brightest so many pixels
LIT_SHARE, LIT_SIGMAS = 0.25, 6.0  # of that brightness, and over the background's noise
PRINTED_SHARE = 0.1  # of the brightness, where the printed formulas take the edge of the lit area
MIN_LIT_PX = 24
RIVAL_SHARE = 0.2  # of the lit area: as much of another body is one
MIN_COUNTS = 60.0  # of the lit part: of less, noise does not hide rounding to whole counts
SATURATED_SHARE = 0.02  # of a column's rows at full scale: its brightness is more than measured
MAX_SATURATED = 0.9  # of the lit columns: the others are too few to tell from where the light falls
HEIGHT_SHARE = 0.35  # of the brightest column: darker ones give no height
OUTER = 0.4  # of the height from its middle: as far as bands reach that tell how ends are lit
MIN_BANDED_PX = 40  # of the height, from where on the bands have rows enough
HEIGHT_FLOOR_PX = 0.06  # error of a height besides noise: pixel phase, blur that is not symmetric


@dataclass(frozen=True, eq=False)
class CylinderProfile:
    """Measurements of a picture.

    columns     (n,) px;  brightness (n,) mean over `rows`, background taken off;  sigma (n,), which
                tells nothing of a column where pixels are at full scale
    heights     (m,) px, of `height_columns` (m,);  height_sigma (m,)
    tops        (m,) rows of their upper ends
    rows        first and last row of the mean
    bright      brightness of the lit part;  noise of a pixel beside it, 1 sigma
    lit         (n,) whether a column stands out of the background
    cut         which sides of the picture the lit part touches, in words
    """

    columns: FloatArray
    brightness: FloatArray
    sigma: FloatArray
    lit: BoolArray
    height_columns: FloatArray
    heights: FloatArray
    height_sigma: FloatArray
    tops: FloatArray
    rows: tuple[int, int]
    bright: float
    noise: float
    cut: tuple[str, ...]

    @property
    def cuts_height(self) -> bool:
        """Whether an end of the strip lies outside the picture."""
        return "top" in self.cut or "bottom" in self.cut


def measure_profile(values: Float32Array, saturation: float | None) -> CylinderProfile:
    """Measure a picture (rows, columns) of a lit cylinder before a darker background.

    saturation  the highest value that it can hold; None for no limit
    Raises NoSolutionError where nothing stands out, or too little, or more than one body.
    """
    background, noise = _estimate_background(values)
    smooth = cv2.blur(values, (SMOOTH_PX, SMOOTH_PX)) - background
    flat = smooth.ravel()
    bright = float(np.partition(flat, flat.size - BRIGHT_PX)[flat.size - BRIGHT_PX])
    threshold = max(LIT_SHARE * bright, LIT_SIGMAS * noise / SMOOTH_PX)
    if not bright > 1.5 * LIT_SIGMAS * noise / SMOOTH_PX:
        raise NoSolutionError("nothing in the picture stands out", ReasonCode.NO_BODY)
    if bright < MIN_COUNTS:
        raise NoSolutionError(
            f"the lit part is {bright:.0f} counts brighter than what is behind it; wanted "
            f"{MIN_COUNTS:.0f}, so that rounding to whole counts plays no part: expose longer",
            ReasonCode.BAD_PICTURE,
        )
    left, top, width, height = _find_lit_box(smooth > threshold)
    rows = top + height // 4, max(top + height - height // 4, top + height // 4 + 1)
    band = values[rows[0] : rows[1]] - background
    brightness = band.mean(axis=0, dtype=np.float64)
    sigma = _estimate_sigmas(band, noise)
    full = np.zeros(brightness.size, bool)
    if saturation is not None:
        full = (band >= saturation - 0.5 - background).mean(axis=0) > SATURATED_SHARE
    sigma[full] = bright
    share = float(full[brightness > threshold].mean())
    if share > MAX_SATURATED:
        raise NoSolutionError(
            f"{100.0 * share:.0f} % of the lit columns are at full scale: overexposed",
            ReasonCode.BAD_PICTURE,
        )
    cut = _find_cut_sides(brightness, band, (left, top, width, height), values.shape, threshold)
    box = slice(left, left + width)
    level = float(np.quantile(brightness[box], 0.97))
    inside = np.zeros(brightness.size, bool)
    inside[box] = brightness[box] > HEIGHT_SHARE * level
    columns = np.flatnonzero(inside)
    levels = brightness + _estimate_end_offsets(values - background, brightness, (top, height))
    ends = [
        _find_ends(values[:, c].astype(np.float64) - background, levels[:, c], rows)
        for c in columns
    ]
    spans = np.array(ends, np.float64).reshape(-1, 2)
    is_uncut = "top" not in cut and "bottom" not in cut
    kept = np.isfinite(spans).all(axis=1) & is_uncut & ~full[columns]
    # the slope of an edge blurred by a pixel is 0.4 of its height a pixel; a height has two
    noises = np.sqrt(2.0) * noise / (0.4 * np.maximum(brightness[columns], 1e-9))
    return CylinderProfile(
        np.arange(brightness.size, dtype=np.float64),
        brightness,
        sigma,
        brightness > threshold,
        columns[kept].astype(np.float64),
        (spans[:, 1] - spans[:, 0])[kept],
        np.hypot(noises, HEIGHT_FLOOR_PX)[kept],
        spans[kept, 0],
        rows,
        bright,
        noise,
        cut,
    )


def measure_printed_extent(profile: CylinderProfile) -> tuple[float, float]:
    """Measure height of the tallest column and width of the lit area, px, for printed formulas."""
    if not profile.heights.size:
        raise NoSolutionError("the lit area is cut, so it has no height", ReasonCode.OUTSIDE_FRAME)
    if {"left", "right"} & set(profile.cut):
        raise NoSolutionError("the lit area is cut, so it has no width", ReasonCode.OUTSIDE_FRAME)
    above = np.flatnonzero(profile.brightness > PRINTED_SHARE * profile.bright)
    first, last = int(above[0]), int(above[-1])
    level, values = PRINTED_SHARE * profile.bright, profile.brightness
    start = _find_crossing(values, first, -1, level) if first > 0 else first - 0.5
    end = _find_crossing(values, last, 1, level) if last < values.size - 1 else last + 0.5
    return float(np.quantile(profile.heights, 0.97)), end - start


def _find_crossing(values: FloatArray, inside: int, step: int, level: float) -> float:
    """Find where values pass a level between a place above it and its neighbour."""
    high, low = values[inside], values[inside + step]
    share = (high - level) / (high - low) if high > low else 0.5
    return inside + step * float(np.clip(share, 0.0, 1.0))


def _estimate_background(values: Float32Array) -> tuple[float, float]:
    """Estimate level and noise behind the cylinder, by the darker part of the picture."""
    coarse = cv2.resize(values, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
    dark = coarse <= np.quantile(coarse, 0.3)
    level = float(np.median(coarse[dark]))
    steps = np.diff(values, axis=1)
    mask = cv2.resize(dark.astype(np.uint8), values.shape[::-1], interpolation=cv2.INTER_NEAREST)
    quiet = steps[mask[:, 1:] > 0]
    noise = MAD_TO_SIGMA * float(np.median(np.abs(quiet))) / np.sqrt(2.0)
    return level, max(noise, 0.3)  # counts are whole numbers


def _find_lit_box(lit: BoolArray) -> tuple[int, int, int, int]:
    """Find left, top, width and height of the largest lit part. Raises NoSolutionError."""
    count, _, stats, _ = cv2.connectedComponentsWithStats(lit.astype(np.uint8), connectivity=8)
    areas = stats[1:count, cv2.CC_STAT_AREA]
    if not areas.size or areas.max() < MIN_LIT_PX:
        raise NoSolutionError("no lit body in the picture", ReasonCode.NO_BODY)
    order = np.argsort(areas)[::-1]
    if len(order) > 1 and areas[order[1]] > max(RIVAL_SHARE * areas[order[0]], MIN_LIT_PX):
        raise NoSolutionError(
            f"two bodies stand out of the background, of {areas[order[0]]} and "
            f"{areas[order[1]]} px; wanted the cylinder alone",
            ReasonCode.SEVERAL_BODIES,
        )
    left, top, width, height, _ = (int(number) for number in stats[1 + order[0]])
    return left, top, width, height


def _estimate_sigmas(band: Float32Array, noise: float) -> FloatArray:
    """Estimate errors (n,) of the means of columns of a band, by how its rows differ."""
    count = len(band)
    if count < 4:
        return np.full(band.shape[1], noise / np.sqrt(count))
    variance = 0.5 * np.square(np.diff(band, axis=0)).mean(axis=0, dtype=np.float64)
    # noise is about the same in neighbouring columns, and its estimate is noisy itself
    smooth = cv2.blur(variance[None], (9, 1))[0]
    sigmas: FloatArray = np.sqrt(np.maximum(smooth, noise**2) / count)
    return sigmas


def _find_cut_sides(
    brightness: FloatArray,
    band: Float32Array,
    box: tuple[int, int, int, int],
    shape: tuple[int, ...],
    threshold: float,
) -> tuple[str, ...]:
    left, top, width, height = box
    sides = []
    if top <= 1:
        sides.append("top")
    if top + height >= shape[0] - 1:
        sides.append("bottom")
    if left <= 1 and brightness[:2].max() > threshold:
        sides.append("left")
    if left + width >= shape[1] - 1 and brightness[-2:].max() > threshold:
        sides.append("right")
    return tuple(sides)


def _estimate_end_offsets(
    values: Float32Array, brightness: FloatArray, span: tuple[int, int]
) -> FloatArray:
    """Estimate how much brighter the strip is at its upper and lower ends than in the mean (2, n).

    Gloss shines on the middle: with half the mean for the level of its ends, a strip under a gloss
    of a fifth comes out 0.07 px too short. A parabola through two bands beside the middle half
    leads to the ends. span: first row and rows of the lit part
    """
    top, height = span
    if height < MIN_BANDED_PX:
        return np.zeros((2, brightness.size))
    outer, inner = round((0.5 - OUTER) * height), height // 4
    upper = values[top + outer : top + inner].mean(axis=0, dtype=np.float64) - brightness
    end = top + height
    lower = values[end - inner : end - outer].mean(axis=0, dtype=np.float64) - brightness
    # means of the squares of rows from the middle, in heights: of the middle half, and of the bands
    half, bands = 0.25**2 / 3.0, (OUTER**3 - 0.25**3) / (3.0 * (OUTER - 0.25))
    even = 0.5 * (upper + lower) * (0.25 - half) / (bands - half)
    odd = 0.5 * (upper - lower) * 0.5 / (0.5 * (OUTER + 0.25))
    return np.array([even + odd, even - odd])


def _find_ends(
    column: FloatArray, levels: FloatArray, rows: tuple[int, int]
) -> tuple[float, float]:
    """Find the rows where a column passes half its level at either end; NaN for none."""
    up = _find_first_below(column[: rows[0] + 1][::-1], 0.5 * float(levels[0]))
    down = _find_first_below(column[rows[1] - 1 :], 0.5 * float(levels[1]))
    return rows[0] - up, rows[1] - 1 + down


def _find_first_below(values: FloatArray, half: float) -> float:
    """Find how far into values (n,) they fall through a level, by a line between two pixels."""
    below = values < half
    # noise may dip one pixel of the strip below the level: two in a row are its end
    both = np.flatnonzero(below[:-1] & below[1:])
    if not both.size or both[0] == 0:
        return float("nan")
    first = int(both[0])
    high, low = float(values[first - 1]), float(values[first])
    return first - 1 + (high - half) / (high - low) if high > low else first - 0.5
