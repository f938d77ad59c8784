"""Connectivity of triangles: neighbours over edges, pieces, and the winding of faces."""

from typing import NamedTuple

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.geometry.kernel import kernel


class Edges(NamedTuple):
    """Edges of faces, each side once: side s is edge s % 3 of face s // 3.

    open     (n,) sides without another side
    crowded  (n,) sides of edges that three faces or more share
    other    (3 m,) the side across, -1 for open and crowded ones
    same     (3 m,) whether the side across runs the same way: one of the faces is inside out
    """

    open: IntArray
    crowded: IntArray
    other: IntArray
    same: BoolArray


def find_edges(faces: IntArray) -> Edges:
    """The edges of faces (m, 3)."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    key = low * (int(faces.max()) + 1) + high
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(np.append(first, key.size))
    pairs = first[count == 2]
    a, b = order[pairs], order[pairs + 1]
    other = np.full(key.size, -1, dtype=np.int64)
    other[a], other[b] = b, a
    same = np.zeros(key.size, dtype=bool)
    same[a] = same[b] = start[a] == start[b]
    many = np.repeat(count, count) > 2
    return Edges(np.sort(order[first[count == 1]]), np.sort(order[many]), other, same)


@kernel
def _orient_pieces(other: IntArray, same: BoolArray, piece: IntArray, turned: BoolArray) -> int:
    """Number pieces and mark which faces are to turn so that each agrees with its first face.

    Returns how many pieces, or minus one where a piece has only one side (as a Moebius strip has).
    """
    faces = piece.size
    waiting = np.empty(faces, np.int64)
    count = 0
    for seed in range(faces):
        if piece[seed] >= 0:
            continue
        piece[seed] = count
        waiting[0] = seed
        size = 1
        while size > 0:
            size -= 1
            face = waiting[size]
            for k in range(3):
                across = other[3 * face + k]
                if across < 0:
                    continue
                wanted = turned[face] != same[3 * face + k]
                next_ = across // 3
                if piece[next_] < 0:
                    piece[next_] = count
                    turned[next_] = wanted
                    waiting[size] = next_
                    size += 1
                elif turned[next_] != wanted:
                    return -1
        count += 1
    return count


def find_pieces(edges: Edges) -> tuple[int, IntArray, BoolArray]:
    """Count a surface's pieces (-1: one-sided); also each face's piece and which faces to turn."""
    piece = np.full(edges.other.size // 3, -1, dtype=np.int64)
    turned = np.zeros(piece.size, dtype=bool)
    return _orient_pieces(edges.other, edges.same, piece, turned), piece, turned


def compute_volume(vertices: FloatArray, faces: IntArray) -> float:
    """Volume inside a closed surface; negative where its faces look inward."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def count_turns(point: FloatArray, vertices: FloatArray, faces: IntArray) -> float:
    """Count the turns of a closed surface round a point: 1 inside, 0 outside.

    Source: van Oosterom & Strackee, IEEE Trans. Biomed. Eng. 30 (1983) 125: the solid angle of a
    triangle.
    """
    a, b, c = (vertices[faces[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    below = la * lb * lc
    for u, v, w in ((a, b, lc), (b, c, la), (c, a, lb)):
        below += np.einsum("ij,ij->i", u, v) * w
    return float(np.sum(2.0 * np.arctan2(triple, below)) / (4.0 * np.pi))
