"""The relief's skyline as the picture's pixels see it, and where it lies in shadow."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from catalog.terrain.limb_skyline import LimbRelief, nadir_axes
from catalog.terrain.relief import GlobalRelief
from optnav_cli.navigation.horizon.sight import Sight

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Skylines of cells' means lie low, of their tops high. At 16 cells a degree 0.8 of the way from
# means to tops meets, within 10 m from 50 to 20 000 km, what 32 a degree with seeded relief below
# show (720 azimuths from six places at each height, 26 m rms a single crest).
TOP_SHARE = 0.8
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


@lru_cache(maxsize=2)
def limb_relief(relief: GlobalRelief) -> LimbRelief:
    """The relief made ready for skylines, once for all frames."""
    return LimbRelief(relief, TOP_SHARE)


def terrain_limb(
    ground: LimbRelief, position: FloatArray, sight: Sight, sun_body: FloatArray | None
) -> TerrainLimb:
    """The skyline from a position (3,), m, at the azimuths of the rays.

    sun_body (3,) towards the Sun, any length; None: all is taken as lit
    """
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


def _near(places: NDArray[np.int64], count: int, reach: int) -> BoolArray:
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
