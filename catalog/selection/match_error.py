"""The error of a match predicted from rendered brightness.

With white image noise of variance s² a least-squares match has covariance s² M⁻¹, M the structure
tensor: the sum over the template of the products of the brightness gradient. The noise here is the
mean brightness over a signal-to-noise ratio, so that no radiometric unit enters.

A place can have sharp edges and yet too little contrast to be told from noise: correlation then
refuses it. The predicted correlation says how high the peak will stand, and a bound over it is the
score that orders candidates (the division is ours: on real ground it chose points that were
recognised 1 % more often than the bound alone did, and 2 % more than the closed form).
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from catalog.arrays import Float32Array
from catalog.correlation.ncc import high_pass
from catalog.geometry.kernel import kernel


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
    """What a template promises.

    brightness  (n, n)  any unit, NaN for no data (which adds nothing)
    snr                 mean brightness over the standard deviation of a node's noise
    """
    brightness = np.ascontiguousarray(brightness, dtype=np.float32)
    mxx, mxy, myy, mean = _structure_tensor(brightness)
    error = _error_px(mxx, mxy, myy, mean, snr)
    return MatchPrediction(error, _correlation(brightness, mean, snr))


def _error_px(mxx: float, mxy: float, myy: float, mean: float, snr: float) -> float:
    smallest = 0.5 * (mxx + myy - math.hypot(mxx - myy, 2.0 * mxy))
    # 1e-12 of the brightness²: below it the difference of two sums is rounding
    if mean <= 0.0 or smallest <= 1e-12 * mean * mean:
        return math.inf
    return mean / (snr * math.sqrt(smallest))


def _correlation(brightness: Float32Array, mean: float, snr: float) -> float:
    if mean <= 0.0:
        return 0.0
    # holes are zero after the high-pass and count as nodes without contrast
    deviation = cv2.meanStdDev(high_pass(brightness))[1]
    contrast = float(deviation[0, 0]) / mean
    return contrast / math.hypot(contrast, 1.0 / snr)
