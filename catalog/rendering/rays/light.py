"""Radiance of ground nodes: slope, cast shadow with its penumbra, and a photometric law."""

from typing import NamedTuple

import numba
import numpy as np

from catalog.arrays import ByteArray, Float32Array, FloatArray
from catalog.geometry.kernel import kernel, parallel_kernel
from catalog.photometry.hapke import reflectance_scalar
from catalog.photometry.sets import HapkeParameters
from catalog.rendering.rays.ground import Ground
from catalog.rendering.rays.march import DARK, Ray, walk

SUN_RADIUS = 0.00465  # rad, as seen from 1 au
BLOCK = 32  # nodes a side of the blocks that are lit and shaded together
# nodes beside the one that is tested do not shade it: there the slope decides
_FIRST_NODES = 1.0


class Light(NamedTuple):
    """The Sun, camera and surface that decide the brightness of ground.

    sun      (3,) unit vector, body frame
    camera   (3,) m, body frame
    surface  Hapke's parameters
    """

    sun: FloatArray
    camera: FloatArray
    surface: HapkeParameters


@kernel
def locate_node(
    ground: Ground, row: float, col: float, height: float
) -> tuple[float, float, float]:
    """Body-fixed place of a node."""
    lat, lon = ground.north - row * ground.step_lat, ground.west + col * ground.step_lon
    r = ground.radius_m + height
    return r * np.cos(lat) * np.cos(lon), r * np.cos(lat) * np.sin(lon), r * np.sin(lat)


@kernel
def _measure_way_out(r: float, climb: float, ground: Ground) -> float:
    """Way (m) from radius r, rising by `climb` a metre, to above the highest node of a ground."""
    top = ground.radius_m + ground.highest_m
    free = r * r * climb * climb + (top - r) * (top + r)
    return float(np.sqrt(free) - r * climb + 1.0 if free > 0.0 else 0.0)


@kernel
def compute_lit_share(
    first: Ground, second: Ground, third: Ground, x: float, y: float, z: float, sun: FloatArray
) -> float:
    """Share of the Sun's disc that terrain leaves free over a place on the first ground.

    first, second, third  where shadows come from, each going on where the one before ends

    Followed is the ray to the disc's lower limb; how far terrain rises above that ray, over the
    disc's diameter, is taken as the hidden share: linear where the exact share is a circle's
    segment, at most 0.06 off, half a node wide on the ground.
    """
    r = np.sqrt(x * x + y * y + z * z)
    ux, uy, uz = x / r, y / r, z / r
    high = ux * sun[0] + uy * sun[1] + uz * sun[2]
    flat = np.sqrt(max(1.0 - high * high, 1e-12))
    # the Sun's direction turned down by its radius
    down = np.sin(SUN_RADIUS) / flat
    keep = np.cos(SUN_RADIUS) + np.sin(SUN_RADIUS) * high / flat
    dx, dy, dz = keep * sun[0] - down * ux, keep * sun[1] - down * uy, keep * sun[2] - down * uz
    low = ux * dx + uy * dy + uz * dz
    full = 2.0 * SUN_RADIUS
    s = _FIRST_NODES * first.step_lat * first.radius_m
    end = _measure_way_out(r, low, first)
    ray = Ray(x, y, z, dx, dy, dz)
    # numbers and not literals, for each of which numba would compile `walk` anew
    finest, coarser = int(np.int64(0)), int(np.int64(2))
    how, s, _, _, deepest = walk(first, ray, s, end, finest, full)
    # one after the other: a loop over the grounds copies them, half as long again
    end = _measure_way_out(r, low, second)
    if how != DARK and s < end:
        s = max(s, second.step_lat * second.radius_m)
        how, s, _, _, deep = walk(second, ray, s, end, coarser, full)
        deepest = max(deepest, deep)
    end = _measure_way_out(r, low, third)
    if how != DARK and s < end:
        s = max(s, third.step_lat * third.radius_m)
        how, s, _, _, deep = walk(third, ray, s, end, coarser, full)
        deepest = max(deepest, deep)
    return max(0.0, 1.0 - deepest / full)


@kernel
def shade(
    ground: Ground,
    lat: float,
    lon: float,
    height: float,
    south_rate: float,
    east_rate: float,
    light: Light,
) -> float:
    """Radiance factor of a place (rad) with given height gradients.

    south_rate  m a row southward; east_rate m a column eastward
    """
    sun, camera, surface = light
    cos_lat, sin_lat, cos_lon, sin_lon = np.cos(lat), np.sin(lat), np.cos(lon), np.sin(lon)
    up, east = (cos_lat * cos_lon, cos_lat * sin_lon, sin_lat), (-sin_lon, cos_lon, 0.0)
    r = ground.radius_m + height
    slope_n = -south_rate / (ground.step_lat * r)
    slope_e = east_rate / (ground.step_lon * r * max(cos_lat, 1e-6))
    # north = up x east
    nx = up[1] * east[2] - up[2] * east[1]
    ny = up[2] * east[0] - up[0] * east[2]
    nz = up[0] * east[1] - up[1] * east[0]
    x = up[0] - slope_n * nx - slope_e * east[0]
    y = up[1] - slope_n * ny - slope_e * east[1]
    z = up[2] - slope_n * nz - slope_e * east[2]
    length = np.sqrt(1.0 + slope_n * slope_n + slope_e * slope_e)
    mu0 = (x * sun[0] + y * sun[1] + z * sun[2]) / length
    if mu0 <= 0.0:
        return 0.0
    vx, vy, vz = camera[0] - r * up[0], camera[1] - r * up[1], camera[2] - r * up[2]
    far = np.sqrt(vx * vx + vy * vy + vz * vz)
    mu = (x * vx + y * vy + z * vz) / (length * far)
    cos_phase = (vx * sun[0] + vy * sun[1] + vz * sun[2]) / far
    return reflectance_scalar(mu0, mu, cos_phase, surface)


@kernel
def shade_node(
    ground: Ground, i: int, j: int, sun: FloatArray, camera: FloatArray, surface: HapkeParameters
) -> float:
    """Radiance factor of a node in full sunlight."""
    h = ground.heights
    rows, cols = h.shape
    a, b = max(i - 1, 0), min(i + 1, rows - 1)
    c, d = max(j - 1, 0), min(j + 1, cols - 1)
    south_rate = (h[b, j] - h[a, j]) / (b - a)
    east_rate = (h[i, d] - h[i, c]) / (d - c)
    lat, lon = ground.north - i * ground.step_lat, ground.west + j * ground.step_lon
    light = Light(sun, camera, surface)
    return shade(ground, lat, lon, float(h[i, j]), float(south_rate), float(east_rate), light)


@parallel_kernel
def fill_lit_shares(
    ground: Ground,
    second: Ground,
    third: Ground,
    sun: FloatArray,
    wanted: ByteArray,
    lit: ByteArray,
) -> None:
    """Lit shares of the nodes in wanted blocks, 0..255, into `lit`, in place.

    second, third  coarser grounds around it, where shadows may come from too
    wanted  (block rows, block cols) of BLOCK nodes: 1 to do, 2 done already, 0 leave
    """
    rows, cols = ground.heights.shape
    for bi in numba.prange(wanted.shape[0]):
        for bj in range(wanted.shape[1]):
            if wanted[bi, bj] != 1:
                continue
            for i in range(bi * BLOCK, min((bi + 1) * BLOCK, rows)):
                for j in range(bj * BLOCK, min((bj + 1) * BLOCK, cols)):
                    x, y, z = locate_node(ground, i, j, float(ground.heights[i, j]))
                    share = compute_lit_share(ground, second, third, x, y, z, sun)
                    lit[i, j] = np.uint8(255.0 * share + 0.5)
            wanted[bi, bj] = 2


@parallel_kernel
def shade_blocks(
    ground: Ground,
    sun: FloatArray,
    camera: FloatArray,
    surface: HapkeParameters,
    wanted: ByteArray,
    lit: ByteArray,
    out: Float32Array,
) -> None:
    """Radiance factors of the nodes in wanted blocks (1), cast shadows included, into `out`."""
    rows, cols = ground.heights.shape
    for bi in numba.prange(wanted.shape[0]):
        for bj in range(wanted.shape[1]):
            if wanted[bi, bj] == 0:
                continue
            for i in range(bi * BLOCK, min((bi + 1) * BLOCK, rows)):
                for j in range(bj * BLOCK, min((bj + 1) * BLOCK, cols)):
                    value = 0.0
                    if lit[i, j] > 0:
                        value = shade_node(ground, i, j, sun, camera, surface) * lit[i, j]
                        value /= 255.0
                    out[i, j] = np.float32(value)
