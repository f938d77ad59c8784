"""The relief's skyline as the picture's pixels see it, and where it lies in shadow."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.skyline.limb import LimbRelief, nadir_axes
from optnav_cli.navigation.horizon.sight import LimbRays

# Skylines of cells' means lie low, of their tops high. What meets the ground of 32 cells a degree
# with seeded relief below, from 50 to 20 000 km: 0.8 of the way from means to tops at 16 cells a
# degree, 0.70 at 4, 0.68 at 2, to 10 m times the cells' size in MOON_POSTING_M; a single crest then
# errs by 27, 67, 125, 204 m at 16, 8, 4, 2 cells a degree (3600 crests each).
TOP_SHARE, TOP_SHARE_MORE, MOON_POSTING_M = 0.68, 0.12, 1895.0
CREST_NOISE_M, CREST_SIGMA_M = 27.0, 10.0
# A relief of a model no finer than itself has no tops: its skyline is low by this share of a cell's
# size (240 m at 4 cells a degree; 207 from 50 km, 274 from 20 000 km), known to LIFT_SIGMA of it.
LIFT, LIFT_SIGMA = 0.032, 0.4
NO_TOPS = 0.003  # tops over means, in a cell's size; the Moon's are ten times as high
SHADOW_CLEARANCE_M = 30.0  # ground by which a crest may miss the Sun and still be taken as lit


@dataclass(frozen=True, eq=False)
class TerrainLimb:
    """The skyline at each ray.

    sizes     (n,) radius of the sphere that a ray on the skyline would touch, in reference radii
    lit       (n,) whether the Sun reaches the crest
    sun_sine  (n,) sine of the Sun's elevation over the sphere at the crest; 1 where not known
    """

    sizes: FloatArray
    lit: BoolArray
    sun_sine: FloatArray


@dataclass(frozen=True, eq=False)
class LimbGround:
    """A body's relief made ready for skylines, and how well these are known.

    crest_noise_m  of a single crest
    crest_sigma_m  common to all of them
    """

    limb: LimbRelief
    crest_noise_m: float
    crest_sigma_m: float

    @property
    def radius_m(self) -> float:
        """Of the reference sphere."""
        return self.limb.radius_m


@lru_cache(maxsize=2)
def limb_ground(relief: GlobalRelief) -> LimbGround:
    """The relief made ready for skylines, once for all frames."""
    cells = relief.posting_m / MOON_POSTING_M
    noise, sigma = CREST_NOISE_M * cells, CREST_SIGMA_M * cells
    rise = float(np.mean(relief.max_heights - relief.heights))
    if rise < NO_TOPS * relief.posting_m:
        lift = LIFT * relief.posting_m
        lifted = relief.heights + np.float32(lift)
        flat = GlobalRelief(lifted, lifted, relief.radius_m, relief.source)
        return LimbGround(LimbRelief(flat, 0.0), noise, max(sigma, LIFT_SIGMA * lift))
    share = TOP_SHARE + TOP_SHARE_MORE / max(cells, 1.0)
    return LimbGround(LimbRelief(relief, share), noise, sigma)


def terrain_limb(
    prepared: LimbGround, position: FloatArray, sight: LimbRays, sun_body: FloatArray | None
) -> TerrainLimb:
    """The skyline from a position (3,), m, at the azimuths of the rays.

    sun_body (3,) towards the Sun, any length; None: all is taken as lit
    """
    ground = prepared.limb
    distance = float(np.linalg.norm(position))
    axes = nadir_axes(position)
    rays_at = sight.azimuths(position)
    # a turn of azimuth moves the crest by R sin(range) and the line of sight by sin(off nadir)
    sine = min(ground.radius_m / distance, 1.0)
    circle = ground.radius_m * np.sqrt(1.0 - sine * sine)
    blur = sight.blur / sine
    spacing = max(0.5 * ground.posting_m, min(0.5 * blur * circle, ground.posting_m))
    count = max(360, int(np.ceil(2.0 * np.pi * circle / spacing)))
    step = 2.0 * np.pi / count
    place = np.mod(rays_at, 2.0 * np.pi) / step
    wanted = _near(np.floor(place).astype(np.int64), count, int(np.ceil(4.0 * blur / step)) + 1)
    azimuths = np.flatnonzero(wanted) * step
    line = ground.skyline(position, axes, azimuths)
    table = np.full(count, float(line.off_nadir.mean()))
    table[wanted] = line.off_nadir
    table = gaussian_filter1d(table, blur / step, mode="wrap")
    left = np.floor(place).astype(np.int64) % count
    share = place - np.floor(place)
    off_nadir = (1.0 - share) * table[left] + share * table[(left + 1) % count]
    lit, sun_sine = np.ones(count, np.bool_), np.ones(count)
    if sun_body is not None:
        across = np.cos(azimuths)[:, None] * axes[0] + np.sin(azimuths)[:, None] * axes[1]
        out = np.cos(line.range)[:, None] * axes[2] + np.sin(line.range)[:, None] * across
        crests = (line.radius_m + SHADOW_CLEARANCE_M)[:, None] * out
        sun_sine[wanted] = out @ (sun_body / np.linalg.norm(sun_body))
        lit[wanted] = ground.sunlit(crests, sun_body)
    return TerrainLimb(
        distance * np.sin(off_nadir) / ground.radius_m,
        lit[left] & lit[(left + 1) % count],
        sun_sine[left],
    )


def _near(places: IntArray, count: int, reach: int) -> BoolArray:
    """Which of `count` places round a circle lie within `reach` of some of these."""
    hit = np.zeros(count, np.int64)
    hit[places % count] = 1
    if 2 * reach + 2 >= count:
        return np.ones(count, np.bool_)
    # one beyond on the far side: rays lie between a place and the next
    around = np.concatenate([hit[-reach - 1 :], hit, hit[: reach + 1]])
    sums = np.concatenate([[0], np.cumsum(around)])
    width = 2 * reach + 3
    return np.asarray(sums[width:] - sums[:-width] > 0)[:count]
