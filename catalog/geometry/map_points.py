"""Points of the stereographic map, compiled; see projection.py."""

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel


@kernel
def compute_map_points(
    x: FloatArray, y: FloatArray, height: FloatArray, radius: float, body_from_local: FloatArray
) -> FloatArray:
    """Body-fixed points (n, 3) of a stereographic map, in one pass; see `local_directions`."""
    out = np.empty((x.size, 3))
    m = body_from_local
    for i in range(x.size):
        u, v = x[i] / (2.0 * radius), y[i] / (2.0 * radius)
        squared = u * u + v * v
        reach = (radius + height[i]) / (1.0 + squared)
        east, north, up = 2.0 * u * reach, 2.0 * v * reach, (1.0 - squared) * reach
        for k in range(3):
            out[i, k] = m[k, 0] * east + m[k, 1] * north + m[k, 2] * up
    return out


@kernel
def compute_node_points(
    offsets: FloatArray, heights: Float32Array, radius: float, body_from_local: FloatArray
) -> FloatArray:
    """Compute points (n, n, 3) of the nodes of a centred grid; offsets (n,) of its columns."""
    size = offsets.size
    out = np.empty((size, size, 3))
    m = body_from_local
    for i in range(size):
        v = -offsets[i] / (2.0 * radius)
        for j in range(size):
            u = offsets[j] / (2.0 * radius)
            squared = u * u + v * v
            reach = (radius + heights[i, j]) / (1.0 + squared)
            east, north, up = 2.0 * u * reach, 2.0 * v * reach, (1.0 - squared) * reach
            for k in range(3):
                out[i, j, k] = m[k, 0] * east + m[k, 1] * north + m[k, 2] * up
    return out
