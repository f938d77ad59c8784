"""The error of a match and its uniqueness, predicted from rendered brightness.

With white image noise of variance s² a least-squares match has covariance s² M⁻¹, M the structure
tensor: the sum over the template of the products of the brightness gradient. The noise here is the
mean brightness over a signal-to-noise ratio, so that no radiometric unit enters.

A place can have sharp edges and yet too little contrast to stand out of the noise: correlation then
refuses it. The predicted correlation is the height of the peak, and a bound over it is the score
that orders candidates (the division is ours: on real ground it chose points that were recognised
1 % more often than the bound alone did, and 2 % more than the closed form).

Uniqueness is how unlike the true place its best rival in the search region is, by SURF.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from catalog.arrays import Float32Array
from catalog.correlation.ncc import high_pass
from catalog.correlation.surf64 import own_similarity_surface
from catalog.geometry.kernel import kernel

# Nearer than this a peak of the similarity is the place itself.
LOBE_NODES = 3


@kernel
def _structure_tensor(brightness: Float32Array) -> tuple[float, float, float, float]:
    """Its elements xx, xy and yy, x along columns, y along rows, and the mean brightness."""
    rows, cols = brightness.shape
    mxx = mxy = myy = total = 0.0
    count = 0
    for r in range(1, rows - 1):
        for c in range(1, cols - 1):
            gx = 0.5 * (np.float64(brightness[r, c + 1]) - brightness[r, c - 1])
            gy = 0.5 * (np.float64(brightness[r + 1, c]) - brightness[r - 1, c])
            value = brightness[r, c]
            if value == value:
                total += value
                count += 1
            if gx == gx and gy == gy:
                mxx += gx * gx
                mxy += gx * gy
                myy += gy * gy
    return mxx, mxy, myy, total / max(count, 1)


@dataclass(frozen=True)
class MatchPrediction:
    """How well a rendered template would match its own picture under white noise.

    error_px     1-sigma error along the worst direction, nodes; infinite without contrast in some
                 direction or without any light
    correlation  0..1, of template and picture, both high-passed; zero without light
    """

    error_px: float
    correlation: float

    @property
    def score(self) -> float:
        """Error over correlation, nodes; infinite where there is nothing to match."""
        return self.error_px / self.correlation if self.correlation > 0.0 else math.inf


def predict_match(brightness: Float32Array, snr: float) -> MatchPrediction:
    """The expected error and correlation of a template's match.

    brightness  (n, n)  any unit, NaN for no data (which adds nothing)
    snr                 mean brightness over the standard deviation of a node's noise
    """
    brightness = np.ascontiguousarray(brightness, dtype=np.float32)
    mxx, mxy, myy, mean = _structure_tensor(brightness)
    if mean <= 0.0:
        return MatchPrediction(math.inf, 0.0)
    smallest = 0.5 * (mxx + myy - math.hypot(mxx - myy, 2.0 * mxy))
    # 1e-12 of the brightness²: below it the difference of two sums is rounding
    known = smallest > 1e-12 * mean * mean
    # holes are zero after the high-pass and count as nodes without contrast
    contrast = float(cv2.meanStdDev(high_pass(brightness))[1][0, 0]) / mean
    return MatchPrediction(
        mean / (snr * math.sqrt(smallest)) if known else math.inf,
        contrast / math.hypot(contrast, 1.0 / snr),
    )


@kernel
def best_rival(surface: Float32Array, search_nodes: float) -> float:
    """Highest local maximum of a similarity surface away from its middle, -1 when there is none.

    surface       (2k + 1, 2k + 1)  similarity, the true place in the middle
    search_nodes                    rivals beyond this distance (on either axis) do not count
    The slope of the true peak is no rival, so only local maxima count; on the outermost nodes a
    maximum is one among the neighbours that exist.
    """
    rows, cols = surface.shape
    middle = rows // 2
    best = -1.0
    for r in range(rows):
        for c in range(cols):
            distance = max(abs(r - middle), abs(c - middle))
            here = surface[r, c]
            if not (LOBE_NODES < distance <= search_nodes and here > best):
                continue
            if here >= surface[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].max():
                best = float(here)
    return best


def uniqueness_margin(brightness: Float32Array, template_nodes: int, search_nodes: float) -> float:
    """One minus the similarity of the best rival: 1 with none similar, 0 for a perfect double.

    brightness      (n, n)  a render of the ground about the place, NaN for no data
    template_nodes          side of the square that is described, n - template_nodes even
    search_nodes            how far the search goes, nodes; capped by the room that n leaves
    Raises ValueError when the template cannot be centred in the brightness.
    """
    rival = best_rival(own_similarity_surface(brightness, template_nodes), search_nodes)
    return float(min(1.0 - rival, 1.0))
