"""Normalised correlation of grids with holes: at every place over the nodes that both have.

Source: D. Padfield, "Masked object registration in the Fourier domain", IEEE Trans. Image Process.
21 (2012). A frame that shows a part of a template's ground is compared in that part.
"""

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.correlation.ncc import MIN_CONTRAST, cropped, high_pass
from catalog.correlation.peak import Match, locate_peak
from catalog.geometry.grid import sample_bicubic

# Sigma of the blur, share of the model's posting. At Phobos, with relief of 20 m rms below its
# 319 m, 97 % of lit points are found behind this blur and 53 % without. Twice as much finds 99 %,
# but leaves a fourth of the evidence against chance.
BLUR_SHARE = 0.3


def blur_nodes(posting_m: float, known_m: float) -> float:
    """Sigma (nodes) of the blur for patches of a posting cut from a model of posting known_m."""
    return BLUR_SHARE * known_m / posting_m if posting_m < known_m else 0.0


def low_pass(grid: Float32Array, sigma_nodes: float) -> Float32Array:
    """Gaussian-weighted local mean of a grid (rows, cols); NaN nodes take no part and stay."""
    valid = np.isfinite(grid)
    filled = np.where(valid, grid, np.float32(0.0)).astype(np.float32)
    weight = cv2.GaussianBlur(valid.astype(np.float32), (0, 0), sigma_nodes)
    mean = cv2.GaussianBlur(filled, (0, 0), sigma_nodes) / np.maximum(weight, np.float32(1e-3))
    return np.where(valid, mean, np.float32(np.nan)).astype(np.float32)


def thinning(sigma_nodes: float) -> float:
    """Nodes from one to the next that is kept behind a blur: a sigma, or all of them."""
    return max(1.0, sigma_nodes)


def thinned(grid: Float32Array, sigma_nodes: float, even: bool) -> Float32Array:
    """A square grid (n, n) behind its blur, with nodes `thinning` apart about the same centre.

    even  whether the sides are even, so that a template and what it is sought in fit
    As many nodes as fit; NaN takes no part in the blur, and where it is the nearest node stays NaN.
    """
    soft = low_pass(grid, sigma_nodes)
    step = thinning(sigma_nodes)
    if step == 1.0:
        return soft
    size = grid.shape[0]
    side = int((size - 1) / step) + 1
    side -= (side % 2 == 0) != even
    places = (size - 1) / 2.0 + (np.arange(side) - (side - 1) / 2.0) * step
    rows, cols = np.meshgrid(places, places, indexing="ij")
    return sample_bicubic(soft, rows, cols)


# A place where both have less than this share of the nodes that they have at the best is none: few
# nodes are alike by chance.
MIN_COMMON_SHARE = 0.7


def match_masked(reference: Float32Array, search: Float32Array, margin_nodes: int = 0) -> Match:
    """Find a reference (n, n) in a search grid (m, m), m - n even; NaN of either takes no part.

    Both are float32 and carry `margin_nodes` that only the high-pass sees. The reference is cut as
    the search grid is about its middle before the high-pass, which bends alike at the same edges.
    """
    room = (search.shape[0] - reference.shape[0]) // 2
    reference = np.where(np.isfinite(cropped(search, room)), reference, np.float32(np.nan))
    sides = [cropped(high_pass(grid), margin_nodes) for grid in (reference, search)]
    masks = [
        np.isfinite(cropped(grid, margin_nodes)).astype(np.float32) for grid in (reference, search)
    ]
    # a side without contrast has no correlation: rounding noise would decide
    floors = [
        MIN_CONTRAST * float(np.nanmax(np.abs(grid), initial=0.0)) for grid in (reference, search)
    ]
    surface, common = _surface(sides[0], masks[0], sides[1], masks[1], floors)
    row, col = np.unravel_index(int(np.argmax(surface)), surface.shape)
    return locate_peak(surface, int(common[row, col]))


def _surface(
    template: Float32Array,
    has: Float32Array,
    image: Float32Array,
    shows: Float32Array,
    floors: list[float],
) -> tuple[Float32Array, FloatArray]:
    """Scores at every place where the template fits, -1 with too few nodes; and common nodes."""
    common = _sums(shows, has)
    n = np.maximum(common, 1.0)
    of_template, of_image = _sums(shows, template), _sums(image, has)
    product = _sums(image, template) - of_template * of_image / n
    squares = (
        _sums(shows, template * template) - of_template**2 / n,
        _sums(image * image, has) - of_image**2 / n,
    )
    enough = common >= max(MIN_COMMON_SHARE * common.max(), 1.0)
    for square, floor in zip(squares, floors, strict=True):
        enough &= square > n * floor**2
    square = np.where(enough, squares[0] * squares[1], 1.0)
    surface = np.where(enough, product / np.sqrt(square), -1.0)
    return np.clip(surface, -1.0, 1.0).astype(np.float32), common


def _sums(image: Float32Array, kernel: Float32Array) -> FloatArray:
    """Sums of products at every place where the kernel fits."""
    return np.asarray(cv2.matchTemplate(image, kernel, cv2.TM_CCORR), dtype=np.float64)
