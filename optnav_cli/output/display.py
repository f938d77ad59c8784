"""Pictures as people see them: 8 bits, stretched, and small enough."""

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import ByteArray, Float32Array
from catalog.errors import OutputError

DARK, BRIGHT = 0.5, 99.7  # percentiles that become black and white
SAMPLES = 1 << 16  # pixels that the percentiles are taken from
PNG_LEVEL = (
    3  # a tenth smaller than OpenCV's default in a third more time; 9 takes 15 times as long
)
# What stands so far out of the scatter about the median, or by so much of the whole range, is lit.
LIT_SIGMAS, LIT_SHARE = 12.0, 0.05
LIT_BRIGHT = 97.0  # percentile of it that becomes white
MAD_TO_SIGMA = 1.4826
GAMMA = 0.8  # lifts the shadows a little; below 1 is brighter


def eight_bits(picture: NDArray[np.generic]) -> ByteArray:
    """Stretch a picture (h, w) of any number type to 8 bits; what is not finite is black.

    A small disc in a wide sky is stretched by its own light, not by the sky's noise.
    """
    values = np.asarray(picture, dtype=np.float32)
    step = max(1, values.size // SAMPLES)
    sample = values.ravel()[::step]
    sample = sample[np.isfinite(sample)]
    if sample.size == 0:
        return np.zeros(values.shape, dtype=np.uint8)
    low, high = (float(v) for v in np.percentile(sample, [DARK, BRIGHT]))
    high = max(high, _light(values, sample))
    if high <= low:  # one value nearly everywhere: show it as what it is
        low, high = min(low, 0.0), max(high, low + 1.0, 255.0)
    scaled = np.clip((np.nan_to_num(values, nan=low) - low) / (high - low), 0.0, 1.0)
    return np.asarray(np.rint(255.0 * scaled**GAMMA), dtype=np.uint8)


def _light(values: Float32Array, sample: Float32Array) -> float:
    """Nearly the brightest of what is lit in a picture of sky; minus infinity for nothing."""
    sky = float(np.median(sample))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(sample - sky)))
    most = float(np.max(values, where=np.isfinite(values), initial=sky))
    lit = values[values > sky + max(LIT_SIGMAS * scatter, LIT_SHARE * (most - sky))]
    lit = lit[np.isfinite(lit)]
    return float(np.percentile(lit, LIT_BRIGHT)) if lit.size else -np.inf


def shrink_factor(width_px: int, height_px: int, longest_px: int) -> float:
    """The factor, at most 1, that brings the longer side down to `longest_px`."""
    return min(1.0, longest_px / max(width_px, height_px, 1))


def resized(picture: ByteArray, factor: float) -> ByteArray:
    """A picture scaled by area means; both sides keep at least one pixel."""
    if factor == 1.0:
        return picture
    height, width = (max(1, round(side * factor)) for side in picture.shape[:2])
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def encoded(picture: ByteArray, suffix: str, quality: int = 85) -> bytes:
    """The bytes of a picture as ".png" or ".jpg" (`quality` 0..100 for the latter)."""
    options = (
        [cv2.IMWRITE_JPEG_QUALITY, quality]
        if suffix == ".jpg"
        else [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL]
    )
    done, data = cv2.imencode(suffix, picture, options)
    if not done:
        raise OutputError(f"a picture of {picture.shape} pixels cannot be written as {suffix}")
    return data.tobytes()
