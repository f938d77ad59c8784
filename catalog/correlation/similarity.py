"""Matching under an unknown roll and scale: the reference is turned and stretched to fit."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.correlation.ncc import Filtered, cropped, filtered, high_pass, match_in, match_ncc
from catalog.correlation.peak import Match
from catalog.geometry.kernel import bare_kernel, kernel


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


def turned(
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
    halved  for `match_ncc`: roll and scale from grids of half as many nodes, at a third of the time
    Raises ValueError for no roll or no scale.
    """
    if matcher is match_ncc:
        image = filtered(search, margin_nodes=margin_nodes)
        roll, scale = best_pair(reference, image, rolls, scales, margin_nodes, halved)
        match = match_in(turned(reference, roll, scale), image, margin_nodes)
        return SimilarityMatch(match, roll, scale)
    find = partial(matcher, search=search, margin_nodes=margin_nodes)
    roll, scale = _refined_pair(
        rolls, scales, lambda pairs: [find(turned(reference, *pair)).score for pair in pairs]
    )
    return SimilarityMatch(find(turned(reference, roll, scale)), roll, scale)


def best_pair(
    reference: Float32Array,
    image: Filtered,
    rolls: Sequence[float],
    scales: Sequence[float],
    margin_nodes: int,
    halved: bool = False,
) -> tuple[float, float]:
    """Roll and scale of `match_similarity` by `match_ncc` in a filtered search grid."""
    scores = half_pair_scores if halved else pair_scores
    return _refined_pair(rolls, scales, lambda pairs: scores(reference, image, pairs, margin_nodes))


def _refined_pair(
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
    return _parabola_peak(rolls, scores[:, j], i), _parabola_peak(scales, scores[i, :], j)


def pair_scores(
    reference: Float32Array,
    image: Filtered,
    pairs: Sequence[tuple[float, float]],
    margin_nodes: int,
) -> list[float]:
    """Score of the reference's best place in a filtered image, by pair; nearly `match_ncc`'s.

    What pairs share is done once: the reference is high-passed before it is turned, not after, and
    the image is transformed and its windows' contrast summed for all of them.
    """
    template = high_pass(reference)
    size = template.shape[0] - 2 * margin_nodes
    places = image.values.shape[0] - size + 1
    side = cv2.getOptimalDFTSize(image.values.shape[0])
    padded = np.zeros((side, side), np.float32)
    padded[: image.values.shape[0], : image.values.shape[1]] = image.values
    spectrum = cv2.dft(padded)
    padded[:] = 0.0
    contrast = _window_contrast(image, size)
    scores = []
    for roll, scale in pairs:
        length = _put_centred(turned(template, roll, scale, beyond=0.0), margin_nodes, padded)
        # the transform of rows that are known to be zero is left out, and that of rows not wanted
        turn = cv2.dft(padded, nonzeroRows=size)
        product = cv2.mulSpectrums(spectrum, turn, 0, conjB=True)
        flags = cv2.DFT_INVERSE | cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT
        sums = np.asarray(cv2.dft(product, flags=flags, nonzeroRows=places), np.float32)
        scores.append(_greatest_ratio(sums, contrast) / max(length, 1e-30))
    return scores


def half_pair_scores(
    reference: Float32Array,
    image: Filtered,
    pairs: Sequence[tuple[float, float]],
    margin_nodes: int,
) -> list[float]:
    """As `pair_scores` from grids of half as many nodes a side; sides and margin are even.

    A score is that of the top of parabolas through the best place and those beside it: the best
    place of so few may lie half a node, one of the whole grids, from the true one.
    """
    template = _halved(high_pass(reference))
    half = Filtered(_halved(image.values), image.floor)
    margin = margin_nodes // 2
    contrast = _window_contrast(half, template.shape[0] - 2 * margin)
    return [
        _top_score(
            cropped(turned(template, roll, scale, beyond=0.0), margin), half.values, contrast
        )
        for roll, scale in pairs
    ]


def _halved(grid: Float32Array) -> Float32Array:
    """Means of 2 x 2 nodes."""
    size = (grid.shape[1] // 2, grid.shape[0] // 2)
    return np.asarray(cv2.resize(grid, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


@kernel
def _top_score(part: Float32Array, image: Float32Array, contrast: Float32Array) -> float:
    """Correlation of a template at the top between its places in an image."""
    rows, cols = contrast.shape
    centred = part - np.float32(part.mean())
    length = np.sqrt(np.square(centred).sum())
    scores = np.empty((rows, cols))
    _fill_scores(centred, image, contrast, np.empty(part.shape[0], np.float32), scores)
    best = int(np.argmax(scores))
    i, j = best // cols, best % cols
    top = scores[i, j]
    if 0 < i < rows - 1:
        top += _rise(scores[i - 1, j], scores[i, j], scores[i + 1, j])
    if 0 < j < cols - 1:
        top += _rise(scores[i, j - 1], scores[i, j], scores[i, j + 1])
    return float(top / max(length, 1e-30))


@bare_kernel
def _fill_scores(
    centred: Float32Array,
    image: Float32Array,
    contrast: Float32Array,
    columns: Float32Array,
    scores: FloatArray,
) -> None:
    """Fill scores (rows, cols) of a template (n, n) at its places, times its length.

    columns  (n,) to work in: a sum a column, so that products are not added one after the other
    """
    size, (rows, cols) = centred.shape[0], contrast.shape
    for i in range(rows):
        for j in range(cols):
            columns[:] = np.float32(0.0)
            for r in range(size):
                line, under = centred[r], image[i + r, j : j + size]
                for c in range(size):
                    columns[c] += line[c] * under[c]
            total = 0.0
            for c in range(size):
                total += columns[c]
            scores[i, j] = total / contrast[i, j]


@kernel
def _rise(before: float, middle: float, after: float) -> float:
    """How far the top of a parabola through three values stands over the middle one."""
    bend = before - 2.0 * middle + after
    return -0.125 * (after - before) ** 2 / bend if bend < 0.0 else 0.0


@kernel
def _put_centred(template: Float32Array, margin: int, padded: Float32Array) -> float:
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
def _greatest_ratio(sums: Float32Array, contrast: Float32Array) -> float:
    """The greatest sum over contrast; sums of places beyond those of contrast do not count."""
    best = -np.inf
    for r in range(contrast.shape[0]):
        for c in range(contrast.shape[1]):
            ratio = sums[r, c] / contrast[r, c]
            if ratio > best:
                best = ratio
    return best


def _window_contrast(image: Filtered, size: int) -> Float32Array:
    """Root of summed squared differences to the mean of square windows; infinite without any."""
    count = image.values.shape[0] - size + 1
    mean, square = (
        box(image.values, cv2.CV_64F, (size, size), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)[
            :count, :count
        ]
        for box in (cv2.boxFilter, cv2.sqrBoxFilter)
    )
    variance = square - mean * mean
    variance[variance <= image.floor**2] = np.inf
    return (size * np.sqrt(variance)).astype(np.float32)


def _parabola_peak(places: Sequence[float], values: FloatArray, index: int) -> float:
    """Place of the maximum of a parabola through three neighbours; at the ends, the sample."""
    if not 0 < index < len(places) - 1:
        return float(places[index])
    left, middle, right = (float(v) for v in values[index - 1 : index + 2])
    bend = left - 2.0 * middle + right
    if bend >= 0.0:
        return float(places[index])
    return float(places[index] + 0.5 * (left - right) / bend * (places[index + 1] - places[index]))
