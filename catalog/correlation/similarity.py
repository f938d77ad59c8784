"""Matching under an unknown roll and scale: the reference is turned and stretched to fit."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import Float32Array, FloatArray
from catalog.correlation.filters import Filtered, filter_grid, filter_high_pass
from catalog.correlation.ncc import match_in, match_ncc
from catalog.correlation.peak import Match
from catalog.geometry.kernel import inplace_kernel, kernel

# Nodes of all windows of a search; with more of them transforms are quicker than one product.
MAX_IN_WINDOWS = 200_000


class Matcher(Protocol):
    """Finds a reference in a search grid; see `catalog.correlation.ncc.match_ncc`."""

    def __call__(
        self, reference: Float32Array, search: Float32Array, margin_nodes: int = 0
    ) -> Match:
        """Both grids carry `margin_nodes` of border that only filters look at."""
        ...


class SimilarityMatch(NamedTuple):
    """A match together with the roll (rad, counter-clockwise seen from above) and scale found."""

    match: Match
    roll: float
    scale: float


def rotate_and_scale(
    reference: Float32Array, roll: float, scale: float, beyond: float = np.nan
) -> Float32Array:
    """A square grid turned by `roll` (rad) and stretched by `scale` about its centre.

    Nodes that the stretched grid does not reach are `beyond`; as NaN they take no part in a match.
    """
    size = reference.shape[0]
    centre = (size - 1) / 2.0
    turn = cv2.getRotationMatrix2D((centre, centre), math.degrees(roll), scale)
    image = cv2.warpAffine(reference, turn, (size, size), borderValue=beyond)
    return np.asarray(image, dtype=np.float32)


def match_similarity(
    reference: Float32Array,
    search: Float32Array,
    rolls: Sequence[float],
    scales: Sequence[float],
    matcher: Matcher = match_ncc,
    margin_nodes: int = 0,
    halved: bool = False,
) -> SimilarityMatch:
    """Best match over a grid of rolls (rad) and scales; the best pair is refined by parabolas.

    reference, search as `match_ncc` takes them. Evenly spaced rolls and scales are expected.
    halved  for `match_ncc`: as for `find_best_pair`
    Raises ValueError for no roll or no scale.
    """
    if matcher is match_ncc:
        image = filter_grid(search, margin_nodes=margin_nodes)
        roll, scale = find_best_pair(reference, image, rolls, scales, margin_nodes, halved)
        match = match_in(rotate_and_scale(reference, roll, scale), image, margin_nodes)
        return SimilarityMatch(match, roll, scale)
    find = partial(matcher, search=search, margin_nodes=margin_nodes)
    roll, scale = _refine_pair(
        rolls,
        scales,
        lambda pairs: [find(rotate_and_scale(reference, *pair)).score for pair in pairs],
    )
    return SimilarityMatch(find(rotate_and_scale(reference, roll, scale)), roll, scale)


def find_best_pair(
    reference: Float32Array,
    image: Filtered,
    rolls: Sequence[float],
    scales: Sequence[float],
    margin_nodes: int,
    halved: bool = False,
) -> tuple[float, float]:
    """Roll and scale of `match_similarity` by `match_ncc` in a filtered search grid.

    halved  from grids of half as many nodes, at a third of the time, where all sides are even
    """
    even = reference.shape[0] % 2 == image.values.shape[0] % 2 == margin_nodes % 2 == 0
    scores = score_pairs_halved if halved and even else score_pairs
    return _refine_pair(rolls, scales, lambda pairs: scores(reference, image, pairs, margin_nodes))


def _refine_pair(
    rolls: Sequence[float],
    scales: Sequence[float],
    scores_of: Callable[[list[tuple[float, float]]], Sequence[float]],
) -> tuple[float, float]:
    if not rolls or not scales:
        raise ValueError("no roll or no scale to try")
    scored = scores_of([(roll, scale) for roll in rolls for scale in scales])
    scores = np.reshape(scored, (len(rolls), len(scales)))
    i, j = divmod(int(np.argmax(scores)), len(scales))
    # a parabola's peak is less than half a step from the best pair: as good, or better
    return _locate_parabola_peak(rolls, scores[:, j], i), _locate_parabola_peak(
        scales, scores[i, :], j
    )


def score_pairs(
    reference: Float32Array,
    image: Filtered,
    pairs: Sequence[tuple[float, float]],
    margin_nodes: int,
) -> list[float]:
    """Score of the reference's best place in a filtered image, by pair; nearly `match_ncc`'s.

    What pairs share is done once: the reference is high-passed before it is turned, not after, and
    the image is transformed and its windows' contrast summed for all of them.
    """
    template = filter_high_pass(reference)
    size = template.shape[0] - 2 * margin_nodes
    places = image.values.shape[0] - size + 1
    side = cv2.getOptimalDFTSize(image.values.shape[0])
    padded = np.zeros((side, side), np.float32)
    padded[: image.values.shape[0], : image.values.shape[1]] = image.values
    spectrum = cv2.dft(padded)
    padded[:] = 0.0
    contrast = _measure_window_contrast(image, size)
    scores = []
    for roll, scale in pairs:
        length = _place_centred(
            rotate_and_scale(template, roll, scale, beyond=0.0), margin_nodes, padded
        )
        # the transform of rows that are known to be zero is left out, and that of rows not wanted
        turn = cv2.dft(padded, nonzeroRows=size)
        product = cv2.mulSpectrums(spectrum, turn, 0, conjB=True)
        flags = cv2.DFT_INVERSE | cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT
        sums = np.asarray(cv2.dft(product, flags=flags, nonzeroRows=places), np.float32)
        scores.append(_find_max_ratio(sums, contrast) / max(length, 1e-30))
    return scores


def score_pairs_halved(
    reference: Float32Array,
    image: Filtered,
    pairs: Sequence[tuple[float, float]],
    margin_nodes: int,
) -> list[float]:
    """Score pairs as `score_pairs` does, from grids of half as many nodes a side; all sides even.

    A score is that of the top of parabolas through the best place and those beside it: the best
    place of so few may lie half a node, one of the whole grids, from the true one.
    """
    template = _pad_with_zeros(_downsample_by_two(filter_high_pass(reference)))
    half = Filtered(_downsample_by_two(image.values), image.floor)
    size = template.shape[0] - 2 * (margin_nodes // 2 + 1)
    contrast = _measure_window_contrast(half, size)
    parts = np.empty((len(pairs), size * size), np.float32)
    _fill_turned(template.reshape(-1), *_map_turned_nodes(tuple(pairs), len(template), size), parts)
    parts -= parts.mean(axis=1, keepdims=True)
    lengths = np.sqrt(np.einsum("kn,kn->k", parts, parts))
    if contrast.size * size * size > MAX_IN_WINDOWS:
        grids = parts.reshape(-1, size, size)
        products = [cv2.matchTemplate(half.values, grid, cv2.TM_CCORR) for grid in grids]
        sums = np.asarray(np.stack(products), np.float32).reshape(len(pairs), -1)
    else:
        windows = np.empty((contrast.size, size * size), np.float32)
        _fill_windows(half.values, size, windows)
        # one product of matrices has the sums of all pairs at all places
        sums = parts @ windows.T
    tops: list[float] = _find_top_scores(sums, contrast, lengths).tolist()
    return tops


def _pad_with_zeros(grid: Float32Array) -> Float32Array:
    """A grid (rows, cols) with a zero on every side."""
    wider = np.zeros((grid.shape[0] + 2, grid.shape[1] + 2), np.float32)
    wider[1:-1, 1:-1] = grid
    return wider


def _downsample_by_two(grid: Float32Array) -> Float32Array:
    """Means of 2 x 2 nodes."""
    size = (grid.shape[1] // 2, grid.shape[0] // 2)
    return np.asarray(cv2.resize(grid, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


@lru_cache(maxsize=8)
def _map_turned_nodes(
    pairs: tuple[tuple[float, float], ...], side: int, size: int
) -> tuple[NDArray[np.uint32], Float32Array]:
    """Where nodes of the middle (size, size) of a grid (side, side) come from when it is turned.

    Returns the node above and before by pair and node, (k, m), counted row by row; and how far
    behind and below it, (2, k, m). Beyond the grid its border goes on.
    """
    nodes = np.arange(size) - (size - 1) / 2.0
    roll, scale = np.array(pairs).T[:, :, None, None]
    along, across = np.cos(roll) / scale, np.sin(roll) / scale
    places = np.stack(
        [
            along * nodes - across * nodes[:, None] + (side - 1) / 2.0,
            across * nodes + along * nodes[:, None] + (side - 1) / 2.0,
        ]
    ).clip(0.0, side - 1.0)
    corner = np.minimum(np.floor(places), side - 2.0)
    at = (corner[1] * side + corner[0]).astype(np.uint32)
    past = (places - corner).astype(np.float32)
    return at.reshape(len(pairs), -1), past.reshape(2, len(pairs), -1)


@inplace_kernel
def _fill_turned(
    grid: Float32Array, at: NDArray[np.uint32], past: Float32Array, parts: Float32Array
) -> None:
    """Fill parts (k, m) with a grid (n^2,) at places of `_map_turned_nodes`."""
    side, next_node = np.uint32(math.sqrt(grid.size)), np.uint32(1)
    for k in range(at.shape[0]):
        line, nodes, behind, below = parts[k], at[k], past[0, k], past[1, k]
        for c in range(line.size):
            upper, lower = nodes[c], nodes[c] + side
            a = grid[upper] + behind[c] * (grid[upper + next_node] - grid[upper])
            b = grid[lower] + behind[c] * (grid[lower + next_node] - grid[lower])
            line[c] = a + below[c] * (b - a)


@inplace_kernel
def _fill_windows(image: Float32Array, size: int, windows: Float32Array) -> None:
    """Fill windows (places, size^2) with the squares of an image at all places, row by row."""
    count = image.shape[0] - size + 1
    for i in range(count):
        for j in range(count):
            into = windows[i * count + j]
            for r in range(size):
                line, under = into[r * size : (r + 1) * size], image[i + r, j : j + size]
                for c in range(size):
                    line[c] = under[c]


@kernel
def _find_top_scores(
    sums: Float32Array, contrast: Float32Array, lengths: Float32Array
) -> FloatArray:
    """Correlations of templates (k) at the top between their places; sums (k, rows cols)."""
    rows, cols = contrast.shape
    tops = np.empty(lengths.size)
    for k in range(lengths.size):
        scores = sums[k].reshape(rows, cols) / contrast
        best = int(np.argmax(scores))
        i, j = best // cols, best % cols
        top = float(scores[i, j])
        if 0 < i < rows - 1:
            top += _compute_peak_rise(scores[i - 1, j], scores[i, j], scores[i + 1, j])
        if 0 < j < cols - 1:
            top += _compute_peak_rise(scores[i, j - 1], scores[i, j], scores[i, j + 1])
        tops[k] = top / max(lengths[k], 1e-30)
    return tops


@kernel
def _compute_peak_rise(before: float, middle: float, after: float) -> float:
    """Compute the height of the top of a parabola through three values over the middle one."""
    bend = before - 2.0 * middle + after
    return -0.125 * (after - before) ** 2 / bend if bend < 0.0 else 0.0


@kernel
def _place_centred(template: Float32Array, margin: int, padded: Float32Array) -> float:
    """Put a template without its margin and mean into a corner; returns the root of its squares."""
    size = template.shape[0] - 2 * margin
    total = 0.0
    for r in range(size):
        for c in range(size):
            total += template[margin + r, margin + c]
    mean = np.float32(total / (size * size))
    squares = 0.0
    for r in range(size):
        for c in range(size):
            value = template[margin + r, margin + c] - mean
            padded[r, c] = value
            squares += value * value
    return float(np.sqrt(squares))


@kernel
def _find_max_ratio(sums: Float32Array, contrast: Float32Array) -> float:
    """The greatest sum over contrast; sums of places beyond those of contrast do not count."""
    best = -np.inf
    for r in range(contrast.shape[0]):
        for c in range(contrast.shape[1]):
            ratio = sums[r, c] / contrast[r, c]
            if ratio > best:
                best = ratio
    return best


def _measure_window_contrast(image: Filtered, size: int) -> Float32Array:
    """Root of summed squared differences to the mean of square windows; infinite without any."""
    rows, cols = image.values.shape
    contrast = np.empty((rows - size + 1, cols - size + 1), np.float32)
    _fill_contrast(image.values, size, image.floor, np.zeros((2, cols)), contrast)
    return contrast


@inplace_kernel
def _fill_contrast(
    image: Float32Array, size: int, floor: float, columns: FloatArray, contrast: Float32Array
) -> None:
    """Fill `_measure_window_contrast`; columns (2, cols), zeros on entry: sums over `size` rows."""
    sums, squares = columns[0], columns[1]
    nodes = size * size
    for row in range(image.shape[0]):
        first = row - size + 1
        for c in range(sums.size):
            value = np.float64(image[row, c])
            sums[c] += value
            squares[c] += value * value
        if first < 0:
            continue
        total = square = 0.0
        for c in range(sums.size):
            total += sums[c]
            square += squares[c]
            if c >= size - 1:
                variance = square / nodes - (total / nodes) ** 2
                known = variance > floor * floor
                contrast[first, c - size + 1] = math.sqrt(nodes * variance) if known else np.inf
                total -= sums[c - size + 1]
                square -= squares[c - size + 1]
        for c in range(sums.size):
            value = np.float64(image[first, c])
            sums[c] -= value
            squares[c] -= value * value


def _locate_parabola_peak(places: Sequence[float], values: FloatArray, index: int) -> float:
    """Place of the maximum of a parabola through three neighbours; at the ends, the sample."""
    if not 0 < index < len(places) - 1:
        return float(places[index])
    left, middle, right = (float(v) for v in values[index - 1 : index + 2])
    bend = left - 2.0 * middle + right
    if bend >= 0.0:
        return float(places[index])
    return float(places[index] + 0.5 * (left - right) / bend * (places[index + 1] - places[index]))
