"""Uniqueness: how unlike the true place its best rival in the search region is, by SURF."""

from catalog.arrays import Float32Array
from catalog.correlation.surf64 import own_similarity_surface
from catalog.geometry.kernel import kernel

# Nearer than this a peak of the similarity is the place itself.
LOBE_NODES = 3


@kernel
def best_rival(surface: Float32Array, search_nodes: float) -> float:
    """Highest local maximum of a similarity surface away from its middle, -1 when there is none.

    surface       (2k + 1, 2k + 1)  similarity, the true place in the middle
    search_nodes                    rivals beyond this distance (on either axis) do not count
    The slope of the true peak is no rival, so only local maxima count; on the outermost nodes a
    maximum is one among the neighbours that exist.
    """
    rows, cols = surface.shape
    middle = rows // 2
    best = -1.0
    for r in range(rows):
        for c in range(cols):
            distance = max(abs(r - middle), abs(c - middle))
            here = surface[r, c]
            if not (LOBE_NODES < distance <= search_nodes and here > best):
                continue
            neighbours = surface[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]
            if here >= neighbours.max():
                best = float(here)
    return best


def uniqueness_margin(brightness: Float32Array, template_nodes: int, search_nodes: float) -> float:
    """One minus the similarity of the best rival: 1 when nothing is alike, 0 for a perfect double.

    brightness      (n, n)  a render of the ground about the place, NaN for no data
    template_nodes          side of the square that is described, n - template_nodes even
    search_nodes            how far the search goes, nodes; capped by the room that n leaves
    Raises ValueError when the template cannot be centred in the brightness.
    """
    rival = best_rival(own_similarity_surface(brightness, template_nodes), search_nodes)
    return float(min(1.0 - rival, 1.0))
