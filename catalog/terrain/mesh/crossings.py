"""Where a closed surface passes through itself: edges that go through faces they do not belong to.

Two faces that cross have an edge of one that goes through the other. Edges are traced through the
mesh as rays; a face that is met counts when the edge, in 64 bits, goes through its inside from one
side to the other, by a thousandth of either's size. So faces that only touch, as at a contact
binary's neck, do not count. A solid library finds none of these: it checks how faces are connected.
"""

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.terrain.mesh.rays import MeshRays

EDGES_AT_ONCE = 1 << 18
MAX_MET = 12  # faces on the way along one edge; most are its own neighbours at its ends
INSIDE = 1e-3


def crossing_places(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Places (n, 3) where edges of a closed surface go through other faces, one an edge at most."""
    rays = MeshRays(vertices[faces])
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    own = start < end  # the other side of each edge runs the other way
    edges = np.stack([start[own], end[own]], axis=1)
    parts = [
        _crossed(rays, vertices, faces, edges[first : first + EDGES_AT_ONCE])
        for first in range(0, len(edges), EDGES_AT_ONCE)
    ]
    return np.concatenate(parts)


def _crossed(rays: MeshRays, vertices: FloatArray, faces: IntArray, edges: IntArray) -> FloatArray:
    begin, way = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    length = np.linalg.norm(way, axis=1)
    along = way / length[:, None]
    travelled = INSIDE * length
    places = []
    waiting = np.arange(len(edges))
    for _ in range(MAX_MET):
        left = length[waiting] - travelled[waiting]
        ahead = left > INSIDE * length[waiting]
        waiting, left = waiting[ahead], left[ahead]
        if not waiting.size:
            break
        origins = begin[waiting] + travelled[waiting, None] * along[waiting]
        face, at = rays.on_segments(origins, along[waiting], left)
        met = face >= 0
        waiting, face, at = waiting[met], face[met], np.maximum(at[met], 0.0)
        shared = (faces[face][:, :, None] == edges[waiting][:, None, :]).any(axis=(1, 2))
        through = ~shared & _inside(vertices[faces[face]], begin[waiting], way[waiting])
        places.append(begin[waiting[through]] + 0.5 * way[waiting[through]])
        # beyond what was met, by more than a step of a 32-bit number of the body's size
        step = np.maximum(INSIDE * length[waiting], 1e-6 * rays.reach_m)
        travelled[waiting] += np.where(np.isfinite(at), at, 0.0) + step
        waiting = waiting[~through]
    return np.concatenate(places) if places else np.empty((0, 3))


def _inside(corners: FloatArray, begin: FloatArray, way: FloatArray) -> BoolArray:
    """Whether ways (n, 3) from their beginnings go through the inside of triangles (n, 3, 3)."""
    a, u, v = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(way, v)
    determinant = np.einsum("ij,ij->i", u, p)
    known = np.abs(determinant) > 1e-300
    scale = 1.0 / np.where(known, determinant, 1.0)
    t = begin - a
    q = np.cross(t, u)
    first = np.einsum("ij,ij->i", t, p) * scale
    second = np.einsum("ij,ij->i", way, q) * scale
    at = np.einsum("ij,ij->i", v, q) * scale
    least = np.min([first, second, 1.0 - first - second, at, 1.0 - at], axis=0)
    inside: BoolArray = known & (least > INSIDE)
    return inside
