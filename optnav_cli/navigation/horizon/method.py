"""Horizon navigation: the camera's position from the lit limb, with and without relief.

The ellipsoid comes first; where the body's relief or shape is known, then its own skyline.
"""

from dataclasses import dataclass

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
from optnav_cli.estimation.models.limb import fit_limb
from optnav_cli.measurements.limb.detection import LimbPoints
from optnav_cli.navigation.horizon.limb_rays import (
    LimbRays,
    arc_deg,
    attitude_covariance,
    edge_errors,
    limb_rays_of,
    relief_covariance,
    require_arc,
)
from optnav_cli.navigation.horizon.relief_skyline import MAX_MISFIT, relief_skyline
from optnav_cli.navigation.horizon.shape_skyline import is_shape, shape_skyline
from optnav_cli.navigation.horizon.skyline import Followed, Skyline, follow, with_limb_errors

SHORT_ARC_DEG = 140.0  # below it a fix is remarked on
INVERSE_MISFIT_SHARE = 0.6  # of the misfit: below it the inverse rotation is the better one


@dataclass(frozen=True, eq=False)
class HorizonFix:
    """A camera position from limb points.

    position_m       (3,)   body frame
    covariance_m2    (3, 3)
    arc_deg          azimuth about the nadir that the used points cover
    residual_rms_px  across the limb, of the used points
    residuals_px     (n_points,) of each, positive away from the body; NaN of those left out
    n_used           kept: lit by the relief, and not outvoted
    terrain          whether the relief's skyline was the model, or the bare ellipsoid
    remark           what a reader should know; empty when nothing
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    arc_deg: float
    residual_rms_px: float
    residuals_px: FloatArray
    n_used: int
    terrain: bool
    remark: str


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
    rays = limb_rays_of(points, camera, camera_from_body)
    start = fit_limb(rays.rays, rays.own_sigmas(), body.radii_m)
    if relief is None:
        azimuths = rays.azimuths(start.state)
        position, covariance = _on_ellipsoid(rays, azimuths, start, sun, body)
        fit = start
    else:
        skyline: Skyline = (
            shape_skyline(relief) if is_shape(relief) else relief_skyline(relief, body.name)
        )
        last = follow(skyline, rays, start.state, sun)
        try:
            skyline.check(last)
        except NoSolutionError as error:
            if is_shape(relief) or last.fit.misfit <= MAX_MISFIT:
                raise
            inverse = limb_rays_of(points, camera, camera_from_body.inv())
            raise NoSolutionError(
                f"{error}{_inverse_rotation_remark(inverse, skyline, last, body)}"
            ) from None
        fit, rays, azimuths = last.fit.estimate, last.fit.rays, last.fit.azimuths
        position, covariance = with_limb_errors(skyline, last.fit)
    used = fit.used
    arc = require_arc(arc_deg(azimuths[used]))
    in_pixels = fit.measured.residuals[used] / rays.pixel_angle[used]
    residuals = np.full(len(points), np.nan)
    residuals[rays.numbers[used]] = in_pixels
    return HorizonFix(
        position_m=position,
        covariance_m2=covariance + attitude_covariance(position, attitude_sigma_rad),
        arc_deg=arc,
        residual_rms_px=float(np.sqrt(np.mean(in_pixels**2))),
        residuals_px=residuals,
        n_used=int(used.sum()),
        terrain=relief is not None,
        remark=f"short arc of limb, {arc:.0f} deg" if arc < SHORT_ARC_DEG else "",
    )


def _on_ellipsoid(
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
    away = distance * float(np.sqrt(1.0 - sine * sine))
    relief = relief_covariance(fit, body, azimuths, away, circle=float(np.arccos(sine)))
    sun_sine = np.ones(len(rays))
    if sun is not None:
        # of the Sun's elevation where the rays touch a sphere
        touch = position - (rays.rays @ position)[:, None] * rays.rays
        sun_sine = touch @ sun / (np.linalg.norm(touch, axis=1) * np.linalg.norm(sun))
    errors = edge_errors(rays, azimuths, sun_sine)
    return position, fit.noise + relief + considered(fit.measured.gain(fit.noise), errors)


def _inverse_rotation_remark(rays: LimbRays, skyline: Skyline, last: Followed, body: Body) -> str:
    """Words for a limb that fits the skyline under the inverse rotation, else none.

    rays  of that rotation
    """
    try:
        start = fit_limb(rays.rays, rays.own_sigmas(), body.radii_m).state
        # the Sun was turned into the picture by the same attitude: what is lit is not known
        inverse = follow(skyline, rays, start, None)
        skyline.check(inverse)
    except NoSolutionError:
        return ""
    if inverse.fit.misfit > INVERSE_MISFIT_SHARE * last.fit.misfit:
        return ""
    return "; it fits the inverse rotation: is the quaternion body_from_camera?"
