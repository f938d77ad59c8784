"""Normalised cross-correlation of a reference against a larger grid, both high-passed.

The high-pass takes out albedo, slope trends and the slow change of illumination, which a
rendered reference does not know (Zhukov 2025, ch. 3, uses plain correlation).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.correlation.peak import Match, locate_peak

Grid = NDArray[np.float32]

# Standard deviation of the Gaussian that is subtracted, nodes.
HIGH_PASS_NODES = 5.0
# Contrast below this share of the brightness is rounding, not relief.
LEAST_CONTRAST = 1e-5


def high_pass(grid: Grid, sigma_nodes: float = HIGH_PASS_NODES) -> Grid:
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


def correlation_surface(
    reference: Grid,
    search: Grid,
    sigma_nodes: float = HIGH_PASS_NODES,
    margin_nodes: int = 0,
) -> Grid:
    """Scores of a reference at every place where it fits whole into the search grid.

    reference (n, n), search (m, m) with m - n even, float32, NaN for no data.
    margin_nodes  a border of both grids that the high-pass sees and the correlation does not: a
                  high-pass that ends at the reference's own border bends it there, which moves
                  the peak by 0.15-0.2 nodes; with 8 nodes of margin 0.01-0.02 are left
    Returns (m - n + 1, m - n + 1); the middle element is the centred place.
    Raises ValueError for sizes that cannot be centred on each other.
    """
    room = (search.shape[0] - reference.shape[0], search.shape[1] - reference.shape[1])
    if min(room) < 0 or room[0] % 2 or room[1] % 2:
        raise ValueError(f"reference {reference.shape} cannot be centred in search {search.shape}")
    template = _cropped(high_pass(reference, sigma_nodes), margin_nodes)
    image = _cropped(high_pass(search, sigma_nodes), margin_nodes)
    surface = np.asarray(cv2.matchTemplate(image, template, cv2.TM_CCOEFF_NORMED), dtype=np.float32)
    # A side without contrast has no correlation; OpenCV then returns ones, rounding noise decides.
    if float(template.std()) <= LEAST_CONTRAST * _largest(reference):
        return np.full_like(surface, -1.0)
    power = cv2.boxFilter(image * image, -1, template.shape[::-1], borderType=cv2.BORDER_CONSTANT)
    rows, cols = surface.shape
    top, left = template.shape[0] // 2, template.shape[1] // 2
    power = power[top : top + rows, left : left + cols]
    surface[power <= (LEAST_CONTRAST * _largest(search)) ** 2] = -1.0
    return surface


def _largest(grid: Grid) -> float:
    finite = grid[np.isfinite(grid)]
    return float(np.abs(finite).max()) if finite.size else 0.0


def _cropped(grid: Grid, margin: int) -> Grid:
    return np.ascontiguousarray(
        grid[margin : grid.shape[0] - margin, margin : grid.shape[1] - margin]
    )


def match_ncc(reference: Grid, search: Grid, margin_nodes: int = 0) -> Match:
    """Find a reference in a search grid by correlation; arguments as `correlation_surface`."""
    surface = correlation_surface(reference, search, margin_nodes=margin_nodes)
    return locate_peak(surface, int(np.isfinite(_cropped(reference, margin_nodes)).sum()))
