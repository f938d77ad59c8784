"""Navigation by the brightness centre of a disc of less than about ten pixels.

Source: Zhukov 2025, ch. 2: the direction to a small body is that of its middle of light, corrected
for the phase; the correction depends on the illumination and hardly on the reflectance law. Ours:
bodies that are no sphere are corrected for their shape too (`light_moments`), and the range comes
from the second moments, which are the disc's and the blur's together. Neither law nor blur is
known, so all that fit are weighed against each other; what they leave is the covariance, along the
line of sight most of all.
"""

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import Evidence, Fix, Method, OutlineMarks
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.segmentation import Segmented
from optnav_cli.outline.disc.moments import (
    compute_light_moments,
    estimate_radius,
    is_round,
    load_disc_sizes,
    measure_disc,
)
from optnav_cli.outline.limb.limb_rays import compute_attitude_covariance
from optnav_cli.outline.neighbour import CameraView
from optnav_cli.reasons import Reason, ReasonCode, format_distinct

MAX_PHASE_DEG = 150.0  # beyond it relief, not the sphere, shapes what is lit
SMALL_PX = 10.0  # across: noise and blur say more of such a disc than how its brightness falls off
MAX_MISFIT = 5.0  # sigmas of the three second moments together
SMALL_ANGLE = 1e-5


def navigate(
    picture: Picture,
    view: CameraView,
    body: Body,
    relief: GlobalRelief | None = None,
    lit: Segmented | None = None,
) -> tuple[Fix, float]:
    """The camera's position from the one small disc in a picture.

    relief  of a body that is no sphere, where it is known
    lit     the picture's lit areas, where they are at hand

    Returns the fix, and by how many sigmas the disc is wider than a point's picture.
    Raises NoSolutionError with what the picture shows instead.
    """
    camera, camera_from_body, sun_body = view.camera, view.camera_from_body, view.sun_body
    disc = measure_disc(lit or Segmented(picture.values), picture.saturation)
    sun = camera_from_body.apply(sun_body)
    towards = camera.unproject(disc.centre)
    phase = float(np.arccos(np.clip(-(towards @ sun), -1.0, 1.0)))
    if np.degrees(phase) > MAX_PHASE_DEG:
        seen, most = format_distinct(float(np.degrees(phase)), MAX_PHASE_DEG, 0)
        raise NoSolutionError(
            f"the phase is {seen} deg: a crescent that thin says little about "
            f"the disc's centre; the limit is {most} deg",
            ReasonCode.THIN_CRESCENT,
        )
    body_from_camera = camera_from_body.inv().as_matrix()
    pixel_from_angle, scale, axes = _differentiate_projection(camera, towards, sun)
    sizes = load_disc_sizes()
    share = np.cos(0.5 * phase) ** 2
    lit_px = 4.0 * np.sqrt(max(0.5 * (disc.second[0] + disc.second[1]), 0.0))  # if lit evenly
    seen_law = sizes.law * np.sin(0.5 * phase) * (1.0 - SMALL_PX / max(lit_px, SMALL_PX))
    shape_sigma = float(np.hypot(sizes.figure, seen_law))
    if not is_round(body):
        shape_sigma = (
            sizes.ellipsoid if relief is None else sizes.relief / share**sizes.shadow_power
        )
    seen = np.vstack([axes, -towards]) @ body_from_camera.T
    moments = compute_light_moments(body, relief, seen, sun_body, phase)
    pixel_from_disc = pixel_from_angle / scale
    size = estimate_radius(disc, pixel_from_disc, moments, shape_sigma, camera.known_blur_px)
    weights, radii = size.weights, size.radii_px
    if size.misfit_sigmas > MAX_MISFIT:
        raise NoSolutionError(
            f"the light of the brightest spot is not spread as that of a disc under this Sun "
            f"({size.misfit_sigmas:.0f} sigmas): a blend of stars, hot pixels, a trail "
            "or another body",
            ReasonCode.WRONG_LIGHT,
        )
    # every radius and law puts the centre elsewhere, and the body at another range
    offsets = np.array([m.offset for m in moments]) @ pixel_from_disc.T
    pixels = disc.centre - offsets[:, None] * radii[:, None]
    rays = camera.unproject(pixels)
    distances = float(np.mean(body.radii_m)) / np.sin(np.arctan(radii / scale))
    places = -rays * distances[:, None]
    position = np.einsum("kn,kni->i", weights, places)
    about = places - position
    covariance = np.einsum("kn,kni,knj->ij", weights, about, about)
    distance = float(np.linalg.norm(position))
    radius = float((weights * radii).sum())
    noise = disc.centre_covariance + (shape_sigma * radius) ** 2 * np.eye(2)
    # change (3, 2) of the unit ray by the pixel
    steps = 0.5 * np.eye(2)
    change = (camera.unproject(disc.centre + steps) - camera.unproject(disc.centre - steps)).T
    across = change * distance
    covariance += across @ noise @ across.T
    share = float(np.sqrt(position @ covariance @ position)) / distance**2
    evidence = Evidence(outline=OutlineMarks.mark_disc(np.einsum("kn,kni->i", weights, pixels)))
    text = f"disc of {2.0 * radius:.1f} px, range to {100.0 * share:.0f} %"
    fix = make_disc_fix(Method.BRIGHTNESS_CENTRE, view, position, covariance, evidence, text)
    return fix, size.width_sigmas


def make_disc_fix(
    method: Method,
    view: CameraView,
    position: FloatArray,
    covariance: FloatArray,
    evidence: Evidence,
    text: str,
) -> Fix:
    """A fix by a small disc from position (3,) and covariance (3, 3), m, in camera axes.

    The attitude's error, which turns the position about the body, is not in the covariance yet.
    """
    covariance = covariance + compute_attitude_covariance(position, view.attitude_sigma_rad)
    turn = view.camera_from_body.inv().as_matrix()
    position_body, spread = turn @ position, turn @ covariance @ turn.T
    reason = Reason(ReasonCode.SMALL_DISC, text)
    return Fix(
        method,
        position_body,
        spread,
        view.camera_from_body,
        view.attitude_sigma_rad,
        evidence,
        reason,
    )


def _differentiate_projection(
    camera: Camera, towards: FloatArray, sun: FloatArray
) -> tuple[FloatArray, float, FloatArray]:
    """Pixels (2, 2) by angle toward the Sun and across, and the px / rad that keep the area.

    And the two directions (2, 3), camera frame.
    """
    along = sun - (sun @ towards) * towards
    length = float(np.linalg.norm(along))
    # with the Sun behind the camera every direction is as good
    along = along / length if length > 1e-9 else np.linalg.svd(towards[None])[2][1]
    axes = np.stack([along, np.cross(towards, along)])
    steps = axes * SMALL_ANGLE
    moved = camera.project(towards + steps) - camera.project(towards - steps)
    matrix = moved.T / (2.0 * SMALL_ANGLE)
    return matrix, float(np.sqrt(abs(np.linalg.det(matrix)))), axes
