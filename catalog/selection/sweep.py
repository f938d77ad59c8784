"""The closed-form response (localisation.py) over wide ground, on a graticule of fixed nodes.

Products of second differences are summed into tiles of step x step nodes, tiles into windows, each
window afresh and always in one order: a sum that slides would round otherwise in every part that
starts elsewhere. Toward the poles columns crowd: second differences are scaled to metres and a
window takes so many more tiles. Neglected: the bend of parallels, the height's slope northward
times tan(latitude) over the radius, 1e-3 of the second differences of real relief.
"""

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.geometry.kernel import inplace_kernel, kernel
from catalog.selection.localisation import compute_eigenvalue_row

BLUR_TAPS = 9  # four sigmas of one node, either side
MARGIN = BLUR_TAPS // 2 + 1  # nodes that blur and second differences want around the tiles
BLOCK_NODES = 2048  # columns done at once: their rows stay in the processor's nearest cache


@inplace_kernel
def _blur_down(heights: Float32Array, taps: Float32Array, out: Float32Array) -> None:
    """The middle row of BLUR_TAPS rows, blurred across them."""
    half = taps.size // 2
    middle = heights[half]
    for c in range(out.size):
        out[c] = taps[half] * middle[c]
    for k in range(half):
        weight, above, below = taps[k], heights[k], heights[2 * half - k]
        for c in range(out.size):
            out[c] += weight * (above[c] + below[c])


@inplace_kernel
def _blur_along(line: Float32Array, taps: Float32Array, out: Float32Array) -> None:
    half = taps.size // 2
    middle = line[half : half + out.size]
    for c in range(out.size):
        out[c] = taps[half] * middle[c]
    for k in range(half):
        weight = taps[k]
        left, right = line[k : k + out.size], line[2 * half - k : 2 * half - k + out.size]
        for c in range(out.size):
            out[c] += weight * (left[c] + right[c])


@inplace_kernel
def _add_products(
    south: Float32Array,
    middle: Float32Array,
    north: Float32Array,
    scale: np.float32,
    stretch: np.float32,
    sums: Float32Array,
) -> None:
    """Add a row's products of second differences (6, cols); rows have a node more at each end."""
    cols = sums.shape[1]
    xx_scale, xy_scale = scale * stretch * stretch, np.float32(0.25) * scale * stretch
    s0, s1, s2 = south[:cols], south[1 : cols + 1], south[2 : cols + 2]
    m0, m1, m2 = middle[:cols], middle[1 : cols + 1], middle[2 : cols + 2]
    n0, n1, n2 = north[:cols], north[1 : cols + 1], north[2 : cols + 2]
    p0, p1, p2, p3, p4, p5 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5]
    for c in range(cols):
        twice = m1[c] + m1[c]
        xx = xx_scale * ((m0[c] - twice) + m2[c])
        yy = scale * ((s1[c] - twice) + n1[c])
        xy = xy_scale * ((n2[c] - n0[c]) - (s2[c] - s0[c]))
        p0[c] += xx * xx
        p1[c] += xx * xy
        p2[c] += xy * xy
        p3[c] += xx * yy
        p4[c] += xy * yy
        p5[c] += yy * yy


@kernel
def _sum_tiles(
    heights: Float32Array,
    taps: Float32Array,
    scale: np.float32,
    stretch: Float32Array,
    step: int,
    out: Float32Array,
) -> None:
    margin = taps.size // 2 + 1
    rows, cols = out.shape[1] * step, out.shape[2] * step
    block = max(1, BLOCK_NODES // step) * step
    for first in range(0, cols, block):
        width = min(block, cols - first)
        ground = heights[:, first : first + width + 2 * margin]
        down = np.empty(width + 2 * margin, np.float32)
        lines = np.empty((3, width + 2), np.float32)
        sums = np.zeros((6, width), np.float32)
        for r in range(rows + 2):
            _blur_down(ground[r : r + taps.size], taps, down)
            _blur_along(down, taps, lines[r % 3])
            if r < 2:
                continue
            node = r - 2
            south, middle, north = lines[node % 3], lines[(node + 1) % 3], lines[r % 3]
            _add_products(south, middle, north, scale, stretch[node], sums)
            if (node + 1) % step == 0:
                for p in range(6):
                    into, line = out[p, node // step, first // step :], sums[p]
                    for t in range(width // step):
                        total = np.float32(0.0)
                        for c in range(t * step, (t + 1) * step):
                            total += line[c]
                        into[t] = total
                sums[:] = np.float32(0.0)


def sum_tiles(
    heights: Float32Array, posting_m: float, stretch: FloatArray, step: int
) -> Float32Array:
    """Sums over tiles of the six products of second differences of blurred heights.

    heights    (rows + 2 MARGIN, cols + 2 MARGIN)  m; row 0 south, column 0 west; rows and cols
               are multiples of step
    posting_m  m between rows
    stretch    (rows,)  m between rows over m between columns
    step       nodes a side of a tile

    Returns (6, rows / step, cols / step) float32, dimensionless; NaN where a height is missing.
    Each tile is the same whatever else is in the grid.
    """
    rows, cols = heights.shape[0] - 2 * MARGIN, heights.shape[1] - 2 * MARGIN
    if rows % step or cols % step or stretch.shape != (rows,):
        raise ValueError(f"{rows} x {cols} nodes are no tiles of {step}, or not {stretch.size}")
    out = np.empty((6, rows // step, cols // step), np.float32)
    # one code for all columns of a row: a library's blur may round its last few otherwise
    taps = cv2.getGaussianKernel(BLUR_TAPS, 1.0)[:, 0].astype(np.float32)
    ground, scale = np.ascontiguousarray(heights, dtype=np.float32), np.float32(1.0 / posting_m)
    _sum_tiles(ground, taps, scale, stretch.astype(np.float32), step, out)
    return out


@inplace_kernel
def _compute_window_eigenvalues(
    tiles: Float32Array,
    tall: int,
    wide: IntArray,
    directions: Float32Array,
    room: tuple[Float32Array, Float32Array],
    out: Float32Array,
) -> None:
    cols = tiles.shape[2]
    down, sums = room
    for i in range(out.shape[0]):
        fit = cols - wide[i] + 1
        share = np.float32(tall / wide[i])
        total = sums[6]
        total[:fit] = np.float32(0.0)
        for p in range(6):
            column, window = down[p], sums[p]
            column[:] = np.float32(0.0)
            for k in range(tall):
                line = tiles[p, i + k]
                for c in range(cols):
                    column[c] += line[c]
            window[:fit] = np.float32(0.0)
            for k in range(wide[i]):
                line = column[k : k + fit]
                for c in range(fit):
                    window[c] += line[c]
            for c in range(fit):
                window[c] *= share
                total[c] += window[c]
        out[i, fit:] = np.float32(np.nan)
        compute_eigenvalue_row(sums[:, :fit], -np.inf, directions, out[i, :fit])


def compute_window_eigenvalues(
    tiles: Float32Array, tall: int, wide: IntArray, products: Float32Array
) -> Float32Array:
    """Smallest eigenvalue, worst Sun, of the products summed in every window of tiles.

    tiles     (6, rows, cols)  of `sum_tiles`
    tall      tiles that a window is high
    wide      (rows - tall + 1,)  tiles that windows of a row are wide, west to east
    products  (n, 3)  of the Suns, see `localisation.compute_sun_products`

    Returns (rows - tall + 1, cols) float32 as of square windows of tall x tall tiles; entry [i, j]
    is the window whose first tile is (i, j). NaN for a window that lacks a height or does not fit.
    """
    out = np.empty((tiles.shape[1] - tall + 1, tiles.shape[2]), np.float32)
    if wide.shape != (out.shape[0],) or out.shape[0] < 1 or wide.max() > tiles.shape[2]:
        raise ValueError(f"windows of {tall} x {wide} tiles do not fit into {tiles.shape}")
    room = np.empty((6, tiles.shape[2]), np.float32), np.empty((7, tiles.shape[2]), np.float32)
    _compute_window_eigenvalues(tiles, tall, wide, products, room, out)
    return out


@kernel
def find_strongest_windows(
    response: Float32Array,
    wide: IntArray,
    west: FloatArray,
    east: FloatArray,
    aspect: FloatArray,
    separation: float,
    count: int,
) -> IntArray:
    """Windows of the largest response in each of some cells, no two too near each other.

    response    (rows, cols)  entry [i, j]: the window of wide[i] tiles from tile j on
    wide        (rows,)
    west, east  (n,)  the strip of a cell in which middles may lie, tiles from column 0
    aspect      (rows,)  m a tile is wide over m it is high
    separation  least distance between middles, heights of a tile
    count       windows wanted a cell

    Returns (n, count, 2): row and column, best first, -1 where there are no more. Windows of
    response 0 and unknown ones are not taken; of equal ones the first by rows.
    """
    out = np.full((west.size, count, 2), -1, np.int64)
    for n in range(west.size):
        for k in range(count):
            best = np.float32(0.0)
            for i in range(response.shape[0]):
                half = 0.5 * wide[i]
                start = max(0, int(np.ceil(west[n] - half)))
                stop = min(response.shape[1] - 1, int(np.floor(east[n] - half)))
                for j in range(start, stop + 1):
                    value = response[i, j]
                    if value > best:
                        free = True
                        for other in range(k):
                            r, c = out[n, other, 0], out[n, other, 1]
                            down = i - r
                            along = (j + half - c - 0.5 * wide[r]) * aspect[(i + r) // 2]
                            if down * down + along * along < separation * separation:
                                free = False
                                break
                        if free:
                            best = value
                            out[n, k, 0], out[n, k, 1] = i, j
            if out[n, k, 0] < 0:
                break
    return out
