"""Hapke's law for one Sun and one view, through a table over the slopes of the ground.

With the Sun and the view fixed, the phase is too, and the brightness depends on the normal alone,
that is on two slopes (a, b) = -(n_x, n_y) / n_z. What is tabulated is the ratio to the
Lommel-Seeliger law, which stays smooth where the brightness falls to zero; it is read bilinearly.
A table over (cos i, cos e) instead would make steps in a view from above, where cos e hardly moves.
"""

import math
from functools import lru_cache

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel
from catalog.photometry.hapke import reflectance_scalar
from catalog.photometry.sets import HapkeParameters
from catalog.rendering.shading import ZERO, Lighting, MapGrid, Rows, compute_normal, round_to_single

TABLE_SLOPE = 1.0  # beyond 45 deg ground is rare, and evaluated
TABLE_SIZE = 129
# For grids too small to pay for that table, a fifteenth of its cost: to 25 deg off nadir the
# brightness is wrong by 5e-4 rms of its mean (2e-3 at most), a tenth of an 8-bit count.
SMALL_TABLE_SIZE = 33
# Below this cosine of incidence the ratio is held; the brightness itself goes to zero.
GRAZING = 1e-3


def make_slope_table(
    sun: FloatArray, view: FloatArray, surface: HapkeParameters, size: int
) -> Float32Array:
    """(size, size) ratios of Hapke's law to mu0 / (mu0 + mu), b along rows, a along columns.

    sun, view (3,) unit. `shade_hapke` fills in what it needs, the rest is NaN: smooth ground has
    few slopes. Tables used last are kept: cells of a band of latitude share their Suns.
    """
    return _cache_table(tuple(sun.tolist()), tuple(view.tolist()), surface, size)


@lru_cache(maxsize=64)  # of 66 kB at most
def _cache_table(
    sun: tuple[float, float, float],
    view: tuple[float, float, float],
    surface: HapkeParameters,
    size: int,
) -> Float32Array:
    return np.full((size, size), np.nan, np.float32)


@kernel
def _fill(
    table: Float32Array,
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
def _look_up_ratio(
    normal: tuple[np.float32, np.float32, np.float32],
    light: Lighting,
    place: int,
    dx: np.float32,
    dy: np.float32,
) -> np.float32:
    """The ratio at a normal: place in the table where it has no value yet, -1 where none."""
    sun, view = light.sun, light.camera
    cos_g = sun[0] * view[0] + sun[1] * view[1] + sun[2] * view[2]
    if place >= 0:
        row, col = divmod(place, light.table.shape[1])
        table = light.table
        _fill(table, row, col, sun, view, cos_g, light.law.surface)
        first = table[row, col] + dx * (table[row, col + 1] - table[row, col])
        second = table[row + 1, col] + dx * (table[row + 1, col + 1] - table[row + 1, col])
        return np.float32(first + dy * (second - first))
    nx, ny, nz = np.float64(normal[0]), np.float64(normal[1]), np.float64(normal[2])
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    mu0 = (nx * sun[0] + ny * sun[1] + nz * sun[2]) / length
    mu = (nx * view[0] + ny * view[1] + nz * view[2]) / length
    ratio = reflectance_scalar(mu0, mu, cos_g, light.law.surface) * (mu0 + mu) / mu0
    return np.float32(ratio)


@kernel
def shade_hapke(
    rows: Rows,
    grid: MapGrid,
    slopes: Float32Array,
    mask: Float32Array,
    light: Lighting,
    target: Float32Array,
) -> None:
    """Fill target (rows, n) with brightness by TABLE; arguments as for `shading.shade_two_terms`.

    What the table lacks is filled in.
    """
    (sx, sy, sz), (vx, vy, vz) = round_to_single(light.sun), round_to_single(light.camera)
    table, us, per_radius = light.table, rows.u, np.float32(1.0 / grid.radius)
    size = us.size
    steps = np.float32(table.shape[0] - 1)
    middle, last = np.float32(0.5) * steps, steps * np.float32(1.0 - 1e-6)
    per_slope = np.float32(middle / TABLE_SLOPE)
    past_x, past_y = np.empty(size, np.float32), np.empty(size, np.float32)
    entry = np.empty(size, np.int32)
    flat, wide = table.reshape(-1), np.uint32(table.shape[1])
    for k in range(rows.together):
        number = rows.first + k
        slope_x, slope_y, v = slopes[k, 0], slopes[k, 1], -us[number]
        here = rows.heights[number - rows.low][:size]
        seen, line = mask[k], target[k][:size]
        # apart from the table, so that it is compiled to vector instructions
        for c in range(size):
            nx, ny, nz = compute_normal(slope_x[c], slope_y[c], us[c], v, here[c] * per_radius)
            mu0 = nx * sx + ny * sy + nz * sz
            mu = nx * vx + ny * vy + nz * vz
            line[c] = seen[c] * (mu0 / (mu0 + mu) if (mu0 > ZERO) & (mu > ZERO) else ZERO)
            per_up = per_slope / nz
            x, y = middle - nx * per_up, middle - ny * per_up
            is_inside = (nz > ZERO) & (x >= ZERO) & (x <= last) & (y >= ZERO) & (y <= last)
            x = x if is_inside else ZERO
            y = y if is_inside else ZERO
            col, row = np.int32(x), np.int32(y)
            past_x[c], past_y[c] = x - np.float32(col), y - np.float32(row)
            entry[c] = row * np.int32(wide) + col if is_inside else np.int32(-1)
        for c in range(size):
            if not line[c] > ZERO:
                continue
            if entry[c] >= 0:
                i = np.uint32(entry[c])
                j = i + wide
                dx = past_x[c]
                first = flat[i] + dx * (flat[i + np.uint32(1)] - flat[i])
                second = flat[j] + dx * (flat[j + np.uint32(1)] - flat[j])
                ratio = first + past_y[c] * (second - first)
                if ratio == ratio:
                    line[c] *= ratio
                    continue
            normal = compute_normal(slope_x[c], slope_y[c], us[c], v, here[c] * per_radius)
            line[c] *= _look_up_ratio(normal, light, entry[c], past_x[c], past_y[c])
