"""A shape model made finer than it is: the truth that a catalog of the model does not know.

Each halving puts a vertex on every edge, on the cubic that has the edge's ends and stands square on
their normals (PN triangles: Vlachos et al., I3D 2001), so the ground is round where the model is
flat and goes through all of the model's vertices. Seeded relief (`detail`) is then added along the
normals: craters and random relief below the model's posting.
"""

import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.vectors import unit
from catalog.terrain.mesh.shape import Shape
from catalog.terrain.synthetic.relief import SyntheticRelief

FINEST_FACES = 4_000_000  # that a coarse model is refined to: a grown mesh must stay in memory


def refined(shape: Shape, halvings: int) -> Shape:
    """The shape with each edge cut in two so many times: 4^halvings faces for one."""
    vertices, faces = shape.vertices, shape.faces
    for _ in range(halvings):
        vertices, faces = _halved(vertices, faces)
    return Shape(vertices, faces)


def roughened(shape: Shape, detail: SyntheticRelief) -> Shape:
    """The shape with a detail's heights added along its normals, read by the vertices' places."""
    lat, lon, _ = latlon_from_xyz(shape.vertices)
    heights = detail.heights(lat, lon)
    moved = shape.vertices + heights[:, None] * _normals(shape.vertices, shape.faces)
    return Shape(moved, shape.faces)


def _normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Unit normals (n, 3) at vertices: means of the faces about them, weighted by their area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.stack(
        [
            sum(np.bincount(faces[:, k], across[:, axis], len(vertices)) for k in range(3))
            for axis in range(3)
        ],
        axis=1,
    )
    return unit(total)


def _halved(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    sides.sort(axis=1)
    count = len(vertices)
    edges, number = np.unique(sides[:, 0] * count + sides[:, 1], return_inverse=True)
    normals = _normals(vertices, faces)
    first, second = edges // count, edges % count
    way = vertices[second] - vertices[first]
    middles = 0.5 * (vertices[first] + vertices[second])
    # the cubic's middle: a chord that dives below the plane of an end lies under the ground
    for end, sign in ((first, -0.125), (second, 0.125)):
        dive = np.einsum("ij,ij->i", way, normals[end])
        middles += sign * dive[:, None] * normals[end]
    a, b, c = faces.T
    ab, bc, ca = (count + number).reshape(3, -1)
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return (
        np.concatenate([vertices, middles]),
        np.concatenate([np.stack(three, axis=1) for three in corners]),
    )
