"""From limb points to a position over a small body's shape.

Each pass predicts the shape's silhouette from the position so far and takes one Gauss-Newton step.
What the model cannot be (shadows it does not know, the neck of a contact binary) loses its weight;
a limb that mostly loses it, or scatters more than the model allows, is refused.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.estimation.limb_fit import LimbFit
from optnav_cli.estimation.silhouette_step import MAD_TO_SIGMA, silhouette_step
from optnav_cli.navigation.horizon.shape_limb import shape_ground, shape_limb
from optnav_cli.navigation.horizon.sight import LimbRays, arc_deg, require_arc
from optnav_cli.navigation.horizon.uncertainty import edge_errors, with_shared_errors
from optnav_cli.reasons import ReasonCode

MAX_PASSES = 15
STILL_SIGMAS = 0.05  # a pass that moves the position by less of its sigma is the last
MIN_CUT_PX = 0.5
MIN_SUN_SINE = 0.05  # as over a relief, see solve
MIN_KEPT_SHARE = 0.7  # of the lit points; of Phobos' 93 % and more are kept
# Scatter over the expected one; right limbs stay below 1.3, wrong attitudes begin at 4.
MISFIT = 2.0
SLOWEST = 0.8  # after so many passes each must move the position by this share of the one before
SETTLING_PASSES = 4


@dataclass(frozen=True, eq=False)
class ShapeFix:
    """A position over a shape.

    position_m, covariance_m2  (3,), (3, 3); the attitude's error is not in it
    fit      of the last step, without what points have wrong together
    kept     the rays that it used, before weights
    arc_deg  azimuth about the nadir that the points with a weight cover
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    fit: LimbFit
    kept: LimbRays
    arc_deg: float
    passes: int


def over_shape(
    sight: LimbRays, start_m: FloatArray, sun_body: FloatArray | None, relief: GlobalRelief
) -> ShapeFix:
    """The position whose silhouette of the shape fits the rays.

    start_m   (3,) that of the ellipsoid
    sun_body  (3,) towards the Sun, any length; None: all is taken as lit

    Raises NoSolutionError when the limb is not that of the shape or does not settle.
    """
    ground = shape_ground(relief)
    position, passes, moved = start_m, 0, np.inf
    while True:
        passes += 1
        limb = shape_limb(ground, position, sight, sun_body)
        usable = limb.usable & (limb.sun_sine > MIN_SUN_SINE)
        kept, azimuths = sight.subset(usable), sight.azimuths(position)[usable]
        require_arc(arc_deg(azimuths))
        sigmas = np.hypot(kept.own_sigmas(), ground.crest_noise_m / limb.ranges[usable])
        fit = silhouette_step(
            position, limb.offsets[usable], limb.rates[usable], sigmas, azimuths,
            MIN_CUT_PX * float(np.median(kept.pixel_angle)),
        )  # fmt: skip
        step = fit.position_m - position
        before, moved = moved, float(np.linalg.norm(step))
        position = fit.position_m
        if float(np.linalg.norm(position)) <= ground.limb.radius_m:
            raise NoSolutionError(
                "the limb leads to a position inside the body", ReasonCode.INSIDE_BODY
            )
        if float(step @ np.linalg.solve(fit.covariance_m2, step)) < STILL_SIGMAS**2:
            break
        if passes == MAX_PASSES or (passes > SETTLING_PASSES and moved > SLOWEST * before):
            raise NoSolutionError(
                f"the position still moves by {moved:.0f} m after {passes} passes over the shape",
                ReasonCode.NOT_SETTLED,
            )
    _check_misfit(fit, sigmas)
    arc = require_arc(arc_deg(azimuths[fit.weights > 0.0]))
    away = float(np.median(limb.ranges[usable]))
    errors = edge_errors(kept, azimuths, limb.sun_sine[usable])
    errors = errors.with_constant(ground.crest_sigma_m / away)
    errors = errors.with_sectors(azimuths, ground.sector_sigma_m / away)
    position, covariance = with_shared_errors(fit, errors)
    return ShapeFix(position, covariance, fit, kept, arc, passes)


def _check_misfit(fit: LimbFit, sigmas: FloatArray) -> None:
    share = float((fit.weights > 0.0).mean())
    misfit = MAD_TO_SIGMA * float(np.median(np.abs(fit.residuals) / sigmas))
    if share < MIN_KEPT_SHARE:
        raise NoSolutionError(
            f"only {100.0 * share:.0f} % of the lit limb lie on the silhouette of the shape; check "
            "attitude, time, camera and body, or the shape has parts that hide behind each other",
            ReasonCode.LIMB_MISFIT,
        )
    if misfit > MISFIT:
        raise NoSolutionError(
            f"the limb is not the silhouette of the shape: it scatters by {misfit:.1f} times what "
            "is expected; check attitude, time, camera and body",
            ReasonCode.LIMB_MISFIT,
        )
