"""From limb points to a position: the ellipsoid first, then the relief's own skyline.

Each pass predicts the skyline of the relief from the position so far, and fits the position again
with every ray touching a sphere of its own skyline's size. Outliers (crests in shadow, ground that
the relief does not know) lose their weight by Tukey's biweight, whose width follows the scatter:
wide while the position is kilometres off, narrow in the end.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.limb_fit import LimbFit, fit_limb
from optnav_cli.estimation.silhouette_step import MAD_TO_SIGMA, TUKEY
from optnav_cli.measurements.limb.detection import LimbPoints
from optnav_cli.navigation.horizon.shape_limb import is_shape
from optnav_cli.navigation.horizon.shape_solve import over_shape
from optnav_cli.navigation.horizon.sight import (
    HorizonFix,
    LimbRays,
    arc_deg,
    limb_rays_of,
    require_arc,
)
from optnav_cli.navigation.horizon.terrain_limb import (
    LimbGround,
    TerrainLimb,
    limb_ground,
    terrain_limb,
)
from optnav_cli.navigation.horizon.uncertainty import (
    attitude_covariance,
    edge_errors,
    relief_covariance,
    with_shared_errors,
)
from optnav_cli.reasons import Reason, ReasonCode

SHORT_ARC_DEG = 140.0  # below it a fix is remarked on
MAX_PASSES = 8
STILL_M = 5.0  # a pass that moves the position by less, or by less than STILL_SIGMAS, is the last
STILL_SIGMAS = 0.1
MIN_CUT_PX = 0.2
# Below 3 deg of Sun edges stray by tenths of a pixel, and outward: what is seen there is the far
# side of shadows.
MIN_SUN_SINE = 0.05
# A limb that scatters by so many times what is expected does not belong to this relief, attitude
# and time: right limbs from 50 to 20 000 km, Sun from 9 deg on, stay below 1.45 over a relief of 16
# cells a degree and below 1.55 over one of 4. From 100 km a clock off by an hour or a focal length
# by 1 % reaches 4, an inverse rotation 20.
MISFIT = 1.8


@dataclass(frozen=True, eq=False)
class _Solved:
    """A fit over the relief: the rays that it kept, the skyline at these, how often it looked."""

    fit: LimbFit
    kept: LimbRays
    sun_sine: FloatArray
    passes: int
    misfit: float


def navigate(
    points: LimbPoints,
    camera: Camera,
    camera_from_body: Rotation,
    attitude_sigma_rad: float,
    sun_body: ArrayLike | None,
    body: Body,
    relief: GlobalRelief | None = None,
) -> HorizonFix:
    """The camera's position from the lit limb in one picture.

    attitude_sigma_rad  of each axis of camera_from_body
    sun_body            (3,) towards the Sun, body frame, any length; None: not known
    relief              of the body; without it the bare ellipsoid is the model

    Raises NoSolutionError, with the reason, when the limb does not give a position.
    """
    sun = None if sun_body is None else np.asarray(sun_body, dtype=np.float64)
    sight = limb_rays_of(points, camera, camera_from_body)
    fit = fit_limb(sight.rays, sight.own_sigmas(), body.radii_m)
    if relief is None:
        return _bare(points, sight, fit, attitude_sigma_rad, sun, body)
    if is_shape(relief):
        shaped = over_shape(sight, fit.position_m, sun, relief)
        attitude = attitude_covariance(shaped.position_m, attitude_sigma_rad)
        return _fix(
            points, shaped.kept, shaped.fit, shaped.position_m, shaped.covariance_m2 + attitude,
            shaped.arc_deg, shaped.passes,
        )  # fmt: skip
    ground = limb_ground(relief)
    solved = _over_relief(sight, fit.position_m, sun, ground)
    if solved.misfit > MISFIT:
        reason = _misfit_reason(points, camera, camera_from_body, sun, body, ground, solved)
        raise reason.error()
    return _terrain_fix(points, solved, attitude_sigma_rad, ground)


def _bare(
    points: LimbPoints, sight: LimbRays, fit: LimbFit, attitude_sigma: float,
    sun: FloatArray | None, body: Body,
) -> HorizonFix:  # fmt: skip
    position = fit.position_m
    azimuths = sight.azimuths(position)
    arc = require_arc(arc_deg(azimuths))
    distance = float(np.linalg.norm(position))
    sine = min(float(np.mean(body.radii_m)) / distance, 1.0)
    away = distance * float(np.sqrt(1.0 - sine * sine))
    covariance = fit.noise_m2 + attitude_covariance(position, attitude_sigma)
    covariance += relief_covariance(fit, body, azimuths, away, circle=float(np.arccos(sine)))
    errors = edge_errors(sight, azimuths, _sun_sine(sight, position, sun))
    shift = fit.gain_m @ errors.shapes
    return _fix(points, sight, fit, position, covariance + shift @ shift.T, arc, 0)


def _terrain_fix(
    points: LimbPoints, solved: _Solved, attitude_sigma: float, ground: LimbGround
) -> HorizonFix:
    fit, kept = solved.fit, solved.kept
    azimuths = kept.azimuths(fit.position_m)
    arc = require_arc(arc_deg(azimuths[fit.weights > 0.0]))
    away = _limb_distance(fit.position_m, ground)
    errors = edge_errors(kept, azimuths, solved.sun_sine)
    errors = errors.with_constant(ground.crest_sigma_m / away)
    position, covariance = with_shared_errors(fit, errors)
    covariance = covariance + attitude_covariance(position, attitude_sigma)
    return _fix(points, kept, fit, position, covariance, arc, solved.passes)


def _over_relief(
    sight: LimbRays, position: FloatArray, sun: FloatArray | None, ground: LimbGround
) -> _Solved:
    """Passes over the relief from a first position till it stands still."""
    for passes in range(1, MAX_PASSES + 1):
        limb = terrain_limb(ground, position, sight, sun)
        lit = limb.lit & (limb.sun_sine > MIN_SUN_SINE)
        kept = sight.subset(lit)
        require_arc(arc_deg(kept.azimuths(position)))
        fit, misfit = _robust_fit(kept, limb, lit, position, ground)
        moved = float(np.linalg.norm(fit.position_m - position))
        position = fit.position_m
        if moved < max(STILL_M, STILL_SIGMAS * float(np.sqrt(np.trace(fit.covariance_m2)))):
            return _Solved(fit, kept, limb.sun_sine[lit], passes, misfit)
    if misfit > MISFIT:
        return _Solved(fit, kept, limb.sun_sine[lit], passes, misfit)
    raise NoSolutionError(
        f"the position still moves by {moved:.0f} m after {MAX_PASSES} passes over the relief",
        ReasonCode.NOT_SETTLED,
    )


def _robust_fit(
    kept: LimbRays, limb: TerrainLimb, lit: BoolArray, position: FloatArray, ground: LimbGround
) -> tuple[LimbFit, float]:
    """A fit to the skyline without its outliers, and its scatter over the expected one."""
    radii = np.full(3, ground.radius_m)
    sizes = limb.sizes[lit]
    sigmas = np.hypot(kept.own_sigmas(), ground.crest_noise_m / _limb_distance(position, ground))
    least = MIN_CUT_PX * float(np.median(kept.pixel_angle))
    fit = fit_limb(kept.rays, sigmas, radii, scales=sizes, start_m=position)
    for _ in range(2):
        scatter = MAD_TO_SIGMA * float(np.median(np.abs(fit.residuals)))
        fit = fit_limb(
            kept.rays, sigmas, radii,
            scales=sizes, start_m=fit.position_m, cut=max(TUKEY * scatter, least),
        )  # fmt: skip
    return fit, MAD_TO_SIGMA * float(np.median(np.abs(fit.residuals) / sigmas))


def _misfit_reason(
    points: LimbPoints, camera: Camera, camera_from_body: Rotation, sun: FloatArray | None,
    body: Body, ground: LimbGround, solved: _Solved,
) -> Reason:  # fmt: skip
    """Why a limb that is no skyline of the relief may be so."""
    reason = Reason(
        ReasonCode.LIMB_MISFIT,
        f"the limb is not the skyline of {body.name}'s relief: it scatters by {solved.misfit:.1f} "
        "times what is expected; check attitude, time, camera and body",
    )
    sight = limb_rays_of(points, camera, camera_from_body.inv())
    try:
        fit = fit_limb(sight.rays, sight.own_sigmas(), body.radii_m)
        # the Sun was turned into the picture by the same attitude: what is lit is not known
        other = _over_relief(sight, fit.position_m, None, ground)
    except NoSolutionError:
        return reason
    if other.misfit > min(MISFIT, 0.6 * solved.misfit):
        return reason
    return Reason(
        ReasonCode.WRONG_ATTITUDE,
        f"{reason}; it fits the inverse rotation: is the quaternion body_from_camera?",
    )


def _limb_distance(position: FloatArray, ground: LimbGround) -> float:
    """From a position (3,) to where a sphere's limb lies, m."""
    return float(np.sqrt(max(float(position @ position) - ground.radius_m**2, 1.0)))


def _sun_sine(sight: LimbRays, position: FloatArray, sun: FloatArray | None) -> FloatArray:
    """(n,) sine of the Sun's elevation where the rays touch a sphere; 1 where not known."""
    if sun is None:
        return np.ones(len(sight))
    touch = position - (sight.rays @ position)[:, None] * sight.rays
    return np.asarray(touch @ sun / (np.linalg.norm(touch, axis=1) * np.linalg.norm(sun)))


def _fix(
    points: LimbPoints, sight: LimbRays, fit: LimbFit, position: FloatArray, covariance: FloatArray,
    arc: float, passes: int,
) -> HorizonFix:  # fmt: skip
    used = fit.weights > 0.0
    in_pixels = fit.residuals[used] / sight.pixel_angle[used]
    residuals = np.full(len(points), np.nan)
    residuals[sight.numbers[used]] = in_pixels
    return HorizonFix(
        position_m=position,
        covariance_m2=np.asarray(covariance),
        arc_deg=arc,
        residual_rms_px=float(np.sqrt(np.mean(in_pixels**2))),
        residuals_px=residuals,
        n_points=len(points),
        n_used=int(used.sum()),
        terrain=passes > 0,
        passes=passes,
        remark=f"short arc of limb, {arc:.0f} deg" if arc < SHORT_ARC_DEG else "",
    )
