"""A piece of ground under one Sun, ready to be looked at from anywhere.

A pixel is the mean radiance over rays through it.
"""

from collections.abc import Callable
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import ByteArray, Float32Array, FloatArray
from catalog.geometry.grid import interpolate_bicubic, interpolate_bilinear
from catalog.geometry.kernel import kernel, parallel_kernel
from catalog.geometry.vectors import unit
from catalog.photometry.sets import LUNAR, HapkeParameters
from catalog.rendering.rays.ground import Ground, crop_surroundings
from catalog.rendering.rays.light import BLOCK, Light, fill_lit_shares, shade, shade_blocks
from catalog.rendering.rays.march import FINE, SKY, WIDE, Ray, intersect_ground

SHADOW_REACH = 0.06  # rad
# Rays within 37 deg of the vertical: ground that rises by less than 53 deg hides nothing from them.
STEEP = 0.8
# What a pixel's parts see is read between the hits of pixel middles where these bend by less than
# this (nodes) from a plane; a bend of half a node moves a sample by an eighth of that.
SMOOTH = 0.5
MIN_SLANT = 0.05  # cosine of emission: flatter views still show so much of the ground's colours


# Brightness (n,) over the mean of ground at unit directions (n, 3) from the body's centre, seen by
# pixels that span so much of it (n,), m.
Reflectivity = Callable[[FloatArray, FloatArray], Float32Array]


class Hits(NamedTuple):
    """The first hits of rays through pixel centres, arrays (rows, cols).

    kind      SKY, FINE or WIDE
    distance  m
    row, col  on the grid that was met
    """

    kind: ByteArray
    distance: Float32Array
    row: Float32Array
    col: Float32Array


class View(NamedTuple):
    """A camera: its place (3,) m and unit rays (rows + 1, cols + 1, 3), body frame."""

    origin: FloatArray
    corners: FloatArray


class Shading(NamedTuple):
    """Brightness of the grounds of a picture.

    sun       (3,) unit vector, body frame
    fine      (rows, cols) radiance factors of the fine ground's nodes, NaN where not computed
    wide_lit  lit shares of the wide ground's nodes, 0..255
    missing   receives 1 in the fine ground's blocks that a ray met and that are not computed
    """

    sun: FloatArray
    fine: Float32Array
    wide_lit: ByteArray
    missing: ByteArray


class Scene:
    """Nested grounds under one Sun. Shadows are computed once, where a picture needs them.

    fine      the ground inside its box
    wide      the ground outside it; see `ground.make_whole_sphere`
    sun_body  (3,) direction to the Sun, body frame, any length
    between   a coarser grid around `fine` that only casts shadows on it
    surface   Hapke's parameters
    """

    def __init__(
        self,
        fine: Ground,
        wide: Ground,
        sun_body: ArrayLike,
        between: Ground | None = None,
        surface: HapkeParameters = LUNAR,
    ) -> None:
        self.fine, self.wide, self.surface = fine, wide, surface
        self.sun = unit(sun_body)
        # mountains beyond the fine ground's border shade it from as far as this, about 100 km
        self._around = crop_surroundings(wide, fine, SHADOW_REACH)
        self.between = self._around if between is None else between
        self._fine_lit, self._fine_wanted = _make_masks(fine)
        self._wide_lit, self._wide_wanted = _make_masks(wide)

    def picture(
        self,
        origin_m: ArrayLike,
        corner_rays: ArrayLike,
        samples: int = 5,
        limb_samples: int = 5,
        albedo: Reflectivity | None = None,
    ) -> Float32Array:
        """Mean radiance factor (rows, cols) of the pixels of a camera.

        origin_m     (3,) the camera, body frame, m
        corner_rays  (rows + 1, cols + 1, 3) unit rays through the pixels' corners, body frame; NaN
                     where the camera sees nothing
        samples      most rays a side of a pixel
        limb_samples rays a side of a pixel at the limb
        albedo       of the ground that pixel middles see; the same everywhere for None

        Rays inside a pixel lie between those of its corners, 3e-4 px from the exact ones in a
        fisheye of 316 arcsec a pixel.
        """
        origin = np.ascontiguousarray(origin_m, dtype=np.float64)
        corners = np.ascontiguousarray(corner_rays, dtype=np.float64)
        shape = corners.shape[0] - 1, corners.shape[1] - 1
        distance, row, col = (np.zeros(shape, np.float32) for _ in range(3))
        view, aside = View(origin, corners), (samples, limb_samples)
        hits = Hits(np.zeros(shape, np.uint8), distance, row, col)
        fill_first_hits(self.fine, self.wide, view, hits)

        mark_blocks(WIDE, hits, self._wide_wanted)
        fill_lit_shares(
            self.wide, self.wide, self.wide, self.sun, self._wide_wanted, self._wide_lit
        )
        wanted = np.zeros_like(self._fine_wanted)
        mark_blocks(FINE, hits, wanted)
        shaded = np.full(self.fine.heights.shape, np.nan, np.float32)
        out = np.full(shape, np.nan, np.float32)
        while True:
            self._shade(wanted, origin, shaded)
            missing = np.zeros_like(wanted)
            shading = Shading(self.sun, shaded, self._wide_lit, missing)
            average_radiance(self.fine, self.wide, self.surface, view, hits, shading, aside, out)
            # between the middles of pixels a few rays find ground that these did not see
            if not missing.any():
                if albedo is not None:
                    self._apply_albedo(out, view, hits, albedo)
                return out
            done = wanted.astype(bool)
            add_with_neighbours(missing, wanted)
            wanted[done] = 0

    def _apply_albedo(
        self, out: Float32Array, view: View, hits: Hits, albedo: Reflectivity
    ) -> None:
        """Multiply radiances (rows, cols) by the albedo of what the pixels' middles see."""
        origin = view.origin
        for i in range(len(out)):
            seen = np.flatnonzero(hits.kind[i] != SKY)
            if not seen.size:
                continue
            corners = view.corners[i : i + 2, :, :]
            near, far = corners[0, seen], corners[1, seen + 1]
            rays = near + far + corners[0, seen + 1] + corners[1, seen]
            rays /= np.linalg.norm(rays, axis=1)[:, None]
            distance = hits.distance[i, seen].astype(np.float64)
            places = origin + distance[:, None] * rays
            places /= np.linalg.norm(places, axis=1)[:, None]
            slant = np.maximum(-np.einsum("ij,ij->i", rays, places), MIN_SLANT)
            angle = np.sqrt(0.5) * np.linalg.norm(near - far, axis=1)
            out[i, seen] *= albedo(places, distance * angle / slant)

    def _shade(self, wanted: ByteArray, origin: FloatArray, shaded: Float32Array) -> None:
        # blocks that an earlier picture lit stay lit
        self._fine_wanted[(wanted == 1) & (self._fine_wanted == 0)] = 1
        grounds = self.fine, self.between, self._around
        fill_lit_shares(*grounds, self.sun, self._fine_wanted, self._fine_lit)
        shade_blocks(self.fine, self.sun, origin, self.surface, wanted, self._fine_lit, shaded)


def _make_masks(ground: Ground) -> tuple[ByteArray, ByteArray]:
    """Lit shares of the nodes and the state of their blocks, both empty."""
    rows, cols = ground.heights.shape
    blocks = (rows + BLOCK - 1) // BLOCK, (cols + BLOCK - 1) // BLOCK
    return np.zeros((rows, cols), np.uint8), np.zeros(blocks, np.uint8)


@kernel
def _make_ray(
    corners: FloatArray, i: int, j: int, y: float, x: float
) -> tuple[float, float, float]:
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
def _measure_pixel_angle(corners: FloatArray, i: int, j: int) -> float:
    p, q = corners[i, j], corners[i + 1, j + 1]
    d = (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2
    return float(np.sqrt(0.5 * d))


@parallel_kernel
def fill_first_hits(fine: Ground, wide: Ground, view: View, hits: Hits) -> None:
    """Fill in what the middle of each pixel sees.

    Where rays are steep, what a pixel sees is as far away as what its left neighbour sees, save
    for relief within a pixel; the search begins well above that.
    """
    kind, distance, row, col = hits.kind, hits.distance, hits.row, hits.col
    origin, corners, radius = view.origin, view.corners, fine.radius_m
    for parallel in numba.prange(kind.shape[0]):
        i, hint = int(np.int64(parallel)), 0.0  # signed, or callees are compiled a second time
        for j in range(kind.shape[1]):
            dx, dy, dz = _make_ray(corners, i, j, 0.5, 0.5)
            kind[i, j] = SKY
            if dx != dx:
                hint = 0.0
                continue
            k, s, r, c = intersect_ground(
                fine, wide, Ray(origin[0], origin[1], origin[2], dx, dy, dz), hint
            )
            kind[i, j], distance[i, j], row[i, j], col[i, j] = k, s, r, c
            hint = 0.0
            if k == FINE:
                sink = dx * (origin[0] + s * dx) + dy * (origin[1] + s * dy)
                sink += dz * (origin[2] + s * dz)
                if sink < -STEEP * radius:
                    hint = max(s - 10.0 * s * _measure_pixel_angle(corners, i, j), 1.0)


@kernel
def mark_blocks(which: int, hits: Hits, wanted: ByteArray) -> None:
    """Set the blocks that pixels of a kind fall on, and their neighbours, to 1 where they are 0."""
    kind, _, row, col = hits
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
def _shade_wide(
    wide: Ground,
    row: float,
    col: float,
    lit: ByteArray,
    sun: FloatArray,
    camera: FloatArray,
    surface: HapkeParameters,
) -> float:
    h = wide.heights
    r, c = min(int(row), h.shape[0] - 2), min(int(col), h.shape[1] - 2)
    y, x = row - r, col - c
    free = (1.0 - y) * ((1.0 - x) * lit[r, c] + x * lit[r, c + 1])
    free += y * ((1.0 - x) * lit[r + 1, c] + x * lit[r + 1, c + 1])
    if free <= 0.0:
        return 0.0
    south_rate = interpolate_bicubic(h, row + 0.5, col) - interpolate_bicubic(h, row - 0.5, col)
    east_rate = interpolate_bicubic(h, row, col + 0.5) - interpolate_bicubic(h, row, col - 0.5)
    lat, lon = wide.north - row * wide.step_lat, wide.west + col * wide.step_lon
    height = interpolate_bicubic(h, row, col)
    light = Light(sun, camera, surface)
    value: float = shade(wide, lat, lon, height, south_rate, east_rate, light)
    value *= free / 255.0
    return value


@kernel
def _count_samples(kind: ByteArray, i: int, j: int, nodes: float, samples: tuple[int, int]) -> int:
    """Rays a side of a pixel: as many as its ground has `nodes`, within `samples` of a `Scene`."""
    most, limb = samples
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
    return min(most, max(1, int(np.ceil(nodes - 0.25))))


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
def average_radiance(
    fine: Ground,
    wide: Ground,
    surface: HapkeParameters,
    view: View,
    hits: Hits,
    shading: Shading,
    samples: tuple[int, int],
    out: Float32Array,
) -> None:
    """Mean radiance factor of each pixel that is NaN in `out`, sky 0.

    samples  most rays a side of a pixel, and those at the limb
    A pixel that sees a node without brightness stays NaN; the node's block is marked as missing.
    """
    kind, distance, row, col = hits.kind, hits.distance, hits.row, hits.col
    sun, shaded, wide_lit, missing = shading.sun, shading.fine, shading.wide_lit, shading.missing
    origin, corners = view.origin, view.corners
    posting = fine.step_lat * fine.radius_m
    for parallel in numba.prange(kind.shape[0]):
        i = int(np.int64(parallel))  # signed, or callees are compiled a second time
        for j in range(kind.shape[1]):
            if out[i, j] == out[i, j]:
                continue
            angle = _measure_pixel_angle(corners, i, j)
            n = _count_samples(kind, i, j, distance[i, j] * angle / posting, samples)
            smooth = n > 1 and _smooth_at(kind, row, col, i, j)
            total = 0.0
            for a in range(n):
                for b in range(n):
                    k, r, c = int(kind[i, j]), float(row[i, j]), float(col[i, j])
                    if smooth:
                        y, x = i + (a + 0.5) / n - 0.5, j + (b + 0.5) / n - 0.5
                        r, c = interpolate_bilinear(row, y, x), interpolate_bilinear(col, y, x)
                    elif n > 1:
                        dx, dy, dz = _make_ray(corners, i, j, (a + 0.5) / n, (b + 0.5) / n)
                        k = SKY
                        if dx == dx:
                            ray = Ray(origin[0], origin[1], origin[2], dx, dy, dz)
                            k, _, r, c = intersect_ground(fine, wide, ray, 0.0)
                    if k == FINE:
                        value = interpolate_bilinear(shaded, r, c)
                        if value != value:
                            missing[int(r) // BLOCK, int(c) // BLOCK] = 1
                        total += value
                    elif k == WIDE:
                        total += _shade_wide(wide, r, c, wide_lit, sun, origin, surface)
            out[i, j] = np.float32(total / (n * n))
