"""Navigation by control points: predict, match from coarse to fine, resect, and again.

Source: Zhukov 2025, ch. 3 (steps of the method); the passes over the whole frame are ours: every
pass searches all points at the level that the present pose uncertainty allows, and solves the
pose before the next pass searches finer.
"""

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from catalog.control_point import ControlPoint, Patch
from catalog.correlation.similarity import Matcher
from catalog.errors import DataError, NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.resection import Pose, Sightings, predict
from optnav_cli.estimation.robust import RobustResection, resect_robustly
from optnav_cli.matching.picture_pyramid import PicturePyramid
from optnav_cli.matching.point_match import MatchGates, PointMatch, match_point
from optnav_cli.matching.reference import Reference
from optnav_cli.matching.visibility import View, ViewLimits, expected_in_view
from optnav_cli.navigation.acceptance import doubt_of_matches, doubt_of_place
from optnav_cli.navigation.error_model import common_errors_px, own_sigma_m
from optnav_cli.navigation.search_plan import (
    finest_level,
    ground_uncertainty_m,
    plan_distortion,
    plan_search,
)
from optnav_cli.navigation.settings import NavigateSettings

FloatArray = NDArray[np.float64]

# The pose stands still when a pass moves it by less than this share of its sigma.
SETTLED_SIGMAS = 0.1
# Rolls and scales are tried this far; beyond it the search in place would miss the point too.
DISTORTION_SIGMAS = 2.0


class PointStore(Protocol):
    """What navigation needs of a catalog."""

    def patches(self, cp_id: int) -> tuple[Patch, ...]:
        """The levels of a point, finest first; DataError when they are damaged."""
        ...


class UnsolvedFrameError(NoSolutionError):
    """A picture gave no position; `tried` are the control points of the last pass."""

    def __init__(self, reason: str, tried: "list[TriedPoint]") -> None:
        super().__init__(reason)
        self.tried = tried


@dataclass
class ControlPointField:
    """The usable points of a catalog, as arrays, and their patches, loaded when first needed.

    points      (n,) the usable control points
    xyz_m       (n, 3) body-fixed
    skyline_deg (n, 36) terrain skyline by azimuth
    damaged     ids whose patches could not be read; they are never used
    """

    store: PointStore
    points: list[ControlPoint]
    postings_m: FloatArray
    radius_m: float
    xyz_m: FloatArray = field(init=False)
    skyline_deg: FloatArray = field(init=False)
    damaged: dict[int, str] = field(default_factory=dict)
    _references: dict[int, Reference] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.xyz_m = np.array([p.xyz_m for p in self.points]).reshape(-1, 3)
        self.skyline_deg = np.array([p.shadow_limit_deg for p in self.points])

    def reference(self, index: int) -> Reference | None:
        """The point at a place in `points`, ready to render; None when its patches are damaged."""
        point = self.points[index]
        if point.id in self.damaged:
            return None
        if point.id not in self._references:
            try:
                patches = self.store.patches(point.id)
            except DataError as error:
                self.damaged[point.id] = str(error)
                return None
            self._references[point.id] = Reference(point, patches, self.radius_m)
        return self._references[point.id]

    def half_sizes_m(self, level: int) -> list[float]:
        """Half a side of the patches from a level up, m."""
        size = next(iter(self._references.values())).patches[0].size if self._references else 0
        return [(size - 1) / 2.0 * float(p) for p in self.postings_m[level:]]


@dataclass(frozen=True)
class Prior:
    """What is believed before the picture: pose, its sigmas a component and an axis.

    attitude_sigma_rad  0 exact, None free
    """

    pose: Pose
    position_sigma_m: float
    attitude_sigma_rad: float | None


@dataclass(frozen=True)
class TriedPoint:
    """One expected control point after the last pass."""

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

    solution: RobustResection
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
    pose = prior.pose
    covariance = _prior_covariance(prior, settings)
    solution: RobustResection | None = None
    tried: list[TriedPoint] = []
    previous_finest = False
    for number in range(settings.solve.max_passes):
        first = number == 0
        view = _expected(points, camera, pose, sun_body, settings, whole=not first)
        if first:
            view = _spread(view, settings.solve.max_first_pass_points)
        if len(view) == 0:
            reason = _why_nothing_in_view(points, camera, pose, sun_body, settings)
            raise UnsolvedFrameError(reason, tried)
        matches, at_finest = _match_all(
            picture, camera, pose, covariance, sun_body, points, view, settings, matcher
        )
        believed = [k for k, match in enumerate(matches) if not match.reason]
        tried = _tried(points, view, matches, None, believed)
        try:
            solution = _solve(camera, points, view, matches, believed, pose, prior, settings)
        except NoSolutionError as error:
            reason = f"{error} ({len(believed)} of {len(view)} matched)"
            raise UnsolvedFrameError(reason, tried) from error
        tried = _tried(points, view, matches, solution, believed)
        step = solution.resection.pose.position_m - pose.position_m
        pose = solution.resection.pose
        position_covariance = solution.resection.position_covariance_m2
        doubt = doubt_of_place(
            pose, position_covariance, prior.pose.position_m, prior.position_sigma_m
        )
        if doubt:
            raise UnsolvedFrameError(doubt, _tried(points, view, matches, None, believed))
        covariance = _full_covariance(solution, prior, settings)
        moved = float(np.sqrt(step @ np.linalg.solve(position_covariance, step)))
        if at_finest and ((previous_finest and moved < 1.0) or moved < SETTLED_SIGMAS):
            break
        previous_finest = at_finest
    if solution is None:
        raise UnsolvedFrameError("no pass was made", tried)
    scores = [t.match.score for t in tried if t.used and t.match.score is not None]
    searched = sum(t.match.score is not None for t in tried)
    doubt = doubt_of_matches(solution, scores, searched, settings.match.template_nodes)
    if doubt:
        raise UnsolvedFrameError(doubt, [replace(t, used=False, reason=doubt) for t in tried])
    return ControlPointFix(solution, tried)


def _prior_covariance(prior: Prior, settings: NavigateSettings) -> FloatArray:
    sigma = prior.attitude_sigma_rad
    turn = np.radians(settings.solve.free_attitude_deg) if sigma is None else sigma
    return np.diag([prior.position_sigma_m**2] * 3 + [turn**2] * 3)


def _full_covariance(
    solution: RobustResection, prior: Prior, settings: NavigateSettings
) -> FloatArray:
    solved = solution.resection.covariance
    full = np.zeros((6, 6))
    full[: len(solved), : len(solved)] = solved
    return full


def _expected(
    points: ControlPointField,
    camera: Camera,
    pose: Pose,
    sun_body: FloatArray,
    settings: NavigateSettings,
    whole: bool,
) -> View:
    """Points expected in the frame, whole with their finest template or with their centre only."""
    limits = ViewLimits(
        settings.view.sun_min_deg, settings.view.sun_max_deg, settings.view.emission_max_deg
    )
    half = np.zeros(len(points.points))
    if whole:
        distance = np.linalg.norm(points.xyz_m - pose.position_m, axis=1)
        sample = distance / camera.focal_length_px
        for level, posting in enumerate(points.postings_m):
            # coarser levels overwrite finer ones as the sample distance passes their posting
            reached = sample * settings.match.finest_posting_per_gsd > (
                0.0 if level == 0 else points.postings_m[level - 1]
            )
            half[reached] = settings.match.template_nodes / 2.0 * posting
    return expected_in_view(
        points.xyz_m,
        half,
        camera,
        (camera.width_px, camera.height_px),
        pose,
        sun_body,
        limits,
        points.skyline_deg,
    )


def _why_nothing_in_view(
    points: ControlPointField,
    camera: Camera,
    pose: Pose,
    sun_body: FloatArray,
    settings: NavigateSettings,
) -> str:
    """Say which condition emptied the view."""
    up = points.xyz_m / np.linalg.norm(points.xyz_m, axis=1, keepdims=True)
    sun = np.degrees(np.arcsin(np.clip(up @ sun_body, -1.0, 1.0)))
    height = float(np.linalg.norm(pose.position_m)) - points.radius_m
    if height <= 0.0:
        return "the prior position is inside the body"
    dark = NavigateSettings(
        view=type(settings.view)(sun_min_deg=0.0, sun_max_deg=90.0), match=settings.match
    )
    seen = expected_in_view(
        points.xyz_m,
        np.zeros(len(points.points)),
        camera,
        (camera.width_px, camera.height_px),
        pose,
        pose.position_m / np.linalg.norm(pose.position_m),
        ViewLimits(-90.0, 90.0, dark.view.emission_max_deg),
    )
    if len(seen) == 0:
        return "no control point of the catalog in the frame at the prior pose"
    lit = sun[seen.index]
    return (
        f"none of the {len(seen)} control points in the frame is lit well: Sun elevation "
        f"{lit.min():.1f} to {lit.max():.1f} deg, wanted {settings.view.sun_min_deg:.0f} to "
        f"{settings.view.sun_max_deg:.0f}"
    )


def _spread(view: View, most: int) -> View:
    """At most `most` points, evenly over the frame: each next is the farthest from all so far."""
    if len(view) <= most:
        return view
    chosen = [int(np.argmin(np.linalg.norm(view.pixels - view.pixels.mean(axis=0), axis=1)))]
    gap = np.linalg.norm(view.pixels - view.pixels[chosen[0]], axis=1)
    while len(chosen) < most:
        nearest = int(np.argmax(gap))
        chosen.append(nearest)
        gap = np.minimum(gap, np.linalg.norm(view.pixels - view.pixels[nearest], axis=1))
    keep = np.sort(np.array(chosen))
    return View(
        view.index[keep],
        view.pixels[keep],
        view.metres_per_pixel[keep],
        view.sun_elevation_deg[keep],
        view.emission_deg[keep],
    )


def _match_all(
    picture: PicturePyramid,
    camera: Camera,
    pose: Pose,
    covariance: FloatArray,
    sun_body: FloatArray,
    points: ControlPointField,
    view: View,
    settings: NavigateSettings,
    matcher: Matcher,
) -> tuple[list[PointMatch], bool]:
    """Match every point of a view; also whether all were searched at their finest level."""
    _, jacobian = predict(camera, pose, points.xyz_m[view.index])
    uncertainty = ground_uncertainty_m(jacobian, covariance, view.metres_per_pixel)
    gates = MatchGates(settings.match.min_score, settings.match.rival_ratio)
    boresight = pose.camera_from_body.as_matrix()[2]
    height_sigma = float(np.sqrt(boresight @ covariance[:3, :3] @ boresight))
    roll_sigma = float(np.sqrt(covariance[5, 5]))
    ranges = np.linalg.norm(points.xyz_m[view.index] - pose.position_m, axis=1)
    matches = []
    at_finest = True
    for k, index in enumerate(view.index):
        reference = points.reference(int(index))
        if reference is None:
            reason = "patch damaged in the catalog"
            matches.append(PointMatch(0, None, None, None, None, None, reason))
            continue
        template = settings.match.template_nodes
        distortion = plan_distortion(
            template, roll_sigma, height_sigma / float(ranges[k]), DISTORTION_SIGMAS
        )
        finest = finest_level(
            points.postings_m, view.metres_per_pixel[k], settings.match.finest_posting_per_gsd
        )
        plan = plan_search(
            points.postings_m,
            finest,
            float(uncertainty[k]),
            settings.match.search_sigmas,
            settings.match.max_search_nodes,
        )
        at_finest = at_finest and plan.level == finest
        matches.append(
            match_point(
                reference,
                plan.level,
                template,
                plan.search_nodes,
                picture,
                camera,
                pose,
                sun_body,
                float(view.metres_per_pixel[k]),
                matcher,
                gates,
                distortion,
            )
        )
    return matches, at_finest


def _solve(
    camera: Camera,
    points: ControlPointField,
    view: View,
    matches: list[PointMatch],
    believed: list[int],
    pose: Pose,
    prior: Prior,
    settings: NavigateSettings,
) -> RobustResection:
    pixels, covariances = [], []
    for k in believed:
        match = matches[k]
        if match.pixel is None or match.covariance_px2 is None:
            continue
        sigma = own_sigma_m(float(points.postings_m[match.level]), float(points.postings_m[0]))
        own = (sigma / view.metres_per_pixel[k]) ** 2
        pixels.append(match.pixel)
        covariances.append(match.covariance_px2 + own * np.eye(2))
    sightings = Sightings(
        points.xyz_m[view.index[believed]],
        np.array(pixels).reshape(-1, 2),
        np.array(covariances).reshape(-1, 2, 2),
    )
    common = None
    if believed:
        samples = view.metres_per_pixel[believed]
        scores = np.array([matches[k].score or 0.0 for k in believed])
        common = common_errors_px(sightings.pixels, samples, scores, float(points.postings_m[0]))
    free = prior.attitude_sigma_rad is None
    attitude = (pose if free else prior.pose).camera_from_body
    return resect_robustly(
        camera,
        sightings,
        Pose(pose.position_m, attitude),
        prior.attitude_sigma_rad,
        common_errors_px=common,
        gate_probability=settings.solve.gate_probability,
    )


def _tried(
    points: ControlPointField,
    view: View,
    matches: list[PointMatch],
    solution: RobustResection | None,
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
        rows.append(
            TriedPoint(
                points.points[int(view.index[k])],
                predicted,
                float(view.sun_elevation_deg[k]),
                match,
                used,
                residual,
                reason,
            )
        )
    return rows
