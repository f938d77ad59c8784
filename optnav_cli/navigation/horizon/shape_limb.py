"""The silhouette of a small body's shape, and how far measured rays lie beside it.

A small body's relief is no small part of its radius: limbs lean, by tens of degrees against a
circle's, and are concave. Off the nadir of its centre the silhouette of ground that every direction
from the centre meets once is single-valued all the same, so `LimbRelief` finds it whole. Ground
that some meet more often (a contact binary's neck) is known by its outermost surface only: its
silhouette is too wide there, and these rays have to be outvoted.
Offsets are counted along the silhouette's own normal: as the camera moves, the crest that a ray
grazes stays the same to first order, so an offset changes as if that crest were a fixed point.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.body import Body
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.skyline.limb import LimbRelief, nadir_axes
from optnav_cli.measurements.limb.detection import RELIEF
from optnav_cli.navigation.horizon.sight import LimbRays

SHAPE_SHARE = 0.05  # of the radius, highest to lowest: the Moon has 0.011, Phobos 0.5
# Round ground with 19 m rms of relief (hills and craters) below the 319 m of the 2 deg model of
# Phobos has its silhouette 14.3 m above that of the cells of 159 m that its catalog carries, and a
# single crest errs by 13 m (ten views from 100 km, 1440 crests each); pictures of it show the limb
# 2 m higher still (eight). A truth of the model's flat faces stands 6 m above the cells. Other
# shapes: in units of their cells.
LIFT, LIFT_SIGMA = 0.100, 0.25
CREST_NOISE, SECTOR_NOISE = 0.080, 0.02
SHADOW_CLEARANCE = 0.16
MIN_AZIMUTHS, MAX_AZIMUTHS = 360, 2880
STEEPEST_COSINE = 0.35  # where a limb leans more against the circle's, azimuths are no measure


@dataclass(frozen=True, eq=False)
class ShapeGround:
    """A shape made ready for silhouettes.

    crest_noise_m   of a single crest;  crest_sigma_m  common to all
    sector_sigma_m  common to the crests of a sector of the limb
    clearance_m     ground by which a crest may miss the Sun and still be taken as lit
    """

    limb: LimbRelief
    crest_noise_m: float
    crest_sigma_m: float
    sector_sigma_m: float
    clearance_m: float


@dataclass(frozen=True, eq=False)
class ShapeLimb:
    """The silhouette at each ray.

    offsets   (n,)   rad, the ray beyond the silhouette along the silhouette's normal
    rates     (n, 3) d offset / d position, rad a m
    ranges    (n,)   m, from the camera to the crest
    usable    (n,)   whether the crest is lit and the silhouette does not run along the azimuth's
                     line
    sun_sine  (n,)   sine of the Sun's elevation over the ground that the ray grazes
    """

    offsets: FloatArray
    rates: FloatArray
    ranges: FloatArray
    usable: BoolArray
    sun_sine: FloatArray


def is_shape(relief: GlobalRelief) -> bool:
    """Whether a relief is so high that it is the body's shape rather than terrain on a sphere."""
    rise = float(relief.heights.max() - relief.heights.min())
    return rise > SHAPE_SHARE * relief.radius_m


def relief_fraction(body: Body) -> float:
    """How far a limb may lie off the body's smooth one, in mean radii: half of what its highest
    place may, for a body whose ground is a shape; that of Phobos' 2 deg model is 0.05 rms.
    """
    beyond = body.radius_m + body.plausible_heights_m[1] - max(body.radii_m)
    share = beyond / body.radius_m
    return 0.5 * share if share > SHAPE_SHARE else RELIEF


@lru_cache(maxsize=2)
def shape_ground(relief: GlobalRelief) -> ShapeGround:
    """The shape made ready for silhouettes, once for all frames."""
    cell = relief.posting_m
    # of slopes as steep as these the tops say how a cell leans, not what stands up in it
    lifted = relief.heights + np.float32(LIFT * cell)
    ground = GlobalRelief(lifted, lifted, relief.radius_m, relief.source)
    return ShapeGround(
        LimbRelief(ground, 0.0), CREST_NOISE * cell, LIFT * LIFT_SIGMA * cell,
        SECTOR_NOISE * cell, SHADOW_CLEARANCE * cell,
    )  # fmt: skip


def shape_limb(
    ground: ShapeGround, position: FloatArray, sight: LimbRays, sun_body: FloatArray | None
) -> ShapeLimb:
    """The silhouette from a position (3,), m, body frame, beside the rays.

    sun_body (3,) towards the Sun, any length; None: all is taken as lit
    """
    limb = ground.limb
    distance = float(np.linalg.norm(position))
    axes = nadir_axes(position)
    sine = min(limb.radius_m / distance, 1.0)
    finest = max(float(np.median(sight.pixel_angle)) / sine, 0.25 * limb.posting_m / limb.radius_m)
    count = int(np.clip(np.ceil(2.0 * np.pi / finest), MIN_AZIMUTHS, MAX_AZIMUTHS))
    step = 2.0 * np.pi / count
    azimuths = np.arange(count) * step
    line = limb.skyline(position, axes, azimuths)
    curve = gaussian_filter1d(line.off_nadir, sight.blur / sine / step, mode="wrap")
    slope = (np.roll(curve, -1) - np.roll(curve, 1)) / (2.0 * step)
    to_crest = np.sqrt(
        distance**2 + line.radius_m**2 - 2.0 * distance * line.radius_m * np.cos(line.range)
    )
    rays_at = sight.azimuths(position)
    place = np.mod(rays_at, 2.0 * np.pi) / step
    left = np.floor(place).astype(np.int64) % count
    right, share = (left + 1) % count, place - np.floor(place)

    def between(values: FloatArray) -> FloatArray:
        return np.asarray((1.0 - share) * values[left] + share * values[right])

    off_nadir, lean, ranges = between(curve), between(slope), between(to_crest)
    # unit vectors of the silhouette's points: up the azimuth, and along it
    across = np.cos(rays_at)[:, None] * axes[0] + np.sin(rays_at)[:, None] * axes[1]
    aside = np.cos(rays_at)[:, None] * axes[1] - np.sin(rays_at)[:, None] * axes[0]
    outward = np.cos(off_nadir)[:, None] * across + np.sin(off_nadir)[:, None] * axes[2]
    width = np.sin(off_nadir)
    size = np.hypot(width, lean)
    cosine = width / size
    normals = cosine[:, None] * outward - (lean / size)[:, None] * aside
    nearest = np.arctan2(np.linalg.norm(np.cross(sight.rays, axes[2]), axis=1),
                         -sight.rays @ axes[2])  # fmt: skip
    usable, sun_sine = cosine > STEEPEST_COSINE, np.ones(len(sight))
    if sun_body is not None:
        sun = sun_body / np.linalg.norm(sun_body)
        sun_sine = normals @ sun
        around = np.cos(azimuths)[:, None] * axes[0] + np.sin(azimuths)[:, None] * axes[1]
        out = np.cos(line.range)[:, None] * axes[2] + np.sin(line.range)[:, None] * around
        lit = limb.sunlit((line.radius_m + ground.clearance_m)[:, None] * out, sun)
        usable = usable & lit[left] & lit[right]
    return ShapeLimb(
        (nearest - off_nadir) * cosine, normals / ranges[:, None], ranges, usable, sun_sine
    )
