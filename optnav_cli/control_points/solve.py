"""All control points of a frame searched from one pose, and the pose that their places give."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.correlation.filters import blur_nodes, choose_thinning
from catalog.correlation.peak import RIVAL_DISTANCE
from catalog.correlation.relief_albedo import ReliefAlbedo, estimate_strengths
from catalog.errors import NoSolutionError
from optnav_cli.control_points import error_model
from optnav_cli.control_points.acceptance import draw_footprints
from optnav_cli.control_points.expectation import (
    ExpectedPoints,
    FrameContext,
    select_evenly,
)
from optnav_cli.control_points.point_match import MatchGates, PointMatch, match_point
from optnav_cli.control_points.search_plan import (
    SearchPlan,
    compute_ground_uncertainty_m,
    plan_distortion,
    search_room,
)
from optnav_cli.estimation.models.points import Pose, ProjectingCamera, Sightings, predict
from optnav_cli.estimation.resection import Resection, resect_robustly
from optnav_cli.reasons import Reason, ReasonCode

# A place at the finest level that scores less is compared with those at the next two.
CERTAIN_SCORE, COARSER_LEVELS = 0.85, 2
# Albedo that follows relief is fitted in frames where, in the median of their points, it explains
# so large a share of what matches leave over, and these score less. Over maria it explains 0.007 to
# 0.25, on highlands under the LROC map 0.015 to 0.05, and where albedo does not follow relief 0.001
# to 0.004, by the fisheye to 0.006; but up to 0.019 of the little that scores of 0.89 leave over,
# and then the place moves by sigmas. Maria score up to 0.75; over more, shading has most of the
# contrast.
MIN_ALBEDO_SHARE, MAX_ALBEDO_SCORE = 0.0065, 0.8
DAMAGED = Reason(ReasonCode.DAMAGED_PATCH, "patch damaged in the catalog")
# So many points lead from one pass to the next where so many of them are found and all agree.
FEW, AGREEING = 12, 8


def compute_min_score(min_score: float, template_nodes: int, coarser: bool = False) -> float:
    """Compute the score that a template must have: `min_score`, less for a wider one.

    template_nodes  to a side
    coarser  it stands in for one at a finer level: `min_score`, where it is narrower as much more.
             One that the frame keeps small scores 0.4 anywhere, and where it is wrong its expected
             error says nothing
    """
    # Chance scores go as one over a template's side (`acceptance.ChanceLaw`): with 67 nodes one
    # search of unrelated ground in a hundred reaches a score of 0.3.
    share = 67.0 / template_nodes
    return min_score * (max(share, 1.0) if coarser else min(share, 1.0))


def list_accepted(matches: list[PointMatch]) -> list[int]:
    """List which matches the pose is solved from."""
    return [k for k, match in enumerate(matches) if not match.reason]


@dataclass(frozen=True, eq=False)
class PointSearch:
    """Search of a view's points from one pose.

    uncertainty_m  (n,) of their places on the ground;  known_m (n,) postings of their models
    """

    frame: FrameContext
    view: ExpectedPoints
    pose: Pose
    uncertainty_m: FloatArray
    known_m: FloatArray
    height_sigma_m: float
    roll_sigma: float
    _made: dict[tuple[int, int, bool], PointMatch] = field(default_factory=dict, repr=False)

    @property
    def searched_postings(self) -> float:
        """Median search radius of the points, postings of the terrain model."""
        sigmas = self.frame.settings.match.search_sigmas
        return sigmas * float(np.median(self.uncertainty_m / self.known_m))

    @property
    def is_interim(self) -> bool:
        """Whether the pose allows some point no search at its finest level."""
        finest = map(self.finest, range(len(self.view)))
        return any(self.room(k, level)[0] > level for k, level in enumerate(finest))

    def room(self, k: int, finest: int) -> tuple[int, int]:
        """Return the level, from `finest` on, to search a point at, and the nodes of room."""
        limits, postings = self.frame.settings.match, self._postings_m(k)
        spread = float(self.uncertainty_m[k])
        return search_room(postings, finest, spread, limits.search_sigmas, limits.max_search_nodes)

    def _postings_m(self, k: int) -> FloatArray:
        return self.frame.points.postings_m(int(self.view.index[k]))

    def finest(self, k: int) -> int:
        """Return the finest level of a point that the picture resolves."""
        return self.frame.find_finest_level(
            self._postings_m(k), float(self.view.metres_per_pixel[k])
        )

    def match(self, k: int, finest: int, coarser: bool = False) -> PointMatch:
        """Match a point at the finest level, from `finest` on, that the pose allows.

        coarser  as for `compute_min_score`
        """
        key = k, finest, coarser
        if key not in self._made:
            self._made[key] = self._match_levels(*key)
        return self._made[key]

    def _match_levels(self, k: int, finest: int, coarser: bool) -> PointMatch:
        level, room = self.room(k, finest)
        plan = self._plan(k, level, room, level > finest)
        least = self.frame.settings.match.min_score
        if not plan.blur_nodes:  # behind one a template has few samples, whatever its side
            least = compute_min_score(least, plan.template_nodes, coarser)
        ratio = self.frame.settings.match.rival_ratio
        # behind a blur the score times the root of the samples compared must reach 3
        return self._search(k, plan, MatchGates(least, ratio, 3.0, refuse_smooth=True))

    def _plan(self, k: int, level: int, room: int, interim: bool) -> SearchPlan:
        sample, known = float(self.view.metres_per_pixel[k]), float(self.known_m[k])
        posting = float(self._postings_m(k)[level])
        template = self.frame.choose_template_nodes(posting, sample, known)
        point_m = self.frame.points.xyz_m[int(self.view.index[k])]
        scale_sigma = self.height_sigma_m / float(np.linalg.norm(point_m - self.pose.position_m))
        # Rolls and scales are tried to 2 sigmas; beyond it the search in place would miss the point
        # too.
        distortion = plan_distortion(template, self.roll_sigma, scale_sigma, 2.0)
        blur = blur_nodes(posting, known)
        return SearchPlan(level, template, room, sample, distortion, blur, interim)

    def _search(self, k: int, plan: SearchPlan, gates: MatchGates) -> PointMatch:
        frame, reference = self.frame, self.frame.points.reference(int(self.view.index[k]))
        if reference is None:
            return PointMatch(0, DAMAGED)
        return match_point(
            reference,
            plan,
            frame.picture,
            frame.camera,
            self.pose,
            frame.sun_body,
            frame.matcher,
            gates,
        )

    def is_unambiguous(self, k: int, match: PointMatch, room: int) -> bool:
        """Whether a match is the best place, without a rival, of a search with more room.

        room  to every side, nodes; behind a blur of those that are kept
        """
        plan = self._plan(k, match.level, room, interim=True)
        node_m = float(self._postings_m(k)[match.level])
        if plan.blur_nodes:
            step = choose_thinning(plan.blur_nodes)
            plan, node_m = replace(plan, search_nodes=int(np.ceil(room * step))), node_m * step
        again = self._search(k, plan, MatchGates(0.0, self.frame.settings.match.rival_ratio))
        if again.reason or again.pixel is None or match.pixel is None:
            return False
        moved_m = float(np.linalg.norm(again.pixel - match.pixel)) * plan.metres_per_pixel
        return moved_m <= RIVAL_DISTANCE * node_m


def plan_search(
    frame: FrameContext, view: ExpectedPoints, pose: Pose, covariance: FloatArray
) -> PointSearch:
    """Plan the search of a view's points from a pose.

    covariance (6, 6) of the pose: position m, rotation rad
    """
    points = frame.points
    _, jacobian = predict(frame.camera, pose, points.xyz_m[view.index])
    uncertainty = compute_ground_uncertainty_m(jacobian, covariance, view.metres_per_pixel)
    boresight = pose.turn[2]
    height_sigma = float(np.sqrt(boresight @ covariance[:3, :3] @ boresight))
    known = points.finest_postings_m(view.index)
    roll_sigma = float(np.sqrt(covariance[5, 5]))
    return PointSearch(frame, view, pose, uncertainty, known, height_sigma, roll_sigma)


def match_few(search: PointSearch) -> tuple[ExpectedPoints, list[PointMatch], Resection] | None:
    """Match some points of a view; return them with matches and pose where they suffice.

    Not where that pass might be the last: points at their finest levels are all searched.
    """
    if len(search.view) <= FEW or not search.is_interim:
        return None
    few = select_evenly(search.view, FEW)
    places = np.flatnonzero(np.isin(search.view.index, few.index)).tolist()
    matches = [search.match(k, search.finest(k)) for k in places]
    if len(list_accepted(matches)) < AGREEING:
        return None
    try:
        solution = solve(search.frame, few, matches, search.pose)
    except NoSolutionError:
        return None
    return (few, matches, solution) if solution.used.all() else None


def match_all(search: PointSearch, chosen: Mapping[int, int]) -> tuple[list[PointMatch], bool]:
    """Match every point of a view.

    chosen  level by point, where a pass before found it to be the best one
    Returns the matches, and whether all points were searched at their finest level.
    """
    view = search.view
    finest = [search.finest(k) for k in range(len(view))]
    first = [chosen.get(int(view.index[k]), level) for k, level in enumerate(finest)]
    matches = [search.match(k, level) for k, level in enumerate(first)]
    damaged = [match.reason == DAMAGED for match in matches]
    at_finest = all(
        match.level == level or no_patch
        for match, level, no_patch in zip(matches, first, damaged, strict=True)
    )
    if not at_finest:  # the pass after this one matches all again
        return matches, at_finest
    doubtful = [
        k
        for k, match in enumerate(matches)
        if match.level == finest[k]
        and match.score is not None
        and match.score < CERTAIN_SCORE
        and match.part is None
        and int(view.index[k]) not in chosen
    ]
    albedo = _fit_albedo(matches)
    if albedo is not None:
        matches = [match.with_albedo(albedo) for match in matches]
    return _choose_best_levels(search, matches, doubtful, albedo), at_finest


def _fit_albedo(matches: list[PointMatch]) -> ReliefAlbedo | None:
    """Fit how albedo follows relief in a frame; None where its matches do not show that.

    All that allow it are fitted with it, or none: points of which some are moved and others stay
    would no longer fit together.
    """
    fits = [(m.albedo, m.score) for m in matches if m.albedo and m.score is not None]
    if not fits or np.median([score for _, score in fits]) > MAX_ALBEDO_SCORE:
        return None
    laid = [fit.laid for fit, _ in fits if fit.laid is not None]
    if not laid or np.median([fit_match.explained for fit_match in laid]) < MIN_ALBEDO_SHARE:
        return None
    return estimate_strengths(laid)


def _choose_best_levels(
    search: PointSearch, matches: list[PointMatch], doubtful: list[int], albedo: ReliefAlbedo | None
) -> list[PointMatch]:
    """Rematch doubtful points at the level with the smallest expected frame error.

    The finest level shows most of what the terrain model does not know. What coarser ones err by is
    more alike from point to point.
    albedo  that follows relief, where it is fitted
    """
    best, errors = list(matches), _predict_errors_px2(search, matches, doubtful)
    for step in range(1, COARSER_LEVELS + 1):
        there = []
        trial = list(matches)
        for k in doubtful:
            level = matches[k].level + step
            if level < len(search.frame.points.postings_m(int(search.view.index[k]))):
                match = search.match(k, level, coarser=True)
                trial[k] = match if albedo is None else match.with_albedo(albedo)
                if trial[k].level == level:
                    there.append(k)
        for k, error in _predict_errors_px2(search, trial, there).items():
            if error < errors.get(k, np.inf):
                best[k], errors[k] = trial[k], error
    return best


def _predict_errors_px2(
    search: PointSearch, matches: list[PointMatch], some: list[int]
) -> dict[int, float]:
    """Predict the contribution of each accepted match to the frame's squared error, px^2.

    Of a point's own error the other points leave one part in as many as they are; what is common to
    all of them stays.
    """
    frame, kept = search.frame, [k for k in some if not matches[k].reason]
    if not kept:
        return {}
    places = frame.points.xyz_m[search.view.index[kept]]
    points = _collect_matched_points(frame, search.view, matches, kept, places, search.pose)
    sizes = load_sizes(frame)
    covariances = error_model.compute_point_covariances_px2(points, sizes)
    covariances += np.array([matches[k].covariance_px2 for k in kept])
    common = error_model.compute_common_errors_px(points, frame.sun_body, sizes)
    squares = np.trace(covariances, axis1=1, axis2=2) / len(list_accepted(matches))
    squares += (common**2).sum(axis=(1, 2))
    return dict(zip(kept, squares.tolist(), strict=True))


def _collect_matched_points(
    frame: FrameContext,
    view: ExpectedPoints,
    matches: list[PointMatch],
    kept: list[int],
    places_m: FloatArray,
    pose: Pose,
) -> error_model.MatchedPoints:
    """Collect the kept matches of a view, seen at points (n, 3) from a pose, with their errors."""
    points, index = frame.points, view.index[kept]
    levels, resolved = np.empty(len(kept)), np.empty(len(kept))
    sizes = np.empty(len(kept))
    finest = points.finest_postings_m(index)
    for i, k in enumerate(kept):
        postings, sample = points.postings_m(int(index[i])), float(view.metres_per_pixel[k])
        levels[i] = postings[matches[k].level]
        resolved[i] = postings[frame.find_finest_level(postings, sample)]
        sizes[i] = levels[i] * frame.choose_template_nodes(
            float(levels[i]), sample, float(finest[i])
        )
    _, jacobian = predict(frame.camera, pose, places_m)
    return error_model.MatchedPoints(
        places_m,
        -jacobian[:, :, :3],  # a point that moves one way looks as if the camera moved
        np.array([matches[k].score or 0.0 for k in kept]),
        view.sun_elevation_deg[kept],
        np.maximum(levels, finest),  # of what is known, not of the nodes
        finest,
        np.where(levels < finest, finest, 0.0),
        np.maximum(levels - resolved, 0.0),
        sizes,
        points.compute_terrain_sigmas_m(index, sizes),
        points.terrain_errors(index),
        levels * [matches[k].under_albedo for k in kept],
    )


@dataclass(frozen=True, eq=False)
class MatchedFrame:
    """A frame's accepted matches, before the errors that matches do not show are added.

    errors       what these go by;  correlation (n, n) of the points' own errors
    sun_body     (3,) unit vector to the Sun, body frame
    """

    sightings: Sightings
    errors: error_model.MatchedPoints | None
    correlation: FloatArray | None
    sun_body: FloatArray

    def weigh(self, sizes: error_model.PointErrorSizes) -> tuple[Sightings, FloatArray | None]:
        """Weigh the sightings by errors of these sizes; return also common errors (n, 2, k), px."""
        if self.errors is None:
            return self.sightings, None
        seen, errors, sun = self.sightings, self.errors, self.sun_body
        point_covariances = error_model.compute_point_covariances_px2(errors, sizes)
        seen = replace(
            seen,
            pixels=seen.pixels - error_model.compute_bias_px(errors, sun, sizes),
            covariances_px2=seen.covariances_px2 + point_covariances,
        )
        return seen, error_model.compute_common_errors_px(errors, sun, sizes)


def make_matched_frame(
    frame: FrameContext, view: ExpectedPoints, matches: list[PointMatch], pose: Pose
) -> MatchedFrame:
    """Collect the accepted matches of a view with their errors as seen from a pose."""
    kept = list_accepted(matches)
    places = frame.points.xyz_m[view.index[kept]]
    pixels = np.array([matches[k].pixel for k in kept]).reshape(-1, 2)
    parts = {i: part for i, k in enumerate(kept) if (part := matches[k].part) is not None}
    for i, part in parts.items():
        # what the frame shows of a cut template is not centred on the point
        places[i], pixels[i] = part.place_m, part.pixel
    sightings = Sightings(
        frame.points.correct_refraction(places, pose.position_m),
        pixels,
        np.array([matches[k].covariance_px2 for k in kept]).reshape(-1, 2, 2),
    )
    if not kept:
        return MatchedFrame(sightings, None, None, frame.sun_body)
    errors = _collect_matched_points(frame, view, matches, kept, places, pose)
    correlation = error_model.correlate_ground(places, errors.sizes_m)
    if parts:
        size_px = frame.camera.width_px, frame.camera.height_px
        correlation[np.ix_(list(parts), list(parts))] = error_model.correlate_overlaps(
            draw_footprints(list(parts.values()), size_px)
        )
    return MatchedFrame(sightings, errors, correlation, frame.sun_body)


def load_sizes(frame: FrameContext) -> error_model.PointErrorSizes:
    """Load the sizes of errors: of rendered templates, or of those that are cut from an image."""
    sizes, points = error_model.load_error_sizes(), frame.points
    if points.image_error_m is None:
        return sizes
    return sizes.convert_for_image(points.image_error_m, float(points.postings_m(0)[0]))


def solve(
    frame: FrameContext, view: ExpectedPoints, matches: list[PointMatch], pose: Pose
) -> Resection:
    """Resect from the accepted matches, from a pose. Raises NoSolutionError."""
    observation = frame.observation
    free = observation.attitude_sigma_rad is None
    return resect_matches(
        frame.camera,
        make_matched_frame(frame, view, matches, pose),
        pose if free else Pose(pose.position_m, observation.camera_from_body),
        observation.attitude_sigma_rad,
        frame.settings.solve.gate_probability,
        load_sizes(frame),
    )


def resect_matches(
    camera: ProjectingCamera,
    matched: MatchedFrame,
    start: Pose,
    attitude_sigma_rad: float | None,
    gate_probability: float,
    sizes: error_model.PointErrorSizes,
) -> Resection:
    """Resect from matches with errors of these sizes. Raises NoSolutionError."""
    sightings, common = matched.weigh(sizes)
    return resect_robustly(
        camera,
        sightings,
        start,
        attitude_sigma_rad,
        common_errors_px=common,
        error_correlation=matched.correlation,
        common_shares=error_model.compute_scatter_shares(matched.errors, sizes),
        gate_probability=gate_probability,
    )
