"""A recognition trial's picture of rendered ground: blur, noise, exposure, 8 bits."""

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel

FINER = 2  # the picture's ground has this many nodes to one of the reference
PSF_SIGMA_PX = 0.7
COUNTS = 255.0
# the brightest percent of a picture may saturate: exposure is set by what is seen
EXPOSURE_PERCENTILE = 99.5
# Ground beyond the window that its outermost pixels depend on, truth nodes: four sigma of the blur,
# one for sampling, one for the slope.
PICTURE_MARGIN = 8


def picture_of(
    brightness: Float32Array,
    ground_from_picture: FloatArray,
    origin: FloatArray,
    size: int,
    averaging: int,
    snr: float,
    rng: np.random.Generator,
) -> Float32Array:
    """The resampled picture (size, size): blurred, sampled, noisy, in 8 bits.

    brightness           (t, t)  on the truth grid
    ground_from_picture  (2, 2)  offsets in the picture to offsets on the truth grid, node to node,
                                 x along columns, y along rows
    origin               (2,)    truth column and row under the picture's centre
    averaging                    picture pixels averaged into one node, each way: lowers the noise
    """
    # a pixel integrates over its own area: a box of one node has sigma 1/sqrt(12)
    sigma = FINER * np.hypot(PSF_SIGMA_PX / averaging, 1.0 / np.sqrt(12.0))
    blurred = cv2.GaussianBlur(brightness, (0, 0), float(sigma))
    centre = np.full(2, (size - 1) / 2.0)
    matrix = np.column_stack([ground_from_picture, origin - ground_from_picture @ centre])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    sampled = cv2.warpAffine(blurred, matrix, (size, size), flags=flags, borderValue=float("nan"))
    noise = rng.standard_normal((size, size), dtype=np.float32)
    return exposed(np.asarray(sampled, dtype=np.float32), noise, 1.0 / (snr * averaging))


@kernel
def _sum_of_valid(sampled: Float32Array) -> tuple[float, int]:
    """Sum and number of the values that are not NaN."""
    total, valid = 0.0, 0
    for r in range(sampled.shape[0]):
        for c in range(sampled.shape[1]):
            if sampled[r, c] == sampled[r, c]:
                total += sampled[r, c]
                valid += 1
    return total, valid


@kernel
def _insert(top: Float32Array, value: np.float32) -> None:
    """Put a value into a rising array in the place of its first element."""
    k = 1
    while k < top.size and top[k] < value:
        top[k - 1] = top[k]
        k += 1
    top[k - 1] = value


@kernel
def exposed(sampled: Float32Array, noise: Float32Array, relative_noise: float) -> Float32Array:
    """Whole counts (rows, cols) of brightness with noise, NaN where the brightness is.

    noise           (rows, cols)  of unit variance
    relative_noise  its share of the mean brightness
    """
    rows, cols = sampled.shape
    total, valid = _sum_of_valid(sampled)
    out = np.empty_like(sampled)
    if valid == 0:
        out[:] = np.nan
        return out
    # the percentile lies between two of the brightest, the first two of `top`, which rises
    place = (valid - 1) * EXPOSURE_PERCENTILE / 100.0
    below = int(place)
    top = np.full(valid - below, -np.inf, np.float32)
    sigma = np.float32(total / valid * relative_noise)
    for r in range(rows):
        for c in range(cols):
            value = sampled[r, c] + noise[r, c] * sigma
            out[r, c] = value
            if value > top[0]:
                _insert(top, value)
    white = float(top[0])
    if top.size > 1:
        white += (place - below) * (float(top[1]) - white)
    gain = np.float32(COUNTS / max(white, 1e-6))
    for r in range(rows):
        line = out[r]
        for c in range(cols):
            line[c] = min(max(np.rint(line[c] * gain), np.float32(0.0)), np.float32(COUNTS))
    for r in range(rows):
        for c in range(cols):
            if sampled[r, c] != sampled[r, c]:
                out[r, c] = np.nan
    return out


def side_under(ground_from_picture: FloatArray, offset: FloatArray, size: int, largest: int) -> int:
    """Nodes a side, even, of the centred part of the truth grid that a picture needs.

    ground_from_picture, size  as `picture_of` takes them
    offset   (2,)  truth nodes from the grid's centre to the picture's
    largest  side of the whole, even
    """
    reach = np.abs(offset) + np.abs(ground_from_picture).sum(axis=1) * (size - 1) / 2.0
    return min(2 * int(np.ceil(reach.max() + PICTURE_MARGIN + 0.5)), largest)
