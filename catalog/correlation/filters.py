"""Filters of grids before correlation: high-pass, blur, thinning.

The high-pass takes out albedo, slope trends and the slow change of illumination, which a
rendered reference does not have.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import BoolArray, Float32Array
from catalog.geometry.grid import sample_bicubic
from catalog.geometry.kernel import inplace_kernel, kernel

Number = TypeVar("Number", np.float32, np.float64, np.bool_)

# Standard deviation of the Gaussian that is subtracted, nodes.
HIGH_PASS_NODES = 5.0
# Of that Gaussian from its middle on, as OpenCV cuts it.
_TAPS: Float32Array = np.array(
    cv2.getGaussianKernel(41, HIGH_PASS_NODES, cv2.CV_32F)[20:, 0], np.float32
)
# Contrast below this share of the brightness is rounding, not relief.
MIN_CONTRAST = 1e-5
# Sigma of the blur, share of the model's posting. At Phobos, with relief of 20 m rms below its
# 319 m, 97 % of lit points are found behind this blur and 53 % without. Twice as much finds 99 %,
# but leaves a fourth of the evidence against chance.
BLUR_SHARE = 0.3


def filter_high_pass(grid: Float32Array, sigma_nodes: float = HIGH_PASS_NODES) -> Float32Array:
    """Grid less its Gaussian-weighted local mean; NaN nodes take no part and become zero.

    grid (rows, cols) float32; returns the same shape, finite.
    """
    return filter_high_pass_masked((grid,), np.isfinite(grid), sigma_nodes)[0]


def filter_high_pass_masked(
    grids: tuple[Float32Array, ...], valid: BoolArray, sigma_nodes: float = HIGH_PASS_NODES
) -> list[Float32Array]:
    """`filter_high_pass` of grids whose nodes are those of `valid`."""
    if valid.all():
        return [filter_high_pass_finite(grid, sigma_nodes) for grid in grids]
    weight, zero = _weight(valid, sigma_nodes), np.float32(0.0)
    passed = []
    for grid in grids:
        filled = np.where(valid, grid, zero)
        passed.append(np.where(valid, filled - _blur(filled, sigma_nodes) / weight, zero))
    return passed


def filter_high_pass_finite(
    grid: Float32Array, sigma_nodes: float = HIGH_PASS_NODES
) -> Float32Array:
    """`filter_high_pass` of a grid (rows, cols), or up to four behind each other, without NaN."""
    return grid - _blur(grid, sigma_nodes)


def filter_high_pass_quickly(
    grids: Sequence[Float32Array], valid: BoolArray, margin_nodes: int = 0
) -> Float32Array:
    """High-pass k grids (rows, cols), crop their margin; faster than `filter_high_pass_masked`.

    Returns (k, rows - 2 margin, cols - 2 margin), right to the rounding. Not in its place:
    catalogs' trials go by that, and their digests by its last bits.
    """
    stack = np.ascontiguousarray(grids[0])[None] if len(grids) == 1 else np.stack(grids)
    return _filter_stack(stack, valid, _TAPS, margin_nodes)


@kernel
def _filter_stack(
    grids: Float32Array, valid: BoolArray, taps: Float32Array, margin: int
) -> Float32Array:
    count, rows, cols = grids.shape
    inner = rows - 2 * margin, cols - 2 * margin
    passed, weight = np.empty((count, *inner), np.float32), np.empty(inner, np.float32)
    filled, line = np.empty((rows, cols), np.float32), np.empty(cols + 2 * taps.size, np.float32)
    unity, zero, least = np.float32(1.0), np.float32(0.0), np.float32(1e-3)
    holes = False
    for r in range(rows):
        for c in range(cols):
            filled[r, c] = unity if valid[r, c] else zero
            holes |= not valid[r, c]
    if holes:
        _fill_blurred(filled, taps, margin, line, weight)
    for k in range(count):
        for r in range(rows):
            for c in range(cols):
                filled[r, c] = grids[k, r, c] if valid[r, c] else zero
        _fill_blurred(filled, taps, margin, line, passed[k])
        for r in range(inner[0]):
            for c in range(inner[1]):
                here, mean = filled[margin + r, margin + c], passed[k, r, c]
                if holes:
                    mean /= max(weight[r, c], least)
                    here, mean = (here, mean) if valid[margin + r, margin + c] else (zero, zero)
                passed[k, r, c] = here - mean
    return passed


@inplace_kernel
def _fill_blurred(
    grid: Float32Array, taps: Float32Array, margin: int, line: Float32Array, out: Float32Array
) -> None:
    """Fill a blurred grid (rows, cols) without its margin; beyond a border it is mirrored.

    taps  (m + 1,) from the middle on, m a multiple of four;  line (cols + 2 m or more,) to work in
    """
    (rows, cols), reach = grid.shape, taps.size - 1
    across = line[reach : reach + cols]
    for row in range(margin, rows - margin):
        here, at, into = grid[row], reach + margin, out[row - margin]
        for c in range(cols):
            across[c] = taps[0] * here[c]
        for j in range(1, reach, 4):
            i, k = row - j, row + j
            before = (
                grid[_mirror_node(i, rows)], grid[_mirror_node(i - 1, rows)],
                grid[_mirror_node(i - 2, rows)], grid[_mirror_node(i - 3, rows)],
            )  # fmt: skip
            behind = (
                grid[_mirror_node(k, rows)], grid[_mirror_node(k + 1, rows)],
                grid[_mirror_node(k + 2, rows)], grid[_mirror_node(k + 3, rows)],
            )  # fmt: skip
            _add_pairs(across, taps[j:], before, behind)
        for j in range(1, reach + 1):
            line[reach - j] = across[_mirror_node(-j, cols)]
            line[reach + cols - 1 + j] = across[_mirror_node(cols - 1 + j, cols)]
        for c in range(into.size):
            into[c] = taps[0] * line[at + c]
        for j in range(1, reach, 4):
            i, k = at - j, at + j
            before = line[i:], line[i - 1 :], line[i - 2 :], line[i - 3 :]
            behind = line[k:], line[k + 1 :], line[k + 2 :], line[k + 3 :]
            _add_pairs(into, taps[j:], before, behind)


@inplace_kernel
def _add_pairs(
    sums: Float32Array,
    taps: Float32Array,
    before: tuple[Float32Array, Float32Array, Float32Array, Float32Array],
    behind: tuple[Float32Array, Float32Array, Float32Array, Float32Array],
) -> None:
    """Add to sums (n,) four pairs of lines, each by a tap."""
    t, u, v, w = taps[0], taps[1], taps[2], taps[3]
    (a, d, f, h), (b, e, g, k) = before, behind
    for c in range(sums.size):
        sums[c] += t * (a[c] + b[c]) + u * (d[c] + e[c]) + (v * (f[c] + g[c]) + w * (h[c] + k[c]))


@inplace_kernel
def _mirror_node(node: int, size: int) -> int:
    """Mirror a node beyond the ends of a line back into it."""
    if size == 1:
        return 0
    while not 0 <= node < size:
        node = -node if node < 0 else 2 * (size - 1) - node
    return node


def _weight(valid: BoolArray, sigma_nodes: float) -> Float32Array:
    """Compute the Gaussian-weighted fraction of valid neighbours of each node, at least 1e-3."""
    return np.maximum(_blur(valid.astype(np.float32), sigma_nodes), np.float32(1e-3))


def _blur(grid: Float32Array, sigma_nodes: float) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(grid, (0, 0), sigma_nodes), dtype=np.float32)


# Edges are measured on a grid blurred by so many nodes, and weighed against those within so many.
EDGE_BLUR_NODES, EDGE_REACH_NODES = 1.0, 8.0
MAX_EDGE = 2.0  # of their local rms: a coast or a cloud's border must not outweigh all fields


def measure_edges(brightness: Float32Array) -> Float32Array:
    """Measure how strong edges are, against the local rms; whichever side is bright.

    Fields change from season to season, their borders stay. Over fields of another season and tone
    this finds 90 % of templates, brightness 67 %, mutual information 64 % (`make study-kmss`).
    brightness (rows, cols), NaN for no data, which has no edges; returns the same shape, >= 0.
    """
    valid = np.isfinite(brightness)
    filled = filter_low_pass(brightness, EDGE_BLUR_NODES)
    filled = np.where(valid, filled, np.float32(np.nanmean(brightness) if valid.any() else 0.0))
    gx, gy = (cv2.Sobel(filled, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1)))
    edges = np.hypot(gx, gy)
    if not valid.all():
        inside = cv2.erode(valid.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        edges = np.where(inside, edges, np.float32(0.0))
    local = np.sqrt(_blur(edges * edges, EDGE_REACH_NODES))
    floor = np.float32(MIN_CONTRAST) * np.abs(filled).max()
    measured = np.minimum(edges / np.maximum(local, floor + np.float32(1e-30)), MAX_EDGE)
    return np.where(valid, measured, np.float32(np.nan)).astype(np.float32)


class Filtered(NamedTuple):
    """A grid made ready to be correlated, perhaps with many others.

    values  high-passed, without the margin; finite
    floor   contrast below this is rounding
    """

    values: Float32Array
    floor: float


def filter_grid(grid: Float32Array, margin_nodes: int = 0) -> Filtered:
    """High-pass a grid (rows, cols) and take off a margin that only the high-pass sees.

    A high-pass that ends at the reference's own border bends it there, which moves the peak by
    0.15-0.2 nodes; with 8 nodes of margin 0.01-0.02 are left.
    """
    floor = MIN_CONTRAST * find_max_size(grid)
    return Filtered(crop(filter_high_pass(grid), margin_nodes), floor)


def filter_grid_quickly(grid: Float32Array, margin_nodes: int = 0) -> Filtered:
    """`filter_grid` by `filter_high_pass_quickly`."""
    floor = MIN_CONTRAST * find_max_size(grid)
    return Filtered(filter_high_pass_quickly((grid,), np.isfinite(grid), margin_nodes)[0], floor)


@kernel
def find_max_size(grid: Float32Array) -> float:
    """Greatest absolute value, holes aside; 0 without any."""
    # of each column, so that no node waits for the one before it
    greatest = np.zeros(grid.shape[1], np.float32)
    for r in range(grid.shape[0]):
        for c in range(grid.shape[1]):
            size = abs(grid[r, c])
            greatest[c] = size if size > greatest[c] else greatest[c]
    return float(greatest.max())


def crop(grid: NDArray[Number], margin: int) -> NDArray[Number]:
    """A grid (rows, cols, ...) without its outer `margin` nodes, contiguous."""
    rows, cols = grid.shape[:2]
    return np.ascontiguousarray(grid[margin : rows - margin, margin : cols - margin])


def blur_nodes(posting_m: float, known_m: float) -> float:
    """Sigma (nodes) of the blur for patches of a posting cut from a model of posting known_m."""
    return BLUR_SHARE * known_m / posting_m if posting_m < known_m else 0.0


def filter_low_pass(grid: Float32Array, sigma_nodes: float) -> Float32Array:
    """Gaussian-weighted local mean of a grid (rows, cols); NaN nodes take no part and stay."""
    valid = np.isfinite(grid)
    filled = np.where(valid, grid, np.float32(0.0)).astype(np.float32)
    mean = _blur(filled, sigma_nodes) / _weight(valid, sigma_nodes)
    return np.where(valid, mean, np.float32(np.nan)).astype(np.float32)


def choose_thinning(sigma_nodes: float) -> float:
    """Nodes from one to the next that is kept behind a blur: a sigma, or all of them."""
    return max(1.0, sigma_nodes)


def downsample_blurred(grid: Float32Array, sigma_nodes: float, even: bool) -> Float32Array:
    """Blur a square grid (n, n) and keep nodes `choose_thinning` apart about the same centre.

    even  whether the sides are even, so that a template and what it is sought in fit
    As many nodes as fit; NaN takes no part in the blur, and where it is the nearest node stays NaN.
    """
    soft = filter_low_pass(grid, sigma_nodes)
    step = choose_thinning(sigma_nodes)
    if step == 1.0:
        return soft
    size = grid.shape[0]
    side = int((size - 1) / step) + 1
    side -= (side % 2 == 0) != even
    places = (size - 1) / 2.0 + (np.arange(side) - (side - 1) / 2.0) * step
    rows, cols = np.meshgrid(places, places, indexing="ij")
    return sample_bicubic(soft, rows, cols)
