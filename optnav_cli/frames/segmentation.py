"""The bright parts of a picture: level and noise of the sky, a threshold, and what rises above it.

The threshold adapts to the picture: well above the sky's noise, and a small share of the way to the
lit ground's level, so that a faint cusp still belongs to the body and stray light does not.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from catalog.arrays import BoolArray, Float32Array, Int32Array, IntArray
from catalog.cache import Cache
from catalog.errors import NoSolutionError
from catalog.geometry.kernel import kernel
from optnav_cli.reasons import ReasonCode

BLOCK_PX = 16
SKY_QUANTILE = 0.05  # of the blocks' means: the darkest parts of the picture are sky or night
THRESHOLD_SIGMAS = 6.0
THRESHOLD_SHARE = 0.08  # of the way from the sky to the lit ground's level
ROUGH_SHARE = 0.15  # of the way to the brightest pixels: what is lit at first sight
MIN_CONTRAST_SIGMAS = 12.0
# Rounding to whole counts hides a smaller noise: the variance of a uniform step of 1.
ROUNDING_VARIANCE = 1.0 / 12.0
STEP = 2  # between the pixels that levels are measured from
HALO_PX = 6  # about a lit area its blur still shines
MAX_SMALL_SHARE = 0.1  # of the largest lit area: a smaller one is no second body
MAX_SMALL_AREAS = 500  # that are taken out, the largest first
MADE = 8  # things held that readers made of one picture
# Stripes: seen in strips so wide at two opposite edges, whose correlation must be so high; smeared
# pictures of 67P have 0.99.
STRIPE_PX, MIN_ALIKE_STRIPES = 4, 0.95


@dataclass(frozen=True)
class Levels:
    """Brightness levels of a picture, in its counts.

    sky, noise   mean of the sky and the scatter of its pixels
    bright       middle level of what is lit at first sight
    peak         highest mean of 3 x 3 pixels: no single hot pixel reaches it
    threshold    above it a pixel is lit
    """

    sky: float
    noise: float
    bright: float
    peak: float
    threshold: float


@dataclass(frozen=True, eq=False)
class Blobs:
    """Connected lit areas of a picture, the largest first.

    labels  (h, w) int32, 0 = not lit, else label of the blob
    label   (k,)   label of each blob
    area    (k,)   pixels
    box     (k, 4) left, top, width, height
    cut     (k,)   whether pixels without a value lie beside it; None where all have one
    """

    labels: Int32Array
    label: IntArray
    area: IntArray
    box: IntArray
    cut: BoolArray | None = None

    def __len__(self) -> int:
        return len(self.area)

    def is_at_border(self, number: int) -> bool:
        """Whether an area reaches the picture's edge, or pixels without a value."""
        if self.cut is not None and self.cut[number]:
            return True
        left, top, width, height = (int(value) for value in self.box[number])
        rows, cols = self.labels.shape
        return bool(left == 0 or top == 0 or left + width == cols or top + height == rows)


class Segmented:
    """A picture (h, w) whose levels and lit areas are made once, for all who ask for them.

    NaN stands for pixels without a value, which are neither lit nor sky.
    """

    def __init__(self, picture: Float32Array, levels: Levels | None = None) -> None:
        self._stated_levels = levels
        self.picture = np.ascontiguousarray(picture, dtype=np.float32)
        # what a reader makes of the picture, by its own key
        self.made: Cache[Hashable, Any] = Cache(MADE)

    @cached_property
    def levels(self) -> Levels:
        """The stated levels, else see `measure_levels`, also for what it raises."""
        return self._stated_levels or measure_levels(self.picture)

    @cached_property
    def blobs(self) -> Blobs:
        """The areas above the levels' threshold."""
        return find_lit_blobs(self.picture, self.levels.threshold)

    def raise_threshold(self, share: float) -> "Segmented":
        """The picture with a threshold no lower than a share of the way to the lit ground."""

        def make() -> Segmented:
            levels = self.levels
            least = levels.sky + share * (levels.bright - levels.sky)
            higher = replace(levels, threshold=max(levels.threshold, least))
            return Segmented(self.picture, higher)

        made: Segmented = self.made.get(("raised", share), make)
        return made

    def select_largest(self, least_pixels: int) -> "Segmented | None":
        """The picture without its small lit areas of so many pixels and more.

        Many small ones are burnt-in text, or stars. None where there is none, or where the second
        is so large that it may be another body.
        """
        blobs = self.blobs
        small = blobs.label[1:][blobs.area[1:] >= least_pixels][:MAX_SMALL_AREAS]
        if small.size == 0 or blobs.area[1] > MAX_SMALL_SHARE * blobs.area[0]:
            return None

        def make() -> Segmented:
            values = remove_blobs(self.picture, blobs, small.tolist(), self.levels.sky)
            return Segmented(values, self.levels)

        made: Segmented = self.made.get("largest alone", make)
        return made


def measure_levels(picture: Float32Array) -> Levels:
    """Levels of a picture (h, w), NaN where a pixel has no value.

    Raises NoSolutionError for a picture in which nothing stands out of the noise.
    """
    mean = _average_blocks(picture)
    sky_mean = float(np.quantile(mean, SKY_QUANTILE))
    sky, variance = _measure_sky(picture, sky_mean)
    noise = float(np.sqrt(max(variance, ROUNDING_VARIANCE)))
    peak = _find_peak(picture)
    if peak - sky < MIN_CONTRAST_SIGMAS * noise and mean.std() > max(0.25 * noise, 1.0):
        # pixels of noise alone average out in a block
        raise NoSolutionError(
            f"no limb in view: the picture is ground all over, about {float(mean.mean()):.0f} "
            "counts, with no sky that stands out; the body fills the picture",
            ReasonCode.NO_SKY,
        )
    if peak - sky < MIN_CONTRAST_SIGMAS * noise:
        raise NoSolutionError(
            f"no body in the picture: its brightest parts are {max(peak - sky, 0.0):.0f} counts "
            f"above a background of {sky:.0f} with a scatter of {noise:.1f}",
            ReasonCode.NO_BODY,
        )
    # the glint of opposition is several times brighter than the ground: the median is not
    sample = picture[::STEP, ::STEP]
    rough = sample[sample > sky + max(ROUGH_SHARE * (peak - sky), THRESHOLD_SIGMAS * noise)]
    bright = float(np.median(rough[:: 1 + rough.size // 10_000])) if rough.size else peak
    rise = max(THRESHOLD_SIGMAS * noise, THRESHOLD_SHARE * (bright - sky))
    return Levels(sky, noise, bright, peak, sky + rise)


def _average_blocks(picture: Float32Array) -> Float32Array:
    """Means of blocks; of those without gaps (k,) where the picture has pixels without a value."""
    height, width = picture.shape
    rows, cols = max(height // BLOCK_PX, 1), max(width // BLOCK_PX, 1)
    mean = np.asarray(cv2.resize(picture, (cols, rows), interpolation=cv2.INTER_AREA), np.float32)
    known = np.isfinite(mean)
    if known.all():
        return mean
    # gaps in every block: single pixels stand for them
    sample = picture[::STEP, ::STEP]
    return mean[known] if known.any() else sample[np.isfinite(sample)]


@kernel
def _measure_sky(picture: Float32Array, darkest: float) -> tuple[float, float]:
    """Mean and variance of the pixels that are sky, from the mean of the darkest blocks.

    Neighbouring blocks of the same level are sky too; the scatter inside the blocks shows it.
    """
    # of the pixels below, whose scatter no bright thing widens; all by row, as accurate as by pairs
    below, squares = 0, 0.0
    for r in range(0, picture.shape[0], STEP):
        count, total = 0, 0.0
        for c in range(0, picture.shape[1], STEP):
            above = picture[r, c] - darkest
            count += above <= 0.0
            total += above * above if above <= 0.0 else 0.0
        below, squares = below + count, squares + total
    reach = max(4.0 * np.sqrt(squares / max(below, 1)), 1.0)
    near, mean, squares = 0, 0.0, 0.0
    for r in range(0, picture.shape[0], STEP):
        count, first, second = 0, 0.0, 0.0
        for c in range(0, picture.shape[1], STEP):
            above = picture[r, c] - darkest
            count += abs(above) <= reach
            first += above if abs(above) <= reach else 0.0
            second += above * above if abs(above) <= reach else 0.0
        near, mean, squares = near + count, mean + first, squares + second
    if near == 0:
        return darkest, 0.0
    mean /= near
    return darkest + mean, max(squares / near - mean * mean, 0.0)


@kernel
def _find_peak(picture: Float32Array) -> float:
    """Highest mean of 3 x 3 pixels, those beyond the edge mirrored at it."""
    rows, cols = picture.shape
    line, highest = np.empty(cols), np.full(cols, -np.inf)
    for r in range(rows):
        above, below = min(abs(r - 1), rows - 1), r + 1 if r + 1 < rows else max(rows - 2, 0)
        for c in range(cols):
            line[c] = float(picture[above, c]) + picture[r, c] + picture[below, c]
        # of each column, so that no pixel waits for the one before it
        for c in range(1, cols - 1):
            mean = line[c - 1] + line[c] + line[c + 1]
            highest[c] = mean if mean > highest[c] else highest[c]
        first, last = min(1, cols - 1), max(cols - 2, 0)
        # no max(): pixels without a value are NaN
        mean = line[0] + 2.0 * line[first]
        highest[0] = mean if mean > highest[0] else highest[0]
        mean = line[cols - 1] + 2.0 * line[last]
        highest[cols - 1] = mean if mean > highest[cols - 1] else highest[cols - 1]
    return float(np.float32(highest.max() / 9.0))


def find_lit_blobs(picture: Float32Array, threshold: float) -> Blobs:
    """Areas of a picture (h, w) above a threshold, joined over corners."""
    mask = (picture > threshold).view(np.uint8)
    # not connectedComponentsWithStats: it takes eight times as long
    count, components = cv2.connectedComponents(mask, connectivity=8)
    labels = np.asarray(components, np.int32)
    area, box = _measure_sizes(labels, count)
    order = np.argsort(-area, kind="stable")
    gaps = np.isnan(picture)
    cut = None
    if gaps.any():
        beside = cv2.dilate(gaps.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
        touched = np.zeros(count, np.bool_)
        touched[labels[beside]] = True
        cut = touched[order + 1]
    return Blobs(labels, order + 1, area[order], box[order], cut)


@kernel
def _measure_sizes(labels: Int32Array, count: int) -> tuple[IntArray, IntArray]:
    """Area (k,) and box (k, 4: left, top, width, height) of the labels from 1 to count - 1."""
    rows, cols = labels.shape
    area, box = np.zeros(count, np.int64), np.zeros((count, 4), np.int64)
    box[:, 0], box[:, 1] = cols, rows
    for r in range(rows):
        line, c = labels[r], 0
        while c < cols:
            label, first = line[c], c
            while c < cols and line[c] == label:
                c += 1
            area[label] += c - first
            box[label, 0], box[label, 1] = min(box[label, 0], first), min(box[label, 1], r)
            box[label, 2], box[label, 3] = max(box[label, 2], c), r + 1
    box[:, 2:] -= box[:, :2]
    return area[1:], box[1:]


def remove_smear(picture: Float32Array, levels: Levels) -> Float32Array | None:
    """A picture (h, w) without the stripes of a bright body's columns, or rows; None: it has none.

    A sensor without a shutter collects light while it is read, so that a body leaves stripes over
    all pixels that pass it, stronger on one side than on the other. They are taken for as strong as
    on the stronger one: the sky beside the body ends dark, the body is darker than it was.
    """
    for values in (picture, picture.T):
        strips = np.stack([values[:STRIPE_PX], values[-STRIPE_PX:]])
        ends = np.asarray(np.median(strips, axis=1), np.float32) - np.float32(levels.sky)
        weaker = ends.min(axis=0)
        lit = weaker > levels.threshold - levels.sky
        if not lit.any() or lit.all() or not np.ptp(ends, axis=1).all():
            continue
        if np.corrcoef(ends)[0, 1] < MIN_ALIKE_STRIPES:
            continue
        darkest = np.nanquantile(values[:, lit], 0.02, axis=0) - levels.sky
        if np.median(darkest) < 0.5 * np.median(weaker[lit]):
            continue  # two edges cut lit ground, with sky between
        strength = cv2.GaussianBlur(ends.max(axis=0)[None], (0, 0), 1.0)
        # stripes shift by a pixel where the body's edge leans
        strength = cv2.dilate(strength.astype(np.float32), np.ones((1, 5), np.uint8))
        darkest_sky = min(levels.sky, float(np.nanmin(values)))
        left = np.maximum(values - np.maximum(strength, 0.0), darkest_sky)
        return np.ascontiguousarray(left if values is picture else left.T, dtype=np.float32)
    return None


def remove_blobs(
    picture: Float32Array, blobs: Blobs, labels: Sequence[int], sky: float
) -> Float32Array:
    """A picture (h, w) with the sky's level in place of some lit areas and of their blur."""
    filled = picture.copy()
    wide = np.ones((2 * HALO_PX + 1, 2 * HALO_PX + 1), dtype=np.uint8)
    for number in np.flatnonzero(np.isin(blobs.label, labels)):
        left, top, width, height = (int(value) for value in blobs.box[number])
        rows = slice(max(top - HALO_PX, 0), top + height + HALO_PX)
        cols = slice(max(left - HALO_PX, 0), left + width + HALO_PX)
        mask = blobs.labels[rows, cols] == blobs.label[number]
        filled[rows, cols][cv2.dilate(mask.view(np.uint8), wide) > 0] = sky
    return filled
