"""A position from the body's outline alone: its limb, or its disc where that is too small."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.terrain.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.imagery.picture import Picture
from optnav_cli.measurements.limb_points import LimbPoints, find_limb
from optnav_cli.navigation import brightness_centre, horizon

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Outline:
    """A position from the outline.

    method           "horizon", "horizon_sphere" or "brightness_centre"
    position_m       (3,)    body frame;  covariance_m2 (3, 3)
    residual_rms_px  across the limb, of the points used; None for a disc
    n_used           limb points used; None for a disc
    limb_px          (n, 2)  limb points, or the disc's centre, for drawing
    """

    method: str
    position_m: FloatArray
    covariance_m2: FloatArray
    residual_rms_px: float | None
    n_used: int | None
    arc_deg: float | None
    limb_px: FloatArray
    remark: str


def limb_of(
    picture: Picture, camera: Camera, camera_from_body: Rotation, sun_body: FloatArray, body: Body
) -> LimbPoints:
    """The lit limb under an attitude. Raises NoSolutionError when the picture shows none."""
    body_from_camera = camera_from_body.as_matrix().T
    return find_limb(
        picture.values,
        camera,
        camera_from_body.apply(sun_body),
        saturation=picture.saturation,
        stretch=body_from_camera / np.array(body.radii_m)[:, None],
    )


def navigate(
    picture: Picture,
    camera: Camera,
    camera_from_body: Rotation,
    attitude_sigma_rad: float,
    sun_body: FloatArray,
    body: Body,
    relief: GlobalRelief | None,
) -> Outline:
    """The camera's position from the outline; relief of the body where it is known.

    A disc too small for a limb is solved by its brightness centre.
    sun_body (3,) unit vector, body frame. Raises NoSolutionError with what the picture shows
    instead.
    """
    try:
        limb = limb_of(picture, camera, camera_from_body, sun_body, body)
    except NoSolutionError as no_limb:
        try:
            disc = brightness_centre.navigate(
                picture.values,
                camera,
                camera_from_body,
                attitude_sigma_rad,
                sun_body,
                body,
                saturation=picture.saturation,
            )
        except NoSolutionError as no_disc:
            raise NoSolutionError(f"{no_limb}; {no_disc}") from None
        return Outline(
            "brightness_centre",
            disc.position_m,
            disc.covariance_m2,
            None,
            None,
            None,
            disc.centre_px[None],
            disc.remark,
        )
    fix = horizon.navigate(
        limb, camera, camera_from_body, attitude_sigma_rad, sun_body, body, relief
    )
    return Outline(
        "horizon" if fix.terrain else "horizon_sphere",
        fix.position_m,
        fix.covariance_m2,
        fix.residual_rms_px,
        fix.n_used,
        fix.arc_deg,
        limb.pixels,
        fix.remark,
    )
