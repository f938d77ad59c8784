"""A colour picture to draw on in the pixels of the frame that it shows."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import ByteArray, Float32Array, FloatArray, Int32Array
from catalog.errors import OutputError
from catalog.geometry.kernel import kernel
from optnav_cli.estimation.robust import MAD_TO_SIGMA

DARK, BRIGHT = 0.5, 99.7  # percentiles that become black and white
SAMPLES = 1 << 16  # pixels that the percentiles are taken from
TABLE = 1 << 16  # counts below it are looked up
# Level 3 takes a third more time for a tenth less; 9 takes 15 times as long. Of few levels of gray
# filters make no shorter files, and take half of the time.
PNG_LEVEL = 2
# What stands so far out of the scatter about the median, or by so much of the whole range, is lit.
LIT_SIGMAS, LIT_SHARE = 12.0, 0.05
LIT_BRIGHT = 97.0  # percentile of it that becomes white
GAMMA = 0.8  # lifts the shadows a little; below 1 is brighter
Bgr = tuple[int, int, int]
FONT = cv2.FONT_HERSHEY_SIMPLEX
TEXT_SIZE = 0.45
SUBPIXEL_BITS = 4  # OpenCV draws at sixteenths of a pixel
GRAY_STEP = 4  # levels of gray are thinned out: noise takes most of a PNG's bytes, nobody sees it
SHADE = 0.8  # the picture is dimmed a little under the marks


def scale_to_eight_bits(picture: NDArray[np.generic]) -> ByteArray:
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
    most = float(np.max(values))
    if not np.isfinite(most):
        most = float(np.max(values, where=np.isfinite(values), initial=-np.inf))
    high = max(high, _find_light_level(values, sample, most))
    if high <= low:  # one value nearly everywhere: show it as what it is
        low, high = min(low, 0.0), max(high, low + 1.0, 255.0)
    # counts are few different numbers: a table of them is quicker than a power for each pixel
    if float(np.min(values)) >= 0.0 and most < TABLE:
        shades = _shade(np.arange(int(most) + 1, dtype=np.float32), low, high)
        looked_up = np.empty(values.shape, dtype=np.uint8)
        if _look_up(values, shades, looked_up):
            return looked_up
    return _shade(np.nan_to_num(values, nan=low), low, high)


@kernel
def _look_up(values: Float32Array, shades: ByteArray, found: ByteArray) -> bool:
    """Write the shade of each count; stops with False at a row where a value is no whole count."""
    rows, cols = values.shape
    for r in range(rows):
        others = 0
        for c in range(cols):  # of no branches: the processor takes many pixels at once
            inside = values[r, c] < shades.size  # no integer is defined for infinity
            count = np.int32(values[r, c] if inside else np.float32(0.0))
            others += 0 if inside & (np.float32(count) == values[r, c]) else 1
        if others:
            return False
        for c in range(cols):
            found[r, c] = shades[np.uint64(values[r, c])]
    return True


def _shade(values: Float32Array, low: float, high: float) -> ByteArray:
    scaled = np.clip((values - low) / (high - low), 0.0, 1.0)
    levels: ByteArray = np.rint(255.0 * scaled**GAMMA).astype(np.uint8)
    return levels


def _find_light_level(values: Float32Array, sample: Float32Array, most: float) -> float:
    """Find nearly the brightest of what is lit in a picture of sky; minus infinity for nothing.

    most  the highest finite value
    """
    sky = float(np.median(sample))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(sample - sky)))
    lit = values[values > sky + max(LIT_SIGMAS * scatter, LIT_SHARE * (most - sky))]
    lit = lit[:: 1 + lit.size // SAMPLES]
    lit = lit[np.isfinite(lit)]
    return float(np.percentile(lit, LIT_BRIGHT)) if lit.size else -np.inf


def compute_shrink_factor(width_px: int, height_px: int, longest_px: int) -> float:
    """Compute the factor, at most 1, that brings the longer side down to `longest_px`."""
    return min(1.0, longest_px / max(width_px, height_px, 1))


def resize_picture(picture: ByteArray, factor: float) -> ByteArray:
    """Scale a picture by area means; both sides keep at least one pixel."""
    if factor == 1.0:
        return picture
    height, width = (max(1, round(side * factor)) for side in picture.shape[:2])
    smaller = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    return smaller.astype(np.uint8, copy=False)


def encode_picture(picture: ByteArray, suffix: str, quality: int = 85) -> bytes:
    """Encode a picture as ".png" or ".jpg" (`quality` 0..100 for the latter)."""
    jpeg = suffix == ".jpg"
    options = (
        [cv2.IMWRITE_JPEG_QUALITY, quality]
        if jpeg
        else [
            *(cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL),
            *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE),
        ]
    )
    done, data = cv2.imencode(suffix, picture, options)
    if not done:
        raise OutputError(f"a picture of {picture.shape} pixels cannot be written as {suffix}")
    return data.tobytes()


@dataclass(frozen=True)
class Canvas:
    """A colour picture and the way from the frame's pixels to its own.

    factor  its pixels a pixel of the frame
    origin  the frame's pixel at its upper left
    """

    image: ByteArray
    factor: float
    origin: tuple[int, int] = (0, 0)

    def place(self, pixels: FloatArray) -> Int32Array:
        """Return frame pixels (..., 2) as OpenCV's fixed-point canvas coordinates."""
        scaled = (np.asarray(pixels) - self.origin + 0.5) * self.factor - 0.5
        places: Int32Array = np.rint(scaled * 2**SUBPIXEL_BITS).astype(np.int32)
        return places

    def line(self, pixels: FloatArray, colour: Bgr, width: int, closed: bool = False) -> None:
        """Draw a line through frame pixels (n, 2), so many canvas pixels wide."""
        points = self.place(pixels)
        cv2.polylines(self.image, [points], closed, colour, width, cv2.LINE_AA, SUBPIXEL_BITS)

    def ring(self, pixel: FloatArray, radius: float, colour: Bgr, width: int = 2) -> None:
        """Draw a circle about a frame pixel, sizes in canvas pixels; width -1: filled."""
        x, y = (int(v) for v in self.place(pixel))
        r = int(radius * 2**SUBPIXEL_BITS)
        cv2.circle(self.image, (x, y), r, colour, width, cv2.LINE_AA, SUBPIXEL_BITS)

    def cross(self, pixel: FloatArray, arm: float, colour: Bgr, width: int = 2) -> None:
        """Draw a slanted cross, arms in canvas pixels."""
        reach = arm / self.factor
        for dx, dy in ((reach, reach), (reach, -reach)):
            self.line(np.array([pixel - (dx, dy), pixel + (dx, dy)]), colour, width)

    def diamond(self, pixel: FloatArray, reach: float, colour: Bgr) -> None:
        """Draw a hollow square on its corner, half its diagonal in canvas pixels."""
        corners = np.array([(0.0, -1.0), (1.0, 0.0), (0.0, 1.0), (-1.0, 0.0)])
        self.line(pixel + corners * (reach / self.factor), colour, 1, closed=True)

    def aim(self, pixel: FloatArray, reach: float, colour: Bgr) -> None:
        """Draw four strokes towards a frame pixel that leave it free, in canvas pixels."""
        for dx, dy in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
            ends = np.array([0.35, 1.0])[:, None] * reach / self.factor * np.array([dx, dy])
            self.line(pixel + ends, colour, 2)

    def dots(self, pixels: FloatArray, colour: Bgr, radius: float = 2.0) -> None:
        """Draw discs about frame pixels (n, 2), their radius in canvas pixels."""
        r = int(radius * 2**SUBPIXEL_BITS)
        for centre in self.place(pixels).tolist():
            cv2.circle(self.image, centre, r, colour, -1, cv2.LINE_AA, SUBPIXEL_BITS)

    def text(self, words: str, x: float, y: float, colour: Bgr) -> None:
        """Draw words with a dark rim, their lower left corner at canvas pixel x, y."""
        at = round(x), round(y)
        # A rim by shifting: OpenCV 5 spaces thick letters wider, so a thick copy would not fit.
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            shifted = at[0] + dx, at[1] + dy
            cv2.putText(self.image, words, shifted, FONT, TEXT_SIZE, (0, 0, 0), 1, cv2.LINE_AA)
        cv2.putText(self.image, words, at, FONT, TEXT_SIZE, colour, 1, cv2.LINE_AA)


def measure_text(words: str) -> int:
    """Measure how wide `Canvas.text` writes, canvas pixels."""
    (width, _), _ = cv2.getTextSize(words, FONT, TEXT_SIZE, 1)
    return int(width)


def shade_picture(gray: ByteArray) -> ByteArray:
    """Shade a picture (h, w) for marks to be drawn on."""
    dim = np.asarray(gray * SHADE, dtype=np.uint8) // GRAY_STEP * GRAY_STEP
    return cv2.cvtColor(dim, cv2.COLOR_GRAY2BGR).astype(np.uint8, copy=False)
