"""The skyline of a relief on a sphere: every ray touches a sphere of its own skyline's size.

Outliers (crests in shadow, ground that is not in the relief) lose their weight by Tukey's
biweight, whose width follows the scatter: wide while the position is kilometres off, narrow in the
end.
"""

from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter1d

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.errors import NoSolutionError
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.skyline.limb import LimbRelief, make_nadir_axes
from optnav_cli.estimation.least_squares import Estimate
from optnav_cli.estimation.robust import TUKEY, scatter
from optnav_cli.outline.limb.limb_rays import (
    HorizonSizes,
    LightSizes,
    LimbRays,
    compute_rough_errors,
    load_horizon_sizes,
)
from optnav_cli.outline.limb.model import fit_limb
from optnav_cli.outline.limb.skyline import (
    SkylineFit,
    SkylineResult,
    compute_shared_errors,
    select_usable_rays,
)
from optnav_cli.reasons import ReasonCode

STILL_SIGMAS = 0.1
# A limb that scatters by so many times what is expected (of edges and crests, each for itself and
# those of a sector together) does not belong to this relief, attitude and time. Right limbs from 50
# to 20 000 km, Sun from 9 deg on, stay below 1.45 over a relief of 16 cells a degree and below 1.55
# over one of 4; with the Sun from 4 deg on below 1.6. From 100 km a clock off by an hour or a focal
# length by 1 % reaches 4, an inverse rotation 20. From 50 km under a Sun of 4 deg an hour makes
# 1.78, and right limbs reach 1.56.
MAX_MISFIT = 1.7


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
        if last.fit.misfit > MAX_MISFIT:
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
