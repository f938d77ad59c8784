"""Navigation by control points: predict, match from coarse to fine, resect, and again.

Source: Zhukov 2025, ch. 3 (steps of the method); the passes over the whole frame are ours: every
pass searches all points at the level that the present pose uncertainty allows, and solves the
pose before the next pass searches finer.
"""

from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.control_point import ControlPoint
from catalog.correlation.similarity import Matcher
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.models.points import Pose
from optnav_cli.estimation.resection import Resection
from optnav_cli.matching.picture_pyramid import PicturePyramid
from optnav_cli.matching.point_match import PointMatch
from optnav_cli.matching.visibility import View
from optnav_cli.navigation.control_points.acceptance import (
    MAX_PART_FACTOR,
    MAX_VARIANCE_FACTOR,
    MIN_DECADES,
    MIN_NEAR_DECADES,
    NEAR_POSTINGS,
    decades_of_parts,
    log10_false_alarms,
    rejection_of_matches,
    rejection_of_place,
)
from optnav_cli.navigation.control_points.error_model import footprints, own_shares
from optnav_cli.navigation.control_points.expectation import (
    FrameContext,
    expected,
    select_evenly,
    why_nothing_in_view,
)
from optnav_cli.navigation.control_points.field import ControlPointField
from optnav_cli.navigation.control_points.solve import Prior, match_all, search_postings, solve
from optnav_cli.navigation.settings import NavigateSettings

# The pose stands still when a pass moves it by less than this share of its sigma.
SETTLED_SIGMAS = 0.1


class UnsolvedFrameError(NoSolutionError):
    """A picture gave no position; `tried` are the control points of the last pass."""

    def __init__(self, reason: str, tried: "list[TriedPoint]") -> None:
        super().__init__(reason)
        self.tried = tried


@dataclass(frozen=True)
class TriedPoint:
    """One expected control point after the last pass; `index` is its place in the field."""

    index: int
    catalog: str
    point: ControlPoint
    predicted_px: FloatArray
    sun_elevation_deg: float
    match: PointMatch
    used: bool
    residual_px: FloatArray | None
    reason: str


@dataclass(frozen=True)
class ControlPointFix:
    """A solved frame; `remark` says what a reader of the row should know."""

    solution: Resection
    tried: list[TriedPoint]
    remark: str = ""


def navigate(
    picture: PicturePyramid,
    camera: Camera,
    prior: Prior,
    sun_body: FloatArray,
    points: ControlPointField,
    settings: NavigateSettings,
    matcher: Matcher,
) -> ControlPointFix:
    """Find the camera's pose from the control points in a picture.

    sun_body (3,) unit vector to the Sun, body frame. The prior limits the search and starts the
    iteration; its position is no part of the estimate.

    Raises UnsolvedFrameError with the reason when the picture gives no position.
    """
    frame = FrameContext(picture, camera, sun_body, points, settings, matcher)
    pose = prior.pose
    covariance = _prior_covariance(prior, settings)
    solution: Resection | None = None
    tried: list[TriedPoint] = []
    previous_finest = False
    searched_postings = np.inf
    for number in range(settings.solve.max_passes):
        first = number == 0
        view = expected(frame, pose, whole=not first)
        most = settings.solve.max_first_pass_points if first else settings.solve.max_points
        view = select_evenly(view, most)
        if len(view) == 0:
            reason = why_nothing_in_view(frame, pose)
            raise UnsolvedFrameError(reason, tried)
        if first:
            searched_postings = search_postings(frame, view, pose, covariance)
        matches, at_finest = match_all(frame, view, pose, covariance)
        believed = [k for k, match in enumerate(matches) if not match.reason]
        tried = _tried(points, view, matches, None, believed)
        try:
            solution = solve(frame, view, matches, believed, pose, prior)
        except NoSolutionError as error:
            reason = f"{error} ({len(believed)} of {len(view)} matched)"
            raise UnsolvedFrameError(reason, tried) from error
        tried = _tried(points, view, matches, solution, believed)
        step = solution.pose.position_m - pose.position_m
        pose = solution.pose
        position_covariance = solution.position_covariance_m2
        doubt = rejection_of_place(
            pose, position_covariance, prior.pose.position_m, prior.position_covariance_m2
        )
        if doubt:
            raise UnsolvedFrameError(doubt, _tried(points, view, matches, None, believed))
        covariance = _full_covariance(solution)
        moved = float(np.sqrt(step @ np.linalg.solve(position_covariance, step)))
        if at_finest and ((previous_finest and moved < 1.0) or moved < SETTLED_SIGMAS):
            break
        previous_finest = at_finest
    if solution is None:
        raise UnsolvedFrameError("no pass was made", tried)
    searched = sum(t.match.score is not None for t in tried)
    used = [t for t in tried if t.used]
    decades = _decades(frame, pose, used, searched, searched_postings)
    parts = all(t.match.part is not None for t in used)
    near = parts and searched_postings <= NEAR_POSTINGS
    least = MIN_NEAR_DECADES if near else MIN_DECADES
    scatter = MAX_PART_FACTOR if parts else MAX_VARIANCE_FACTOR
    doubt = rejection_of_matches(solution, decades, searched, least, scatter)
    if doubt:
        raise UnsolvedFrameError(doubt, [replace(t, used=False, reason=doubt) for t in tried])
    return ControlPointFix(solution, tried)


def _prior_covariance(prior: Prior, settings: NavigateSettings) -> FloatArray:
    sigma = prior.attitude_sigma_rad
    turn = np.radians(settings.solve.free_attitude_deg) if sigma is None else sigma
    full = np.diag([0.0] * 3 + [turn**2] * 3)
    full[:3, :3] = prior.position_covariance_m2
    return full


def _full_covariance(solution: Resection) -> FloatArray:
    solved = solution.covariance
    full = np.zeros((6, 6))
    full[: len(solved), : len(solved)] = solved
    return full


def _sample_m(frame: FrameContext, pose: Pose, tried: TriedPoint) -> float:
    """Ground sample distance at a point, m, along the picture plane."""
    distance = float(np.linalg.norm(tried.point.xyz_m - pose.position_m))
    return distance / frame.camera.focal_length_px


def _decades(
    frame: FrameContext,
    pose: Pose,
    used: list[TriedPoint],
    searched: int,
    searched_postings: float,
) -> float:
    """What speaks against chance for the used points, powers of ten."""
    whole = [t for t in used if t.match.part is None]
    cut = [(t.match.score or 0.0, t.match.part) for t in used if t.match.part is not None]
    decades = 0.0
    if whole:
        template = min(_template_side(frame, pose, t) for t in whole)
        scores = [t.match.score or 0.0 for t in whole]
        decades += log10_false_alarms(scores, searched - len(cut), template)
    if cut:
        strengths = [score * np.sqrt(part.samples) for score, part in cut]
        size_px = frame.camera.width_px, frame.camera.height_px
        shares = own_shares(footprints([part for _, part in cut], size_px))
        decades += decades_of_parts(strengths, shares, searched - len(whole), searched_postings)
    return decades


def _template_side(frame: FrameContext, pose: Pose, tried: TriedPoint) -> int:
    """Side of the template that a point was matched with, nodes."""
    posting = float(frame.points.postings_m(tried.index)[tried.match.level])
    known = float(frame.points.finest_postings_m(np.array([tried.index]))[0])
    return frame.template_nodes(posting, _sample_m(frame, pose, tried), known)


def _tried(
    points: ControlPointField,
    view: View,
    matches: list[PointMatch],
    solution: Resection | None,
    believed: list[int],
) -> list[TriedPoint]:
    place = {k: i for i, k in enumerate(believed)}
    rows = []
    for k, match in enumerate(matches):
        used, residual, reason = False, None, match.reason
        if solution is not None and k in place:
            used = bool(solution.used[place[k]])
            residual = solution.residuals_px[place[k]]
            reason = "" if used else "disagrees with the others"
        predicted = view.pixels[k]
        if match.pixel is not None and residual is not None:
            predicted = match.pixel - residual
        index = int(view.index[k])
        rows.append(
            TriedPoint(
                index,
                points.name(index)[0],
                points.point(index),
                predicted,
                float(view.sun_elevation_deg[k]),
                match,
                used,
                residual,
                reason,
            )
        )
    return rows
