"""All control points of a frame searched from one pose, and the pose that their places give."""

from dataclasses import replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.correlation.ncc import blur_nodes
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.estimation.resection import Resection, resect_robustly
from optnav_cli.matching.point_match import MatchGates, PointMatch, match_point
from optnav_cli.matching.search_plan import (
    SearchPlan,
    ground_uncertainty_m,
    plan_distortion,
    search_room,
)
from optnav_cli.navigation.control_points import error_model
from optnav_cli.navigation.control_points.expectation import ExpectedPoints, FrameContext
from optnav_cli.reasons import Reason, ReasonCode

# Rolls and scales are tried this far; beyond it the search in place would miss the point too.
DISTORTION_SIGMAS = 2.0
# Behind a blur: score times the root of the samples that were compared.
MIN_STRENGTH = 3.0
DAMAGED = Reason(ReasonCode.DAMAGED_PATCH, "patch damaged in the catalog")


def accepted(matches: list[PointMatch]) -> list[int]:
    """Which of some matches the pose is solved from."""
    return [k for k, match in enumerate(matches) if not match.reason]


def match_all(
    frame: FrameContext, view: ExpectedPoints, pose: Pose, covariance: FloatArray
) -> tuple[list[PointMatch], bool, float]:
    """Match every point of a view.

    covariance (6, 6) of the pose that the search starts from: position m, rotation rad
    Returns the matches, whether all points were searched at their finest level, and how far they
    were searched, in postings of the terrain model (median).
    """
    points, camera, settings = frame.points, frame.camera, frame.settings
    _, jacobian = predict(camera, pose, points.xyz_m[view.index])
    uncertainty = ground_uncertainty_m(jacobian, covariance, view.metres_per_pixel)
    known = points.finest_postings_m(view.index)
    searched_postings = settings.match.search_sigmas * float(np.median(uncertainty / known))
    boresight = pose.camera_from_body.as_matrix()[2]
    height_sigma = float(np.sqrt(boresight @ covariance[:3, :3] @ boresight))
    roll_sigma = float(np.sqrt(covariance[5, 5]))
    ranges = np.linalg.norm(points.xyz_m[view.index] - pose.position_m, axis=1)
    gates = MatchGates(settings.match.min_score, settings.match.rival_ratio, MIN_STRENGTH)
    matches, at_finest = [], True
    for k, index in enumerate(view.index):
        reference = points.reference(int(index))
        if reference is None:
            matches.append(PointMatch(0, DAMAGED))
            continue
        sample = float(view.metres_per_pixel[k])
        postings = points.postings_m(int(index))
        finest = frame.finest_level(postings, sample)
        spread, sigmas = float(uncertainty[k]), settings.match.search_sigmas
        level, room = search_room(postings, finest, spread, sigmas, settings.match.max_search_nodes)
        at_finest = at_finest and level == finest
        posting = float(postings[level])
        template = frame.template_nodes(posting, sample, float(known[k]))
        scale_sigma = height_sigma / float(ranges[k])
        distortion = plan_distortion(template, roll_sigma, scale_sigma, DISTORTION_SIGMAS)
        blur = blur_nodes(posting, float(known[k]))
        plan = SearchPlan(level, template, room, sample, distortion, blur)
        match = match_point(
            reference, plan, frame.picture, camera, pose, frame.sun_body, frame.matcher, gates
        )
        matches.append(match)
    return matches, at_finest, searched_postings


def solve(
    frame: FrameContext, view: ExpectedPoints, matches: list[PointMatch], pose: Pose
) -> Resection:
    """Resect from the accepted matches, from a pose. Raises NoSolutionError."""
    points, observation = frame.points, frame.observation
    kept = accepted(matches)
    index = view.index[kept]
    places = points.xyz_m[index]
    pixels = np.array([matches[k].pixel for k in kept]).reshape(-1, 2)
    parts = {i: part for i, k in enumerate(kept) if (part := matches[k].part) is not None}
    for i, part in parts.items():
        # what the frame shows of a cut template is not centred on the point
        places[i], pixels[i] = part.place_m, part.pixel
    sightings = Sightings(
        places, pixels, np.array([matches[k].covariance_px2 for k in kept]).reshape(-1, 2, 2)
    )
    common = error_correlation = None
    if kept:
        levels = np.array([points.postings_m(int(view.index[k]))[matches[k].level] for k in kept])
        finest = points.finest_postings_m(index)
        samples = view.metres_per_pixel[kept]
        triples = zip(levels.tolist(), samples.tolist(), finest.tolist(), strict=True)
        nodes = [frame.template_nodes(*three) for three in triples]
        sizes_m = levels * nodes
        error_correlation = error_model.ground_correlation(places, sizes_m)
        if parts:
            size_px = frame.camera.width_px, frame.camera.height_px
            error_correlation[np.ix_(list(parts), list(parts))] = error_model.overlap_correlation(
                error_model.footprints(list(parts.values()), size_px)
            )
        _, jacobian = predict(frame.camera, pose, places)
        errors = error_model.MatchedPoints(
            places,
            -jacobian[:, :, :3],  # a point that moves one way looks as if the camera moved
            np.array([matches[k].score or 0.0 for k in kept]),
            view.sun_elevation_deg[kept],
            np.maximum(levels, finest),  # of what is known, not of the nodes
            finest,
            np.where(levels < finest, finest, 0.0),
            points.terrain_sigmas_m(index, sizes_m),
        )
        covariances = sightings.covariances_px2 + error_model.own_covariances_px2(errors)
        sightings = replace(sightings, covariances_px2=covariances)
        common = error_model.common_errors_px(errors, frame.sun_body)
    free = observation.attitude_sigma_rad is None
    start = pose if free else Pose(pose.position_m, observation.camera_from_body)
    return resect_robustly(
        frame.camera,
        sightings,
        start,
        observation.attitude_sigma_rad,
        common_errors_px=common,
        error_correlation=error_correlation,
        gate_probability=frame.settings.solve.gate_probability,
    )
