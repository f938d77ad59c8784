"""A position from the body's outline alone: its limb, or its disc where that is too small.

Where another body may be in the picture too, each lit disc is taken for the body in turn, and the
one stands whose position puts the other body where the picture shows it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.terrain.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.imagery.picture import Picture
from optnav_cli.measurements.bright_body import lit_blobs, measure_levels, without_blobs
from optnav_cli.measurements.limb_points import LimbPoints, find_limb
from optnav_cli.measurements.shape_moments import is_round
from optnav_cli.measurements.sun_side import doubt_of_sun
from optnav_cli.navigation import brightness_centre, horizon
from optnav_cli.navigation.horizon.shape_limb import stand_off
from optnav_cli.navigation.neighbour import (
    BLUR_PX,
    Disc,
    OtherBody,
    Spot,
    View,
    is_lit,
    is_rather,
    is_seen,
    is_within,
    must_be_seen,
    predicted,
    spots_of,
)
from optnav_cli.solution import OutlineMarks

FloatArray = NDArray[np.float64]

# A disc of a larger radius, rad, is that of a body close by: it is not asked which.
NEAR_ANGLE = 0.25
LEAST_SPOT_PIXELS = 9
MOST_SPOTS = 30  # the largest; the rest are stars
MOST_BODIES = 4  # of them are taken for the body
FARTHEST = 1.5  # from the body, in distances of the other one
ROUGH_SHARE = 0.3  # error of a range from the extent of a spot
# Wider uncertain, the other body's direction speaks for nothing.
WIDEST_SIGMA = 0.06
LEAST_WIDTH_SIGMAS = 3.0  # of a disc over a point


@dataclass(frozen=True, eq=False)
class Outline:
    """A position from the outline.

    method           "horizon", "horizon_sphere" or "brightness_centre"
    position_m       (3,)    body frame;  covariance_m2 (3, 3)
    residual_rms_px  across the limb, of the points used; None for a disc
    n_used           limb points used; None for a disc
    marks            of the outline in the picture, for drawing
    """

    method: str
    position_m: FloatArray
    covariance_m2: FloatArray
    residual_rms_px: float | None
    n_used: int | None
    arc_deg: float | None
    marks: OutlineMarks
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
        relief=stand_off(body),
    )


def navigate(
    picture: Picture,
    camera: Camera,
    camera_from_body: Rotation,
    attitude_sigma_rad: float,
    sun_body: FloatArray,
    body: Body,
    relief: GlobalRelief | None,
    other: OtherBody | None = None,
) -> Outline:
    """The camera's position from the outline; relief of the body where it is known.

    A disc too small for a limb is solved by its brightness centre.
    sun_body (3,) unit vector, body frame;  other  the neighbour that may be in the picture as well.
    Raises NoSolutionError with what the picture shows instead.
    """
    view = View(camera, camera_from_body, attitude_sigma_rad, sun_body)
    alone, reason = None, ""
    try:
        alone = _solve(picture, view, body, relief)
    except NoSolutionError as error:
        reason = str(error)
    if other is not None and (alone is None or _disc(view, body, alone).angle < NEAR_ANGLE):
        return _one_of_two(picture, view, body, relief, other, alone, reason)
    if alone is None:
        raise NoSolutionError(reason)
    return alone


def _one_of_two(
    picture: Picture,
    view: View,
    body: Body,
    relief: GlobalRelief | None,
    other: OtherBody,
    alone: Outline | None,
    reason: str,
) -> Outline:
    """The outline that another body in the picture speaks for, or does not speak against.

    alone, reason  what the picture gives without asking which body it is
    """
    names = f"the {other.name}", f"the {body.name}"
    try:
        levels = measure_levels(picture.values)
    except NoSolutionError:
        raise NoSolutionError(reason) from None
    blobs = lit_blobs(picture.values, levels.threshold)
    spots = spots_of(
        view.camera, blobs, np.flatnonzero(blobs.area >= LEAST_SPOT_PIXELS)[:MOST_SPOTS]
    )
    if alone is not None:
        # lit peaks beyond the terminator are the body's own
        own = _disc(view, body, alone)
        spots = [spot for spot in spots if spot.extent > own.angle or not is_within(spot, own)]
    if len(spots) > 1:
        agreed = []
        for spot in spots[:MOST_BODIES]:
            rest = [one for one in spots if one is not spot]
            if not _may_be(view, body, other, spot, rest):
                continue
            others = [one.label for one in rest]
            try:
                masked = replace(
                    picture, values=without_blobs(picture.values, blobs, others, levels.sky)
                )
                found = _solve(masked, view, body, relief)
            except NoSolutionError:
                continue
            if np.linalg.norm(found.position_m) > FARTHEST * np.linalg.norm(other.centre_m):
                continue
            seen = _other_disc(view, other, found)
            if seen.sigma < WIDEST_SIGMA and any(is_seen(seen, one) for one in rest):
                agreed.append(found)
        if len(agreed) == 1:
            remark = f"{names[0]} is in the picture too, where this position puts it"
            return replace(agreed[0], remark="; ".join(filter(None, (agreed[0].remark, remark))))
        if agreed:
            raise NoSolutionError(
                f"two bodies in the picture: either may be {names[1]}, for each puts {names[0]} "
                "where the other one is"
            )
    if alone is None:
        raise NoSolutionError(reason)
    expected = _other_disc(view, other, alone)
    if must_be_seen(view, expected, _disc(view, body, alone)) and not is_lit(expected, spots):
        x, y = view.camera.project(expected.towards)
        raise NoSolutionError(
            f"if the disc were {names[1]}, {names[0]} should be seen about ({x:.0f}, {y:.0f}) and "
            "is not: another body, or attitude, time or focal length are wrong"
        )
    if is_rather(view, other, alone.position_m, _sigma(alone), body.radius_m):
        raise NoSolutionError(
            f"the disc is where {names[0]} stands as seen from near {names[1]}, and of its size: "
            f"it is {names[0]}, or cannot be told from it"
        )
    return alone


def _may_be(view: View, body: Body, other: OtherBody, spot: Spot, rest: list[Spot]) -> bool:
    """Whether a spot taken for the body puts the other body about where one of the rest is."""
    if spot.extent > NEAR_ANGLE:
        return True
    towards = view.camera_from_body.inv().apply(spot.towards)
    distance = body.radius_m / np.sin(spot.extent)
    blur = BLUR_PX * spot.rad_per_px / spot.extent
    seen = predicted(
        view, other.centre_m, other.radius_m, -distance * towards, (ROUGH_SHARE + blur) * distance
    )
    reach = seen.angle + seen.sigma
    return any(
        float(seen.towards @ one.towards) > np.cos(min(reach + one.extent, np.pi)) for one in rest
    )


def _sigma(found: Outline) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(found.covariance_m2)[-1]))


def _disc(view: View, body: Body, found: Outline) -> Disc:
    return predicted(view, np.zeros(3), body.radius_m, found.position_m, 0.0)


def _other_disc(view: View, other: OtherBody, found: Outline) -> Disc:
    return predicted(view, other.centre_m, other.radius_m, found.position_m, _sigma(found))


def _solve(picture: Picture, view: View, body: Body, relief: GlobalRelief | None) -> Outline:
    """A position from the one body of a picture: by its limb, else by its middle of light."""
    try:
        limb = limb_of(picture, view.camera, view.camera_from_body, view.sun_body, body)
        fix = horizon.navigate(
            limb,
            view.camera,
            view.camera_from_body,
            view.attitude_sigma_rad,
            view.sun_body,
            body,
            relief,
        )
    except NoSolutionError as no_limb:
        doubt = _doubt_of_sun(picture, view, body)
        if doubt:
            raise NoSolutionError(f"{doubt}; {no_limb}") from None
        return _by_centre(picture, view, body, relief, str(no_limb))
    # close to the body the limb's own relief tells a wrong Sun
    doubt = _doubt_of_sun(picture, view, body) if limb.cone_angle < NEAR_ANGLE else ""
    if doubt:
        raise NoSolutionError(f"{doubt}: attitude or time is wrong")
    return Outline(
        "horizon" if fix.terrain else "horizon_sphere",
        fix.position_m,
        fix.covariance_m2,
        fix.residual_rms_px,
        fix.n_used,
        fix.arc_deg,
        OutlineMarks(limb.pixels, limb.inward, fix.residuals_px),
        fix.remark,
    )


def _doubt_of_sun(picture: Picture, view: View, body: Body) -> str:
    """What the lit part of a disc says against the Sun, in words, if anything."""
    if not is_round(body):
        return ""
    try:
        limb = find_limb(picture.values, view.camera, None, saturation=picture.saturation)
    except NoSolutionError:
        return ""
    return doubt_of_sun(limb, view.camera, view.camera_from_body.apply(view.sun_body))


def _by_centre(
    picture: Picture, view: View, body: Body, relief: GlobalRelief | None, why_no_limb: str
) -> Outline:
    """A position from the middle of light of a small disc."""
    try:
        disc = brightness_centre.navigate(
            picture.values,
            view.camera,
            view.camera_from_body,
            view.attitude_sigma_rad,
            view.sun_body,
            body,
            saturation=picture.saturation,
            relief=relief,
        )
    except NoSolutionError as no_disc:
        both = dict.fromkeys((why_no_limb, str(no_disc)))
        raise NoSolutionError("; ".join(both)) from None
    if disc.width_sigmas < LEAST_WIDTH_SIGMAS:
        raise NoSolutionError(
            f"{why_no_limb}; one bright spot, no wider than a point's picture "
            f"({disc.width_sigmas:.1f} sigmas): a star or a planet looks the same"
        )
    return Outline(
        "brightness_centre",
        disc.position_m,
        disc.covariance_m2,
        None,
        None,
        None,
        OutlineMarks.of_disc(disc.centre_px),
        disc.remark,
    )
