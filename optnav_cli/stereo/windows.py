"""Shifts of many windows between two pictures that already lie on each other within a pixel or two.

Least squares in brightness (Lucas and Kanade, IJCAI 1981), for windows on a regular grid at once:
sums over windows are box filters. The shift e of a window solves left(x) = right(x + e).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray

MIN_SCORE = 0.5  # correlation of a window of one ground; noise alone gives 0.1
MIN_SHARE = 0.999  # of a window that lies in both pictures
MIN_TEXTURE = 1e-4  # smaller eigenvalue of the gradients' products, brightness in its scatter
GRADIENT_BLUR_PX = 1.0
STEP_PX = 16  # between windows: those of 64 px overlap by three quarters
Gradients = tuple[Float32Array, Float32Array]  # along x and y


@dataclass(frozen=True, eq=False)
class Shifts:
    """Shifts of windows on a grid (rows, cols).

    x, y         (rows, cols) middles of the windows, px
    shift_px     (rows, cols, 2)
    covariance   (rows, cols, 2, 2) px², from what is left of the brightness
    usable       (rows, cols)
    overlap      how many windows share the ground of one: their errors are not apart
    """

    x: FloatArray
    y: FloatArray
    shift_px: FloatArray
    covariance: FloatArray
    usable: BoolArray
    overlap: float


def measure_shifts(left: Float32Array, right: Float32Array, size: int, blur_px: float) -> Shifts:
    """Measure shifts of windows of a size (px, odd or even) between two pictures on one grid.

    left, right  (rows, cols); NaN where there is none
    blur_px      of both before: a wide blur takes larger shifts
    """
    valid = np.isfinite(left) & np.isfinite(right)
    a, b = (_normalise(image, valid, size, blur_px) for image in (left, right))
    mean_of, difference = 0.5 * (a + b), a - b
    gradients = _differentiate(mean_of)
    # Noise of the gradients goes with that of the difference: smoothed ones have little of it.
    smooth = _differentiate(np.asarray(cv2.GaussianBlur(mean_of, (0, 0), GRADIENT_BLUR_PX)))
    first, rows, cols = size // 2, *left.shape

    def average(image: Float32Array) -> FloatArray:
        filtered = cv2.boxFilter(image, cv2.CV_32F, (size, size), borderType=cv2.BORDER_CONSTANT)
        nodes: FloatArray = filtered[first::STEP_PX, first::STEP_PX].astype(np.float64)
        return nodes

    def average_products(first_gradients: Gradients, second_gradients: Gradients) -> FloatArray:
        rows_of = [[average(p * q) for q in second_gradients] for p in first_gradients]
        products_of = np.moveaxis(np.array(rows_of), (0, 1), (-2, -1))
        symmetric: FloatArray = 0.5 * (products_of + np.swapaxes(products_of, -1, -2))
        return symmetric

    normal = average_products(smooth, gradients)
    offset = np.stack([average(g * difference) for g in smooth], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        score = np.nan_to_num(average(a * b) / np.sqrt(average(a * a) * average(b * b)))
    usable = average(valid.astype(np.float32)) >= MIN_SHARE
    usable &= (score >= MIN_SCORE) & (np.linalg.eigvalsh(normal)[..., 0] > MIN_TEXTURE)
    inverse = np.linalg.inv(np.where(usable[..., None, None], normal, np.eye(2)))
    shift = np.where(usable[..., None], np.einsum("...ij,...j->...i", inverse, offset), 0.0)
    unexplained = average(difference * difference) - np.einsum("...i,...i->...", shift, offset)
    covariance = inverse @ average_products(smooth, smooth) @ inverse
    covariance *= (np.maximum(unexplained, 1e-9) / size**2)[..., None, None]
    half_px = 0.0 if size % 2 else 0.5  # the box of an even size reaches farther up and left
    x, y = np.meshgrid(
        np.arange(first, cols, STEP_PX) - half_px, np.arange(first, rows, STEP_PX) - half_px
    )
    return Shifts(x, y, shift, covariance, usable, max(1.0, (size / STEP_PX) ** 2))


def _normalise(image: Float32Array, valid: BoolArray, size: int, blur_px: float) -> Float32Array:
    """Subtract the mean of the window about each pixel, divide by its scatter."""
    plain = np.where(valid, image, 0.0).astype(np.float32)
    if blur_px > 0.0:
        plain = cv2.GaussianBlur(plain, (0, 0), blur_px).astype(np.float32)
    level = cv2.boxFilter(plain, cv2.CV_32F, (size, size))
    centred = plain - level
    spread = np.sqrt(np.maximum(cv2.boxFilter(centred * centred, cv2.CV_32F, (size, size)), 1e-12))
    levelled: Float32Array = np.where(valid, centred / spread, 0.0).astype(np.float32)
    return levelled


def _differentiate(image: Float32Array) -> Gradients:
    """Return central differences along x and y."""
    half = np.array([[-0.5, 0.0, 0.5]], np.float32)
    return (
        np.asarray(cv2.filter2D(image, cv2.CV_32F, half), np.float32),
        np.asarray(cv2.filter2D(image, cv2.CV_32F, half.T.copy()), np.float32),
    )
