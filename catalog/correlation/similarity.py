"""Matching under an unknown roll and scale: the reference is turned and stretched to fit."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.correlation.ncc import (
    cropped,
    filtered,
    high_pass,
    match_in,
    match_ncc,
)
from catalog.correlation.peak import Match

Grid = NDArray[np.float32]

# Roll and scale are told apart on grids of half as many nodes a side, from this side on.
HALVED_FROM_NODES = 48


class Matcher(Protocol):
    """Finds a reference in a search grid; see `catalog.correlation.ncc.match_ncc`."""

    def __call__(self, reference: Grid, search: Grid, margin_nodes: int = 0) -> Match:
        """Both grids carry `margin_nodes` of border that only filters look at."""
        ...


class SimilarityMatch(NamedTuple):
    """A match together with the roll (rad, counter-clockwise seen from above) and scale found."""

    match: Match
    roll: float
    scale: float


def turned(reference: Grid, roll: float, scale: float, beyond: float = np.nan) -> Grid:
    """A square grid turned by `roll` (rad) and stretched by `scale` about its centre.

    Nodes that the stretched grid does not reach are `beyond`; as NaN they take no part in a match.
    """
    size = reference.shape[0]
    centre = (size - 1) / 2.0
    matrix = cv2.getRotationMatrix2D((centre, centre), float(np.degrees(roll)), scale)
    return np.asarray(
        cv2.warpAffine(
            reference,
            matrix,
            (size, size),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=beyond,
        ),
        dtype=np.float32,
    )


def match_similarity(
    reference: Grid,
    search: Grid,
    rolls: Sequence[float],
    scales: Sequence[float],
    matcher: Matcher = match_ncc,
    margin_nodes: int = 0,
) -> SimilarityMatch:
    """Best match over a grid of rolls (rad) and scales; the best pair is refined by parabolas.

    reference, search as `match_ncc` takes them. Evenly spaced rolls and scales are expected.
    Raises ValueError for no roll or no scale.
    """
    if not rolls or not scales:
        raise ValueError("no roll or no scale to try")
    pairs = [(roll, scale) for roll in rolls for scale in scales]
    if matcher is match_ncc:
        image = filtered(search, margin_nodes=margin_nodes)
        scored = _correlation_scores(reference, image.values, pairs, margin_nodes)
        find: Callable[[Grid], Match] = partial(match_in, image=image, margin_nodes=margin_nodes)
    else:
        find = partial(matcher, search=search, margin_nodes=margin_nodes)
        scored = [find(turned(reference, *pair)).score for pair in pairs]
    scores = np.reshape(scored, (len(rolls), len(scales)))
    i, j = divmod(int(np.argmax(scores)), len(scales))
    # a parabola's peak is less than half a step from the best pair: as good, or better
    roll = _parabola_peak(rolls, scores[:, j], i)
    scale = _parabola_peak(scales, scores[i, :], j)
    return SimilarityMatch(find(turned(reference, roll, scale)), roll, scale)


def _correlation_scores(
    reference: Grid, image: Grid, pairs: Sequence[tuple[float, float]], margin_nodes: int
) -> list[float]:
    """How well the reference correlates with a high-passed image at its best place, by pair.

    Good enough to tell pairs apart, at a fifth of the cost of `match_ncc`: the reference is
    high-passed once and turned after that, and both are averaged to half as many nodes a side
    (unless the reference is small), which a wrong roll or scale moves by more than a node still.
    """
    template = high_pass(reference)
    if min(template.shape) - 2 * margin_nodes >= HALVED_FROM_NODES:
        template, image, margin_nodes = _halved(template), _halved(image), margin_nodes // 2
    scores = []
    for roll, scale in pairs:
        part = cropped(turned(template, roll, scale, beyond=0.0), margin_nodes)
        scores.append(float(cv2.matchTemplate(image, part, cv2.TM_CCOEFF_NORMED).max()))
    return scores


def _halved(grid: Grid) -> Grid:
    half = (grid.shape[1] // 2, grid.shape[0] // 2)
    even = grid[: 2 * half[1], : 2 * half[0]]
    return np.asarray(cv2.resize(even, half, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _parabola_peak(places: Sequence[float], values: NDArray[np.float64], index: int) -> float:
    """Place of the maximum of a parabola through three neighbours; at the ends, the sample."""
    if not 0 < index < len(places) - 1:
        return float(places[index])
    left, middle, right = (float(v) for v in values[index - 1 : index + 2])
    bend = left - 2.0 * middle + right
    if bend >= 0.0:
        return float(places[index])
    return float(places[index] + 0.5 * (left - right) / bend * (places[index + 1] - places[index]))
