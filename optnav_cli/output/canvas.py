"""A colour picture to draw on in the pixels of the frame that it shows."""

from dataclasses import dataclass

import cv2
import numpy as np

from catalog.arrays import ByteArray, FloatArray, Int32Array

Bgr = tuple[int, int, int]
FONT = cv2.FONT_HERSHEY_SIMPLEX
TEXT_SIZE = 0.45
SUBPIXEL_BITS = 4  # OpenCV draws at sixteenths of a pixel
GRAY_STEP = 4  # levels of gray are thinned out: noise takes most of a PNG's bytes, nobody sees it
SHADE = 0.8  # the picture is dimmed a little under the marks
# Blue, green, red. Told apart by people with colour-blindness too, and by shape.
PREDICTED = (255, 190, 60)
FOUND = (90, 240, 110)
REJECTED = (80, 90, 255)
RESIDUAL = (60, 220, 255)
OUTLINE = (210, 170, 80)
DISC = (60, 220, 255)
RESIDUALS_ENLARGED = 50.0


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
        """(..., 2) frame pixels as OpenCV's fixed-point canvas coordinates."""
        scaled = (np.asarray(pixels) - self.origin + 0.5) * self.factor - 0.5
        return np.asarray(np.rint(scaled * 2**SUBPIXEL_BITS), dtype=np.int32)

    def line(self, pixels: FloatArray, colour: Bgr, width: int, closed: bool = False) -> None:
        """A line through frame pixels (n, 2), so many canvas pixels wide."""
        points = self.place(pixels)
        cv2.polylines(self.image, [points], closed, colour, width, cv2.LINE_AA, SUBPIXEL_BITS)

    def ring(self, pixel: FloatArray, radius: float, colour: Bgr) -> None:
        """A circle about a frame pixel, its radius in canvas pixels."""
        x, y = (int(v) for v in self.place(pixel))
        r = int(radius * 2**SUBPIXEL_BITS)
        cv2.circle(self.image, (x, y), r, colour, 2, cv2.LINE_AA, SUBPIXEL_BITS)

    def cross(self, pixel: FloatArray, arm: float, colour: Bgr) -> None:
        """A slanted cross, arms in canvas pixels."""
        reach = arm / self.factor
        for dx, dy in ((reach, reach), (reach, -reach)):
            self.line(np.array([pixel - (dx, dy), pixel + (dx, dy)]), colour, 2)

    def aim(self, pixel: FloatArray, reach: float, colour: Bgr) -> None:
        """Four strokes towards a frame pixel that leave it free, in canvas pixels."""
        for dx, dy in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
            ends = np.array([0.35, 1.0])[:, None] * reach / self.factor * np.array([dx, dy])
            self.line(pixel + ends, colour, 2)

    def dot(self, pixel: FloatArray, colour: Bgr, radius: float = 2.0) -> None:
        """A disc about a frame pixel, its radius in canvas pixels."""
        x, y = (int(v) for v in self.place(pixel))
        r = int(radius * 2**SUBPIXEL_BITS)
        cv2.circle(self.image, (x, y), r, colour, -1, cv2.LINE_AA, SUBPIXEL_BITS)

    def text(self, words: str, x: float, y: float, colour: Bgr) -> None:
        """Words with a dark rim, their lower left corner at canvas pixel x, y."""
        at = round(x), round(y)
        # A rim by shifting: OpenCV 5 spaces thick letters wider, so a thick copy would not fit.
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            shifted = at[0] + dx, at[1] + dy
            cv2.putText(self.image, words, shifted, FONT, TEXT_SIZE, (0, 0, 0), 1, cv2.LINE_AA)
        cv2.putText(self.image, words, at, FONT, TEXT_SIZE, colour, 1, cv2.LINE_AA)


def text_width(words: str) -> int:
    """How wide `Canvas.text` writes, canvas pixels."""
    (width, _), _ = cv2.getTextSize(words, FONT, TEXT_SIZE, 1)
    return int(width)


def dimmed(gray: ByteArray) -> ByteArray:
    """A picture (h, w) as what marks are drawn on."""
    dim = np.asarray(gray * SHADE, dtype=np.uint8) // GRAY_STEP * GRAY_STEP
    return np.asarray(cv2.cvtColor(dim, cv2.COLOR_GRAY2BGR), np.uint8)
