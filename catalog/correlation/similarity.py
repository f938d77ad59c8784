"""Matching under an unknown roll and scale: the reference is turned and stretched to fit."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.correlation.ncc import match_ncc
from catalog.correlation.peak import Match

Grid = NDArray[np.float32]


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


def turned(reference: Grid, roll: float, scale: float) -> Grid:
    """A square grid turned by `roll` (rad) and stretched by `scale` about its centre.

    Nodes that the stretched grid does not reach are NaN, so that they take no part in a match.
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
            borderValue=float("nan"),
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
    """
    best: SimilarityMatch | None = None
    scores = np.full((len(rolls), len(scales)), -1.0)
    for row, roll in enumerate(rolls):
        for column, scale in enumerate(scales):
            match = matcher(turned(reference, roll, scale), search, margin_nodes)
            scores[row, column] = match.score
            if best is None or match.score > best.match.score:
                best = SimilarityMatch(match, roll, scale)
    if best is None:
        raise ValueError("no roll or no scale to try")
    i, j = divmod(int(np.argmax(scores)), len(scales))
    roll = _parabola_peak(rolls, scores[:, j], i)
    scale = _parabola_peak(scales, scores[i, :], j)
    if (roll, scale) == (best.roll, best.scale):
        return best
    refined = matcher(turned(reference, roll, scale), search, margin_nodes)
    return SimilarityMatch(refined, roll, scale) if refined.score >= best.match.score else best


def _parabola_peak(places: Sequence[float], values: NDArray[np.float64], index: int) -> float:
    """Place of the maximum of a parabola through three neighbours; at the ends, the sample."""
    if not 0 < index < len(places) - 1:
        return float(places[index])
    left, middle, right = (float(v) for v in values[index - 1 : index + 2])
    bend = left - 2.0 * middle + right
    if bend >= 0.0:
        return float(places[index])
    return float(places[index] + 0.5 * (left - right) / bend * (places[index + 1] - places[index]))
