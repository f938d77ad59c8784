"""Height grids in latitude and longitude that rays can be followed over.

A grid carries the highest node of its blocks of 4, 16, 64 and 256 nodes, so that a ray crosses
empty space in large steps. Grids are a NamedTuple because compiled kernels take them whole.
"""

from typing import NamedTuple

import numba
import numpy as np

from catalog.arrays import Float32Array
from catalog.geometry.kernel import kernel, parallel_kernel


class Ground(NamedTuple):
    """Heights on a regular grid of latitudes and longitudes.

    heights     (rows, cols) float32, m above the sphere of `radius_m`; rows run south, columns east
    north, west            rad  the first node
    step_lat, step_lon     rad  positive
    highest_4 .. highest_256  highest node of each block, borders shared with the next block
    """

    heights: Float32Array
    north: float
    west: float
    step_lat: float
    step_lon: float
    radius_m: float
    highest_4: Float32Array
    highest_16: Float32Array
    highest_64: Float32Array
    highest_256: Float32Array
    lowest_m: float
    highest_m: float

    @property
    def posting_m(self) -> float:
        """Distance of neighbouring rows, m."""
        return self.step_lat * self.radius_m


def make_ground(
    heights: Float32Array,
    north: float,
    west: float,
    step_lat: float,
    step_lon: float,
    radius_m: float,
) -> Ground:
    """A ground from heights; the arguments are those of `Ground`.

    Raises ValueError for fewer than 4 x 4 nodes or a node without a height.
    """
    heights = np.ascontiguousarray(heights, dtype=np.float32)
    if heights.ndim != 2 or min(heights.shape) < 4:
        raise ValueError(f"a ground needs at least 4 x 4 nodes, not {heights.shape}")
    lowest, highest = float(heights.min()), float(heights.max())
    if not np.isfinite(highest - lowest):
        raise ValueError("a ground needs a height at every node")
    of_4 = _find_block_maxima(heights)
    of_16 = _join_maxima(of_4)
    of_64 = _join_maxima(of_16)
    max_heights = of_4, of_16, of_64, _join_maxima(of_64)
    location = float(north), float(west), float(step_lat), float(step_lon), float(radius_m)
    return Ground(heights, *location, *max_heights, lowest, highest)


def make_whole_sphere(heights: Float32Array, radius_m: float, seam: float) -> Ground:
    """A ground all round the body from pixels that cover the sphere once.

    heights  (n, 2n) m, pixel centres half a step inside the poles, first column half a step east
             of longitude 0
    seam     rad  the longitude where columns begin; put it away from the scene

    Rows are added beyond the poles from the opposite meridian, columns beyond the seam from the
    other end, so that interpolation needs no exceptions.
    Raises ValueError for another shape.
    """
    rows, cols = heights.shape
    if cols != 2 * rows or cols % 2:
        raise ValueError(f"{rows} x {cols} pixels do not cover a sphere in equal steps")
    step = np.pi / rows
    shift = int(np.floor(np.mod(seam, 2.0 * np.pi) / step))
    rolled = np.roll(heights, -shift, axis=1)
    pole = np.roll(rolled, rows, axis=1)
    tall = np.concatenate([pole[1::-1], rolled, pole[:-3:-1]])
    wide = np.concatenate([tall[:, -2:], tall, tall[:, :2]], axis=1)
    return make_ground(wide, 0.5 * np.pi + 1.5 * step, (shift - 1.5) * step, step, step, radius_m)


def crop_surroundings(wide: Ground, inner: Ground, margin: float) -> Ground:
    """The part of an all-round ground (`make_whole_sphere`) about another one.

    margin  rad  how far it reaches beyond the inner ground, as far as the wide one has nodes
    """
    rows, cols = inner.heights.shape
    high, low = wide.heights.shape[0] - 1, 0
    first = int((wide.north - inner.north - margin) / wide.step_lat)
    last = int((wide.north - inner.north + (rows - 1) * inner.step_lat + margin) / wide.step_lat)
    first, last = min(max(first, low), high - 4), max(min(last + 1, high), low + 4)
    widest = max(abs(wide.north - first * wide.step_lat), abs(wide.north - last * wide.step_lat))
    stretch = min(margin / max(np.cos(min(widest, 0.5 * np.pi)), 1e-3), np.pi)
    start = int(np.floor((inner.west - stretch - wide.west) / wide.step_lon))
    count = int(((cols - 1) * inner.step_lon + 2.0 * stretch) / wide.step_lon) + 2
    turn = round(2.0 * np.pi / wide.step_lon)
    # of the columns beyond the seam either copy will do; the first of them is the west node
    columns = np.mod(start + np.arange(min(count, turn + 3)), turn)
    heights = wide.heights[first : last + 1][:, columns]
    north, west = wide.north - first * wide.step_lat, wide.west + start * wide.step_lon
    return make_ground(heights, north, west, wide.step_lat, wide.step_lon, wide.radius_m)


@parallel_kernel
def _find_block_maxima(heights: Float32Array) -> Float32Array:
    rows, cols = heights.shape
    out = np.empty(((rows + 3) // 4, (cols + 3) // 4), np.float32)
    for i in numba.prange(out.shape[0]):
        for j in range(out.shape[1]):
            top = heights[4 * i, 4 * j]
            for r in range(4 * i, min(4 * i + 5, rows)):
                for c in range(4 * j, min(4 * j + 5, cols)):
                    value = heights[r, c]
                    if value > top:
                        top = value
            out[i, j] = top
    return out


@kernel
def _join_maxima(max_heights: Float32Array) -> Float32Array:
    rows, cols = max_heights.shape
    out = np.empty(((rows + 3) // 4, (cols + 3) // 4), np.float32)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = max_heights[4 * i : 4 * i + 4, 4 * j : 4 * j + 4].max()
    return out


@kernel
def locate_on_grid(ground: Ground, x: float, y: float, z: float) -> tuple[float, float]:
    """Fractional row and column of a body-fixed direction; columns count from the west node on."""
    lat = np.arctan2(z, np.sqrt(x * x + y * y))
    east = np.arctan2(y, x) - ground.west
    east -= 2.0 * np.pi * np.floor(east / (2.0 * np.pi))
    return (ground.north - lat) / ground.step_lat, east / ground.step_lon
