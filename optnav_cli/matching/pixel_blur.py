"""A rendered map grid as a picture shows it: averaged over what each pixel sees of the ground.

A lens and its pixels average light over angles. Seen obliquely such an angle spans several times as
much ground outwards as across, more on slopes that face away from the camera than on those that
face it, and nothing of those turned from it. A template that lacks this is found some 10 m nearer
to the camera's nadir for a squared tangent of the emission of 1, at 948 m from node to node.
"""

import math

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel
from optnav_cli.camera.camera import PIXEL_SIGMA_PX, Camera

# Blur of a lens of which none is stated: templates fit pictures of 0.7 px nearly as well by 0.6 as
# by 0.8.
ASSUMED_PSF_PX = 0.6
# Sigma, in nodes, of a blur that counts, in the median of some nodes. Below it the picture resolves
# what the grid holds, and of relief so fine terrain models have little that is true: over ground
# off as the Moon's is from GLD100 fixes are no better with it.
LEAST_NODES = 0.8
PROBE_NODES = 8  # from one node to the next that tell whether the blur counts
MOST_NODES = 12  # that a blur reaches to either side
# The weight (1 - d^2 / reach^2)^4 has the variance of a Gaussian whose sigma is reach / sqrt(12).
REACH = math.sqrt(12.0)


def sigma_px(camera: Camera) -> float:
    """Sigma of the blur of a camera's lens and pixels together, px."""
    psf = ASSUMED_PSF_PX if camera.psf_sigma_px is None else camera.psf_sigma_px
    return math.hypot(psf, PIXEL_SIGMA_PX)


def as_seen(grid: Float32Array, pixels: FloatArray, blur_px: float) -> Float32Array:
    """A grid (n, n) about the middle of pixels (m, m, 2), m > n, each node averaged as it is seen.

    pixels   where the nodes are seen; NaN outside the camera's view
    blur_px  sigma of the camera's blur
    NaN of the grid stays and takes no part. Where the blur is below LEAST_NODES, the grid itself.
    """
    size, border = grid.shape[0], (pixels.shape[0] - grid.shape[0]) // 2
    places = np.ascontiguousarray(pixels)
    area, reach = np.zeros((size, size)), np.zeros((2, size, size), np.float32)
    _fill_footprints(places, border, blur_px * REACH, PROBE_NODES, area, reach)
    probed = reach[:, ::PROBE_NODES, ::PROBE_NODES]
    if np.median(probed, axis=(1, 2)).max() < LEAST_NODES * REACH:
        return grid
    _fill_footprints(places, border, blur_px * REACH, 1, area, reach)
    out = np.empty_like(grid)
    _average(grid, places, border, area, reach, blur_px * REACH, out)
    return out


@kernel
def _fill_footprints(
    pixels: FloatArray,
    border: int,
    reach_px: float,
    step: int,
    area: FloatArray,
    reach: Float32Array,
) -> None:
    """What some nodes cover of the picture, and how far a circle about each reaches there.

    step   from one node to the next
    area   (size, size) px^2, 0 of ground that is turned from the camera
    reach  (2, size, size) nodes down and along that `reach_px` spans
    """
    size, facing = area.shape[0], 0.0
    for i in range(0, size, step):
        for j in range(0, size, step):
            p, q = i + border, j + border
            down_x = 0.5 * (pixels[p + 1, q, 0] - pixels[p - 1, q, 0])
            down_y = 0.5 * (pixels[p + 1, q, 1] - pixels[p - 1, q, 1])
            along_x = 0.5 * (pixels[p, q + 1, 0] - pixels[p, q - 1, 0])
            along_y = 0.5 * (pixels[p, q + 1, 1] - pixels[p, q - 1, 1])
            turned = down_x * along_y - down_y * along_x
            if turned == turned and turned != 0.0:
                area[i, j] = turned
                facing += turned
                reach[0, i, j] = reach_px * math.hypot(along_x, along_y) / abs(turned)
                reach[1, i, j] = reach_px * math.hypot(down_x, down_y) / abs(turned)
    # ground that is turned from the camera is seen the other way round
    sign = 1.0 if facing >= 0.0 else -1.0
    for i in range(0, size, step):
        for j in range(0, size, step):
            area[i, j] = max(sign * area[i, j], 0.0)


@kernel
def _average(
    grid: Float32Array,
    pixels: FloatArray,
    border: int,
    area: FloatArray,
    reach: Float32Array,
    reach_px: float,
    out: Float32Array,
) -> None:
    size, per_square = grid.shape[0], 1.0 / reach_px**2
    for i in range(size):
        for j in range(size):
            out[i, j] = grid[i, j]
            x, y = pixels[i + border, j + border, 0], pixels[i + border, j + border, 1]
            if grid[i, j] != grid[i, j] or reach[0, i, j] == 0.0:
                continue
            down = int(min(reach[0, i, j], MOST_NODES - 1)) + 1
            along = int(min(reach[1, i, j], MOST_NODES - 1)) + 1
            total = weights = 0.0
            for r in range(max(i - down, 0), min(i + down + 1, size)):
                for c in range(max(j - along, 0), min(j + along + 1, size)):
                    dx = pixels[r + border, c + border, 0] - x
                    dy = pixels[r + border, c + border, 1] - y
                    left = 1.0 - (dx * dx + dy * dy) * per_square
                    if left > 0.0 and grid[r, c] == grid[r, c]:
                        weight = left * left * left * left * area[r, c]
                        total += weight * grid[r, c]
                        weights += weight
            if weights > 0.0:
                out[i, j] = total / weights
