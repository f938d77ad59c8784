"""Skylines of real ground: of a relief on a sphere, and of a small body's shape.

A relief: every ray touches a sphere of its own skyline's size. Outliers (crests in shadow, ground
that is not in the relief) lose their weight by Tukey's biweight, whose width follows the scatter:
wide while the position is kilometres off, narrow in the end.

A shape: its relief is no small part of the radius, so limbs lean, by tens of degrees against a
circle's, and are concave. Off the nadir of its centre the silhouette of ground that every direction
from the centre meets once is single-valued all the same, so `LimbRelief` finds it whole. Ground
that some meet more often (a contact binary's neck) is known by its outermost surface only: its
silhouette is too wide there, and these rays have to be outvoted. Offsets are counted along the
silhouette's own normal: as the camera moves, the crest that a ray grazes stays the same to first
order, so an offset changes as if that crest were a fixed point.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.geometry.vectors import squared_distance
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.skyline.limb import LimbRelief, make_nadir_axes
from optnav_cli.estimation.least_squares import Estimate
from optnav_cli.estimation.robust import TUKEY, scatter
from optnav_cli.outline.limb.detection import RELIEF
from optnav_cli.outline.limb.limb_rays import (
    HorizonSizes,
    LightSizes,
    LimbRays,
    compute_rough_errors,
    load_horizon_sizes,
)
from optnav_cli.outline.limb.model import fit_limb, solve_silhouette_step
from optnav_cli.outline.limb.skyline import (
    SkylineFit,
    SkylineResult,
    compute_shared_errors,
    select_usable_rays,
)
from optnav_cli.reasons import ReasonCode

SHAPE_SHARE = 0.05  # of the radius, highest to lowest: the Moon has 0.011, Phobos 0.5
# Scatter over the expected one; right limbs stay below 1.3, wrong attitudes begin at 4.
MAX_MISFIT = 2.0
STILL_SIGMAS = 0.1
# A limb that scatters by so many times what is expected (of edges and crests, each for itself and
# those of a sector together) does not belong to this relief, attitude and time. Right limbs from 50
# to 20 000 km, Sun from 9 deg on, stay below 1.45 over a relief of 16 cells a degree and below 1.55
# over one of 4; with the Sun from 4 deg on below 1.6. From 100 km a clock off by an hour or a focal
# length by 1 % reaches 4, an inverse rotation 20. From 50 km under a Sun of 4 deg an hour makes
# 1.78, and right limbs reach 1.56.
MAX_RELIEF_MISFIT = 1.7


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


class ReliefSkyline:
    """A relief made ready for skylines, and how well these are known; see `BodySkyline`.

    crest_noise_m  of a single crest
    sector_sigma_m that crests of a sector share by the model's error
    light          other sizes of errors by light than the shipped ones
    """

    max_passes = 8
    must_converge = False

    def __init__(
        self,
        limb: LimbRelief,
        body_name: str,
        crest_noise_m: float,
        crest_sigma_m: float,
        sector_sigma_m: float = 0.0,
        light: LightSizes | None = None,
    ) -> None:
        self.limb, self._body_name, self.light = limb, body_name, light
        self.crest_noise_m, self.crest_sigma_m = crest_noise_m, crest_sigma_m
        self.sector_sigma_m = sector_sigma_m

    def fit(self, rays: LimbRays, position: FloatArray, sun: FloatArray | None) -> SkylineFit:
        """Fit the skyline without its outliers; see `BodySkyline.fit`."""
        sizes, lit, sun_sine = self.predict_sizes(position, rays, sun)
        usable, kept = select_usable_rays(rays, position, lit, sun_sine)
        sizes, radii = sizes[usable], np.full(3, self.limb.radius_m)
        sigmas = np.hypot(
            kept.compute_point_sigmas(self.light),
            self.crest_noise_m / self._measure_limb_distance(position),
        )
        # The cut is never below 0.2 px.
        least = 0.2 * float(np.median(kept.pixel_angle))
        fit = fit_limb(kept.rays, sigmas, radii, scales=sizes, start_m=position)
        for _ in range(2):
            cut = max(TUKEY * scatter(fit.measured.residuals), least)
            fit = fit_limb(kept.rays, sigmas, radii, scales=sizes, start_m=fit.state, cut=cut)
        azimuths, distance = (
            kept.compute_azimuths(fit.state),
            self._measure_limb_distance(fit.state),
        )
        made = SkylineFit(fit, kept, azimuths, sun_sine[usable], distance, misfit=np.inf)
        shared = compute_shared_errors(self, made, self.light)
        rough = compute_rough_errors(kept, azimuths, self.light)
        expected = np.sqrt(sigmas**2 + (shared**2).sum(axis=1) + (rough**2).sum(axis=1))
        return made._replace(misfit=scatter(fit.measured.residuals / expected))

    def has_converged(self, step: FloatArray, estimate: Estimate[FloatArray]) -> bool:
        """Whether a step (3,), m, is too small for another pass."""
        sigma = float(np.sqrt(np.trace(estimate.covariance)))
        # A pass that moves the position by less than 5 m or 0.1 sigma is the last.
        return float(np.linalg.norm(step)) < max(5.0, STILL_SIGMAS * sigma)

    def check(self, last: SkylineResult) -> None:
        """Raise NoSolutionError for a misfit or no convergence; see `BodySkyline.check`."""
        if last.fit.misfit > MAX_RELIEF_MISFIT:
            raise NoSolutionError(
                f"the limb is not the skyline of {self._body_name}'s relief: it scatters by "
                f"{last.fit.misfit:.1f} times what is expected; check attitude, time, camera and "
                "body",
                ReasonCode.LIMB_MISFIT,
            )
        if not last.settled:
            raise NoSolutionError(
                f"the position still moves by {last.moved_m:.0f} m after {last.passes} passes over "
                "the relief",
                ReasonCode.NOT_SETTLED,
            )

    def _measure_limb_distance(self, position: FloatArray) -> float:
        """Measure the distance from a position (3,) to the sphere's limb, m."""
        return float(np.sqrt(max(float(position @ position) - self.limb.radius_m**2, 1.0)))

    def predict_sizes(
        self, position: FloatArray, rays: LimbRays, sun_body: FloatArray | None
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Predict the skyline from a position (3,), m, at the azimuth of each ray.

        sun_body (3,) towards the Sun, any length; None: all is taken as lit
        Returns, each (n,): the radius of the sphere that a ray on the skyline would touch, in
        reference radii; whether the Sun reaches the crest; the sine of the Sun's elevation over
        the sphere there, 1 where not known.
        """
        ground = self.limb
        distance = float(np.linalg.norm(position))
        axes = make_nadir_axes(position)
        rays_at = rays.compute_azimuths(position)
        # a turn of azimuth moves the crest by R sin(range) and the line of sight by sin(off nadir)
        sine = min(ground.radius_m / distance, 1.0)
        circle = ground.radius_m * np.sqrt(1.0 - sine * sine)
        blur = rays.blur / sine
        spacing = max(0.5 * ground.posting_m, min(0.5 * blur * circle, ground.posting_m))
        count = max(360, int(np.ceil(2.0 * np.pi * circle / spacing)))
        step = 2.0 * np.pi / count
        cell = np.mod(rays_at, 2.0 * np.pi) / step
        wanted = _mark_near(
            np.floor(cell).astype(np.int64), count, int(np.ceil(4.0 * blur / step)) + 1
        )
        azimuths = np.flatnonzero(wanted) * step
        line = ground.skyline(position, axes, azimuths)
        table = np.full(count, float(line.off_nadir.mean()))
        table[wanted] = line.off_nadir
        table = gaussian_filter1d(table, blur / step, mode="wrap")
        left = np.floor(cell).astype(np.int64) % count
        share = cell - np.floor(cell)
        off_nadir = (1.0 - share) * table[left] + share * table[(left + 1) % count]
        lit, sun_sine = np.ones(count, np.bool_), np.ones(count)
        if sun_body is not None:
            across = np.cos(azimuths)[:, None] * axes[0] + np.sin(azimuths)[:, None] * axes[1]
            out = np.cos(line.range)[:, None] * axes[2] + np.sin(line.range)[:, None] * across
            # A crest up to 30 m below the Sun's reach still counts as lit.
            crests = (line.radius_m + 30.0)[:, None] * out
            sun_sine[wanted] = out @ (sun_body / np.linalg.norm(sun_body))
            lit[wanted] = ground.mark_sunlit(crests, sun_body)
        sizes = distance * np.sin(off_nadir) / ground.radius_m
        return sizes, lit[left] & lit[(left + 1) % count], sun_sine[left]


@lru_cache(maxsize=2)
def make_relief_skyline(
    relief: GlobalRelief, body_name: str, other: HorizonSizes | None = None
) -> ReliefSkyline:
    """Prepare the relief for skylines, once for all frames; with other sizes to score them."""
    sizes, light = (other or load_horizon_sizes()).crest, None if other is None else other.light
    cells = relief.posting_m / sizes.posting_m
    noise, sigma = sizes.noise_m * cells, sizes.sigma_m * cells
    sector = sizes.model_sector * (relief.error_m or 0.0)
    rise = float(np.mean(relief.max_heights - relief.heights))
    # Relief without tops: these rise 0.3 % of a cell over the means, the Moon's ten times as much.
    if rise < 0.003 * relief.posting_m:
        lift = sizes.lift * relief.posting_m
        lifted = relief.heights + np.float32(lift)
        flat = GlobalRelief(lifted, lifted, relief.radius_m, relief.source)
        sigma = max(sigma, sizes.lift_sigma * lift)
        return ReliefSkyline(LimbRelief(flat, 0.0), body_name, noise, sigma, sector, light)
    share = sizes.top_share + sizes.top_share_more / max(cells, 1.0)
    return ReliefSkyline(LimbRelief(relief, share), body_name, noise, sigma, sector, light)


def _mark_near(places: IntArray, count: int, reach: int) -> BoolArray:
    """Mark those of `count` cells round a circle that lie within `reach` of one of these."""
    hit = np.zeros(count, np.int64)
    hit[places % count] = 1
    if 2 * reach + 2 >= count:
        return np.ones(count, np.bool_)
    # one beyond on the far side: rays lie between a place and the next
    around = np.concatenate([hit[-reach - 1 :], hit, hit[: reach + 1]])
    sums = np.concatenate([[0], np.cumsum(around)])
    width = 2 * reach + 3
    near: BoolArray = sums[width:] > sums[:-width]
    return near[:count]
