"""A picture at several resolutions, so that coarse map grids average it, not pick pixels."""

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.grid import sample_bicubic


class PicturePyramid:
    """Samples a picture at any place, averaged over about the footprint of a map node.

    picture (height, width) float32
    """

    def __init__(self, picture: Float32Array) -> None:
        self._levels: dict[int, Float32Array] = {1: np.ascontiguousarray(picture, dtype=np.float32)}

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the picture, px."""
        height, width = self._levels[1].shape
        return int(height), int(width)

    def sample(self, pixels: FloatArray, pixels_per_node: float) -> Float32Array:
        """Brightness at pixels (..., 2); NaN outside the picture or where a pixel is NaN.

        pixels_per_node  picture pixels that one node of the map grid spans
        """
        height, width = self.shape
        # A block of up to one node; cubic interpolation between blocks does the rest.
        smallest_side = max(1, min(self.shape) // 8)
        factor = int(min(max(1.0, np.floor(pixels_per_node + 0.25)), smallest_side))
        level = self._level(factor)
        with np.errstate(invalid="ignore"):
            x, y = pixels[..., 0], pixels[..., 1]
            inside = (x >= -0.5) & (y >= -0.5) & (x <= width - 0.5) & (y <= height - 0.5)
        # the centre of the first block of `factor` pixels lies at (factor - 1) / 2
        shift = (factor - 1) / 2.0
        # Not cv2.remap: its cubic kernel (a = -3/4) does not give a ramp back. It moves a pattern
        # by up to 0.05 px, the same at all nodes of a grid that happens to step with the pixels.
        row = np.where(inside, (y - shift) / factor, np.nan)
        col = np.where(inside, (x - shift) / factor, np.nan)
        rows, cols = level.shape
        # the last rows and columns that fill no whole block take the nearest block's value
        return sample_bicubic(level, np.minimum(row, rows - 0.5), np.minimum(col, cols - 0.5))

    def _level(self, factor: int) -> Float32Array:
        if factor not in self._levels:
            picture = self._levels[1]
            rows, cols = picture.shape[0] // factor, picture.shape[1] // factor
            whole = picture[: rows * factor, : cols * factor]
            level = cv2.resize(whole, (cols, rows), interpolation=cv2.INTER_AREA)
            self._levels[factor] = np.asarray(level, dtype=np.float32)
        return self._levels[factor]
