"""Shading kernels: the brightness of each node of a map grid under one Sun.

The ground's normal is built in the frame of the grid's centre, on the curved body: the local up and
the two map axes of a stereographic point are rational in its coordinates, so that this costs no
more than the flat formula. To first order it is the flat normal with the gradient's
(dh/dx - x/R, dh/dy - y/R).
"""

import math
from typing import NamedTuple

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.geometry.kernel import kernel
from catalog.photometry.laws import SurfaceLaw, reflectance_by_law


class MapGrid(NamedTuple):
    """The heights of a map grid as kernels take them.

    heights  (n, n) float32  m above the reference sphere, NaN for no data; row 0 north
    posting  m between nodes
    radius   m, of the reference sphere
    """

    heights: Float32Array
    posting: float
    radius: float


@kernel
def _slope(before: float, here: float, after: float, posting: float) -> float:
    """Central difference; one-sided beside a hole or the border (NaN); 0 without neighbours."""
    if after == after:
        if before == before:
            return (after - before) / (2.0 * posting)
        return (after - here) / posting
    if before == before:
        return (here - before) / posting
    return 0.0


@kernel
def _row_slopes(
    heights: Float32Array, row: int, posting: float, east: FloatArray, north: FloatArray
) -> None:
    """Fill east, north (n,) with dh/dx and dh/dy of a row's nodes, by central differences."""
    size = heights.shape[0]
    here = heights[row]
    above = heights[row - 1] if row > 0 else here
    below = heights[row + 1] if row < size - 1 else here
    per_column = 1.0 / (2.0 * posting)
    per_row = per_column if 0 < row < size - 1 else 1.0 / posting
    left, right = here[: size - 2], here[2:]
    inner = east[1 : size - 1]
    total = 0.0
    for c in range(size - 2):
        inner[c] = (right[c] - left[c]) * per_column
        total += inner[c]
    for c in range(size):
        north[c] = (above[c] - below[c]) * per_row
        total += north[c]
    east[0] = (here[1] - here[0]) / posting
    east[size - 1] = (here[size - 1] - here[size - 2]) / posting
    if total == total and east[0] == east[0] and east[size - 1] == east[size - 1]:
        return
    # a hole is near: look at each node's neighbours
    for c in range(size):
        west_of = here[c - 1] if c > 0 else np.nan
        east_of = here[c + 1] if c < size - 1 else np.nan
        north_of = above[c] if row > 0 else np.nan
        south_of = below[c] if row < size - 1 else np.nan
        east[c] = _slope(west_of, here[c], east_of, posting)
        north[c] = _slope(south_of, here[c], north_of, posting)


@kernel
def row_normals(grid: MapGrid, row: int, normals: FloatArray) -> None:
    """Fill normals (3, n) with a row's outward normals (any length; east, north, up at the centre).

    Times (1 + q), with u = x/2R, v = y/2R, q = u^2 + v^2: the local up is (2u, 2v, 1 - q), map east
    (1 - u^2 + v^2, -2uv, -2u), map north (-2uv, 1 + u^2 - v^2, -2v). A metre of map is 1 / (1 + q)
    metres on the sphere and (R + h) / R times as much at the ground.
    """
    heights, posting, radius = grid
    size = heights.shape[0]
    nx, ny, nz = normals[0], normals[1], normals[2]
    _row_slopes(heights, row, posting, nx, ny)
    here = heights[row]
    scale = posting / (2.0 * radius)
    middle = (size - 1) / 2.0
    v = (middle - row) * scale
    for c in range(size):
        u = (c - middle) * scale
        uu, uv, q = u * u, u * v, u * u + v * v
        stretch = (1.0 + q) * (1.0 - here[c] / radius)  # 1 / (1 + h/R) to (h/R)^2 = 1e-5
        gx = nx[c] * stretch
        gy = ny[c] * stretch
        nx[c] = 2.0 * u - gx * (1.0 - uu + v * v) + gy * 2.0 * uv
        ny[c] = 2.0 * v + gx * 2.0 * uv - gy * (1.0 + uu - v * v)
        nz[c] = 1.0 - q + 2.0 * (gx * u + gy * v)


@kernel
def darken(heights: Float32Array, lit: BoolArray, row: int, line: Float32Array) -> None:
    """Put the row's shadows and holes into its brightness."""
    here = heights[row]
    if lit.shape[0] > 0:
        seen = lit[row]
        for c in range(line.size):
            line[c] = line[c] if seen[c] else np.float32(0.0)
    for c in range(line.size):
        line[c] = line[c] if here[c] == here[c] else np.float32(np.nan)


@kernel
def shade_two_terms(
    grid: MapGrid, sun: FloatArray, view: FloatArray, weight: float, albedo: float, lit: BoolArray
) -> Float32Array:
    """Radiance factor (n, n) of every node seen from the same direction `view` (3,) unit.

    lit     (n, n), or (0, 0) when all nodes are lit
    weight  share of the Lommel-Seeliger term, the rest is Lambert's: all three simple laws are so,
            for one Sun and one view
    """
    size = grid.heights.shape[0]
    out = np.empty((size, size), np.float32)
    normals = np.empty((3, size))
    nx, ny, nz = normals[0], normals[1], normals[2]
    sx, sy, sz = sun[0], sun[1], sun[2]
    vx, vy, vz = view[0], view[1], view[2]
    ratio, plain = 2.0 * albedo * weight, albedo * (1.0 - weight)
    for row in range(size):
        row_normals(grid, row, normals)
        line = out[row]
        for c in range(size):
            mu0 = nx[c] * sx + ny[c] * sy + nz[c] * sz
            mu = nx[c] * vx + ny[c] * vy + nz[c] * vz
            length = math.sqrt(nx[c] * nx[c] + ny[c] * ny[c] + nz[c] * nz[c])
            value = mu0 * (ratio / (mu0 + mu) + plain / length)
            line[c] = value if (mu0 > 0.0) & (mu > 0.0) else 0.0
        darken(grid.heights, lit, row, line)
    return out


@kernel
def shade_fixed(
    grid: MapGrid, sun: FloatArray, view: FloatArray, law: SurfaceLaw, lit: BoolArray
) -> Float32Array:
    """As `shade_two_terms`, by any law, each node evaluated."""
    size = grid.heights.shape[0]
    out = np.zeros((size, size), np.float32)
    normals = np.empty((3, size))
    nx, ny, nz = normals[0], normals[1], normals[2]
    cos_g = sun[0] * view[0] + sun[1] * view[1] + sun[2] * view[2]
    for row in range(size):
        row_normals(grid, row, normals)
        line = out[row]
        for c in range(size):
            if lit.shape[0] > 0 and not lit[row, c]:
                continue
            length = math.sqrt(nx[c] * nx[c] + ny[c] * ny[c] + nz[c] * nz[c])
            mu0 = (nx[c] * sun[0] + ny[c] * sun[1] + nz[c] * sun[2]) / length
            mu = (nx[c] * view[0] + ny[c] * view[1] + nz[c] * view[2]) / length
            line[c] = reflectance_by_law(mu0, mu, cos_g, law)
        darken(grid.heights, lit, row, line)
    return out


@kernel
def shade_from_camera(
    grid: MapGrid, sun: FloatArray, camera: FloatArray, law: SurfaceLaw, lit: BoolArray
) -> Float32Array:
    """The same for a near camera: `camera` (3,) m from the centre's foot on the sphere."""
    heights, posting, radius = grid
    size = heights.shape[0]
    out = np.zeros((size, size), np.float32)
    normals = np.empty((3, size))
    nx, ny, nz = normals[0], normals[1], normals[2]
    middle = (size - 1) / 2.0
    for row in range(size):
        row_normals(grid, row, normals)
        v = (middle - row) * posting / (2.0 * radius)
        for c in range(size):
            h = heights[row, c]
            if lit.shape[0] > 0 and not lit[row, c]:
                continue
            u = (c - middle) * posting / (2.0 * radius)
            q = u * u + v * v
            reach = (radius + h) / (1.0 + q)
            vx = camera[0] - 2.0 * u * reach
            vy = camera[1] - 2.0 * v * reach
            vz = camera[2] - (h * (1.0 - q) - 2.0 * q * radius) / (1.0 + q)
            length = math.sqrt(nx[c] * nx[c] + ny[c] * ny[c] + nz[c] * nz[c])
            distance = math.sqrt(vx * vx + vy * vy + vz * vz)
            mu0 = (nx[c] * sun[0] + ny[c] * sun[1] + nz[c] * sun[2]) / length
            mu = (nx[c] * vx + ny[c] * vy + nz[c] * vz) / (length * distance)
            cos_g = (sun[0] * vx + sun[1] * vy + sun[2] * vz) / distance
            out[row, c] = reflectance_by_law(mu0, mu, cos_g, law)
        darken(heights, lit, row, out[row])
    return out
