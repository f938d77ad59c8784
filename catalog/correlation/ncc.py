"""Normalised cross-correlation of a reference against a larger grid, both high-passed.

The high-pass takes out albedo, slope trends and the slow change of illumination, which a
rendered reference does not know (Zhukov 2025, ch. 3, uses plain correlation).
"""

from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import Float32Array
from catalog.correlation.peak import Match, locate_peak
from catalog.geometry.kernel import kernel

Number = TypeVar("Number", np.float32, np.float64)

# Standard deviation of the Gaussian that is subtracted, nodes.
HIGH_PASS_NODES = 5.0
# Contrast below this share of the brightness is rounding, not relief.
MIN_CONTRAST = 1e-5


def high_pass(grid: Float32Array, sigma_nodes: float = HIGH_PASS_NODES) -> Float32Array:
    """Grid less its Gaussian-weighted local mean; NaN nodes take no part and become zero.

    grid (rows, cols) float32; returns the same shape, finite.
    """
    valid = np.isfinite(grid)
    if valid.all():
        return np.asarray(grid - cv2.GaussianBlur(grid, (0, 0), sigma_nodes), dtype=np.float32)
    filled = np.where(valid, grid, np.float32(0.0)).astype(np.float32)
    weight = cv2.GaussianBlur(valid.astype(np.float32), (0, 0), sigma_nodes)
    mean = cv2.GaussianBlur(filled, (0, 0), sigma_nodes) / np.maximum(weight, np.float32(1e-3))
    return np.where(valid, filled - mean, np.float32(0.0)).astype(np.float32)


class Filtered(NamedTuple):
    """A grid made ready to be correlated, perhaps with many others.

    values  high-passed, without the margin; finite
    floor   contrast below this is rounding
    """

    values: Float32Array
    floor: float


def filtered(grid: Float32Array, margin_nodes: int = 0) -> Filtered:
    """High-pass a grid (rows, cols) and take off a margin that only the high-pass sees.

    A high-pass that ends at the reference's own border bends it there, which moves the peak by
    0.15-0.2 nodes; with 8 nodes of margin 0.01-0.02 are left.
    """
    floor = MIN_CONTRAST * float(np.nanmax(np.abs(grid), initial=0.0))
    return Filtered(cropped(high_pass(grid), margin_nodes), floor)


def correlated(template: Filtered, image: Filtered) -> Float32Array:
    """Scores of a reference at every place where it fits whole into the search grid.

    template (n, n), image (m, m) with m - n even, both of `filtered`.
    Returns (m - n + 1, m - n + 1); the middle element is the centred place.
    Raises ValueError for sizes that cannot be centred on each other.
    """
    (height, width), (rows, cols) = template.values.shape, image.values.shape
    room = (rows - height, cols - width)
    if min(room) < 0 or room[0] % 2 or room[1] % 2:
        raise ValueError(
            f"reference ({height}, {width}) cannot be centred in search {(rows, cols)}"
        )
    surface = np.asarray(
        cv2.matchTemplate(image.values, template.values, cv2.TM_CCOEFF_NORMED), dtype=np.float32
    )
    # A side without contrast has no correlation; OpenCV then returns ones, rounding noise decides.
    if float(cv2.meanStdDev(template.values)[1][0, 0]) <= template.floor:
        return np.full_like(surface, -1.0)
    _void_flat_windows(image.values, height, width, image.floor, surface)
    return surface


@kernel
def _void_flat_windows(
    image: Float32Array, height: int, width: int, least_rms: float, surface: Float32Array
) -> None:
    """Put -1 where the rms of the (height, width) window under a score is least_rms or less."""
    rows, cols = image.shape
    columns = np.zeros(cols)
    for row in range(rows):
        for c in range(cols):
            columns[c] += image[row, c] * image[row, c]
        first = row - height + 1
        if first < 0:
            continue
        total = 0.0
        for c in range(cols):
            total += columns[c]
            if c >= width - 1:
                # running sums leave rounding of the largest term behind: far below a floor of
                # 1e-10 of the brightness squared in double precision
                if total <= least_rms * least_rms * height * width:
                    surface[first, c - width + 1] = -1.0
                total -= columns[c - width + 1]
        for c in range(cols):
            columns[c] -= image[first, c] * image[first, c]


def cropped(grid: NDArray[Number], margin: int) -> NDArray[Number]:
    """A grid (rows, cols, ...) without its outer `margin` nodes, contiguous."""
    return np.ascontiguousarray(
        grid[margin : grid.shape[0] - margin, margin : grid.shape[1] - margin]
    )


def match_ncc(reference: Float32Array, search: Float32Array, margin_nodes: int = 0) -> Match:
    """Find a reference (n, n) in a search grid (m, m), m - n even, by correlation.

    Both are float32 with NaN for no data, and carry `margin_nodes` that only the high-pass sees.
    """
    return match_in(reference, filtered(search, margin_nodes=margin_nodes), margin_nodes)


def match_in(reference: Float32Array, image: Filtered, margin_nodes: int = 0) -> Match:
    """`match_ncc` in a search grid that is filtered already."""
    nodes = int(np.isfinite(cropped(reference, margin_nodes)).sum())
    template = filtered(reference, margin_nodes=margin_nodes)
    return locate_peak(correlated(template, image), nodes)
