"""Where the nodes of a map grid, or any points, fall in a raster: its columns and rows.

Trigonometry of every node would cost more than reading its height. On a polar stereographic raster
the place of a node is rational. On a cylindrical one it is worked out on every sixteenth node and
interpolated between by cubics; on more of them, at last on all, toward a pole, where longitudes
bend more and more.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.geometry.kernel import inplace_kernel, kernel
from catalog.geometry.latlon import body_from_local
from catalog.geometry.projection import Stereographic
from catalog.terrain.dem.georeference import CYLINDRICAL, POLAR, Georeference

STEPS = (16, 8, 4, 2)  # nodes between those whose place is worked out, the fewer the nearer a pole
# Cubics over s nodes miss the longitude by at most 0.14 s (s / d)^3 nodes at d nodes from a pole
# (0.023 h^4 times the fourth derivative of the arctangent): 6e-4 nodes where d is so many steps.
POLE_STEPS = 12.5
# The same for the map's own curvature: 1e-5 nodes when a step is no longer than this (rad).
MAX_STEP = 0.05


class Pixels(NamedTuple):
    """Places in a raster, flat.

    row, col  (n) fractional; whole numbers are pixel centres
    column_scale  (n) columns in the ground length of one row: 1 / cos(latitude) for square pixels
                  of a cylindrical map
    """

    row: FloatArray
    col: FloatArray
    column_scale: FloatArray

    def part(self, chosen: IntArray) -> "Pixels":
        """Some of the places."""
        return Pixels(self.row[chosen], self.col[chosen], self.column_scale[chosen])


class Cylinder(NamedTuple):
    """A cylindrical raster about a map grid.

    middle        column under the grid's middle
    row0          row of the equator
    ratio         columns a row of ground length at the equator
    """

    middle: float
    cols_per_rad: float
    row0: float
    rows_per_rad: float
    ratio: float


def locate_points(place: Georeference, lat: FloatArray, lon: FloatArray) -> Pixels:
    """Places of points (n), rad."""
    col, row = place.pixel_from_latlon(lat, lon)
    if place.wraps and col.size:
        # continuous about the points, so that their window is small across ±180° too
        col = col - np.floor((col - col[0]) / place.period + 0.5) * place.period
    return _shift_to_raster(place, Pixels(row, col, place.columns_per_posting(1.0, lat)))


def locate_grid(
    place: Georeference, projection: Stereographic, posting_m: float, size: int
) -> Pixels:
    """Places of the nodes of a centred map grid (size, size), row by row from the north-west."""
    spacing = posting_m / (2.0 * projection.radius_m)
    row, col, column_scale = places = np.empty((3, size * size))
    ratio = place.row_angle / place.column_angle
    parameters = np.array(place.parameters)
    # longitudes are counted from the grid's middle, so that none jumps inside it
    m = body_from_local(projection.lat, 0.0)
    if place.kind == CYLINDRICAL:
        col0, cols_per_rad, row0, rows_per_rad, _ = place.parameters
        cols_per_rad *= place.longitude_sign
        middle = col0 + cols_per_rad * projection.lon
        step = _choose_step(projection, posting_m, size)
        # one before the first node, two beyond the last
        first, n = (-step, (size - 1) // step + 4) if step > 1 else (0, size)
        nodes = np.empty((3, n, n))
        cylinder = Cylinder(middle, cols_per_rad, row0, rows_per_rad, ratio)
        _locate_cylindrical(m, size, spacing, first, step, cylinder, nodes)
        if step > 1:
            _interpolate_between(
                nodes, size, _make_cubic_weights(step), np.empty(nodes.shape[1]), places
            )
        else:
            row, col, column_scale = nodes.reshape(3, -1)
    elif place.kind == POLAR:
        sign = place.longitude_sign
        _locate_polar(m, size, spacing, projection.lon * sign, sign, parameters, row, col)
        column_scale[:] = ratio
    else:
        offsets = (np.arange(size) - (size - 1) / 2.0) * posting_m
        lat, lon = projection.latlon(*np.meshgrid(offsets, -offsets))
        return locate_points(place, lat.ravel(), lon.ravel())
    return _shift_to_raster(place, Pixels(row, col, column_scale))


def _shift_to_raster(place: Georeference, pixels: Pixels) -> Pixels:
    """Columns of that turn which a raster shows, of a raster that does not show all of one."""
    period = place.period
    if not period or place.wraps:  # any turn is right where columns go on without end
        return pixels
    middle = (place.shape[1] - 1) / 2.0
    col = pixels.col - np.floor((pixels.col - middle) / period + 0.5) * period
    return pixels._replace(col=col)


def _choose_step(projection: Stereographic, posting_m: float, size: int) -> int:
    """Nodes from one whose place is worked out to the next; 1 about a pole and for small grids."""
    angle = posting_m / projection.radius_m
    pole = (np.pi / 2.0 - abs(projection.lat)) / angle
    for step in STEPS:
        corner = (size / 2.0 + 2 * step) * np.sqrt(2.0)
        if pole - corner > POLE_STEPS * step and step * angle < MAX_STEP and size > step:
            return step
    return 1


@cache
def _make_cubic_weights(step: int) -> FloatArray:
    """Weights (4, step) of four equidistant values for places between the middle two (Lagrange)."""
    t = np.arange(step) / step
    return np.stack(
        [
            -t * (t - 1.0) * (t - 2.0) / 6.0,
            (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0,
            -(t + 1.0) * t * (t - 2.0) / 2.0,
            (t + 1.0) * t * (t - 1.0) / 6.0,
        ]
    )


@kernel
def _locate_cylindrical(
    m: FloatArray,
    size: int,
    spacing: float,
    first: int,
    stride: int,
    cylinder: Cylinder,
    out: FloatArray,
) -> None:
    """Row, column and column scale (3, n, n) of the nodes first, first + stride, ... both ways."""
    middle, cols_per_rad, row0, rows_per_rad, ratio = cylinder
    half = (size - 1) / 2.0
    n = out.shape[1]
    for a in range(n):
        v = (half - (first + a * stride)) * spacing
        for b in range(n):
            u = (first + b * stride - half) * spacing
            squared = u * u + v * v
            scale = 1.0 / (1.0 + squared)
            e, n_, up = 2.0 * u * scale, 2.0 * v * scale, (1.0 - squared) * scale
            x = m[0, 0] * e + m[0, 1] * n_ + m[0, 2] * up
            y = m[1, 0] * e + m[1, 1] * n_ + m[1, 2] * up
            z = m[2, 0] * e + m[2, 1] * n_ + m[2, 2] * up
            across = np.sqrt(x * x + y * y)
            out[0, a, b] = row0 + rows_per_rad * np.arctan2(z, across)
            out[1, a, b] = middle + cols_per_rad * np.arctan2(y, x)
            out[2, a, b] = ratio / max(across, 1e-9)


@inplace_kernel
def _interpolate_between(
    nodes: FloatArray, size: int, weights: FloatArray, line: FloatArray, places: FloatArray
) -> None:
    """All nodes (3, size^2) from every `step`th (3, n, n), whose first lies one outside the grid.

    weights  (4, step)  by number, so that a step's places are worked out side by side
    line     (n,) to work in
    """
    step, n = weights.shape[1], nodes.shape[1]
    first, second, third, fourth = weights[0], weights[1], weights[2], weights[3]
    for k in range(3):
        for i in range(size):
            a, w = i // step, weights[:, i % step]
            above, upper, lower, below = (
                nodes[k, a],
                nodes[k, a + 1],
                nodes[k, a + 2],
                nodes[k, a + 3],
            )
            for b in range(n):
                line[b] = w[0] * above[b] + w[1] * upper[b] + w[2] * lower[b] + w[3] * below[b]
            row = places[k, i * size : (i + 1) * size]
            for b in range(n - 3):
                part = row[b * step : (b + 1) * step]
                v0, v1, v2, v3 = line[b], line[b + 1], line[b + 2], line[b + 3]
                for s in range(part.size):
                    part[s] = first[s] * v0 + second[s] * v1 + third[s] * v2 + fourth[s] * v3


@kernel
def _locate_polar(
    m: FloatArray,
    size: int,
    spacing: float,
    middle: float,
    longitude_sign: float,
    p: FloatArray,
    row: FloatArray,
    col: FloatArray,
) -> None:
    """Rows and columns in a polar stereographic raster; `middle` is the grid's map longitude."""
    half = (size - 1) / 2.0
    sign = p[0]
    sine, cosine = np.sin(middle - p[4]), np.cos(middle - p[4])
    for i in range(size):
        v = (half - i) * spacing
        for j in range(size):
            u = (j - half) * spacing
            squared = u * u + v * v
            scale = 1.0 / (1.0 + squared)
            e, n_, up = 2.0 * u * scale, 2.0 * v * scale, (1.0 - squared) * scale
            x = m[0, 0] * e + m[0, 1] * n_ + m[0, 2] * up
            y = longitude_sign * (m[1, 0] * e + m[1, 1] * n_ + m[1, 2] * up)
            z = m[2, 0] * e + m[2, 1] * n_ + m[2, 2] * up
            # tan of half the polar distance, over its sine
            distance = p[3] / max(1.0 + sign * z, 1e-12)
            col[i * size + j] = p[1] + distance * (sine * x + cosine * y)
            row[i * size + j] = p[2] + sign * distance * (cosine * x - sine * y)
