"""Shading kernels: the brightness of each node of a map grid under one Sun.

The ground's normal is built in the frame of the grid's centre, on the curved body: the local up and
the two map axes of a stereographic point are rational in its coordinates, so that this costs no
more than the flat formula. To first order it is the flat normal with the gradient's
(dh/dx - x/R, dh/dy - y/R).
"""

import math

import numpy as np
from numpy.typing import NDArray

from catalog.geometry.kernel import kernel
from catalog.photometry import hapke, lambert, lommel_seeliger, lunar_lambert
from catalog.photometry.hapke import HapkeParameters

FloatArray = NDArray[np.float64]
HeightGrid = NDArray[np.float32]
BoolGrid = NDArray[np.bool_]

HAPKE, LOMMEL_SEELIGER, LUNAR_LAMBERT, LAMBERT = 0, 1, 2, 3


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
def node_normal(
    heights: HeightGrid, row: int, col: int, posting: float, radius: float
) -> tuple[float, float, float]:
    """Outward normal (any length; east, north, up at the grid's centre) of the ground at a node."""
    size = heights.shape[0]
    here = heights[row, col]
    west = heights[row, col - 1] if col > 0 else np.nan
    east = heights[row, col + 1] if col < size - 1 else np.nan
    north = heights[row - 1, col] if row > 0 else np.nan
    south = heights[row + 1, col] if row < size - 1 else np.nan
    u = (col - (size - 1) / 2.0) * posting / (2.0 * radius)
    v = ((size - 1) / 2.0 - row) * posting / (2.0 * radius)
    q = u * u + v * v
    # Times (1 + q): up = (2u, 2v, 1 - q), map east = (1 - u^2 + v^2, -2uv, -2u), map north alike.
    # A metre of map is 1 / (1 + q) m on the sphere and (R + h) / R more at the ground.
    stretch = (1.0 + q) / (1.0 + here / radius)
    gx = _slope(west, here, east, posting) * stretch
    gy = _slope(south, here, north, posting) * stretch
    return (
        2.0 * u - gx * (1.0 - u * u + v * v) + gy * 2.0 * u * v,
        2.0 * v + gx * 2.0 * u * v - gy * (1.0 + u * u - v * v),
        1.0 - q + 2.0 * (gx * u + gy * v),
    )


@kernel
def brightness(
    law: int, mu0: float, mu: float, cos_g: float, surface: HapkeParameters, albedo: float
) -> float:
    """Radiance factor by a law's number."""
    if law == HAPKE:
        return hapke.reflectance_scalar(mu0, mu, cos_g, surface)
    if law == LOMMEL_SEELIGER:
        return lommel_seeliger.reflectance_scalar(mu0, mu, albedo)
    if law == LUNAR_LAMBERT:
        return lunar_lambert.reflectance_scalar(mu0, mu, cos_g, albedo)
    return lambert.reflectance_scalar(mu0, mu, albedo)


@kernel
def shade_fixed(
    heights: HeightGrid,
    posting: float,
    radius: float,
    sun: FloatArray,
    view: FloatArray,
    law: int,
    surface: HapkeParameters,
    albedo: float,
    lit: BoolGrid,
) -> HeightGrid:
    """Every node seen from the same direction `view` (3,) unit; `lit` may be (0, 0): all lit."""
    size = heights.shape[0]
    out = np.zeros((size, size), np.float32)
    shadows = lit.shape[0] > 0
    sx, sy, sz = sun[0], sun[1], sun[2]
    vx, vy, vz = view[0], view[1], view[2]
    cos_g = sx * vx + sy * vy + sz * vz
    for row in range(size):
        for col in range(size):
            if heights[row, col] != heights[row, col]:
                out[row, col] = np.nan
                continue
            if shadows and not lit[row, col]:
                continue
            nx, ny, nz = node_normal(heights, row, col, posting, radius)
            mu0 = nx * sx + ny * sy + nz * sz
            mu = nx * vx + ny * vy + nz * vz
            if mu0 <= 0.0 or mu <= 0.0:
                continue
            if law != LOMMEL_SEELIGER:  # whose ratio does not ask for the normal's length
                length = math.sqrt(nx * nx + ny * ny + nz * nz)
                mu0 /= length
                mu /= length
            out[row, col] = brightness(law, mu0, mu, cos_g, surface, albedo)
    return out


@kernel
def shade_from_camera(
    heights: HeightGrid,
    posting: float,
    radius: float,
    sun: FloatArray,
    camera: FloatArray,
    law: int,
    surface: HapkeParameters,
    albedo: float,
    lit: BoolGrid,
) -> HeightGrid:
    """Every node seen from a place: `camera` (3,) m from the centre's foot on the sphere."""
    size = heights.shape[0]
    out = np.zeros((size, size), np.float32)
    shadows = lit.shape[0] > 0
    middle = (size - 1) / 2.0
    sx, sy, sz = sun[0], sun[1], sun[2]
    for row in range(size):
        v = (middle - row) * posting / (2.0 * radius)
        for col in range(size):
            h = heights[row, col]
            if h != h:
                out[row, col] = np.nan
                continue
            if shadows and not lit[row, col]:
                continue
            nx, ny, nz = node_normal(heights, row, col, posting, radius)
            mu0 = nx * sx + ny * sy + nz * sz
            u = (col - middle) * posting / (2.0 * radius)
            q = u * u + v * v
            reach = (radius + h) / (1.0 + q)
            vx = camera[0] - 2.0 * u * reach
            vy = camera[1] - 2.0 * v * reach
            vz = camera[2] - (h * (1.0 - q) - 2.0 * q * radius) / (1.0 + q)
            mu = nx * vx + ny * vy + nz * vz
            if mu0 <= 0.0 or mu <= 0.0:
                continue
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            distance = math.sqrt(vx * vx + vy * vy + vz * vz)
            cos_g = (sx * vx + sy * vy + sz * vz) / distance
            mu0 /= length
            mu /= length * distance
            out[row, col] = brightness(law, mu0, mu, cos_g, surface, albedo)
    return out
