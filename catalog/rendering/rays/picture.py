"""Pictures of the ground: mean radiance over each pixel from rays through it."""

import numba
import numpy as np

from catalog.arrays import ByteArray, Float32Array, FloatArray
from catalog.geometry.grid import bicubic_at
from catalog.geometry.kernel import kernel, parallel_kernel
from catalog.photometry.hapke import HapkeParameters
from catalog.rendering.rays.ground import Ground, bilinear
from catalog.rendering.rays.light import BLOCK, shade
from catalog.rendering.rays.trace import FINE, SKY, WIDE, trace

# Rays within 37 deg of the vertical: ground that rises by less than 53 deg hides nothing from them.
STEEP = 0.8
# What a pixel's parts see is read between the hits of pixel middles where these bend by less than
# this (nodes) from a plane; a bend of half a node moves a sample by an eighth of that.
SMOOTH = 0.5


@kernel
def _ray(corners: FloatArray, i: int, j: int, y: float, x: float) -> tuple[float, float, float]:
    """Unit ray through a pixel at (x, y) in 0..1 across it; NaN where the camera has none."""
    a, b = (1.0 - y) * (1.0 - x), (1.0 - y) * x
    c, d = y * (1.0 - x), y * x
    p, q, r, s = corners[i, j], corners[i, j + 1], corners[i + 1, j], corners[i + 1, j + 1]
    u = a * p[0] + b * q[0] + c * r[0] + d * s[0]
    v = a * p[1] + b * q[1] + c * r[1] + d * s[1]
    w = a * p[2] + b * q[2] + c * r[2] + d * s[2]
    length = np.sqrt(u * u + v * v + w * w)
    return u / length, v / length, w / length


@kernel
def _pixel_angle(corners: FloatArray, i: int, j: int) -> float:
    p, q = corners[i, j], corners[i + 1, j + 1]
    d = (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2
    angle: float = np.sqrt(0.5 * d)
    return angle


@parallel_kernel
def first_hits(
    fine: Ground, wide: Ground, origin: FloatArray, corners: FloatArray, kind: ByteArray,
    distance: Float32Array, row: Float32Array, col: Float32Array,
) -> None:  # fmt: skip
    """What the middle of each pixel sees, into arrays of the picture's shape.

    Where rays are steep, what a pixel sees is as far away as what its left neighbour sees, save
    for relief within a pixel; the search begins well above that.
    """
    radius = fine.radius_m
    for i in numba.prange(kind.shape[0]):
        hint = 0.0
        for j in range(kind.shape[1]):
            dx, dy, dz = _ray(corners, i, j, 0.5, 0.5)
            kind[i, j] = SKY
            if dx != dx:
                hint = 0.0
                continue
            k, s, r, c = trace(fine, wide, origin[0], origin[1], origin[2], dx, dy, dz, hint)
            kind[i, j], distance[i, j], row[i, j], col[i, j] = k, s, r, c
            hint = 0.0
            if k == FINE:
                sink = dx * (origin[0] + s * dx) + dy * (origin[1] + s * dy)
                sink += dz * (origin[2] + s * dz)
                if sink < -STEEP * radius:
                    hint = max(s - 10.0 * s * _pixel_angle(corners, i, j), 1.0)


@kernel
def mark_blocks(
    which: int, kind: ByteArray, row: Float32Array, col: Float32Array, wanted: ByteArray
) -> None:
    """Set the blocks that pixels of a kind fall on, and their neighbours, to 1 where they are 0."""
    seen = np.zeros(wanted.shape, np.uint8)
    for i in range(kind.shape[0]):
        for j in range(kind.shape[1]):
            if kind[i, j] == which:
                seen[int(row[i, j]) // BLOCK, int(col[i, j]) // BLOCK] = 1
    add_with_neighbours(seen, wanted)


@kernel
def add_with_neighbours(seen: ByteArray, wanted: ByteArray) -> None:
    """Set blocks that are 1 in `seen`, and their neighbours, to 1 where they are 0 in `wanted`."""
    rows, cols = wanted.shape
    for i in range(rows):
        for j in range(cols):
            if seen[i, j]:
                for a in range(max(i - 1, 0), min(i + 2, rows)):
                    for b in range(max(j - 1, 0), min(j + 2, cols)):
                        if wanted[a, b] == 0:
                            wanted[a, b] = 1


@kernel
def _wide_radiance(
    wide: Ground, row: float, col: float, lit: ByteArray, sun: FloatArray, origin: FloatArray,
    surface: HapkeParameters,
) -> float:  # fmt: skip
    h = wide.heights
    r, c = min(int(row), h.shape[0] - 2), min(int(col), h.shape[1] - 2)
    y, x = row - r, col - c
    free = (1.0 - y) * ((1.0 - x) * lit[r, c] + x * lit[r, c + 1])
    free += y * ((1.0 - x) * lit[r + 1, c] + x * lit[r + 1, c + 1])
    if free <= 0.0:
        return 0.0
    south_rate = bicubic_at(h, row + 0.5, col) - bicubic_at(h, row - 0.5, col)
    east_rate = bicubic_at(h, row, col + 0.5) - bicubic_at(h, row, col - 0.5)
    lat, lon = wide.north - row * wide.step_lat, wide.west + col * wide.step_lon
    cos_lat, sin_lat, cos_lon, sin_lon = np.cos(lat), np.sin(lat), np.cos(lon), np.sin(lon)
    value: float = shade(
        wide, lat, bicubic_at(h, row, col), (cos_lat * cos_lon, cos_lat * sin_lon, sin_lat),
        (-sin_lon, cos_lon, 0.0), south_rate, east_rate, sun, origin, surface,
    )  # fmt: skip
    value *= free / 255.0
    return value


@kernel
def _samples(
    kind: ByteArray,
    i: int,
    j: int,
    distance: float,
    angle: float,
    posting: float,
    most: int,
    limb: int,
) -> int:
    """Rays a side of a pixel: as many as its ground has nodes, `limb` of them at the limb."""
    rows, cols = kind.shape
    here = kind[i, j] == SKY
    for a, b in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        p, q = min(max(i + a, 0), rows - 1), min(max(j + b, 0), cols - 1)
        if (kind[p, q] == SKY) != here:
            return limb
    if limb > most and not here:
        # one pixel farther in, brightness still falls steeply towards the limb
        for a, b in ((-2, 0), (2, 0), (0, -2), (0, 2), (-1, -1), (-1, 1), (1, -1), (1, 1)):
            p, q = min(max(i + a, 0), rows - 1), min(max(j + b, 0), cols - 1)
            if kind[p, q] == SKY:
                return limb
    if kind[i, j] != FINE:
        return 1
    return min(most, max(1, int(np.ceil(distance * angle / posting - 0.25))))


@kernel
def _smooth_at(kind: ByteArray, row: Float32Array, col: Float32Array, i: int, j: int) -> bool:
    """Whether a pixel and its eight neighbours see fine ground without a jump between them."""
    if not (0 < i < kind.shape[0] - 1 and 0 < j < kind.shape[1] - 1):
        return False
    for a in range(-1, 2):
        for b in range(-1, 2):
            if kind[i + a, j + b] != FINE:
                return False
    for a, b in ((0, 1), (1, 0), (1, 1), (1, -1)):
        for grid in (row, col):
            bend = grid[i + a, j + b] + grid[i - a, j - b] - 2.0 * grid[i, j]
            if abs(bend) > SMOOTH:
                return False
    return True


@parallel_kernel
def mean_radiance(
    fine: Ground, wide: Ground, origin: FloatArray, corners: FloatArray, kind: ByteArray,
    distance: Float32Array, row: Float32Array, col: Float32Array, shaded: Float32Array,
    wide_lit: ByteArray, sun: FloatArray, surface: HapkeParameters, most: int, limb: int,
    missing: ByteArray, out: Float32Array,
) -> None:  # fmt: skip
    """Mean radiance factor of each pixel that is NaN in `out`, sky 0.

    A pixel that sees a node nobody shaded stays NaN; the node's block is set to 1 in `missing`.
    """
    posting = fine.step_lat * fine.radius_m
    for i in numba.prange(kind.shape[0]):
        for j in range(kind.shape[1]):
            if out[i, j] == out[i, j]:
                continue
            angle = _pixel_angle(corners, i, j)
            n = _samples(kind, i, j, distance[i, j], angle, posting, most, limb)
            smooth = n > 1 and _smooth_at(kind, row, col, i, j)
            total = 0.0
            for a in range(n):
                for b in range(n):
                    k, r, c = int(kind[i, j]), float(row[i, j]), float(col[i, j])
                    if smooth:
                        y, x = i + (a + 0.5) / n - 0.5, j + (b + 0.5) / n - 0.5
                        r, c = bilinear(row, y, x), bilinear(col, y, x)
                    elif n > 1:
                        dx, dy, dz = _ray(corners, i, j, (a + 0.5) / n, (b + 0.5) / n)
                        k = SKY
                        if dx == dx:
                            k, _, r, c = trace(
                                fine, wide, origin[0], origin[1], origin[2], dx, dy, dz, 0.0
                            )
                    if k == FINE:
                        value = bilinear(shaded, r, c)
                        if value != value:
                            missing[int(r) // BLOCK, int(c) // BLOCK] = 1
                        total += value
                    elif k == WIDE:
                        total += _wide_radiance(wide, r, c, wide_lit, sun, origin, surface)
            out[i, j] = np.float32(total / (n * n))
