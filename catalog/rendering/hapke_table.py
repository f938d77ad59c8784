"""Hapke's law for one Sun and one view, through a table over the slopes of the ground.

With the Sun and the view fixed, the phase is too, and the brightness depends on the normal alone,
that is on two slopes (a, b) = -(n_x, n_y) / n_z. What is tabulated is the ratio to the
Lommel-Seeliger law, which stays smooth where the brightness falls to zero; it is read bilinearly.
A table over (cos i, cos e) instead would make steps in a view from above, where cos e hardly moves.
"""

import math
from functools import lru_cache

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.geometry.kernel import kernel
from catalog.photometry.hapke import HapkeParameters, reflectance_scalar
from catalog.rendering.shading import MapGrid, darken, row_normals

TABLE_SLOPE = 1.0  # beyond 45 deg ground is rare, and evaluated
TABLE_SIZE = 129
# For grids too small to pay for that table, a fifteenth of its cost: to 25 deg off nadir the
# brightness is wrong by 5e-4 rms of its mean (2e-3 at most), a tenth of an 8-bit count.
SMALL_TABLE_SIZE = 33
# Below this cosine of incidence the ratio is held; the brightness itself goes to zero.
GRAZING = 1e-3


def slope_table(
    sun: FloatArray, view: FloatArray, surface: HapkeParameters, size: int
) -> FloatArray:
    """(size, size) ratios of Hapke's law to mu0 / (mu0 + mu), b along rows, a along columns.

    sun, view (3,) unit. `shade_hapke` fills in what it needs, the rest is NaN: smooth ground has
    few slopes. Tables used last are kept: cells of a band of latitude share their Suns.
    """
    return _kept_table(tuple(sun.tolist()), tuple(view.tolist()), surface, size)


@lru_cache(maxsize=64)  # of 130 kB at most
def _kept_table(
    sun: tuple[float, float, float],
    view: tuple[float, float, float],
    surface: HapkeParameters,
    size: int,
) -> FloatArray:
    return np.full((size, size), np.nan)


@kernel
def _between(table: FloatArray, i: np.uint64, j: np.uint64, dy: float, dx: float) -> float:
    """The table's value dy rows and dx columns (0..1) after element [i, j]."""
    i1, j1 = i + np.uint64(1), j + np.uint64(1)
    value: float = (1.0 - dy) * ((1.0 - dx) * table[i, j] + dx * table[i, j1]) + dy * (
        (1.0 - dx) * table[i1, j] + dx * table[i1, j1]
    )
    return value


@kernel
def _fill(
    table: FloatArray,
    i: int,
    j: int,
    sun: FloatArray,
    view: FloatArray,
    cos_g: float,
    surface: HapkeParameters,
) -> None:
    """Compute those of the four elements from [i, j] on that are still NaN."""
    step = 2.0 * TABLE_SLOPE / (table.shape[0] - 1)
    for row in range(i, i + 2):
        for col in range(j, j + 2):
            if table[row, col] != table[row, col]:
                a, b = col * step - TABLE_SLOPE, row * step - TABLE_SLOPE
                length = math.sqrt(a * a + b * b + 1.0)
                mu0 = max((-a * sun[0] - b * sun[1] + sun[2]) / length, GRAZING)
                mu = max((-a * view[0] - b * view[1] + view[2]) / length, GRAZING)
                table[row, col] = reflectance_scalar(mu0, mu, cos_g, surface) * (mu0 + mu) / mu0


@kernel
def shade_hapke(
    grid: MapGrid,
    sun: FloatArray,
    view: FloatArray,
    surface: HapkeParameters,
    lit: BoolArray,
    table: FloatArray,
) -> Float32Array:
    """Radiance factor (n, n) of every node seen from the same direction `view` (3,) unit.

    lit    (n, n), or (0, 0) when all nodes are lit
    table  of this Sun, view and surface, see `slope_table`; what is needed is filled in
    """
    size = grid.heights.shape[0]
    out = np.zeros((size, size), np.float32)
    normals = np.empty((3, size))
    nx, ny, nz = normals[0], normals[1], normals[2]
    sx, sy, sz = sun[0], sun[1], sun[2]
    vx, vy, vz = view[0], view[1], view[2]
    cos_g = sx * vx + sy * vy + sz * vz
    steps = table.shape[0] - 1
    per_step = steps / (2.0 * TABLE_SLOPE)
    geometric, x, y = np.empty(size), np.empty(size), np.empty(size)
    for row in range(size):
        row_normals(grid, row, normals)
        line = out[row]
        # apart from the table, so that it is compiled to vector instructions
        for c in range(size):
            mu0 = nx[c] * sx + ny[c] * sy + nz[c] * sz
            mu = nx[c] * vx + ny[c] * vy + nz[c] * vz
            geometric[c] = mu0 / (mu0 + mu) if (mu0 > 0.0) & (mu > 0.0) else 0.0
            x[c] = (TABLE_SLOPE - nx[c] / nz[c]) * per_step
            y[c] = (TABLE_SLOPE - ny[c] / nz[c]) * per_step
        for c in range(size):
            if not geometric[c] > 0.0:
                continue
            if nz[c] > 0.0 and 0.0 <= x[c] < steps and 0.0 <= y[c] < steps:
                j, i = np.uint64(x[c]), np.uint64(y[c])
                dx, dy = x[c] - j, y[c] - i
                ratio = _between(table, i, j, dy, dx)
                if ratio != ratio:
                    _fill(table, int(i), int(j), sun, view, cos_g, surface)
                    ratio = _between(table, i, j, dy, dx)
                line[c] = ratio * geometric[c]
            else:
                mu0 = nx[c] * sx + ny[c] * sy + nz[c] * sz
                mu = nx[c] * vx + ny[c] * vy + nz[c] * vz
                length = math.sqrt(nx[c] * nx[c] + ny[c] * ny[c] + nz[c] * nz[c])
                line[c] = reflectance_scalar(mu0 / length, mu / length, cos_g, surface)
        darken(grid.heights, lit, row, line)
    return out
