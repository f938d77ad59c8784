"""The error of a match predicted from rendered brightness.

With white image noise of variance s² a least-squares match has covariance s² M⁻¹, M the structure
tensor: the sum over the template of the products of the brightness gradient. The noise here is the
mean brightness over a signal-to-noise ratio, so that no radiometric unit enters.

A place can have sharp edges and yet too little contrast to be told from noise: correlation then
refuses it. `predicted_correlation` says how high the peak will stand, and a bound over it is the
score that orders candidates (the division is ours: on real ground it chose points that were
recognised 1 % more often than the bound alone did, and 2 % more than the closed form).
"""

import numpy as np
from numpy.typing import NDArray

from catalog.correlation.ncc import high_pass
from catalog.geometry.kernel import kernel

Grid = NDArray[np.float32]
FloatArray = NDArray[np.float64]


@kernel
def _structure_tensor(brightness: Grid) -> tuple[float, float, float, float]:
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


def structure_tensor(brightness: Grid) -> FloatArray:
    """Structure tensor (2, 2) of a brightness grid, x along columns, y along rows.

    brightness (rows, cols), NaN for no data (which adds nothing); unit of brightness² a node².
    """
    mxx, mxy, myy, _ = _structure_tensor(np.ascontiguousarray(brightness, dtype=np.float32))
    return np.array([[mxx, mxy], [mxy, myy]])


def predicted_error_px(brightness: Grid, snr: float) -> float:
    """Predicted 1-sigma error of a match along its worst direction, nodes.

    brightness  (n, n)  rendered template, any unit, NaN for no data
    snr                 mean brightness over the standard deviation of a node's noise
    Returns infinity for a template without contrast in some direction or without any light.
    """
    brightness = np.ascontiguousarray(brightness, dtype=np.float32)
    mxx, mxy, myy, mean = _structure_tensor(brightness)
    smallest = 0.5 * (mxx + myy - np.hypot(mxx - myy, 2.0 * mxy))
    # 1e-12 of the brightness²: below it the difference of two sums is rounding
    if mean <= 0.0 or smallest <= 1e-12 * mean * mean:
        return float("inf")
    return float(mean / (snr * np.sqrt(smallest)))


def predicted_correlation(brightness: Grid, snr: float) -> float:
    """Correlation, 0..1, of a template with its own picture under white noise, both high-passed.

    Arguments as `predicted_error_px`; zero without light.
    """
    brightness = np.ascontiguousarray(brightness, dtype=np.float32)
    mean = _structure_tensor(brightness)[3]
    if mean <= 0.0:
        return 0.0
    contrast = float(high_pass(brightness).std()) / mean
    return float(contrast / np.hypot(contrast, 1.0 / snr))
