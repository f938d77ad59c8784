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
from catalog.errors import NoSolutionError
from catalog.geometry.vectors import squared_distance
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.skyline.limb import LimbRelief, make_nadir_axes
from optnav_cli.estimation.least_squares import Estimate
from optnav_cli.estimation.robust import scatter
from optnav_cli.outline.limb.detection import RELIEF
from optnav_cli.outline.limb.limb_rays import LimbRays, load_horizon_sizes
from optnav_cli.outline.limb.model import solve_silhouette_step
from optnav_cli.outline.limb.skyline import SkylineFit, SkylineResult, select_usable_rays
from optnav_cli.reasons import ReasonCode

SHAPE_SHARE = 0.05  # of the radius, highest to lowest: the Moon has 0.011, Phobos 0.5
# Scatter over the expected one; right limbs stay below 1.3, wrong attitudes begin at 4.
MAX_MISFIT = 2.0


@dataclass(frozen=True, eq=False)
class Silhouette:
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


class ShapeSkyline:
    """A shape made ready for silhouettes; see `BodySkyline`.

    crest_noise_m   of a single crest
    clearance_m     ground by which a crest may miss the Sun and still be taken as lit
    cell_m          size of the shape's cells
    """

    max_passes = 15
    must_converge = True

    def __init__(self, limb: LimbRelief, cell_m: float) -> None:
        self.limb, sizes = limb, load_horizon_sizes().shape
        self.crest_noise_m = sizes.crest_noise * cell_m
        self.crest_sigma_m = sizes.lift * sizes.lift_sigma * cell_m
        self.sector_sigma_m = sizes.sector_noise * cell_m
        # A crest up to 0.16 cells below the Sun's reach still counts as lit.
        self.clearance_m = 0.16 * cell_m

    def fit(self, rays: LimbRays, position: FloatArray, sun: FloatArray | None) -> SkylineFit:
        """Make one Gauss-Newton step; see `BodySkyline.fit`."""
        line = self.predict_silhouette(position, rays, sun)
        usable, kept = select_usable_rays(rays, position, line.usable, line.sun_sine)
        azimuths, ranges = kept.compute_azimuths(position), line.ranges[usable]
        sigmas = np.hypot(kept.compute_point_sigmas(), self.crest_noise_m / ranges)
        # The cut is never below 0.5 px.
        least_cut = 0.5 * float(np.median(kept.pixel_angle))
        fit = solve_silhouette_step(
            position, line.offsets[usable], line.rates[usable], sigmas, azimuths, least_cut
        )
        if float(np.linalg.norm(fit.state)) <= self.limb.radius_m:
            text = "the limb leads to a position inside the body"
            raise NoSolutionError(text, ReasonCode.INSIDE_BODY)
        distance, misfit = float(np.median(ranges)), scatter(fit.measured.residuals / sigmas)
        return SkylineFit(fit, kept, azimuths, line.sun_sine[usable], distance, misfit)

    def has_converged(self, step: FloatArray, estimate: Estimate[FloatArray]) -> bool:
        """Whether a step (3,), m, is too small for another pass."""
        # A pass that moves the position by less than 0.05 of its sigma is the last.
        return squared_distance(step, estimate.covariance) < 0.05**2

    def check(self, last: SkylineResult) -> None:
        """Raise NoSolutionError for a misfit or no convergence; see `BodySkyline.check`."""
        if not last.settled:
            raise NoSolutionError(
                f"the position still moves by {last.moved_m:.0f} m after {last.passes} passes over "
                "the shape",
                ReasonCode.NOT_SETTLED,
            )
        share = float(last.fit.estimate.used.mean())
        # Of the lit points of Phobos 93 % and more are kept.
        if share < 0.7:
            raise NoSolutionError(
                f"only {100.0 * share:.0f} % of the lit limb lie on the silhouette of the shape; "
                "check attitude, time, camera and body, or the shape has parts that hide behind "
                "each other",
                ReasonCode.LIMB_MISFIT,
            )
        if last.fit.misfit > MAX_MISFIT:
            raise NoSolutionError(
                f"the limb is not the silhouette of the shape: it scatters by "
                f"{last.fit.misfit:.1f} times what is expected; check attitude, time, camera and "
                "body",
                ReasonCode.LIMB_MISFIT,
            )

    def predict_silhouette(
        self, position: FloatArray, rays: LimbRays, sun_body: FloatArray | None
    ) -> Silhouette:
        """Predict the silhouette from a position (3,), m, body frame, at the rays.

        sun_body (3,) towards the Sun, any length; None: all is taken as lit
        """
        limb = self.limb
        distance = float(np.linalg.norm(position))
        axes = make_nadir_axes(position)
        sine = min(limb.radius_m / distance, 1.0)
        pixel = float(np.median(rays.pixel_angle)) / sine
        finest = max(pixel, 0.25 * limb.posting_m / limb.radius_m)
        count = int(np.clip(np.ceil(2.0 * np.pi / finest), 360, 2880))
        step = 2.0 * np.pi / count
        azimuths = np.arange(count) * step
        line = limb.skyline(position, axes, azimuths)
        curve = gaussian_filter1d(line.off_nadir, rays.blur / sine / step, mode="wrap")
        slope = (np.roll(curve, -1) - np.roll(curve, 1)) / (2.0 * step)
        to_crest = np.sqrt(
            distance**2 + line.radius_m**2 - 2.0 * distance * line.radius_m * np.cos(line.range)
        )
        rays_at = rays.compute_azimuths(position)
        cell = np.mod(rays_at, 2.0 * np.pi) / step
        left = np.floor(cell).astype(np.int64) % count
        right, share = (left + 1) % count, cell - np.floor(cell)

        def interpolate(values: FloatArray) -> FloatArray:
            return (1.0 - share) * values[left] + share * values[right]

        off_nadir, lean, ranges = interpolate(curve), interpolate(slope), interpolate(to_crest)
        # unit vectors of the silhouette's points: up the azimuth, and along it
        across = np.cos(rays_at)[:, None] * axes[0] + np.sin(rays_at)[:, None] * axes[1]
        aside = np.cos(rays_at)[:, None] * axes[1] - np.sin(rays_at)[:, None] * axes[0]
        outward = np.cos(off_nadir)[:, None] * across + np.sin(off_nadir)[:, None] * axes[2]
        width = np.sin(off_nadir)
        size = np.hypot(width, lean)
        cosine = width / size
        normals = cosine[:, None] * outward - (lean / size)[:, None] * aside
        sine_nadir = np.linalg.norm(np.cross(rays.rays, axes[2]), axis=1)
        nearest = np.arctan2(sine_nadir, -rays.rays @ axes[2])
        # Where a limb leans further against the circle's, azimuths are no measure.
        usable, sun_sine = cosine > 0.35, np.ones(len(rays))
        if sun_body is not None:
            sun = sun_body / np.linalg.norm(sun_body)
            sun_sine = normals @ sun
            around = np.cos(azimuths)[:, None] * axes[0] + np.sin(azimuths)[:, None] * axes[1]
            out = np.cos(line.range)[:, None] * axes[2] + np.sin(line.range)[:, None] * around
            lit = limb.mark_sunlit((line.radius_m + self.clearance_m)[:, None] * out, sun)
            usable = usable & lit[left] & lit[right]
        return Silhouette(
            (nearest - off_nadir) * cosine, normals / ranges[:, None], ranges, usable, sun_sine
        )


def is_shape(relief: GlobalRelief) -> bool:
    """Whether a relief is so high that it is the body's shape rather than terrain on a sphere."""
    return relief.span_m > SHAPE_SHARE * relief.radius_m


def estimate_relief_fraction(body: Body) -> float:
    """Estimate how far a limb may lie off the body's smooth one, in mean radii.

    For a body whose ground is a shape: half of what its highest ground may; the limb of Phobos'
    2 deg model is 0.05 rms off.
    """
    beyond = body.radius_m + body.plausible_heights_m[1] - max(body.radii_m)
    share = beyond / body.radius_m
    return 0.5 * share if share > SHAPE_SHARE else RELIEF


@lru_cache(maxsize=2)
def make_shape_skyline(relief: GlobalRelief) -> ShapeSkyline:
    """Prepare the shape for silhouettes, once for all frames."""
    # of slopes as steep as these the tops say how a cell leans, not what stands up in it
    lifted = relief.heights + np.float32(load_horizon_sizes().shape.lift * relief.posting_m)
    ground = GlobalRelief(lifted, lifted, relief.radius_m, relief.source)
    return ShapeSkyline(LimbRelief(ground, 0.0), relief.posting_m)
