"""Uniqueness: how unlike the true place its best rival in the search region is, by SURF."""

import numpy as np
from numpy.typing import NDArray

from catalog.correlation.surf64 import similarity_surface

Grid = NDArray[np.float32]

# Nearer than this a peak of the similarity is the place itself.
LOBE_NODES = 3


def best_rival(surface: Grid, search_nodes: float) -> float:
    """Highest local maximum of a similarity surface away from its middle, -1 when there is none.

    surface       (2k + 1, 2k + 1)  similarity, the true place in the middle
    search_nodes                    rivals beyond this distance (on either axis) do not count
    The slope of the true peak is no rival, so only local maxima count; on the outermost nodes a
    maximum is one among the neighbours that exist.
    """
    middle = surface.shape[0] // 2
    padded = np.pad(surface, 1, constant_values=-np.inf)
    rows, cols = surface.shape
    is_peak = np.ones(surface.shape, dtype=bool)
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            if dr or dc:
                is_peak &= surface >= padded[1 + dr : 1 + dr + rows, 1 + dc : 1 + dc + cols]
    offsets = np.abs(np.arange(rows) - middle)
    distance = np.maximum(offsets[:, None], offsets[None, :])
    is_peak &= (distance > LOBE_NODES) & (distance <= search_nodes)
    return float(surface[is_peak].max()) if is_peak.any() else -1.0


def uniqueness_margin(brightness: Grid, template_nodes: int, search_nodes: float) -> float:
    """One minus the similarity of the best rival: 1 when nothing is alike, 0 for a perfect double.

    brightness      (n, n)  a render of the ground about the place, NaN for no data
    template_nodes          side of the square that is described, n - template_nodes even
    search_nodes            how far the search goes, nodes; capped by the room that n leaves
    Raises ValueError when the template cannot be centred in the brightness.
    """
    size = brightness.shape[0]
    first = (size - template_nodes) // 2
    template = brightness[first : first + template_nodes, first : first + template_nodes]
    rival = best_rival(similarity_surface(template, brightness), search_nodes)
    return float(min(1.0 - rival, 1.0))
