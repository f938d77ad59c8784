"""Matching grids that are finer than what is known of the ground: both sides blurred first.

Patches that are cut from a coarser shape model are smooth between its vertices. What a picture
shows there is relief that the model does not know, which drowns what it does know.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

Grid = NDArray[np.float32]

# Sigma of the blur, share of the model's posting. At Phobos, with relief of 20 m rms below its
# 319 m, 97 % of lit points are found behind this blur and 53 % without. Twice as much finds 99 %,
# but leaves a fourth of the evidence against chance.
BLUR_SHARE = 0.3


def blur_nodes(posting_m: float, known_m: float) -> float:
    """Sigma (nodes) of the blur for patches of a posting cut from a model of posting known_m."""
    return BLUR_SHARE * known_m / posting_m if posting_m < known_m else 0.0


def low_pass(grid: Grid, sigma_nodes: float) -> Grid:
    """Gaussian-weighted local mean of a grid (rows, cols); NaN nodes take no part and stay."""
    valid = np.isfinite(grid)
    filled = np.where(valid, grid, np.float32(0.0)).astype(np.float32)
    weight = cv2.GaussianBlur(valid.astype(np.float32), (0, 0), sigma_nodes)
    mean = cv2.GaussianBlur(filled, (0, 0), sigma_nodes) / np.maximum(weight, np.float32(1e-3))
    return np.where(valid, mean, np.float32(np.nan)).astype(np.float32)
