"""Meshes with finer faces than a shape model's.

`smooth_corners` makes a smooth surface through the model's vertices: flat faces meet in edges that
no body has; where patches are finer than the model they would show as edges of brightness. Radii on
a grid are interpolated by bicubic splines over latitude and longitude, other meshes by the modified
butterfly scheme (Zorin, Schroeder, Sweldens, "Interpolating subdivision for meshes with arbitrary
topology", SIGGRAPH 1996). Both keep the model's vertices.

`refine_shape` and `add_detail` make the ground of simulations, which a catalog of the model does
not have. Each halving puts a vertex on every edge, on the cubic that has the edge's ends and stands
square on their normals (PN triangles: Vlachos et al., I3D 2001), so the ground is round where the
model is flat and goes through all of the model's vertices. Seeded relief is then added along the
normals: craters and random relief below the model's posting.
"""

from pathlib import Path

import numpy as np
from scipy.interpolate import RectBivariateSpline

from catalog.arrays import FloatArray, IntArray
from catalog.geometry.kernel import kernel
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.vectors import unit
from catalog.terrain.mesh.file import RadiiGrid, is_grid, make_surface, read_grid
from catalog.terrain.mesh.shape import Shape, find_edges
from catalog.terrain.synthetic.relief import SyntheticRelief

# Rows that a spline is carried on over a pole: what lies beyond changes it by less than 1e-3.
OVER_POLE = 6
# An edge's middle leaves it by less than this share of the lower of its two faces' heights: beyond
# that (needles, sharp ridges) faces could fold over.
MAX_BULGE = 0.25
FINEST_FACES = 4_000_000  # that a coarse model is refined to: a grown mesh must stay in memory


def smooth_corners(
    path: Path, longitude: str, metres: float, vertices: FloatArray, faces: IntArray, halvings: int
) -> FloatArray:
    """Corners (m, 3, 3) m of a mesh whose edges are 2^halvings times shorter than the model's.

    path, longitude  the model's file, as it was read; metres in one of its units
    vertices, faces  (n, 3) m and (k, 3): the closed surface that was made of it
    """
    if path.suffix.lower() in (".tab", ".txt") and is_grid(path):
        vertices, faces = make_surface(refine_grid(read_grid(path), 2**halvings), longitude)
        return metres * vertices[faces]
    for _ in range(halvings):
        vertices, faces = split_by_butterfly(vertices, faces)
    return vertices[faces]


def refine_grid(grid: RadiiGrid, times: int) -> RadiiGrid:
    """Radii at so many times as many latitudes and longitudes, from a bicubic spline.

    Where the two ends of a parallel differ, their mean is taken for both.
    """
    radii = grid.radii.copy()
    radii[:, [0, -1]] = radii[:, [0, -1]].mean(axis=1, keepdims=True)
    radii[[0, -1]] = radii[[0, -1], :-1].mean(axis=1, keepdims=True)
    # beyond a pole a meridian goes on as the one opposite
    opposite = np.array(
        [np.interp(grid.lons + 180.0, grid.lons, row, period=360.0) for row in radii]
    )
    rows = min(OVER_POLE, len(radii) - 1)
    south, north = slice(rows, 0, -1), slice(-2, -2 - rows, -1)
    lats = np.concatenate([-180.0 - grid.lats[south], grid.lats, 180.0 - grid.lats[north]])
    radii = np.concatenate([opposite[south], radii, opposite[north]])
    cols = min(OVER_POLE, radii.shape[1] - 1)
    west, east = slice(-1 - cols, -1), slice(1, 1 + cols)
    lons = np.concatenate([grid.lons[west] - 360.0, grid.lons, grid.lons[east] + 360.0])
    radii = np.concatenate([radii[:, west], radii, radii[:, east]], axis=1)
    fine_lats, fine_lons = (
        _interpolate_between(grid.lats, times),
        _interpolate_between(grid.lons, times),
    )
    fine = RectBivariateSpline(lats, lons, radii)(fine_lats, fine_lons)
    fine[:, -1] = fine[:, 0]
    fine[[0, -1]] = grid.radii[[0, -1], :-1].mean(axis=1, keepdims=True)
    return RadiiGrid(fine_lats, fine_lons, fine)


def split_by_butterfly(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Four faces for each of a closed mesh; vertices stay, new ones follow.

    vertices (n, 3); faces (m, 3), counter-clockwise from outside
    """
    edges = find_edges(faces)
    sides = np.arange(edges.other.size)
    first_side = sides < edges.other
    number = np.empty(sides.size, np.int64)
    number[first_side] = len(vertices) + np.arange(int(first_side.sum()))
    number[edges.other[first_side]] = number[first_side]
    start = np.ascontiguousarray(faces.ravel())
    count = np.bincount(start, minlength=len(vertices))
    middles = _place_middles(vertices, start, edges.other, count, sides[first_side])
    a, b, c = faces.T
    ab, bc, ca = number.reshape(-1, 3).T
    four = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    finer = np.stack([np.stack(face, axis=1) for face in four], axis=1)
    return np.concatenate([vertices, middles]), finer.reshape(-1, 3)


def _interpolate_between(values: FloatArray, times: int) -> FloatArray:
    """Values and those that cut each step between them into `times`."""
    count = values.size - 1
    return np.interp(np.arange(count * times + 1) / times, np.arange(count + 1), values)


@kernel
def _get_next(side: int) -> int:
    return side - 2 if side % 3 == 2 else side + 1


@kernel
def _get_last(side: int) -> int:
    return side + 2 if side % 3 == 0 else side - 1


@kernel
def _add_ring(
    vertices: FloatArray, start: IntArray, other: IntArray, side: int, count: int, out: FloatArray
) -> None:
    """Add the place that the ring about a side's first vertex gives its middle."""
    out += 0.75 * vertices[start[side]]
    at = side
    for j in range(count):
        if count == 3:
            weight = 5.0 / 12.0 if j == 0 else -1.0 / 12.0
        elif count == 4:
            weight = 0.375 if j == 0 else (-0.125 if j == 2 else 0.0)
        else:
            turn = 2.0 * np.pi * j / count
            weight = (0.25 + np.cos(turn) + 0.5 * np.cos(2.0 * turn)) / count
        out += weight * vertices[start[_get_next(at)]]
        at = other[_get_last(at)]


@kernel
def _measure_height(vertices: FloatArray, start: IntArray, side: int) -> float:
    """Least height of the face of a side: twice its area over its longest edge."""
    a, b = vertices[start[side]], vertices[start[_get_next(side)]]
    c = vertices[start[_get_last(side)]]
    u, v, w = b - a, c - a, c - b
    twice = np.sqrt(max((u * u).sum() * (v * v).sum() - (u * v).sum() ** 2, 0.0))
    return float(twice / np.sqrt(max((u * u).sum(), (v * v).sum(), (w * w).sum())))


@kernel
def _place_middles(
    vertices: FloatArray, start: IntArray, other: IntArray, counts: IntArray, sides: IntArray
) -> FloatArray:
    """New vertices (n, 3), one for each edge, given by one of its sides."""
    out = np.zeros((sides.size, 3))
    for n in range(sides.size):
        side = sides[n]
        across = other[side]
        first, second = counts[start[side]], counts[start[across]]
        if first == 6 and second == 6:
            for at in (side, across):
                out[n] += 0.5 * vertices[start[at]] + 0.125 * vertices[start[_get_last(at)]]
                for wing in (_get_next(at), _get_last(at)):
                    out[n] -= 0.0625 * vertices[start[_get_last(other[wing])]]
        elif first != 6 and second != 6:
            _add_ring(vertices, start, other, side, first, out[n])
            _add_ring(vertices, start, other, across, second, out[n])
            out[n] *= 0.5
        elif first != 6:
            _add_ring(vertices, start, other, side, first, out[n])
        else:
            _add_ring(vertices, start, other, across, second, out[n])
        plain = 0.5 * (vertices[start[side]] + vertices[start[across]])
        bulge = out[n] - plain
        most = MAX_BULGE * min(
            _measure_height(vertices, start, side), _measure_height(vertices, start, across)
        )
        size = np.sqrt((bulge * bulge).sum())
        if size > most:
            out[n] = plain + bulge * (most / size)
    return out


def refine_shape(shape: Shape, halvings: int) -> Shape:
    """The shape with each edge cut in two `halvings` times: 4^halvings faces for one."""
    vertices, faces = shape.vertices, shape.faces
    for _ in range(halvings):
        vertices, faces = _split_edges(vertices, faces)
    return Shape(vertices, faces)


def add_detail(shape: Shape, detail: SyntheticRelief) -> Shape:
    """The shape with a detail's heights added along its normals, read by the vertices' places."""
    lat, lon, _ = latlon_from_xyz(shape.vertices)
    heights = detail.heights(lat, lon)
    moved = shape.vertices + heights[:, None] * _compute_normals(shape.vertices, shape.faces)
    return Shape(moved, shape.faces)


def _compute_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
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


def _split_edges(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    sides.sort(axis=1)
    count = len(vertices)
    edges, number = np.unique(sides[:, 0] * count + sides[:, 1], return_inverse=True)
    normals = _compute_normals(vertices, faces)
    first, second = edges // count, edges % count
    way = vertices[second] - vertices[first]
    middles = 0.5 * (vertices[first] + vertices[second])
    # the cubic's middle: a chord that dives below the plane of an end lies under the ground
    for end, sign in ((first, -0.125), (second, 0.125)):
        middles += sign * np.einsum("ij,ij->i", way, normals[end])[:, None] * normals[end]
    a, b, c = faces.T
    ab, bc, ca = (count + number).reshape(3, -1)
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return (
        np.concatenate([vertices, middles]),
        np.concatenate([np.stack(three, axis=1) for three in corners]),
    )
