"""Shading kernels: the brightness of some rows of a map grid under one Sun.

The ground's normal is built in the frame of the grid's centre, on the curved body: the local up and
the two map axes of a stereographic point are rational in its coordinates, so that this costs no
more than the flat formula. To first order it is the flat normal with the gradient's
(dh/dx - x/R, dh/dy - y/R).

Computed in single precision, as heights and brightness are stored, so that a vector
register holds twice as many nodes: a brightness is then right to 1e-6 of the brightest.
"""

import math
from typing import NamedTuple

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import inplace_kernel
from catalog.photometry.laws import (
    SurfaceLaw,
    compute_lunar_weight,
    compute_phase_degrees,
    evaluate_law,
)

LIMIT, LIT, TWO_TERMS, TABLE, FAR, NEAR, NEAR_LUNAR = range(7)  # numbers of what a sweep makes
ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
UNKNOWN = np.float32(np.nan)


class MapGrid(NamedTuple):
    """The heights of a map grid as kernels take them.

    heights  (n, n) float32  m above the reference sphere, NaN for no data; row 0 north
    posting  m between nodes
    radius   m, of the reference sphere
    """

    heights: Float32Array
    posting: float
    radius: float


class Lighting(NamedTuple):
    """The quantity to compute on a grid, with its light and law.

    made    LIMIT: the heights that ground must pass to see the Sun; LIT: 1 where it does, else 0;
            the brightness by TWO_TERMS: a share of Lommel-Seeliger's law, the rest Lambert's, which
            all three simple laws are for one Sun and one view; by TABLE: Hapke's law read from a
            table; by FAR: any law, node by node, one view; by NEAR: the same for a near camera; by
            NEAR_LUNAR: the lunar-Lambert law for a near camera
    sun     (3,)  unit; all vectors are x along columns, y against rows, up at the grid's centre
    camera  (3,)  unit; for a near one its place, m from the centre's foot on the sphere
    weight  share of the Lommel-Seeliger term
    table   of this Sun, view and surface, see `hapke_table.slope_table`; (0, 0) for other laws
    """

    made: int
    sun: FloatArray
    camera: FloatArray
    weight: float
    law: SurfaceLaw
    table: Float32Array


class Rows(NamedTuple):
    """Some rows of a grid of n x n nodes, which are worked on together.

    heights  (m, n or more)  rows from number `low` on, among them the neighbours of these
    first    number of the first of these rows
    together how many they are
    u        (n,) x / 2R of columns; y / 2R of a row is -u[number]
    """

    heights: Float32Array
    low: int
    first: int
    together: int
    u: Float32Array


@inplace_kernel
def round_to_single(vector: FloatArray) -> tuple[np.float32, np.float32, np.float32]:
    """The elements of a vector (3,) in single precision."""
    return np.float32(vector[0]), np.float32(vector[1]), np.float32(vector[2])


@inplace_kernel
def _compute_slope(
    before: np.float32, here: np.float32, after: np.float32, per_m: np.float32
) -> np.float32:
    """Central difference; one-sided beside a hole or the border (NaN); 0 without neighbours.

    per_m  one over the posting
    """
    if after == after:
        if before == before:
            return (after - before) * (HALF * per_m)
        return (after - here) * per_m
    if before == before:
        return (here - before) * per_m
    return ZERO


@inplace_kernel
def _fill_slopes_near_holes(
    above: Float32Array,
    here: Float32Array,
    below: Float32Array,
    per_m: np.float32,
    along: Float32Array,
    across: Float32Array,
) -> None:
    """Slopes of a row with holes about it; `above` or `below` are empty beyond the border."""
    size = here.size
    for c in range(size):
        west_of = here[c - 1] if c > 0 else UNKNOWN
        east_of = here[c + 1] if c < size - 1 else UNKNOWN
        north_of = above[c] if above.size > 0 else UNKNOWN
        south_of = below[c] if below.size > 0 else UNKNOWN
        along[c] = _compute_slope(west_of, here[c], east_of, per_m)
        across[c] = _compute_slope(south_of, here[c], north_of, per_m)


@inplace_kernel
def _fill_row_slopes(
    rows: Rows, number: int, posting: float, along: Float32Array, across: Float32Array
) -> None:
    """Fill along, across (n,) with dh/dx and dh/dy of a row's nodes, by central differences."""
    size, i = along.size, number - rows.low
    is_first, is_last = number == 0, number == size - 1
    here = rows.heights[i][:size]
    above = here if is_first else rows.heights[i - 1][:size]
    below = here if is_last else rows.heights[i + 1][:size]
    per_m = np.float32(1.0 / posting)
    per_column = HALF * per_m
    per_row = per_m if is_first or is_last else per_column
    left, right, inner = here[: size - 2], here[2:], along[1 : size - 1]
    for c in range(size - 2):
        inner[c] = (right[c] - left[c]) * per_column
    for c in range(size):
        across[c] = (above[c] - below[c]) * per_row
    along[0] = (here[1] - here[0]) * per_m
    along[size - 1] = (here[size - 1] - here[size - 2]) * per_m
    # counted in whole numbers: a sum of slopes would make the loop wait for each addition
    holes = 0
    for c in range(size):
        slopes = along[c] + across[c]
        holes += 1 if slopes != slopes else 0
    if holes:
        none = here[:0]
        _fill_slopes_near_holes(
            none if is_first else above, here, none if is_last else below, per_m, along, across
        )


@inplace_kernel
def fill_slopes(rows: Rows, grid: MapGrid, slopes: Float32Array) -> None:
    """Fill slopes (rows, 2, n) with dh/dx and dh/dy of nodes, by central differences."""
    for k in range(rows.together):
        _fill_row_slopes(rows, rows.first + k, grid.posting, slopes[k, 0], slopes[k, 1])


@inplace_kernel
def compute_normal(
    slope_x: np.float32,
    slope_y: np.float32,
    u: np.float32,
    v: np.float32,
    raised: np.float32,
) -> tuple[np.float32, np.float32, np.float32]:
    """The outward normal of a node (any length; frame as `Lighting` has it).

    Times (1 + q), with u = x/2R, v = y/2R, q = u^2 + v^2: the local up is (2u, 2v, 1 - q), map x
    (1 - u^2 + v^2, -2uv, -2u), map y (-2uv, 1 + u^2 - v^2, -2v). A metre of map is 1 / (1 + q)
    metres on the sphere and (R + h) / R times as much at the ground; raised: h / R.
    """
    uu, vv, uv = u * u, v * v, TWO * u * v
    length = ONE + (uu + vv)
    stretch = length * (ONE - raised)  # 1 / (1 + h/R) to (h/R)^2 = 1e-5
    gx, gy = slope_x * stretch, slope_y * stretch
    return (
        TWO * u - gx * (ONE - uu + vv) + gy * uv,
        TWO * v + gx * uv - gy * (ONE + uu - vv),
        TWO - length + TWO * (gx * u + gy * v),
    )


@inplace_kernel
def shade_two_terms(
    rows: Rows,
    grid: MapGrid,
    slopes: Float32Array,
    mask: Float32Array,
    light: Lighting,
    target: Float32Array,
) -> None:
    """Fill target (rows, n) with brightness by TWO_TERMS.

    slopes  (rows, 2, n)
    mask    (rows, n)  0 in shadow, 1 in the light, NaN in holes
    """
    (sx, sy, sz), (vx, vy, vz) = round_to_single(light.sun), round_to_single(light.camera)
    ratio = np.float32(2.0 * light.law.albedo * light.weight)
    plain = np.float32(light.law.albedo * (1.0 - light.weight))
    us, per_radius = rows.u, np.float32(1.0 / grid.radius)
    for k in range(rows.together):
        number = rows.first + k
        slope_x, slope_y, v = slopes[k, 0], slopes[k, 1], -us[number]
        here = rows.heights[number - rows.low][: us.size]
        seen, line = mask[k], target[k][: us.size]
        for c in range(line.size):
            nx, ny, nz = compute_normal(slope_x[c], slope_y[c], us[c], v, here[c] * per_radius)
            mu0 = nx * sx + ny * sy + nz * sz
            mu = nx * vx + ny * vy + nz * vz
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            total = mu0 + mu
            value = mu0 * (ratio * length + plain * total) / (total * length)
            line[c] = seen[c] * (value if (mu0 > ZERO) & (mu > ZERO) else ZERO)


@inplace_kernel
def shade_nodes(
    rows: Rows,
    grid: MapGrid,
    slopes: Float32Array,
    mask: Float32Array,
    light: Lighting,
    target: Float32Array,
) -> None:
    """Fill target by FAR or NEAR: each lit node is evaluated; arguments as `shade_two_terms`."""
    sun, camera = light.sun, light.camera
    vx, vy, vz, distance = camera[0], camera[1], camera[2], 1.0
    for k in range(rows.together):
        number = rows.first + k
        v = -np.float64(rows.u[number])
        for c in range(rows.u.size):
            target[k, c] = mask[k, c]
            if not mask[k, c] > ZERO:
                continue
            h, u = np.float64(rows.heights[number - rows.low, c]), np.float64(rows.u[c])
            nx, ny, nz = compute_normal(
                slopes[k, 0, c],
                slopes[k, 1, c],
                rows.u[c],
                -rows.u[number],
                np.float32(h / grid.radius),
            )
            if light.made == NEAR:
                q = u * u + v * v
                reach = (grid.radius + h) / (1.0 + q)
                vx = camera[0] - 2.0 * u * reach
                vy = camera[1] - 2.0 * v * reach
                vz = camera[2] - (h * (1.0 - q) - 2.0 * q * grid.radius) / (1.0 + q)
                distance = math.sqrt(vx * vx + vy * vy + vz * vz)
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            mu0 = (nx * sun[0] + ny * sun[1] + nz * sun[2]) / length
            mu = (nx * vx + ny * vy + nz * vz) / (length * distance)
            cos_g = (sun[0] * vx + sun[1] * vy + sun[2] * vz) / distance
            target[k, c] = evaluate_law(mu0, mu, cos_g, light.law)


@inplace_kernel
def shade_near(
    rows: Rows,
    grid: MapGrid,
    slopes: Float32Array,
    mask: Float32Array,
    light: Lighting,
    target: Float32Array,
) -> None:
    """Fill target by NEAR_LUNAR, without branches, in a third of the time of `shade_nodes`.

    To single precision; the phase of each node to 2e-8 rad.
    """
    sun, camera = light.sun, light.camera
    sx, sy, sz = sun[0], sun[1], sun[2]
    us, diameter, per_radius = rows.u, 2.0 * grid.radius, np.float32(1.0 / grid.radius)
    cx, cy, cz, albedo = camera[0], camera[1], camera[2], light.law.albedo
    for k in range(rows.together):
        number = rows.first + k
        slope_x, slope_y, w = slopes[k, 0], slopes[k, 1], -us[number]
        here = rows.heights[number - rows.low][: us.size]
        seen, line, v = mask[k], target[k][: us.size], np.float64(w)
        for c in range(line.size):
            nx, ny, nz = compute_normal(slope_x[c], slope_y[c], us[c], w, here[c] * per_radius)
            h, u = np.float64(here[c]), np.float64(us[c])
            q = u * u + v * v
            reach = (diameter + 2.0 * h) / (1.0 + q)
            vx, vy = cx - u * reach, cy - v * reach
            vz = cz - (h * (1.0 - q) - q * diameter) / (1.0 + q)
            distance = np.sqrt(vx * vx + vy * vy + vz * vz)
            length = np.sqrt(np.float64(nx * nx + ny * ny + nz * nz))
            mu0 = (nx * sx + ny * sy + nz * sz) / length
            mu = (nx * vx + ny * vy + nz * vz) / (length * distance)
            weight = compute_lunar_weight(
                compute_phase_degrees((sx * vx + sy * vy + sz * vz) / distance)
            )
            value = albedo * mu0 * (2.0 * weight / (mu0 + mu) + (1.0 - weight))
            line[c] = seen[c] * (np.float32(value) if (mu0 > 0.0) & (mu > 0.0) else ZERO)
