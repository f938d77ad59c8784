"""Horizon navigation: the camera's position from the lit limb, with and without relief.

The ellipsoid comes first; where the body's relief or shape is known, then its own skyline.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.consider import considered
from optnav_cli.estimation.least_squares import Estimate
from optnav_cli.fix import Evidence, Fix, Method, OutlineMarks
from optnav_cli.outline.limb.detection import LimbPoints
from optnav_cli.outline.limb.ground_skyline import (
    MAX_RELIEF_MISFIT,
    is_shape,
    make_relief_skyline,
    make_shape_skyline,
)
from optnav_cli.outline.limb.limb_rays import (
    LimbRays,
    compute_attitude_covariance,
    compute_edge_errors,
    compute_relief_covariance,
    make_limb_rays,
    require_arc,
)
from optnav_cli.outline.limb.model import fit_limb
from optnav_cli.outline.limb.skyline import (
    BodySkyline,
    SkylineResult,
    add_limb_errors,
    fit_repeatedly,
)
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode


def navigate(
    points: LimbPoints,
    camera: Camera,
    camera_from_body: Rotation,
    attitude_sigma_rad: float,
    sun_body: ArrayLike | None,
    body: Body,
    relief: GlobalRelief | None = None,
) -> Fix:
    """The camera's position from the lit limb in one picture.

    attitude_sigma_rad  of each axis of camera_from_body
    sun_body            (3,) towards the Sun, body frame, any length; None: not known
    relief              of the body; without it the bare ellipsoid is the model

    Raises NoSolutionError, with the reason, when the limb does not give a position.
    """
    sun = None if sun_body is None else np.asarray(sun_body, dtype=np.float64)
    rays = make_limb_rays(points, camera, camera_from_body)
    start = fit_limb(rays.rays, rays.compute_point_sigmas(), body.radii_m)
    if relief is None:
        azimuths = rays.compute_azimuths(start.state)
        position, covariance = _solve_on_ellipsoid(rays, azimuths, start, sun, body)
        fit = start
    else:
        skyline: BodySkyline = (
            make_shape_skyline(relief)
            if is_shape(relief)
            else make_relief_skyline(relief, body.name)
        )
        last = fit_repeatedly(skyline, rays, start.state, sun)
        try:
            skyline.check(last)
        except NoSolutionError as error:
            if is_shape(relief) or last.fit.misfit <= MAX_RELIEF_MISFIT:
                raise
            inverse = make_limb_rays(points, camera, camera_from_body.inv())
            if not _is_better_fit(inverse, skyline, last, body):
                raise
            raise NoSolutionError(
                f"{error}; it fits the inverse rotation: is the quaternion body_from_camera?",
                ReasonCode.WRONG_ATTITUDE,
            ) from None
        fit, rays, azimuths = last.fit.estimate, last.fit.rays, last.fit.azimuths
        position, covariance = add_limb_errors(skyline, last.fit)
    used = fit.used
    arc = require_arc(azimuths[used])
    in_pixels = fit.measured.residuals[used] / rays.pixel_angle[used]
    residuals = np.full(len(points), np.nan)
    residuals[rays.numbers[used]] = in_pixels
    rms = float(np.sqrt(np.mean(in_pixels**2)))
    marks = OutlineMarks(points.pixels, points.inward, residuals)
    evidence = Evidence(residual_rms_px=rms, n_limb=int(used.sum()), arc_deg=arc, outline=marks)
    covariance = covariance + compute_attitude_covariance(position, attitude_sigma_rad)
    short = Reason(ReasonCode.SHORT_ARC, f"short arc of limb, {arc:.0f} deg")
    # A fix by an arc below 140 deg carries a remark.
    remark = _describe_coding(points).add_sentence(short if arc < 140.0 else NO_REASON)
    method = Method.HORIZON_SPHERE if relief is None else Method.HORIZON
    return Fix(method, position, covariance, camera_from_body, attitude_sigma_rad, evidence, remark)


def _describe_coding(points: LimbPoints) -> Reason:
    """A remark where the limb shows that counts are not linear in light; else none."""
    if points.exponent == 1.0:
        return NO_REASON
    return Reason(
        ReasonCode.NONLINEAR_COUNTS,
        f"the limb shows that counts go as light to the power of {1.0 / points.exponent:.2f}; if "
        "the camera codes them so, state it in its file ([coding])",
    )


def _solve_on_ellipsoid(
    rays: LimbRays,
    azimuths: FloatArray,
    fit: Estimate[FloatArray],
    sun: FloatArray | None,
    body: Body,
) -> tuple[FloatArray, FloatArray]:
    """Position (3,), m, and covariance (3, 3) of the bare ellipsoid with what relief does to it."""
    position = fit.state
    distance = float(np.linalg.norm(position))
    sine = min(float(np.mean(body.radii_m)) / distance, 1.0)
    limb_distance = distance * float(np.sqrt(1.0 - sine * sine))
    relief = compute_relief_covariance(
        fit, body, azimuths, limb_distance, circle=float(np.arccos(sine))
    )
    sun_sine = np.ones(len(rays))
    if sun is not None:
        # of the Sun's elevation where the rays touch a sphere
        touch = position - (rays.rays @ position)[:, None] * rays.rays
        sun_sine = touch @ sun / (np.linalg.norm(touch, axis=1) * np.linalg.norm(sun))
    errors = compute_edge_errors(rays, azimuths, sun_sine)
    return position, fit.noise + relief + considered(fit.measured.gain(fit.noise), errors)


def _is_better_fit(
    inverse: LimbRays, skyline: BodySkyline, last: SkylineResult, body: Body
) -> bool:
    """Whether rays by the inverse rotation fit a skyline, where those of the stated one do not."""
    try:
        start = fit_limb(inverse.rays, inverse.compute_point_sigmas(), body.radii_m).state
        # the Sun was turned into the picture by the same attitude: what is lit is not known
        result = fit_repeatedly(skyline, inverse, start, None)
        skyline.check(result)
    except NoSolutionError:
        return False
    # The inverse rotation is the better one below 60 % of the misfit.
    return result.fit.misfit <= 0.6 * last.fit.misfit
