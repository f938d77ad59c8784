"""A position from the outline of the one body in a picture: its limb, or its small disc.

A limb is lit where its surface faces the Sun, so the middle of the lit arc is on the Sun's side.
The cusps that end the arc are rough by relief; an arc that the frame or structure ends is less
certain. Of a whole disc the Sun lights a share that the phase alone decides.

A sphere's disc of five to twenty-five pixels' radius has a limb, but too few pixels about it for
profiles. All its pixels are fitted at once (`fit_disc`), which is several times as accurate as the
limb alone, with an honest covariance. This is ours.
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.geometry.vectors import perpendicular_basis, unit
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import Evidence, Fix, Method, OutlineMarks
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.segmentation import Segmented
from optnav_cli.outline.disc import brightness_centre
from optnav_cli.outline.disc.brightness_centre import make_disc_fix
from optnav_cli.outline.disc.fit import ABOUT_PX, fit_disc, rad_per_px
from optnav_cli.outline.disc.moments import MAX_SMALL_DISC_PX, is_round, load_disc_sizes
from optnav_cli.outline.limb import method as horizon
from optnav_cli.outline.limb.detection import LimbPoints, find_limb
from optnav_cli.outline.limb.ground_skyline import estimate_relief_fraction, is_shape
from optnav_cli.outline.neighbour import CameraView
from optnav_cli.outline.silhouette import method as silhouette
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

# A disc of a larger radius, rad, is that of a body close by: it is not asked which.
NEAR_ANGLE = 0.25


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
        return _solve_by_centre(Reason.from_error(no_limb), picture, view, body, relief, lit)
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
    if is_round(body) and _is_small_disc(limb, view.camera):
        return _fit_small_disc(picture, view, body, limb)
    radius_px = limb.cone_angle / rad_per_px(view.camera, limb.cone_axis_camera)
    # Up to 20 px the light of a body of known shape and uniform ground is more accurate than its
    # limb: to 0.005 radii up to a phase of 80 deg, to 0.02 at 120.
    if relief is None or is_round(body) or radius_px > 20.0:
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
    if width_sigmas < 3.0:
        remedy = "a nearer picture or a longer lens tells"
        if view.camera.known_blur_px is None:
            remedy = "a blur calibrated in the camera file (psf_sigma_px) would tell more"
        raise NoSolutionError(
            f"{no_limb}; one bright spot, no wider than a point's picture "
            f"({width_sigmas:.1f} sigmas): a star or a planet looks the same; {remedy}",
            ReasonCode.POINT_SOURCE,
        )
    return fix


@dataclass(frozen=True)
class SunSide:
    """Angle between the lit side seen and the Sun's, about the body's centre, rad.

    sigma  its 1-sigma error; pi where picture or Sun has no side
    """

    angle: float
    sigma: float

    @property
    def disagrees(self) -> bool:
        """Whether the two are further apart than their error allows."""
        return self.angle > 3.0 * self.sigma


def measure_sun_side(limb: LimbPoints, rays: FloatArray, sun_camera: FloatArray) -> SunSide:
    """Compare the lit side of a limb with the Sun's direction.

    limb        found without the Sun, which else would have chosen the side
    rays        (n, 3) unit rays of its points, camera frame
    sun_camera  (3,) unit vector to the Sun
    """
    axis = limb.cone_axis_camera
    outward = rays - (rays @ axis)[:, None] * axis
    seen = unit(outward).mean(axis=0)
    expected = sun_camera - (sun_camera @ axis) * axis
    sine = float(np.linalg.norm(expected))
    # Too short an arc of limb, or one lit all round, has no side; nor has a Sun within 3 deg of the
    # line to the body's centre.
    sided = 100.0 <= limb.arc_deg <= 300.0 and np.linalg.norm(seen) > 0.0
    if not sided or sine < 0.05:
        return SunSide(0.0, float(np.pi))
    cosine = float(seen @ expected / (np.linalg.norm(seen) * sine))
    # The middle of an arc that ends at the cusps was 1.5 deg off rms, 3.3 at most, on 17 rendered
    # discs of 60 to 710 px radius at phases of 26 to 103 deg. The frame may have ended others.
    sigma = np.radians(35.0) if limb.cut_by_frame else np.radians(5.0)
    # as the Sun nears the line of sight the cusps spread and the side blurs
    return SunSide(float(np.arccos(np.clip(cosine, -1.0, 1.0))), float(min(sigma / sine, np.pi)))


def measure_lit_share(limb: LimbPoints, camera: Camera) -> float | None:
    """Measure a whole disc's lit share; None where the frame cuts it or it is too small or near.

    limb  of a sphere, found without the Sun
    """
    # Of a body so close (0.25 rad) a cap is seen, whose lit share is another.
    if limb.cone_angle > 0.25:
        return None
    axis = limb.cone_axis_camera
    u, v = perpendicular_basis(axis)
    turn = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)[:, None]
    outward = np.cos(turn) * u + np.sin(turn) * v
    rim = camera.project(np.cos(limb.cone_angle) * axis + np.sin(limb.cone_angle) * outward)
    if limb.cut_by_frame or not camera.contains(rim).all():
        return None
    x, y = (rim - rim[0]).T
    area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
    radius = float(np.sqrt(area / np.pi))
    if radius < 8.0:
        return None
    # Blur widens a small disc by about a pixel.
    return limb.lit_pixels / (area * (1.0 + 1.0 / radius) ** 2)


def describe_wrong_sun(limb: LimbPoints, camera: Camera, sun_camera: FloatArray) -> str:
    """Describe how a limb contradicts the stated Sun; empty when it does not.

    limb        of a sphere, found without the Sun, which else would have chosen the side
    sun_camera  (3,) unit vector to the Sun
    """
    side = measure_sun_side(limb, camera.unproject(limb.pixels), sun_camera)
    if side.disagrees:
        return (
            f"the lit side of the body is {np.degrees(side.angle):.0f} deg from where attitude "
            f"and time put the Sun (sigma {np.degrees(side.sigma):.0f} deg)"
        )
    share = measure_lit_share(limb, camera)
    expected = 0.5 * (1.0 - float(limb.cone_axis_camera @ sun_camera))
    # On the discs of `measure_sun_side` the lit share was 0.03 rms off the phase's, 0.05 at most,
    # by the threshold and by shadows at the terminator.
    if share is not None and abs(share - expected) > 0.12:
        return (
            f"{100.0 * share:.0f} % of the disc is lit, and {100.0 * expected:.0f} % should be by "
            "the Sun of this attitude and time"
        )
    return ""


# Of 100 drawn discs the misfit was 0.7-1.1 under their own Sun, and over 1.25 or without a solution
# under one turned by 45 or 180 deg about the line of sight from a phase of 15 deg on. Ground of two
# kinds may cost as much, so that only the larger one refuses.
TRUSTED_MISFIT, MAX_MISFIT = 1.2, 3.0
STEP_PX = 0.01


def _is_small_disc(limb: LimbPoints, camera: Camera) -> bool:
    """Whether a disc is small enough, and whole in the picture with its surroundings."""
    radius_px = limb.cone_angle / rad_per_px(camera, limb.cone_axis_camera)
    margin = radius_px + ABOUT_PX + 2.0
    pixel = camera.project(limb.cone_axis_camera)
    return radius_px < MAX_SMALL_DISC_PX and bool(camera.contains(pixel, margin))


def _fit_small_disc(picture: Picture, view: CameraView, body: Body, limb: LimbPoints) -> Fix | None:
    """Fit all pixels of a small disc whose limb was found.

    Returns None where the light leaves a doubt about a sphere under this Sun: the limb is better.
    Raises NoSolutionError for a disc whose light is not that of a sphere under this Sun.
    """
    camera, sun = view.camera, view.camera_from_body.apply(view.sun_body)
    per_px = rad_per_px(camera, limb.cone_axis_camera)
    fit = fit_disc(
        picture.values, camera, limb.cone_axis_camera, limb.cone_angle, sun, picture.saturation
    )
    if fit.misfit > MAX_MISFIT:
        raise NoSolutionError(
            f"the disc's light is {fit.misfit:.1f} times as far from that of a sphere under the "
            "Sun of attitude and time as noise explains: one of these is wrong, or another body",
            ReasonCode.WRONG_LIGHT,
        )
    if fit.misfit > TRUSTED_MISFIT:
        return None

    def locate(state: FloatArray) -> FloatArray:
        ray = camera.unproject(state[:2])
        position: FloatArray = -ray * body.radius_m / np.sin(state[2] * per_px)
        return position

    state = np.append(fit.centre_px, fit.radius_px)
    steps = STEP_PX * np.eye(3)
    change = np.stack([locate(state + s) - locate(state - s) for s in steps], axis=1) / (
        2 * STEP_PX
    )
    position = locate(state)
    lit = 0.5 * (1.0 + float(position @ sun) / float(np.linalg.norm(position)))
    # the figure moves the fitted centre and radius; shadows on its ground do more as the lit share
    # shrinks
    sizes = load_disc_sizes()
    shape_px = sizes.figure * fit.radius_px / max(lit, 0.1)
    spread = fit.covariance + (shape_px**2 + sizes.drawing_px**2) * np.eye(3)
    covariance = change @ spread @ change.T
    marks = OutlineMarks(limb.pixels, limb.inward, np.zeros(len(limb)))
    evidence = Evidence(n_limb=len(limb), arc_deg=limb.arc_deg, outline=marks)
    text = f"disc of {2.0 * fit.radius_px:.1f} px fitted whole"
    return make_disc_fix(Method.HORIZON_SPHERE, view, position, covariance, evidence, text)
