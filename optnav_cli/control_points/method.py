"""Navigation by control points: predict, match from coarse to fine, resect, and again.

Source: Zhukov 2025, ch. 3 (steps of the method); the passes over the whole frame are ours: every
pass searches all points at the level that the present pose uncertainty allows, and solves the
pose before the next pass searches finer.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from scipy.linalg import block_diag

from catalog.correlation.filters import (
    blur_nodes,
    choose_thinning,
    crop,
    downsample_blurred,
)
from catalog.correlation.similarity import Matcher
from catalog.errors import NoSolutionError
from catalog.geometry.vectors import squared_distance, unit
from optnav_cli.control_points import acceptance
from optnav_cli.control_points.acceptance import (
    PROOF_NODES,
    compute_evidence_shares,
    draw_footprints,
    drop_disproven,
)
from optnav_cli.control_points.expectation import (
    ExpectedPoints,
    FrameContext,
    explain_empty_view,
    find_expected,
    select_evenly,
)
from optnav_cli.control_points.field import ControlPointField
from optnav_cli.control_points.picture_pyramid import PicturePyramid
from optnav_cli.control_points.point_match import CHANCE_NODES_PER_SAMPLE, MARGIN_NODES, PointMatch
from optnav_cli.control_points.settings import NavigateSettings
from optnav_cli.control_points.solve import (
    list_accepted,
    match_all,
    match_few,
    plan_search,
    solve,
)
from optnav_cli.estimation.models.points import Pose, predict
from optnav_cli.estimation.resection import Resection
from optnav_cli.fix import (
    Evidence,
    Fix,
    GateMargins,
    MatchRow,
    Method,
    PositionPrior,
    UnsolvedFrameError,
)
from optnav_cli.frames.folder import Observation
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

# The pose stands still when a pass moves it by less than this share of its sigma, or the points in
# the picture by so little (rms, nodes of their levels) that the next one would compare the same
# pixels: a tenth of the way is left to it, below the 0.006 nodes that a frame has in common.
SETTLED_SIGMAS, SETTLED_NODES = 0.1, 0.05
# With fewer points there is no position, whatever is known of the attitude.
FEWEST = 2
NO_POINTS = Evidence(n_predicted=0, n_matched=0, n_used=0)
OUTLIER = Reason(ReasonCode.OUTLIER, "disagrees with the others")


@dataclass(frozen=True, eq=False)
class _Pass:
    """All points of a frame searched once from one pose, and the pose that they gave.

    moved              how far that is from the pose before, sigmas
    moved_nodes        and the points in the picture, rms, nodes of their levels
    searched_postings  how far the points were searched, postings of the terrain model
    """

    view: ExpectedPoints
    matches: list[PointMatch]
    solution: Resection
    evidence: Evidence
    moved: float
    moved_nodes: float
    at_finest: bool
    searched_postings: float

    @property
    def used(self) -> list[int]:
        """Which of the points the solution keeps."""
        return list(compress(list_accepted(self.matches), self.solution.used))

    @property
    def chosen(self) -> dict[int, int]:
        """Level by point: the best one, once the finest were searched."""
        if not self.at_finest:
            return {}
        return {int(self.view.index[k]): self.matches[k].level for k in list_accepted(self.matches)}


def navigate(
    observation: Observation,
    prior: PositionPrior,
    points: ControlPointField,
    settings: NavigateSettings,
    matcher: Matcher,
) -> Fix:
    """Solve the camera's pose from the control points in a picture.

    The prior limits the search and starts the iteration; its position is no part of the estimate.

    Raises UnsolvedFrameError with the reason when the picture gives no position.
    """
    picture = PicturePyramid(observation.picture.values, observation.picture.saturation)
    frame = FrameContext(observation, picture, points, settings, matcher)
    passes: list[_Pass] = []
    while len(passes) < settings.solve.max_passes and not _is_settled(passes):
        passes.append(_search(frame, prior, passes[-1] if passes else None))
    last = passes[-1]
    reason, margins = _check_solution(frame, last, passes[0].searched_postings)
    evidence = replace(last.evidence, margins=margins)
    if reason:
        refused = tuple(
            replace(row, used=False, reason=reason.text, reason_code=reason.code)
            if row.used
            else row
            for row in evidence.matches
        )
        tried = replace(evidence, n_used=0, residual_rms_px=None, matches=refused)
        raise UnsolvedFrameError(reason, tried)
    pose, turn = last.solution.pose, last.solution.pose.camera_from_body
    covariance, sigma = last.solution.position_covariance_m2, last.solution.attitude_sigma_rad
    return Fix(Method.CONTROL_POINTS, pose.position_m, covariance, turn, sigma, evidence)


def _is_settled(passes: list[_Pass]) -> bool:
    """Whether the finest levels were searched and the pose moves no more."""
    if not passes or not passes[-1].at_finest:
        return False
    last, again = passes[-1], len(passes) > 1 and passes[-2].at_finest
    if len(passes) > 1 and last.moved_nodes < SETTLED_NODES:  # the first takes some points only
        return True
    return last.moved < (1.0 if again else SETTLED_SIGMAS)


def _search(frame: FrameContext, prior: PositionPrior, before: _Pass | None) -> _Pass:
    """Search once, from the prior or the pose of the pass before. Raises UnsolvedFrameError."""
    limits = frame.settings.solve
    if before is None:
        pose = Pose(prior.position_m, frame.observation.camera_from_body)
        sigma = frame.settings.attitude_sigma_rad(frame.observation.attitude_sigma_rad)
        covariance = block_diag(prior.covariance_m2, sigma**2 * np.eye(3))
        most = limits.max_first_pass_points
    else:
        pose, most = before.solution.pose, limits.max_points
        solved = before.solution.covariance
        covariance = np.pad(solved, (0, 6 - len(solved)))
    view = find_expected(frame, pose, whole=before is not None)
    if len(view) < FEWEST:  # a frame hardly wider than its templates: parts of them must do
        view = find_expected(frame, pose, whole=False)
    view = select_evenly(view, most)
    if len(view) == 0:
        tried = NO_POINTS if before is None else before.evidence
        raise UnsolvedFrameError(
            explain_empty_view(frame, pose), replace(tried, n_used=0, residual_rms_px=None)
        )
    chosen = {} if before is None else before.chosen
    search = plan_search(frame, view, pose, covariance)
    few = match_few(search)
    if few is not None:
        (view, matches, solution), at_finest = few, False
    else:
        matches, at_finest = match_all(search, chosen)
        try:
            solution = solve(frame, view, matches, pose)
        except NoSolutionError as error:
            reason = Reason.from_error(error)
            text = f"{reason} ({len(list_accepted(matches))} of {len(view)} matched)"
            evidence = _make_evidence(frame, prior, view, matches, None)
            raise UnsolvedFrameError(reason.with_text(text), evidence) from error
    position, covariance_m2 = solution.pose.position_m, solution.position_covariance_m2
    reason = acceptance.check_position(position, covariance_m2, prior)
    if reason:
        raise UnsolvedFrameError(reason, _make_evidence(frame, prior, view, matches, None))
    moved = float(np.sqrt(squared_distance(position - pose.position_m, covariance_m2)))
    evidence = _make_evidence(frame, prior, view, matches, solution)
    nodes = _measure_move_nodes(frame, view, matches, solution.pose)
    postings = search.searched_postings
    return _Pass(view, matches, solution, evidence, moved, nodes, at_finest, postings)


def _measure_move_nodes(
    frame: FrameContext, view: ExpectedPoints, matches: list[PointMatch], pose: Pose
) -> float:
    """Measure how far matched points lie from where they were searched, rms, nodes."""
    kept = list_accepted(matches)
    pixels, _ = predict(frame.camera, pose, frame.points.xyz_m[view.index[kept]])
    postings = [frame.points.postings_m(int(view.index[k]))[matches[k].level] for k in kept]
    nodes = view.metres_per_pixel[kept] / np.array(postings)
    offsets = np.linalg.norm(pixels - view.pixels[kept], axis=1) * nodes
    return float(np.sqrt(np.mean(offsets**2)))


def _check_solution(
    frame: FrameContext, last: _Pass, searched_postings: float
) -> tuple[Reason, GateMargins]:
    """Check the last pass's solution: reason of refusal, empty when accepted, and margins.

    searched_postings  of the first pass
    """
    searched = sum(match.score is not None for match in last.matches)
    parts = all(last.matches[k].part is not None for k in last.used)
    limits = acceptance.load_acceptance_limits()
    least, most = limits.decades.least, limits.scatter.points
    if parts:
        near = searched_postings <= limits.chance.near_postings
        least = limits.decades.least_of_near_parts if near else limits.decades.least_of_parts
        most = limits.scatter.parts

    def compute_decades(some: list[int]) -> float:
        return _compute_decades(frame, last, some, searched, searched_postings)

    decades, n_ambiguous = compute_decades(last.used), 0
    if decades >= least:
        kept = _select_proven(frame, last, compute_decades, least)
        decades, n_ambiguous = compute_decades(kept), len(last.used) - len(kept)
    reason = acceptance.check_matches(last.solution, decades, searched, least, most)
    if n_ambiguous and reason.code == ReasonCode.BY_CHANCE:
        reason = reason.with_text(f"{reason}: {n_ambiguous} match as well elsewhere nearby")
    if parts:
        reason = reason or acceptance.check_parts(len(last.used))
    reason = reason or acceptance.check_light(_measure_lights(frame, last))
    scatter = float(np.sqrt(last.solution.variance_factor / most))
    return reason, GateMargins(decades - least, scatter)


def _select_proven(
    frame: FrameContext, last: _Pass, decades_of: Callable[[list[int]], float], least: float
) -> list[int]:
    """Select used points without those that look alike elsewhere about the solved pose."""
    solved = last.solution.covariance
    covariance = np.pad(solved, (0, 6 - len(solved)))
    search = plan_search(frame, last.view, last.solution.pose, covariance)

    def compute_strength(k: int) -> float:
        part, score = last.matches[k].part, last.matches[k].score or 0.0
        if part is not None:
            return score * float(np.sqrt(part.samples))
        return score * _find_template_side(frame, last, k) / float(np.sqrt(CHANCE_NODES_PER_SAMPLE))

    return drop_disproven(
        lambda k: search.is_unambiguous(k, last.matches[k], PROOF_NODES),
        sorted(last.used, key=compute_strength, reverse=True),
        decades_of,
        least,
    )


def _compute_decades(
    frame: FrameContext, last: _Pass, some: list[int], searched: int, searched_postings: float
) -> float:
    """Compute powers of ten against chance for some points that a pass uses."""
    uncut = [k for k in some if last.matches[k].part is None]
    used = [last.matches[k] for k in some]
    cut = [(match.score or 0.0, match.part) for match in used if match.part is not None]
    decades = 0.0
    if uncut:
        sides = [_find_template_side(frame, last, k) for k in uncut]
        scores = [last.matches[k].score or 0.0 for k in uncut]
        decades += acceptance.compute_decades(scores, searched - len(cut), sides)
    if cut:
        strengths = [score * np.sqrt(part.samples) for score, part in cut]
        size_px = frame.camera.width_px, frame.camera.height_px
        shares = compute_evidence_shares(draw_footprints([part for _, part in cut], size_px))
        decades += acceptance.compute_part_decades(
            strengths, shares, searched - len(uncut), searched_postings
        )
    return decades


def _measure_lights(frame: FrameContext, last: _Pass) -> list[acceptance.PointLight]:
    """Measure the light on some of the used points; none where scores leave no doubt."""
    limits = acceptance.load_acceptance_limits().light
    scores = np.array([last.matches[k].score or 0.0 for k in last.used])
    if frame.points.image_error_m is not None:
        return []  # an image has the light of its own day
    if np.mean(scores**2) >= 1.0 / limits.agreeing_gain:
        return []  # no other light can explain so many times as much
    step = max(len(scores) / limits.points, 1.0)
    some = [last.used[int(at)] for at in np.arange(0.0, len(scores) - 0.5, step)]
    return [_measure_light(frame, last, k) for k in some]


def _measure_light(frame: FrameContext, last: _Pass, k: int) -> acceptance.PointLight:
    """Measure the light on the ground of a used point at the solved pose."""
    index, level, pose = int(last.view.index[k]), last.matches[k].level, last.solution.pose
    reference = frame.points.reference(index)
    if reference is None:
        raise ValueError(f"point {index} was matched and has no patches")
    posting, side = reference.patches[level].posting_m, _find_template_side(frame, last, k)
    blur = blur_nodes(posting, float(frame.points.finest_postings_m(np.array([index]))[0]))
    aside_nodes = acceptance.load_acceptance_limits().light.nodes
    margin, room = (int(np.ceil(n * choose_thinning(blur))) for n in (MARGIN_NODES, aside_nodes))
    heights = reference.heights(level, side + 2 * (margin + room))
    turn = pose.turn
    pixels = frame.camera.project_from_body(
        reference.surface(level, heights), pose.position_m, turn
    )
    window = frame.picture.sample(pixels, posting / float(last.view.metres_per_pixel[k]))
    up, sun = unit(frame.points.verticals[index]), frame.sun_body
    aside = np.cross(up, sun) + up * (up @ sun)
    template, other = (
        reference.render(level, crop(heights, room), light, pose.position_m)
        for light in (sun, aside)
    )
    if blur:
        even = side % 2 == 0
        template, other, window = (
            downsample_blurred(g, blur, even) for g in (template, other, window)
        )
    return acceptance.measure_light(template, other, window, MARGIN_NODES)


def _find_template_side(frame: FrameContext, last: _Pass, k: int) -> int:
    """Find the side of the template that a point was matched with, nodes, at the solved pose."""
    index = int(last.view.index[k])
    offset = frame.points.xyz_m[index] - last.solution.pose.position_m
    sample = float(np.linalg.norm(offset)) / frame.camera.coarse_focal_px
    posting = float(frame.points.postings_m(index)[last.matches[k].level])
    known = float(frame.points.finest_postings_m(np.array([index]))[0])
    return frame.choose_template_nodes(posting, sample, known)


def _make_evidence(
    frame: FrameContext,
    prior: PositionPrior,
    view: ExpectedPoints,
    matches: list[PointMatch],
    solution: Resection | None,
) -> Evidence:
    """Make the evidence of the points tried; solution None: there is none."""
    turn = frame.observation.camera_from_body.as_matrix()
    places = frame.points.xyz_m[view.index]
    from_prior = frame.camera.project_from_body(places, prior.position_m, turn)
    row_of = {k: i for i, k in enumerate(list_accepted(matches))}
    rows = []
    for k, match in enumerate(matches):
        used, residual, reason = False, None, match.reason
        if solution is not None and k in row_of:
            used = bool(solution.used[row_of[k]])
            residual = solution.residuals_px[row_of[k]]
            reason = NO_REASON if used else OUTLIER
        predicted = view.pixels[k]
        if match.pixel is not None and residual is not None:
            predicted = match.pixel - residual
        index = int(view.index[k])
        catalog, point_id = frame.points.name(index)
        rows.append(
            MatchRow(
                file=frame.observation.file,
                cp_id=point_id,
                level=match.level,
                cp_position_m=places[k],
                predicted_px=predicted,
                measured_px=None if match.reason else match.pixel,
                score=match.score,
                runner_up=match.runner_up,
                used=used,
                reason=reason.text,
                sun_elevation_deg=float(view.sun_elevation_deg[k]),
                residual_px=residual,
                prior_px=from_prior[k] if np.isfinite(from_prior[k]).all() else None,
                catalog=catalog,
                reason_code=reason.code,
            )
        )
    residuals = [row.residual_px for row in rows if row.used and row.residual_px is not None]
    rms = float(np.sqrt(np.mean(np.square(residuals)))) if residuals else None
    return Evidence(len(matches), len(row_of), len(residuals), rms, matches=tuple(rows))
