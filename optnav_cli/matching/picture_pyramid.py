"""A picture at several resolutions, so that coarse map grids average it, not pick pixels."""

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.grid import bicubic_at
from catalog.geometry.kernel import bare_kernel


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
        places = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 2)
        out = np.full(len(places), np.nan, np.float32)
        _sample(level, places, factor, height, width, out)
        return out.reshape(pixels.shape[:-1])

    def _level(self, factor: int) -> Float32Array:
        if factor not in self._levels:
            picture = self._levels[1]
            rows, cols = picture.shape[0] // factor, picture.shape[1] // factor
            whole = picture[: rows * factor, : cols * factor]
            level = cv2.resize(whole, (cols, rows), interpolation=cv2.INTER_AREA)
            self._levels[factor] = np.asarray(level, dtype=np.float32)
        return self._levels[factor]


@bare_kernel
def _sample(
    level: Float32Array,
    pixels: FloatArray,
    factor: int,
    height: int,
    width: int,
    out: Float32Array,
) -> None:
    """Fill brightness (n,) at pixels (n, 2) of a picture, from its means over blocks of `factor`.

    Places outside the picture stay as they are.
    """
    # Not cv2.remap: its cubic kernel (a = -3/4) does not give a ramp back. It moves a pattern by
    # up to 0.05 px, the same at all nodes of a grid that happens to step with the pixels.
    rows, cols = level.shape
    # the centre of the first block of `factor` pixels lies at (factor - 1) / 2
    shift, inverse = (factor - 1) / 2.0, 1.0 / factor
    for i in range(out.size):
        x, y = pixels[i, 0], pixels[i, 1]
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            continue
        # the last rows and columns that fill no whole block take the nearest block's value
        row, col = min((y - shift) * inverse, rows - 0.5), min((x - shift) * inverse, cols - 0.5)
        if not (1.0 <= row < rows - 2.0 and 1.0 <= col < cols - 2.0):
            out[i] = bicubic_at(level, row, col)
            continue
        # as bicubic_at, in single precision, which a picture is stored in: half the time
        r, c = int(row), int(col)
        w0, w1, w2, w3 = _weights(np.float32(row - r))
        x0, x1, x2, x3 = _weights(np.float32(col - c))
        a, b, d, e = level[r - 1], level[r], level[r + 1], level[r + 2]
        value = w0 * (x0 * a[c - 1] + x1 * a[c] + x2 * a[c + 1] + x3 * a[c + 2])
        value += w1 * (x0 * b[c - 1] + x1 * b[c] + x2 * b[c + 1] + x3 * b[c + 2])
        value += w2 * (x0 * d[c - 1] + x1 * d[c] + x2 * d[c + 1] + x3 * d[c + 2])
        value += w3 * (x0 * e[c - 1] + x1 * e[c] + x2 * e[c + 1] + x3 * e[c + 2])
        out[i] = value


@bare_kernel
def _weights(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """`cubic_weights` in single precision."""
    half, two = np.float32(0.5), np.float32(2.0)
    t2, t3 = t * t, t * t * t
    outer = t2 - half * (t + t3)
    inner = half * t + two * t2 - np.float32(1.5) * t3
    return outer, np.float32(1.0) - outer - inner - half * (t3 - t2), inner, half * (t3 - t2)
