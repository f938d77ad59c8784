"""Spots of light that may be stars: where they stand, how bright they are.

A background by medians of blocks, a threshold in the smoothed picture, and a Gaussian-windowed
centroid, iterated (as XWIN_IMAGE of E. Bertin's SExtractor): the plain moment is drawn to the
middle of a pixel and to whatever else lies about. What is large is a body; spots at its rim and in
its glare are left out.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import BoolArray, Float32Array, FloatArray, IntArray

BLOCK_PX = 32  # of the background
SMOOTH_PX, THRESHOLD_SIGMAS = 1.0, 5.0
MIN_PIXELS, MAX_STAR_PX = 4, 13  # a spot's pixels, and its longer side
MIN_BODY_PX = 25  # across: larger than the picture of any star
BODY_MARGIN_PX = 12
MIN_LIT_SHARE = 0.05  # of a disc: a crescent is wider up to a phase of 150 deg
TRAIL_RATIO, MIN_TRAIL_PX = 2.2, 5.0
# Of the middle pixel's light, in the eight about it; a hot pixel has none.
MIN_NEIGHBOUR_SHARE = 0.3
WINDOW_SIGMA_PX, WINDOW_PX, STEPS = 1.2, 4, 12
MAX_SPOTS = 60
BRIGHT_SPOTS, MAX_BRIGHT_SPOTS = 12, 30  # that triples are made of, in narrow and wide fields
LARGE_SPOTS = 16  # the same for a catalog so large that it is indexed
BLUR_SIGMA_PX = 1.1  # of a star's picture, for the noise of a centroid


@dataclass(frozen=True, eq=False)
class StarSpots:
    """Spots of a picture, the brightest first.

    pixels    (n, 2) x, y;  light (n,) over the background;  sigma_px (n,) of a coordinate by noise
    n_trails  spots that were left out because they are drawn out
    n_hot     single hot pixels that were left out
    body      share of the picture that large lit areas take
    """

    pixels: FloatArray
    light: FloatArray
    sigma_px: FloatArray
    n_trails: int
    n_hot: int
    body: float

    def __len__(self) -> int:
        return len(self.pixels)

    def describe_rejects(self) -> str:
        """Describe trails, hot pixels and lit bodies, as the end of a sentence."""
        parts = []
        if self.n_trails:
            are = "1 spot is" if self.n_trails == 1 else f"{self.n_trails} spots are"
            parts.append(f"{are} drawn out: trailed stars")
        if self.n_hot:
            hot = "1 is a single hot pixel" if self.n_hot == 1 else f"{self.n_hot} are hot pixels"
            parts.append(hot)
        if self.body > 0.02:
            parts.append(f"a lit body and its glare take {100.0 * self.body:.0f} % of the picture")
        return f"; {'; '.join(parts)}" if parts else ""


def find_spots(picture: Float32Array, saturation: float | None = None) -> StarSpots:
    """Find the spots of a picture (h, w) that look like stars.

    Pixels without a value are NaN; a spot whose window reaches one is left out.
    """
    gaps = np.isnan(picture)
    holed = bool(gaps.any())
    if holed:
        picture = np.where(gaps, np.nanmedian(picture), picture)
    over = picture - _estimate_background(picture)
    over[gaps] = 0.0
    smooth = cv2.GaussianBlur(over, (0, 0), SMOOTH_PX)
    body = _find_bodies(picture, over, _estimate_noise(smooth, ~gaps), saturation)
    share = float(body.mean())
    if holed:
        wide = np.ones((2 * WINDOW_PX + 1, 2 * WINDOW_PX + 1), np.uint8)
        body = body | (cv2.dilate(gaps.view(np.uint8), wide) > 0)
    # relief of a lit body is no noise: with a third of the picture it would count 1.6 times
    sigma, noise = _estimate_noise(smooth, ~body), _estimate_noise(over, ~body)
    lit = (smooth > THRESHOLD_SIGMAS * sigma) & ~body
    count, labels, stats, _ = cv2.connectedComponentsWithStats(lit.astype(np.uint8))
    del labels
    centroids: list[tuple[float, float, float]] = []
    trails = hot = 0
    for number in range(1, count):
        left, top, width, height, area = (int(v) for v in stats[number])
        longest = max(width, height)
        if area < MIN_PIXELS:
            continue
        part = np.asarray(smooth[top : top + height, left : left + width], np.float32)
        ratio, length = _measure_elongation(part * (part > THRESHOLD_SIGMAS * sigma))
        if ratio > TRAIL_RATIO and length > MIN_TRAIL_PX:
            trails += 1
            continue
        if longest > MAX_STAR_PX:
            continue
        r, c = np.unravel_index(int(np.argmax(part)), part.shape)
        x, y = left + int(c), top + int(r)
        if _is_touching(body, x, y, picture.shape):
            continue
        if _is_hot(over, x, y):
            hot += 1
            continue
        centred = _locate_centroid(over, float(x), float(y))
        if centred is not None:
            centroids.append(centred)
    centroids.sort(key=lambda spot: -spot[2])
    table = np.array(centroids[:MAX_SPOTS]).reshape(-1, 3)
    # a centroid's noise of a Gaussian spot over white noise, with its window
    by_noise = noise * np.sqrt(8.0 * np.pi) * BLUR_SIGMA_PX**2 / np.maximum(table[:, 2], 1e-9)
    return StarSpots(table[:, :2], table[:, 2], by_noise, trails, hot, share)


def _estimate_noise(over: NDArray[Any], sky: BoolArray) -> float:
    """Estimate 1 sigma of a picture (h, w) less its background, where it shows the sky."""
    sample = np.abs(over[::3, ::3][sky[::3, ::3]])
    return max(1.4826 * float(np.median(sample)), 1e-6) if sample.size else 1e-6


def _estimate_background(picture: Float32Array) -> Float32Array:
    """Estimate the background by medians of blocks of every other pixel, interpolated."""
    rows, cols = (max(1, side // BLOCK_PX) for side in picture.shape)
    tall, wide = picture.shape[0] // rows, picture.shape[1] // cols
    part = picture[: rows * tall, : cols * wide].reshape(rows, tall, cols, wide)
    thin = part[:, ::3, :, ::3].transpose(0, 2, 1, 3).reshape(rows, cols, -1)
    blocks = np.median(thin, axis=2).astype(np.float32)
    if min(blocks.shape) >= 3:
        blocks = cv2.medianBlur(blocks, 3).astype(np.float32, copy=False)
    size = picture.shape[1], picture.shape[0]
    return np.asarray(cv2.resize(blocks, size, interpolation=cv2.INTER_LINEAR), np.float32)


def _find_bodies(
    picture: Float32Array, over: Float32Array, sigma: float, saturation: float | None
) -> BoolArray:
    """Find large lit areas, with a margin: (h, w)."""
    sky = float(np.median(picture[::4, ::4]))
    highest = float(picture.max())
    level = sky + max(20.0 * sigma, 0.1 * (min(highest, saturation or highest) - sky))
    lit = ((picture > level) | (over > 20.0 * sigma)).astype(np.uint8)
    # opening takes away stars, whose pictures are small
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (MIN_BODY_PX, MIN_BODY_PX))
    small = cv2.resize(lit, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    opened = cv2.morphologyEx(small, cv2.MORPH_OPEN, kernel[::4, ::4])
    body = np.zeros(picture.shape, bool)
    if opened.any():
        count, labels = cv2.connectedComponents(lit)
        up = cv2.resize(opened, picture.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        chosen = np.zeros(count, bool)
        chosen[np.unique(labels[up])] = True
        chosen[0] = False
        body = chosen[labels] | up
        wide = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * BODY_MARGIN_PX + 1,) * 2)
        body = cv2.dilate(_cover_night_side(body), wide) > 0
    covered: BoolArray = body
    return covered


def _cover_night_side(body: BoolArray) -> NDArray[np.uint8]:
    """Cover the discs that lit areas are part of: sunlit peaks stand beyond a terminator."""
    covered = body.astype(np.uint8)
    contours, _ = cv2.findContours(covered, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    for contour in contours:
        (x, y), radius = cv2.minEnclosingCircle(contour)
        # a rod of the ship is part of no disc
        if cv2.contourArea(contour) > MIN_LIT_SHARE * np.pi * radius**2:
            cv2.circle(covered, (round(x), round(y)), round(radius), 1, -1)
    return covered


def _is_touching(body: BoolArray, x: int, y: int, shape: tuple[int, ...]) -> bool:
    """Whether a spot's window leaves the picture or reaches a body."""
    r, rows, cols = WINDOW_PX, shape[0], shape[1]
    if x < r or y < r or x >= cols - r or y >= rows - r:
        return True
    return bool(body[y - r : y + r + 1, x - r : x + r + 1].any())


def _measure_elongation(part: Float32Array) -> tuple[float, float]:
    """Measure longer by shorter axis of light (h, w), and the longer one's full length, px."""
    rows, cols = np.mgrid[: part.shape[0], : part.shape[1]]
    total = max(float(part.sum()), 1e-9)
    x, y = float((part * cols).sum()) / total, float((part * rows).sum()) / total
    xx = float((part * (cols - x) ** 2).sum()) / total + 1.0 / 12.0
    yy = float((part * (rows - y) ** 2).sum()) / total + 1.0 / 12.0
    xy = float((part * (cols - x) * (rows - y)).sum()) / total
    shorter, longer = np.linalg.eigvalsh(np.array([[xx, xy], [xy, yy]]))
    return float(np.sqrt(longer / max(shorter, 1e-9))), float(4.0 * np.sqrt(longer))


def _is_hot(over: Float32Array, x: int, y: int) -> bool:
    patch = over[y - 1 : y + 2, x - 1 : x + 2]
    middle = float(patch.max())
    return float(patch.sum()) - middle < MIN_NEIGHBOUR_SHARE * middle


def _locate_centroid(over: Float32Array, x: float, y: float) -> tuple[float, float, float] | None:
    """Locate a spot and sum its light; None where the centroid runs away."""
    c0, r0 = round(x), round(y)
    window = over[r0 - WINDOW_PX : r0 + WINDOW_PX + 1, c0 - WINDOW_PX : c0 + WINDOW_PX + 1]
    patch = window.astype(np.float64)
    side = np.arange(-WINDOW_PX, WINDOW_PX + 1, dtype=np.float64)
    dx = dy = 0.0
    light = 0.0
    for _ in range(STEPS):
        wx = np.exp(-0.5 * ((side - dx) / WINDOW_SIGMA_PX) ** 2)
        wy = np.exp(-0.5 * ((side - dy) / WINDOW_SIGMA_PX) ** 2)
        weighted = patch * np.outer(wy, wx)
        light = float(weighted.sum())
        if light <= 0.0:
            return None
        # twice the moment: window and spot of one width halve a shift
        step_x = 2.0 * float((weighted.sum(axis=0) * (side - dx)).sum()) / light
        step_y = 2.0 * float((weighted.sum(axis=1) * (side - dy)).sum()) / light
        dx, dy = dx + step_x, dy + step_y
        if max(abs(dx), abs(dy)) > 2.0:
            return None
        if max(abs(step_x), abs(step_y)) < 1e-3:
            break
    return c0 + dx, r0 + dy, 2.0 * light


def list_triples(seen: IntArray, rays: FloatArray, widest: float) -> Iterator[tuple[int, ...]]:
    """List triples of the brightest spots within an angle, in order of the sum of their ranks."""
    count = min(len(seen), MAX_BRIGHT_SPOTS)
    near = rays[seen[:count]] @ rays[seen[:count]].T > np.cos(widest)
    if near[:BRIGHT_SPOTS, :BRIGHT_SPOTS].mean() > 0.5:  # else a wide field, whose spots lie apart
        count = min(count, BRIGHT_SPOTS)
    some = [
        (i, j, k)
        for i, j, k in combinations(range(count), 3)
        if near[i, j] and near[i, k] and near[j, k]
    ]
    some.sort(key=lambda three: (sum(three), three))
    for three in some:
        yield tuple(int(seen[rank]) for rank in three)


def list_compact_triples(
    seen: IntArray, rays: FloatArray, shortest: float, reach: float
) -> Iterator[tuple[int, ...]]:
    """List triples of bright spots, small ones first: pairs of an angle grow with its square.

    The first of each triple is the corner of both shorter sides, which are looked up.
    """
    bright = rays[seen[:LARGE_SPOTS]]
    apart = np.linalg.norm(bright[:, None] - bright[None], axis=2)
    some = []
    for three in combinations(range(len(bright)), 3):
        corners = [(apart[a, b], apart[a, c], a, b, c) for a, b, c in (
            three, (three[1], three[0], three[2]), (three[2], three[0], three[1])
        )]  # fmt: skip
        shorter_a, shorter_b, a, b, c = min(corners, key=lambda corner: corner[0] + corner[1])
        if min(shorter_a, shorter_b, apart[b, c]) > shortest and max(shorter_a, shorter_b) < reach:
            some.append((shorter_a * shorter_b * (3 + sum(three)), a, b, c))
    for _, a, b, c in sorted(some):
        yield int(seen[a]), int(seen[b]), int(seen[c])
