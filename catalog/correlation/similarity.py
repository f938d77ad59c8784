"""Matching under an unknown roll and scale: the reference is turned and stretched to fit."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.correlation.ncc import Filtered, cropped, filtered, high_pass, match_in, match_ncc
from catalog.correlation.peak import Match


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
    turn = cv2.getRotationMatrix2D((centre, centre), float(np.degrees(roll)), scale)
    image = cv2.warpAffine(reference, turn, (size, size), borderValue=beyond)
    return np.asarray(image, dtype=np.float32)


def match_similarity(
    reference: Float32Array,
    search: Float32Array,
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
        scored = pair_scores(reference, image, pairs, margin_nodes)
        find: Callable[[Float32Array], Match] = partial(
            match_in, image=image, margin_nodes=margin_nodes
        )
    else:
        find = partial(matcher, search=search, margin_nodes=margin_nodes)
        scored = [find(turned(reference, *pair)).score for pair in pairs]
    scores = np.reshape(scored, (len(rolls), len(scales)))
    i, j = divmod(int(np.argmax(scores)), len(scales))
    # a parabola's peak is less than half a step from the best pair: as good, or better
    roll = _parabola_peak(rolls, scores[:, j], i)
    scale = _parabola_peak(scales, scores[i, :], j)
    return SimilarityMatch(find(turned(reference, roll, scale)), roll, scale)


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
        part = cropped(turned(template, roll, scale, beyond=0.0), margin_nodes)
        part = part - part.mean()
        padded[:size, :size] = part
        product = cv2.mulSpectrums(spectrum, cv2.dft(padded), 0, conjB=True)
        sums = cv2.dft(product, flags=cv2.DFT_INVERSE | cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT)
        length = max(float(np.linalg.norm(part)), 1e-30)
        scores.append(float((sums[:places, :places] / contrast).max()) / length)
    return scores


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
