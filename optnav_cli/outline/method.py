"""Which lit disc of a picture is the body, where another one may be in the picture too.

Each disc is taken for the body in turn, and the one stands whose position puts the other body
where the picture shows it.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import Fix
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.segmentation import Blobs, Segmented, without_blobs
from optnav_cli.outline import neighbour
from optnav_cli.outline.neighbour import CameraView, OtherBody, PredictedDisc, Spot
from optnav_cli.outline.one_body import NEAR_ANGLE, solve
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

MIN_SPOT_PIXELS = 9
MAX_SPOTS = 30  # the largest; the rest are stars
MAX_BODIES = 4  # of them are taken for the body
FARTHEST = 1.5  # from the body, in distances of the other one
ROUGH_SHARE = 0.3  # error of a range from the extent of a spot
# A less certain direction of the other body decides nothing.
MAX_SIGMA = 0.06


def navigate(
    picture: Picture,
    camera: Camera,
    camera_from_body: Rotation,
    attitude_sigma_rad: float,
    sun_body: FloatArray,
    body: Body,
    relief: GlobalRelief | None,
    other: OtherBody | None = None,
) -> Fix:
    """The camera's position from the outline; relief of the body where it is known.

    A disc too small for a limb is solved by its brightness centre.
    sun_body (3,) unit vector, body frame;  other  the neighbour that may be in the picture as well.
    Raises NoSolutionError with what the picture shows instead.
    """
    view = CameraView(camera, camera_from_body, attitude_sigma_rad, sun_body)
    return outline_of(picture, view, body, relief, other)[0]


def outline_of(
    picture: Picture,
    view: CameraView,
    body: Body,
    relief: GlobalRelief | None,
    other: OtherBody | None,
) -> tuple[Fix, Picture]:
    """The position, and the picture that gives it: with sky in place of the neighbour if it shows.

    Raises NoSolutionError as `navigate` does.
    """
    alone, reason, lit = None, NO_REASON, Segmented(picture.values)
    try:
        alone = solve(picture, view, body, relief, lit)
    except NoSolutionError as error:
        reason = Reason.of(error)
    if other is not None and (alone is None or _disc(view, body, alone).angle < NEAR_ANGLE):
        return _one_of_two(picture, view, body, relief, other, lit, alone or reason)
    if alone is None:
        raise reason.error()
    return alone, picture


def _one_of_two(
    picture: Picture,
    view: CameraView,
    body: Body,
    relief: GlobalRelief | None,
    other: OtherBody,
    lit: Segmented,
    first: Fix | Reason,
) -> tuple[Fix, Picture]:
    """The outline that another body in the picture confirms, or does not contradict.

    lit    the picture's lit areas
    first  what the picture gives without asking which body it is, or why it gives nothing
    """
    alone, reason = (None, first) if isinstance(first, Reason) else (first, NO_REASON)
    names = f"the {other.name}", f"the {body.name}"
    try:
        levels, blobs = lit.levels, lit.blobs
    except NoSolutionError:
        raise reason.error() from None
    large = np.flatnonzero(blobs.area >= MIN_SPOT_PIXELS)[:MAX_SPOTS]
    spots = neighbour.spots_of(view.camera, blobs, large)
    if alone is not None:
        # lit peaks beyond the terminator are the body's own
        own = _disc(view, body, alone)
        spots = [s for s in spots if s.extent > own.angle or not neighbour.is_within(s, own)]
    if len(spots) > 1:
        agreed = _agreed(picture, view, body, relief, other, blobs, spots, levels.sky)
        if len(agreed) == 1:
            found, masked = agreed[0]
            text = f"{names[0]} is in the picture too, where this position puts it"
            remark = Reason(ReasonCode.NEIGHBOUR_IN_VIEW, text)
            return replace(found, reason=found.reason.followed_by(remark)), masked
        if agreed:
            raise NoSolutionError(
                f"two bodies in the picture: either may be {names[1]}, for each puts {names[0]} "
                "where the other one is",
                ReasonCode.SEVERAL_BODIES,
            )
    if alone is None:
        raise reason.error()
    expected = _other_disc(view, other, alone)
    seen = neighbour.must_be_seen(view, expected, _disc(view, body, alone))
    if seen and not neighbour.is_lit(expected, spots):
        x, y = view.camera.project(expected.towards)
        raise NoSolutionError(
            f"if the disc were {names[1]}, {names[0]} should be seen about ({x:.0f}, {y:.0f}) and "
            "is not: another body, or attitude, time or focal length are wrong",
            ReasonCode.OTHER_BODY,
        )
    place, sigma = alone.position_m, _sigma(alone)
    if neighbour.is_more_likely_neighbour(view, other, place, sigma, body.radius_m):
        raise NoSolutionError(
            f"the disc is where {names[0]} stands as seen from near {names[1]}, and of its size: "
            f"it is {names[0]}, or cannot be distinguished from it",
            ReasonCode.OTHER_BODY,
        )
    return alone, picture


def _agreed(
    picture: Picture,
    view: CameraView,
    body: Body,
    relief: GlobalRelief | None,
    other: OtherBody,
    blobs: Blobs,
    spots: list[Spot],
    sky: float,
) -> list[tuple[Fix, Picture]]:
    """The outline of each spot taken for the body that puts the other body where a spot is."""
    agreed = []
    for spot in spots[:MAX_BODIES]:
        rest = [one for one in spots if one is not spot]
        if not _may_be(view, body, other, spot, rest):
            continue
        values = without_blobs(picture.values, blobs, [one.label for one in rest], sky)
        masked = replace(picture, values=values)
        try:
            found = solve(masked, view, body, relief)
        except NoSolutionError:
            continue
        if np.linalg.norm(found.position_m) > FARTHEST * np.linalg.norm(other.centre_m):
            continue
        seen = _other_disc(view, other, found)
        if seen.sigma < MAX_SIGMA and any(neighbour.is_seen(seen, one) for one in rest):
            agreed.append((found, masked))
    return agreed


def _may_be(view: CameraView, body: Body, other: OtherBody, spot: Spot, rest: list[Spot]) -> bool:
    """Whether a spot taken for the body puts the other body about where one of the rest is."""
    if spot.extent > NEAR_ANGLE:
        return True
    towards = view.camera_from_body.inv().apply(spot.towards)
    distance = body.radius_m / np.sin(spot.extent)
    blur = neighbour.SPOT_BLUR_PX * spot.rad_per_px / spot.extent
    place, sigma_m = -distance * towards, (ROUGH_SHARE + blur) * distance
    seen = neighbour.predicted(view, other.centre_m, other.radius_m, place, sigma_m)
    reach = seen.angle + seen.sigma
    return any(
        float(seen.towards @ one.towards) > np.cos(min(reach + one.extent, np.pi)) for one in rest
    )


def _sigma(found: Fix) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(found.covariance_m2)[-1]))


def _disc(view: CameraView, body: Body, found: Fix) -> PredictedDisc:
    return neighbour.predicted(view, np.zeros(3), body.radius_m, found.position_m, 0.0)


def _other_disc(view: CameraView, other: OtherBody, found: Fix) -> PredictedDisc:
    position, sigma = found.position_m, _sigma(found)
    return neighbour.predicted(view, other.centre_m, other.radius_m, position, sigma)
