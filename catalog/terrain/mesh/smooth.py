"""A smooth surface through a shape model's vertices, as a mesh with finer faces.

Flat faces meet in edges that no body has; where patches are finer than the model they would show
as edges of brightness. Radii on a grid are interpolated by bicubic splines over latitude and
longitude, other meshes by the modified butterfly scheme (Zorin, Schroeder, Sweldens, "Interpolating
subdivision for meshes with arbitrary topology", SIGGRAPH 1996). Both keep the model's vertices.
"""

from pathlib import Path

import numpy as np
from scipy.interpolate import RectBivariateSpline

from catalog.arrays import FloatArray, IntArray
from catalog.geometry.kernel import kernel
from catalog.terrain.mesh.table import RadiiGrid, is_grid, read_grid, surface_of
from catalog.terrain.mesh.winding import edges_of

# Rows that a spline is carried on over a pole: what lies beyond is felt by less than 1e-3.
OVER_POLE = 6
# An edge's middle leaves it by less than this share of the lower of its two faces' heights: beyond
# that (needles, sharp ridges) faces could fold over.
MAX_BULGE = 0.25


def smooth_corners(
    path: Path,
    longitude: str,
    metres: float,
    vertices: FloatArray,
    faces: IntArray,
    halvings: int,
) -> FloatArray:
    """Corners (m, 3, 3) m of a mesh whose edges are 2^halvings times shorter than the model's.

    path, longitude  the model's file, as it was read; metres in one of its units
    vertices, faces  (n, 3) m and (k, 3): the closed surface that was made of it
    """
    if path.suffix.lower() in (".tab", ".txt") and is_grid(path):
        grid = finer_grid(read_grid(path), 2**halvings)
        vertices, faces = surface_of(grid, longitude)
        return np.asarray(metres * vertices[faces])
    for _ in range(halvings):
        vertices, faces = butterfly(vertices, faces)
    return np.asarray(vertices[faces])


def finer_grid(grid: RadiiGrid, times: int) -> RadiiGrid:
    """Radii at so many times as many latitudes and longitudes, from a bicubic spline.

    Where the two ends of a parallel differ, their mean stands for both.
    """
    radii = grid.radii.copy()
    radii[:, [0, -1]] = radii[:, [0, -1]].mean(axis=1, keepdims=True)
    radii[[0, -1]] = radii[[0, -1], :-1].mean(axis=1, keepdims=True)
    # beyond a pole a meridian goes on as the one opposite
    opposite = np.array([np.interp(grid.lons + 180.0, grid.lons, row, period=360.0)
                         for row in radii])  # fmt: skip
    rows = min(OVER_POLE, len(radii) - 1)
    south, north = slice(rows, 0, -1), slice(-2, -2 - rows, -1)
    lats = np.concatenate([-180.0 - grid.lats[south], grid.lats, 180.0 - grid.lats[north]])
    radii = np.concatenate([opposite[south], radii, opposite[north]])
    cols = min(OVER_POLE, radii.shape[1] - 1)
    west, east = slice(-1 - cols, -1), slice(1, 1 + cols)
    lons = np.concatenate([grid.lons[west] - 360.0, grid.lons, grid.lons[east] + 360.0])
    radii = np.concatenate([radii[:, west], radii, radii[:, east]], axis=1)
    fine_lats, fine_lons = _between(grid.lats, times), _between(grid.lons, times)
    fine = RectBivariateSpline(lats, lons, radii)(fine_lats, fine_lons)
    fine[:, -1] = fine[:, 0]
    fine[[0, -1]] = grid.radii[[0, -1], :-1].mean(axis=1, keepdims=True)
    return RadiiGrid(fine_lats, fine_lons, fine)


def butterfly(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Four faces for each of a closed mesh; vertices stay, new ones follow.

    vertices (n, 3); faces (m, 3), counter-clockwise from outside
    """
    edges = edges_of(faces)
    sides = np.arange(edges.other.size)
    own = sides < edges.other
    number = np.empty(sides.size, np.int64)
    number[own] = len(vertices) + np.arange(int(own.sum()))
    number[edges.other[own]] = number[own]
    start = np.ascontiguousarray(faces.ravel())
    count = np.bincount(start, minlength=len(vertices))
    middles = _middles(vertices, start, edges.other, count, sides[own])
    a, b, c = faces.T
    ab, bc, ca = number.reshape(-1, 3).T
    four = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    finer = np.stack([np.stack(face, axis=1) for face in four], axis=1)
    return np.concatenate([vertices, middles]), finer.reshape(-1, 3)


def _between(values: FloatArray, times: int) -> FloatArray:
    """Values and those that cut each step between them into `times`."""
    count = values.size - 1
    places = np.arange(count * times + 1) / times
    return np.asarray(np.interp(places, np.arange(count + 1), values))


@kernel
def _next(side: int) -> int:
    return side - 2 if side % 3 == 2 else side + 1


@kernel
def _last(side: int) -> int:
    return side + 2 if side % 3 == 0 else side - 1


@kernel
def _about(
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
        out += weight * vertices[start[_next(at)]]
        at = other[_last(at)]


@kernel
def _height(vertices: FloatArray, start: IntArray, side: int) -> float:
    """Least height of the face of a side: twice its area over its longest edge."""
    a, b = vertices[start[side]], vertices[start[_next(side)]]
    c = vertices[start[_last(side)]]
    u, v, w = b - a, c - a, c - b
    twice = np.sqrt(max((u * u).sum() * (v * v).sum() - (u * v).sum() ** 2, 0.0))
    return float(twice / np.sqrt(max((u * u).sum(), (v * v).sum(), (w * w).sum())))


@kernel
def _middles(
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
                out[n] += 0.5 * vertices[start[at]] + 0.125 * vertices[start[_last(at)]]
                for wing in (_next(at), _last(at)):
                    out[n] -= 0.0625 * vertices[start[_last(other[wing])]]
        elif first != 6 and second != 6:
            _about(vertices, start, other, side, first, out[n])
            _about(vertices, start, other, across, second, out[n])
            out[n] *= 0.5
        elif first != 6:
            _about(vertices, start, other, side, first, out[n])
        else:
            _about(vertices, start, other, across, second, out[n])
        plain = 0.5 * (vertices[start[side]] + vertices[start[across]])
        bulge = out[n] - plain
        most = MAX_BULGE * min(_height(vertices, start, side), _height(vertices, start, across))
        size = np.sqrt((bulge * bulge).sum())
        if size > most:
            out[n] = plain + bulge * (most / size)
    return out
