"""All control points of a frame searched from one pose, and the pose that their places give."""

from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.correlation.ncc import blur_nodes
from optnav_cli.estimation.resection import Pose, Sightings, predict
from optnav_cli.estimation.robust import RobustResection, resect_robustly
from optnav_cli.matching.point_match import (
    MatchGates,
    PointMatch,
    match_point,
)
from optnav_cli.matching.search_plan import ground_uncertainty_m, plan_distortion, plan_search
from optnav_cli.matching.visibility import View
from optnav_cli.navigation.control_points.error_model import (
    common_errors_px,
    footprints,
    ground_alikeness,
    overlap_correlation,
    own_covariances_px2,
)
from optnav_cli.navigation.control_points.expectation import FrameContext

# Rolls and scales are tried this far; beyond it the search in place would miss the point too.
DISTORTION_SIGMAS = 2.0
# Behind a blur a score is worth what the samples are that were compared: least of their root's
# multiples.
MIN_STRENGTH = 3.0


@dataclass(frozen=True, eq=False)
class Prior:
    """What is believed before the picture.

    position_covariance_m2  (3, 3) of the pose's position, body frame
    attitude_sigma_rad      1 sigma an axis; 0 exact, None free
    """

    pose: Pose
    position_covariance_m2: FloatArray
    attitude_sigma_rad: float | None

    @classmethod
    def isotropic(
        cls, pose: Pose, position_sigma_m: float, attitude_sigma_rad: float | None
    ) -> "Prior":
        """A prior as wrong in every direction: its sigma a component."""
        return cls(pose, np.eye(3) * position_sigma_m**2, attitude_sigma_rad)


def match_all(
    frame: FrameContext, view: View, pose: Pose, covariance: FloatArray
) -> tuple[list[PointMatch], bool]:
    """Match every point of a view; also whether all were searched at their finest level.

    covariance (6, 6) of the pose that the search starts from: position m, rotation rad
    """
    points, camera, settings = frame.points, frame.camera, frame.settings
    uncertainty = _uncertainty_m(frame, view, pose, covariance)
    known = points.finest_postings_m(view.index)
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
        sample = float(view.metres_per_pixel[k])
        postings = points.postings_m(int(index))
        finest = frame.finest_level(postings, sample)
        plan = plan_search(
            postings,
            finest,
            float(uncertainty[k]),
            settings.match.search_sigmas,
            settings.match.max_search_nodes,
        )
        at_finest = at_finest and plan.level == finest
        posting = float(postings[plan.level])
        template = frame.template_nodes(posting, sample, float(known[k]))
        distortion = plan_distortion(
            template, roll_sigma, height_sigma / float(ranges[k]), DISTORTION_SIGMAS
        )
        blur = blur_nodes(posting, float(known[k]))
        gates = MatchGates(settings.match.min_score, settings.match.rival_ratio, MIN_STRENGTH)
        matches.append(
            match_point(
                reference,
                plan.level,
                template,
                plan.search_nodes,
                frame.picture,
                camera,
                pose,
                frame.sun_body,
                sample,
                frame.matcher,
                gates,
                distortion,
                blur,
            )
        )
    return matches, at_finest


def search_postings(frame: FrameContext, view: View, pose: Pose, covariance: FloatArray) -> float:
    """How far a view is searched from a pose, in postings of the terrain model (median)."""
    sigmas = _uncertainty_m(frame, view, pose, covariance)
    known = frame.points.finest_postings_m(view.index)
    return float(frame.settings.match.search_sigmas * np.median(sigmas / known))


def _uncertainty_m(
    frame: FrameContext, view: View, pose: Pose, covariance: FloatArray
) -> FloatArray:
    _, jacobian = predict(frame.camera, pose, frame.points.xyz_m[view.index])
    return ground_uncertainty_m(jacobian, covariance, view.metres_per_pixel)


def solve(
    frame: FrameContext,
    view: View,
    matches: list[PointMatch],
    believed: list[int],
    pose: Pose,
    prior: Prior,
) -> RobustResection:
    """Resect from the believed matches, from a pose. Raises NoSolutionError."""
    points = frame.points
    kept = [k for k in believed if matches[k].covariance_px2 is not None]
    index = view.index[kept]
    places = points.xyz_m[index]
    pixels = np.array([matches[k].pixel for k in kept]).reshape(-1, 2)
    parts = {i: part for i, k in enumerate(kept) if (part := matches[k].part) is not None}
    for i, part in parts.items():
        # what the frame shows of a cut template is not centred on the point
        places[i], pixels[i] = part.place_m, part.pixel
    sightings = Sightings(
        places,
        pixels,
        np.array([matches[k].covariance_px2 for k in kept]).reshape(-1, 2, 2),
    )
    common = error_correlation = None
    if kept:
        levels = np.array([points.postings_m(int(view.index[k]))[matches[k].level] for k in kept])
        finest = points.finest_postings_m(index)
        samples = view.metres_per_pixel[kept]
        triples = zip(levels.tolist(), samples.tolist(), finest.tolist(), strict=True)
        nodes = [frame.template_nodes(*three) for three in triples]
        error_correlation = ground_alikeness(places, levels * nodes)
        if parts:
            size_px = frame.camera.width_px, frame.camera.height_px
            error_correlation[np.ix_(list(parts), list(parts))] = overlap_correlation(
                footprints(list(parts.values()), size_px)
            )
        _, jacobian = predict(frame.camera, pose, places)
        pixel_per_metre = -jacobian[
            :, :, :3
        ]  # a point that moves one way looks as if the camera moved
        hidden = np.where(levels < finest, finest, 0.0)
        postings = np.maximum(levels, finest)  # of what is known, not of the nodes
        suns = view.sun_elevation_deg[kept]
        own = own_covariances_px2(places, pixel_per_metre, postings, finest, suns, hidden)
        sightings = replace(sightings, covariances_px2=sightings.covariances_px2 + own)
        scores = np.array([matches[k].score or 0.0 for k in kept])
        common = common_errors_px(
            places, pixel_per_metre, scores, frame.sun_body, finest, postings, hidden
        )
    free = prior.attitude_sigma_rad is None
    attitude = (pose if free else prior.pose).camera_from_body
    return resect_robustly(
        frame.camera,
        sightings,
        Pose(pose.position_m, attitude),
        prior.attitude_sigma_rad,
        common_errors_px=common,
        error_correlation=error_correlation,
        gate_probability=frame.settings.solve.gate_probability,
    )
