"""A position from a limb on a body's own skyline: predicted, fitted, and predicted again.

The skyline is predicted from the position so far and the position fitted to it, until that stands
still. What is not in the model (crests in shadow, ground below its cells) loses its weight.
"""

from typing import NamedTuple, Protocol

import numpy as np

from catalog.arrays import BoolArray, FloatArray
from optnav_cli.estimation.consider import considered, with_shared_errors
from optnav_cli.estimation.least_squares import Estimate
from optnav_cli.outline.limb.limb_rays import (
    LightSizes,
    LimbRays,
    compute_edge_errors,
    compute_rough_errors,
    group_by_sector,
    require_arc,
)


class SkylineFit(NamedTuple):
    """A fit to the skyline as it is predicted from one position.

    rays        that were used, before robust weights
    azimuths    (n,) rad, of these about the nadir
    sun_sine    (n,) sine of the Sun's elevation over the ground that they graze
    distance_m  from the camera to the limb
    misfit      scatter of the residuals over the expected one
    """

    estimate: Estimate[FloatArray]
    rays: LimbRays
    azimuths: FloatArray
    sun_sine: FloatArray
    distance_m: float
    misfit: float


class SkylineResult(NamedTuple):
    """Result of the last pass over a skyline.

    passes   how many were made;  moved_m  by the last of them
    settled  whether it left the position where it was
    """

    fit: SkylineFit
    passes: int
    moved_m: float
    settled: bool


class BodySkyline(Protocol):
    """The skyline of a body, as the limb of its relief or of its shape.

    max_passes      over it
    must_converge   whether it is given up before these, when passes move the position no less
    crest_sigma_m   error of height that all crests share
    sector_sigma_m  that the crests of a sector of the limb share; 0 for none
    """

    max_passes: int
    must_converge: bool
    crest_sigma_m: float
    sector_sigma_m: float

    def fit(self, rays: LimbRays, position: FloatArray, sun: FloatArray | None) -> SkylineFit:
        """Fit a position (3,), m, to the skyline as predicted from another one.

        sun (3,) towards the Sun, any length; None: all is taken as lit

        Raises NoSolutionError when too little of the limb is lit.
        """

    def has_converged(self, step: FloatArray, estimate: Estimate[FloatArray]) -> bool:
        """Whether a step (3,), m, is too small for another pass."""

    def check(self, last: SkylineResult) -> None:
        """Raises NoSolutionError when the limb is not this skyline or does not settle on it."""


def select_usable_rays(
    rays: LimbRays, position: FloatArray, lit: BoolArray, sun_sine: FloatArray
) -> tuple[BoolArray, LimbRays]:
    """Select rays (n,) that the Sun lights: mask and rays. Raises NoSolutionError for few."""
    # Below a Sun of 3 deg edges stray by tenths of a pixel, and outward: the far side of shadows is
    # seen there.
    usable = lit & (sun_sine > 0.05)
    kept = rays.subset(usable)
    require_arc(kept.compute_azimuths(position))
    return usable, kept


def fit_repeatedly(
    skyline: BodySkyline, rays: LimbRays, start_m: FloatArray, sun: FloatArray | None
) -> SkylineResult:
    """Predict and fit a skyline from a first position (3,) until it converges or passes run out."""
    position, moved, passes = start_m, np.inf, 0
    while True:
        passes += 1
        fit = skyline.fit(rays, position, sun)
        step = fit.estimate.state - position
        before, moved = moved, float(np.linalg.norm(step))
        position = fit.estimate.state
        if not skyline.must_converge and passes > 1:
            # Moves over a relief shrink from pass to pass at about one rate; the next is expected
            # at most three times as large as that.
            step = step * min(1.0, 3.0 * moved / before)
        if skyline.has_converged(step, fit.estimate):
            return SkylineResult(fit, passes, moved, True)
        slow = skyline.must_converge and passes > 4
        # A skyline that must converge is given up after four passes when a pass moves the position
        # by more than 80 % of the pass before.
        if passes == skyline.max_passes or (slow and moved > 0.8 * before):
            return SkylineResult(fit, passes, moved, False)


def add_limb_errors(
    skyline: BodySkyline, fit: SkylineFit, light: LightSizes | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return position (3,), m, and covariance (3, 3) with common errors of limb points and crests.

    The attitude's error is not in it.  light  as `edge_errors`
    """
    position, covariance = with_shared_errors(
        fit.estimate, compute_shared_errors(skyline, fit, light)
    )
    # not solved for: they look like a shift of the position on a part of the limb
    rough = compute_rough_errors(fit.rays, fit.azimuths, light)
    gain = fit.estimate.measured.gain(fit.estimate.noise)
    return position, covariance + considered(gain, rough)


def compute_shared_errors(
    skyline: BodySkyline, fit: SkylineFit, light: LightSizes | None = None
) -> FloatArray:
    """Compute the common errors of limb points and crests: (n, m) rad, one sigma of each.

    light  as `edge_errors`
    """
    crests = np.full((len(fit.rays), 1), skyline.crest_sigma_m / fit.distance_m)
    errors = [compute_edge_errors(fit.rays, fit.azimuths, fit.sun_sine, light), crests]
    if skyline.sector_sigma_m > 0.0:
        errors.append(group_by_sector(fit.azimuths) * (skyline.sector_sigma_m / fit.distance_m))
    return np.concatenate(errors, axis=1)
