"""Ground with rocks for the study of the rock detector, and a camera's picture of it.

Rocks follow the exponential law of cumulative fractional area, F(> D) = k exp(-q D) with
q = 1.79 + 0.152 / k: M. P. Golombek and D. Rapp, JGR 102 (1997) 4117; lunar sites fit the same form
(K. Di et al., Planet. Space Sci. 120 (2016) 103; Y. Li and B. Wu, JGR Planets 123 (2018) 1061). For
comparison Surveyor I: 0.00234 D^-2.11 rocks above D per m^2 (E. M. Shoemaker and E. C. Morris,
Icarus 12 (1970) 188). Height over the largest diameter is 0.54, as of 445 rocks on the Moon (N. E.
Demidov and A. T. Basilevsky, Solar System Research 48 (2014) 324); width over length 0.71, as of
fragments of impacts (A. Fujiwara et al., Nature 272 (1978) 602). The scatter of shapes is ours.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel
from catalog.rendering.map_view import render_map
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.picture import Picture
from optnav_cli.simulation.sensor import expose
from tests.studies.hazard_fields import (
    GOLDEN_DEG,
    HURST,
    KINDS,
    LARGEST_M,
    RADIUS_M,
    SENSOR,
    SITE,
    albedo,
    sun_vector,
)

POSTING_M, RELIEF = 0.03, 4  # of the drawn ground; its relief is drawn at every fourth node
SMALLEST_CRATER_M = 0.4
ROCK_SIZES_M = (0.15, 3.0)  # mean diameters that are drawn
HEIGHT_RATIO, HEIGHT_SCATTER = 0.54, 0.1  # over the largest diameter
WIDTH_RATIO, WIDTH_SCATTER = 0.71, 0.12
ROCK_ALBEDO, ROCK_ALBEDO_SCATTER = 1.1, 0.15  # over that of the ground
FACES = 9  # of a rock with faces; every other one is round
BLUR_PX = 0.53  # sigma of the optics and of the pixel itself
BLOCK = 16  # nodes; rays start above the highest ground of the blocks about them


class Rocks(NamedTuple):
    """Rocks (n,) of a ground: places from its middle (east, north, up), sizes, all m."""

    x: FloatArray
    y: FloatArray
    z: FloatArray
    length: FloatArray
    width: FloatArray
    height: FloatArray


@dataclass(frozen=True, eq=False)
class RockyGround:
    """Ground of posting `POSTING_M` with its rocks; reflectance over the mean, m, (n, n)."""

    seed: int
    heights: Float32Array
    reflectance: Float32Array
    rocks: Rocks

    def azimuth_deg(self) -> float:
        """Azimuth of the Sun."""
        return self.seed * GOLDEN_DEG % 360.0


def count_rocks(k: float, diameter_m: FloatArray) -> FloatArray:
    """Count rocks above mean diameters (n,) per m^2: the area law over the area of one rock.

    k  share of the ground that rocks cover, of all sizes
    """
    q = 1.79 + 0.152 / k
    # from the largest diameter that matters down; a rock covers pi / 4 D^2
    d = np.geomspace(0.01, 60.0, 20001)
    rate = k * q * np.exp(-q * d) / (0.25 * np.pi * d * d)
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(d)
    above = np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    counts: FloatArray = np.interp(diameter_m, d, above)
    return counts


def draw_rocks(seed: int, k: float, side_m: float) -> Rocks:
    """Draw the rocks of a square."""
    rng = np.random.default_rng([seed, 501, round(1000 * k)])
    sizes = np.geomspace(*ROCK_SIZES_M, 400)
    above = count_rocks(k, sizes)
    total = rng.poisson((above[0] - above[-1]) * side_m**2)
    drawn = rng.uniform(above[-1], above[0], total)
    diameter = np.interp(-drawn, -above, sizes)
    ratio = np.clip(rng.normal(WIDTH_RATIO, WIDTH_SCATTER, total), 0.4, 1.0)
    length = diameter / np.sqrt(ratio)  # the ellipse has the area of the circle
    tall = np.clip(rng.normal(HEIGHT_RATIO, HEIGHT_SCATTER, total), 0.25, ratio)
    x, y = rng.uniform(-0.5 * side_m, 0.5 * side_m, (2, total))
    return Rocks(x, y, np.zeros(total), length, ratio * length, tall * length)


@kernel
def _add_rocks(
    heights: Float32Array,
    reflectance: Float32Array,
    base: Float32Array,
    table: FloatArray,
    faces: FloatArray,
) -> None:
    """Set rocks on the ground `base`, the taller one where they overlap.

    table  (n, 9): row, col, half axes, turn, height, two powers, reflectance
    faces  (n, FACES, 3): slopes of planes and their height at the middle; none where that is 0
    """
    rows, cols = heights.shape
    for k in range(table.shape[0]):
        row, col, a, b, turn, tall, p, q, share = table[k]
        cos, sin = math.cos(turn), math.sin(turn)
        top, bottom = max(0, int(row - a)), min(rows - 1, int(row + a) + 1)
        left, right = max(0, int(col - a)), min(cols - 1, int(col + a) + 1)
        for i in range(top, bottom + 1):
            for j in range(left, right + 1):
                u = ((j - col) * cos + (i - row) * sin) / a
                v = ((i - row) * cos - (j - col) * sin) / b
                rho = math.sqrt(u * u + v * v)
                if rho >= 1.0:
                    continue
                z = (1.0 - rho**p) ** (1.0 / q)
                for f in range(faces.shape[1]):
                    if faces[k, f, 2] > 0.0:
                        z = min(z, faces[k, f, 2] - faces[k, f, 0] * u - faces[k, f, 1] * v)
                top_m = base[i, j] + np.float32(tall * z)
                if top_m > heights[i, j]:
                    heights[i, j] = top_m
                    reflectance[i, j] *= np.float32(share)


def _sample_heights(heights: Float32Array, x: FloatArray, y: FloatArray) -> FloatArray:
    middle = 0.5 * (len(heights) - 1)
    at = [np.clip(np.rint(middle + part / POSTING_M).astype(int), 0, len(heights) - 1)
          for part in (-y, x)]  # fmt: skip
    sampled: FloatArray = heights[at[0], at[1]].astype(np.float64)
    return sampled


def make_rocky_ground(kind: str, seed: int, k: float, side_m: float = 64.0) -> RockyGround:
    """Make ground of a kind with rocks that cover a share k of it."""
    nodes = round(side_m / POSTING_M)
    rough = KINDS[kind]
    relief = SyntheticRelief(
        seed, 0.5 * LARGEST_M, RADIUS_M, SMALLEST_CRATER_M, rough.rms_slope_deg, HURST,
        rough.saturation,
    )  # fmt: skip
    nodes -= nodes % RELIEF
    coarse = relief.sample_local(SITE, RELIEF * POSTING_M, nodes // RELIEF)
    fine = cv2.resize(coarse, (nodes, nodes), interpolation=cv2.INTER_CUBIC)
    heights: Float32Array = (fine - fine.mean()).astype(np.float32)
    reflectance = albedo(seed, nodes, POSTING_M, 0.03)
    rocks = draw_rocks(seed, k, side_m)
    rocks = rocks._replace(z=_sample_heights(heights, rocks.x, rocks.y))
    set_rocks(heights, reflectance, rocks, seed)
    return RockyGround(seed, heights, reflectance, rocks)


def set_rocks(heights: Float32Array, reflectance: Float32Array, rocks: Rocks, seed: int) -> None:
    """Set rocks on a ground in place, half of them round, the others with faces."""
    rng = np.random.default_rng([seed, 502])
    n, middle = rocks.x.size, 0.5 * (len(heights) - 1)
    powers = rng.uniform(1.8, 4.0, (2, n))
    share = np.maximum(rng.normal(ROCK_ALBEDO, ROCK_ALBEDO_SCATTER, n), 0.6)
    table = np.stack(
        [
            middle - rocks.y / POSTING_M, middle + rocks.x / POSTING_M,
            0.5 * rocks.length / POSTING_M, 0.5 * rocks.width / POSTING_M,
            rng.uniform(0.0, math.pi, n), rocks.height, *powers, share,
        ], axis=1,
    )  # fmt: skip
    # planes tangent to about the middle of the sides; all pass over the top, which stays as high
    faces = np.zeros((n, FACES, 3))
    angle, steep = rng.uniform(0.0, 2.0 * math.pi, (n, FACES)), rng.uniform(0.3, 4.0, (n, FACES))
    faces[..., 0], faces[..., 1] = steep * np.cos(angle), steep * np.sin(angle)
    faces[..., 2] = 1.0 + steep * rng.uniform(0.0, 0.6, (n, FACES))
    faces[rng.uniform(size=n) < 0.5] = 0.0
    _add_rocks(heights, reflectance, heights.copy(), table, faces)


def measure_shadow_ratio(elevation_deg: float, seed: int = 1) -> float:
    """Area of rocks above 30 cm over that of their shadows on level ground, seen from above."""
    nodes, share = 3200, 0.05
    rocks = draw_rocks(seed, share, nodes * POSTING_M)
    tall = rocks.height >= 0.3
    rocks = Rocks(*(part[tall] for part in rocks))
    heights = np.zeros((nodes, nodes), np.float32)
    set_rocks(heights, np.ones_like(heights), rocks, seed)
    bright = render_map(heights, POSTING_M, sun_vector(elevation_deg, 60.0), radius_m=RADIUS_M)
    return float((heights > 0.0).sum() / (bright <= 0.0).sum())


@kernel
def _trace(
    heights: Float32Array,
    bright: Float32Array,
    starts: Float32Array,
    rays: FloatArray,
    camera_m: float,
    posting: float,
) -> Float32Array:
    """Brightness where rays (n, 2), tangents east and north, first meet the ground from above."""
    size, out = heights.shape[0], np.zeros(rays.shape[0], np.float32)
    middle, step = 0.5 * (size - 1), 0.5 * posting
    for n in range(rays.shape[0]):
        slant = math.hypot(rays[n, 0], rays[n, 1])
        fall = min(step / max(slant, 1e-3), posting)
        col = middle + rays[n, 0] * camera_m / posting
        row = middle - rays[n, 1] * camera_m / posting
        a = min(max(int(row) // BLOCK, 0), starts.shape[0] - 1)
        b = min(max(int(col) // BLOCK, 0), starts.shape[1] - 1)
        z = float(starts[a, b])
        while True:
            col = middle + rays[n, 0] * (camera_m - z) / posting
            row = middle - rays[n, 1] * (camera_m - z) / posting
            i = min(max(int(row), 0), size - 2)
            j = min(max(int(col), 0), size - 2)
            y, x = min(max(row - i, 0.0), 1.0), min(max(col - j, 0.0), 1.0)
            w = ((1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x)
            ground = (w[0] * heights[i, j] + w[1] * heights[i, j + 1]
                      + w[2] * heights[i + 1, j] + w[3] * heights[i + 1, j + 1])  # fmt: skip
            if ground >= z or z < -50.0:
                out[n] = (w[0] * bright[i, j] + w[1] * bright[i, j + 1]
                          + w[2] * bright[i + 1, j] + w[3] * bright[i + 1, j + 1])  # fmt: skip
                break
            z -= max(fall, 0.3 * (z - ground) if z - ground > 1.0 else 0.0)
    return out


def cut_camera(camera: Camera, height_m: float, side_m: float) -> Camera:
    """The middle of a camera's frame, which sees a square of this side from a height."""
    wide = min(camera.width_px, int(side_m / (height_m * camera.angular_resolution)))
    wide -= wide % 2
    x, y = camera.principal_point_px
    middle = x - 0.5 * (camera.width_px - wide), y - 0.5 * (camera.height_px - wide)
    return replace(camera, width_px=wide, height_px=wide, principal_point_px=middle)


def photograph(
    ground: RockyGround, camera: Camera, height_m: float, elevation_deg: float
) -> Picture:
    """Picture of the ground by a camera that looks straight down on its middle, in counts."""
    sun = sun_vector(elevation_deg, ground.azimuth_deg())
    place = (0.0, 0.0, height_m)
    bright = render_map(ground.heights, POSTING_M, sun, radius_m=RADIUS_M, camera_local=place)
    bright *= ground.reflectance
    many = -(-len(bright) // BLOCK)
    padded = np.full((many * BLOCK,) * 2, -np.inf, np.float32)
    padded[: len(bright), : len(bright)] = ground.heights
    tops = padded.reshape(many, BLOCK, many, BLOCK).max(axis=(1, 3))
    starts = cv2.dilate(tops, np.ones((9, 9), np.uint8)) + np.float32(0.01)
    grid = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1)
    rays = camera.unproject(grid.reshape(-1, 2).astype(np.float64))
    slopes = np.ascontiguousarray(rays[:, :2] / rays[:, 2:] * (1.0, -1.0))
    seen = _trace(ground.heights, bright, starts, slopes, height_m, POSTING_M)
    seen = cv2.GaussianBlur(seen.reshape(camera.shape), (0, 0), BLUR_PX).astype(np.float32)
    rng = np.random.default_rng([ground.seed, 55])
    counts = expose(seen, SENSOR, rng)
    return Picture(counts.astype(np.float32), None)
