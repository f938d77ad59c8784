"""A position from the outline of the one body in a picture: its limb, or its small disc."""

from contextlib import suppress

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import Fix
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.segmentation import Segmented
from optnav_cli.outline.disc import brightness_centre, whole_disc
from optnav_cli.outline.disc.fit import rad_per_px
from optnav_cli.outline.disc.moments import is_round
from optnav_cli.outline.limb import method as horizon
from optnav_cli.outline.limb.detection import LimbPoints, find_limb
from optnav_cli.outline.limb.shape_skyline import estimate_relief_fraction, is_shape
from optnav_cli.outline.limb.sun_check import describe_wrong_sun
from optnav_cli.outline.neighbour import CameraView
from optnav_cli.outline.silhouette import method as silhouette
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

# A disc of a larger radius, rad, is that of a body close by: it is not asked which.
NEAR_ANGLE = 0.25
MIN_WIDTH_SIGMAS = 3.0  # of a disc over a point
# Radius up to which the light of a body of known shape, whose ground is of one kind, says more than
# its limb: to 0.005 radii up to a phase of 80 deg, to 0.02 at 120.
KNOWN_SHAPE_PX = 20.0


def detect_limb(
    picture: Picture,
    camera: Camera,
    camera_from_body: Rotation,
    sun_body: FloatArray,
    body: Body,
    lit: Segmented | None = None,
) -> LimbPoints:
    """The lit limb under an attitude. Raises NoSolutionError when the picture shows none.

    lit  the picture's lit areas, where they are at hand
    """
    body_from_camera = camera_from_body.as_matrix().T
    return find_limb(
        picture.values,
        camera,
        camera_from_body.apply(sun_body),
        saturation=picture.saturation,
        stretch=body_from_camera / np.array(body.radii_m)[:, None],
        relief=estimate_relief_fraction(body),
        lit=lit,
    )


def solve(
    picture: Picture,
    view: CameraView,
    body: Body,
    relief: GlobalRelief | None,
    lit: Segmented | None = None,
) -> Fix:
    """A position from the one body of a picture: by its limb, else by its middle of light.

    lit  the picture's lit areas, where they are at hand
    """
    lit = lit or Segmented(picture.values)
    camera, turn, sun = view.camera, view.camera_from_body, view.sun_body
    try:
        limb = detect_limb(picture, camera, turn, sun, body, lit)
        fix = horizon.navigate(limb, camera, turn, view.attitude_sigma_rad, sun, body, relief)
    except NoSolutionError as no_limb:
        doubt = _check_sun(picture, view, body, lit)
        if doubt:
            raise NoSolutionError(f"{doubt}; {no_limb}", ReasonCode.WRONG_LIGHT) from None
        if relief is not None and is_shape(relief):
            with suppress(NoSolutionError):
                return silhouette.navigate(picture, view, body, relief, lit)
        return _solve_by_centre(Reason.of(no_limb), picture, view, body, relief, lit)
    small = _solve_by_disc(picture, view, body, relief, limb, lit)
    if small is not None:
        return small
    # close to the body a wrong Sun shows in the fit of the limb's relief
    doubt = _check_sun(picture, view, body, lit) if limb.cone_angle < NEAR_ANGLE else ""
    if doubt:
        raise NoSolutionError(f"{doubt}: attitude or time is wrong", ReasonCode.WRONG_LIGHT)
    return fix


def _solve_by_disc(
    picture: Picture,
    view: CameraView,
    body: Body,
    relief: GlobalRelief | None,
    limb: LimbPoints,
    lit: Segmented,
) -> Fix | None:
    """A position from all of a small disc; None for one whose limb is the better measurement.

    Raises NoSolutionError for a sphere's disc that cannot be lit by this Sun.
    """
    if is_round(body) and whole_disc.is_for(limb, view.camera):
        return whole_disc.navigate(picture, view, body, limb)
    radius_px = limb.cone_angle / rad_per_px(view.camera, limb.cone_axis_camera)
    if relief is None or is_round(body) or radius_px > KNOWN_SHAPE_PX:
        return None
    with suppress(NoSolutionError):
        return _solve_by_centre(NO_REASON, picture, view, body, relief, lit)
    return None


def _check_sun(picture: Picture, view: CameraView, body: Body, lit: Segmented) -> str:
    """Describe how the lit part of a disc contradicts the Sun; empty when it does not."""
    if not is_round(body):
        return ""
    try:
        limb = find_limb(picture.values, view.camera, None, saturation=picture.saturation, lit=lit)
    except NoSolutionError:
        return ""
    return describe_wrong_sun(limb, view.camera, view.camera_from_body.apply(view.sun_body))


def _solve_by_centre(
    no_limb: Reason,
    picture: Picture,
    view: CameraView,
    body: Body,
    relief: GlobalRelief | None,
    lit: Segmented,
) -> Fix:
    """A position from the middle of light of a small disc."""
    try:
        fix, width_sigmas = brightness_centre.navigate(picture, view, body, relief, lit)
    except NoSolutionError as no_disc:
        if str(no_disc) == no_limb.text:
            raise
        # of a disc too small for a limb the centre says why
        code = no_disc.code if no_limb.code == ReasonCode.SMALL_DISC else no_limb.code
        raise NoSolutionError(f"{no_limb}; {no_disc}", code) from None
    if width_sigmas < MIN_WIDTH_SIGMAS:
        remedy = "a nearer picture or a longer lens tells"
        if view.camera.known_blur_px is None:
            remedy = "a blur calibrated in the camera file (psf_sigma_px) would tell more"
        raise NoSolutionError(
            f"{no_limb}; one bright spot, no wider than a point's picture "
            f"({width_sigmas:.1f} sigmas): a star or a planet looks the same; {remedy}",
            ReasonCode.POINT_SOURCE,
        )
    return fix
