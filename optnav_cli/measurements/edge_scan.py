"""Candidates for the limb: rises from dark to bright along rows and columns, in both directions.

Source: Zhukov 2025, ch. 2: a threshold and a derivative test, scanning rows and columns forward and
back. A rise counts when the pixels before it are dark and those after it are bright for some way,
so that stars' cores and hot pixels are no rises.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray, IntArray
from catalog.geometry.kernel import kernel

RUN_PX = 3  # dark pixels before a rise and bright ones after it
MAX_CANDIDATES = 200_000  # a picture full of texture has no limb worth finding in it
_STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))


@dataclass(frozen=True, eq=False)
class Candidates:
    """Rises from dark to bright.

    pixels    (n, 2)  x, y where the threshold is crossed
    scan      (n, 2)  unit vector of the scan, from dark to bright
    gradient  (n, 2)  of brightness over 5 x 5 pixels, counts / px
    """

    pixels: FloatArray
    scan: FloatArray
    gradient: FloatArray

    def __len__(self) -> int:
        return len(self.pixels)

    def subset(self, kept: BoolArray | IntArray) -> "Candidates":
        """Those that a mask or an index array keeps."""
        return Candidates(self.pixels[kept], self.scan[kept], self.gradient[kept])


@kernel
def _rises(
    picture: Float32Array,
    threshold: float,
    least_rise: float,
    row_step: int,
    places: FloatArray,
    directions: IntArray,
) -> int:
    """Rises along rows (row_step 0) or columns (1), both ways; returns their number."""
    height, width = picture.shape
    dy, dx = row_step, 1 - row_step
    forward = 2 * row_step
    count = 0
    for y in range(RUN_PX * dy, height - RUN_PX * dy):
        for x in range(RUN_PX * dx, width - RUN_PX * dx):
            here = picture[y, x]
            after = picture[y + dy, x + dx]
            if (here < threshold) == (after < threshold):
                continue
            up = here < threshold
            # `step` walks from the dark pixel of the pair to the bright one
            step = 1 if up else -1
            y0, x0 = (y, x) if up else (y + dy, x + dx)
            clean = True
            for k in range(1, RUN_PX):
                dark = picture[y0 - k * step * dy, x0 - k * step * dx]
                lit = picture[y0 + (k + 1) * step * dy, x0 + (k + 1) * step * dx]
                if dark >= threshold or lit < threshold:
                    clean = False
                    break
            if not clean:
                continue
            far = picture[y0 + 3 * step * dy, x0 + 3 * step * dx]
            if far - picture[y0 - step * dy, x0 - step * dx] < least_rise:
                continue
            if count == places.shape[0]:
                return count
            low = here if up else after
            high = after if up else here
            part = (threshold - low) / (high - low)
            places[count, 0] = x0 + part * step * dx
            places[count, 1] = y0 + part * step * dy
            directions[count] = forward + (0 if up else 1)
            count += 1
    return count


@kernel
def _gradients(picture: Float32Array, places: FloatArray, gradients: FloatArray) -> None:
    """Brightness gradient by differences three pixels apart, averaged over five lines."""
    height, width = picture.shape
    for i in range(places.shape[0]):
        x = min(max(round(places[i, 0]), 2), width - 3)
        y = min(max(round(places[i, 1]), 2), height - 3)
        gx, gy = 0.0, 0.0
        for k in range(-2, 3):
            gx += picture[y + k, x + 2] - picture[y + k, x - 2]
            gx += picture[y + k, x + 1] - picture[y + k, x - 1]
            gy += picture[y + 2, x + k] - picture[y - 2, x + k]
            gy += picture[y + 1, x + k] - picture[y - 1, x + k]
        gradients[i, 0], gradients[i, 1] = gx / 30.0, gy / 30.0


def scan_edges(picture: Float32Array, threshold: float, least_rise: float) -> Candidates:
    """Rises of a picture (h, w) through a threshold that gain least_rise within four pixels."""
    picture = np.ascontiguousarray(picture, dtype=np.float32)
    places, directions = [], []
    for row_step in (0, 1):
        room = np.empty((MAX_CANDIDATES, 2))
        ways = np.empty(MAX_CANDIDATES, dtype=np.int64)
        count = _rises(picture, threshold, least_rise, row_step, room, ways)
        places.append(room[:count])
        directions.append(ways[:count])
    pixels = np.concatenate(places)
    gradient = np.empty_like(pixels)
    _gradients(picture, pixels, gradient)
    scan = np.array(_STEPS, dtype=np.float64)[np.concatenate(directions)]
    return Candidates(pixels, scan, gradient)
