"""A picture at several resolutions, so that coarse map grids average it, not pick pixels."""

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.grid import bicubic_at
from catalog.geometry.kernel import bare_kernel, kernel

BLOCK = 512  # places that are sampled side by side
NONE = np.uint32(2**32 - 1)  # no row of a picture


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


@kernel
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
    row, col = np.empty(BLOCK), np.empty(BLOCK)
    top, left = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.uint32)
    down, across = np.empty((4, BLOCK), np.float32), np.empty((4, BLOCK), np.float32)
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    for first in range(0, out.size, BLOCK):
        size = min(BLOCK, out.size - first)
        # loops of their own over plain arrays: the processor takes several places at once
        for k in range(size):
            x, y = pixels[first + k, 0], pixels[first + k, 1]
            seen = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
            # the last rows and columns that fill no whole block take the nearest block's value
            row[k] = min((y - shift) * inverse, rows - 0.5) if seen else np.nan
            col[k] = min((x - shift) * inverse, cols - 0.5) if seen else np.nan
        for k in range(size):
            inner = (row[k] >= 1.0) & (row[k] < rows - 2.0)
            inner &= (col[k] >= 1.0) & (col[k] < cols - 2.0)
            r, c = np.int32(row[k] if inner else 1.0), np.int32(col[k] if inner else 1.0)
            top[k], left[k] = r - 1 if inner else NONE, c - 1
            down[0, k], across[0, k] = np.float32(row[k] - r), np.float32(col[k] - c)
        for k in range(size):
            weights = _weights(down[0, k])
            down[0, k], down[1, k], down[2, k], down[3, k] = weights
            weights = _weights(across[0, k])
            across[0, k], across[1, k], across[2, k], across[3, k] = weights
        for k in range(size):
            if top[k] == NONE:
                if row[k] == row[k]:
                    out[first + k] = bicubic_at(level, row[k], col[k])
                continue
            # as bicubic_at, in single precision, which a picture is stored in: half the time;
            # indices are unsigned: none counts from the end
            i, j = np.uint64(top[k]), np.uint64(left[k])
            x0, x1, x2, x3 = across[0, k], across[1, k], across[2, k], across[3, k]
            value = np.float32(0.0)
            for w in range(4):
                a, b = level[i, j], level[i, j + one]
                d, e = level[i, j + two], level[i, j + three]
                value += down[w, k] * (x0 * a + x1 * b + x2 * d + x3 * e)
                i += one
            out[first + k] = value


@bare_kernel
def _weights(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """`cubic_weights` in single precision."""
    half, two = np.float32(0.5), np.float32(2.0)
    t2, t3 = t * t, t * t * t
    outer = t2 - half * (t + t3)
    inner = half * t + two * t2 - np.float32(1.5) * t3
    return outer, np.float32(1.0) - outer - inner - half * (t3 - t2), inner, half * (t3 - t2)
