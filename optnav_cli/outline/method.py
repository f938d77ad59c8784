"""Choice of the lit disc that is the body when a second body may be in the picture.

Each disc is solved as the body in turn. The fix is kept whose position predicts the other body
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
from optnav_cli.frames.segmentation import Blobs, Segmented, remove_blobs
from optnav_cli.outline import neighbour
from optnav_cli.outline.neighbour import CameraView, OtherBody, PredictedDisc, Spot
from optnav_cli.outline.one_body import NEAR_ANGLE, solve
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode


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
    """Compute the camera's position from the outline; with the body's relief where it is known.

    A disc too small for a limb is solved by its brightness centre.
    sun_body (3,) unit vector, body frame;  other  the neighbour that may be in the picture as well.
    Raises NoSolutionError with what the picture shows instead.
    """
    view = CameraView(camera, camera_from_body, attitude_sigma_rad, sun_body)
    return solve_outline(picture, view, body, relief, other)[0]


def solve_outline(
    picture: Picture,
    view: CameraView,
    body: Body,
    relief: GlobalRelief | None,
    other: OtherBody | None,
) -> tuple[Fix, Picture]:
    """Return the position and the picture that gives it, with the neighbour masked if in view.

    Raises NoSolutionError as `navigate` does.
    """
    alone, reason, lit = None, NO_REASON, Segmented(picture.values)
    try:
        alone = solve(picture, view, body, relief, lit)
    except NoSolutionError as error:
        reason = Reason.from_error(error)
    if other is not None and (alone is None or _predict_disc(view, body, alone).angle < NEAR_ANGLE):
        return _choose_body(picture, view, body, relief, other, lit, alone or reason)
    if alone is None:
        raise reason.error()
    return alone, picture


def _choose_body(
    picture: Picture,
    view: CameraView,
    body: Body,
    relief: GlobalRelief | None,
    other: OtherBody,
    lit: Segmented,
    first: Fix | Reason,
) -> tuple[Fix, Picture]:
    """Choose the outline that another body in the picture confirms or does not contradict.

    lit    the picture's lit areas
    first  what the picture gives without asking which body it is, or why it gives nothing
    """
    alone, reason = (None, first) if isinstance(first, Reason) else (first, NO_REASON)
    names = f"the {other.name}", f"the {body.name}"
    try:
        levels, blobs = lit.levels, lit.blobs
    except NoSolutionError:
        raise reason.error() from None
    # The largest 30; the others are stars.
    large = np.flatnonzero(blobs.area >= 9)[:30]
    spots = neighbour.make_spots(view.camera, blobs, large)
    if alone is not None:
        # lit peaks beyond the terminator are the body's own
        limb = _predict_disc(view, body, alone)
        spots = [s for s in spots if s.extent > limb.angle or not neighbour.is_within(s, limb)]
    if len(spots) > 1:
        consistent = _solve_consistent(picture, view, body, relief, other, blobs, spots, levels.sky)
        if len(consistent) == 1:
            fix, masked = consistent[0]
            text = f"{names[0]} is in the picture too, where this position puts it"
            remark = Reason(ReasonCode.NEIGHBOUR_IN_VIEW, text)
            return replace(fix, reason=fix.reason.add_sentence(remark)), masked
        if consistent:
            raise NoSolutionError(
                f"two bodies in the picture: either may be {names[1]}, for each puts {names[0]} "
                "where the other one is",
                ReasonCode.SEVERAL_BODIES,
            )
    if alone is None:
        raise reason.error()
    expected = _predict_other_disc(view, other, alone)
    seen = neighbour.is_expected_in_view(view, expected, _predict_disc(view, body, alone))
    if seen and not neighbour.is_lit(expected, spots):
        x, y = view.camera.project(expected.towards)
        raise NoSolutionError(
            f"if the disc were {names[1]}, {names[0]} should be seen about ({x:.0f}, {y:.0f}) and "
            "is not: another body, or attitude, time or focal length are wrong",
            ReasonCode.OTHER_BODY,
        )
    position_m, sigma_m = alone.position_m, _get_sigma(alone)
    if neighbour.is_more_likely_neighbour(view, other, position_m, sigma_m, body.radius_m):
        raise NoSolutionError(
            f"the disc is where {names[0]} stands as seen from near {names[1]}, and of its size: "
            f"it is {names[0]}, or cannot be distinguished from it",
            ReasonCode.OTHER_BODY,
        )
    return alone, picture


def _solve_consistent(
    picture: Picture,
    view: CameraView,
    body: Body,
    relief: GlobalRelief | None,
    other: OtherBody,
    blobs: Blobs,
    spots: list[Spot],
    sky: float,
) -> list[tuple[Fix, Picture]]:
    """Solve each spot as the body; keep fixes that predict the other body at another spot."""
    consistent = []
    # The largest four are each taken for the body.
    for spot in spots[:4]:
        others = [candidate for candidate in spots if candidate is not spot]
        if not _is_plausible(view, body, other, spot, others):
            continue
        values = remove_blobs(picture.values, blobs, [candidate.label for candidate in others], sky)
        masked = replace(picture, values=values)
        try:
            fix = solve(masked, view, body, relief)
        except NoSolutionError:
            continue
        # A fix beyond 1.5 times the other body's distance is discarded.
        if np.linalg.norm(fix.position_m) > 1.5 * np.linalg.norm(other.centre_m):
            continue
        seen = _predict_other_disc(view, other, fix)
        # A direction of the other body that is less certain than 0.06 rad decides nothing.
        if seen.sigma < 0.06 and any(neighbour.is_seen(seen, candidate) for candidate in others):
            consistent.append((fix, masked))
    return consistent


def _is_plausible(
    view: CameraView, body: Body, other: OtherBody, spot: Spot, others: list[Spot]
) -> bool:
    """Whether a spot taken for the body puts the other body about where another spot is."""
    if spot.extent > NEAR_ANGLE:
        return True
    towards = view.camera_from_body.inv().apply(spot.towards)
    distance = body.radius_m / np.sin(spot.extent)
    blur = neighbour.SPOT_BLUR_PX * spot.rad_per_px / spot.extent
    # A range from the extent of a spot is 30 % uncertain.
    position, sigma_m = -distance * towards, (0.3 + blur) * distance
    seen = neighbour.predict_disc(view, other.centre_m, other.radius_m, position, sigma_m)
    reach = seen.angle + seen.sigma
    return any(
        float(seen.towards @ candidate.towards) > np.cos(min(reach + candidate.extent, np.pi))
        for candidate in others
    )


def _get_sigma(fix: Fix) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(fix.covariance_m2)[-1]))


def _predict_disc(view: CameraView, body: Body, fix: Fix) -> PredictedDisc:
    return neighbour.predict_disc(view, np.zeros(3), body.radius_m, fix.position_m, 0.0)


def _predict_other_disc(view: CameraView, other: OtherBody, fix: Fix) -> PredictedDisc:
    position, sigma = fix.position_m, _get_sigma(fix)
    return neighbour.predict_disc(view, other.centre_m, other.radius_m, position, sigma)
