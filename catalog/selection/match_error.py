"""The error of a match predicted from rendered brightness.

With white image noise of variance s² a least-squares match has covariance s² M⁻¹, M the structure
tensor: the sum over the template of the products of the brightness gradient. The noise here is the
mean brightness over a signal-to-noise ratio, so that no radiometric unit enters.
"""

import numpy as np
from numpy.typing import NDArray

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
