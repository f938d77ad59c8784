"""The rows of matches.csv of a descent: windows of the terrain model, then landmarks."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.vectors import unit
from optnav_cli.control_points.expectation import FrameContext
from optnav_cli.control_points.point_match import PointMatch
from optnav_cli.estimation.models.points import Pose
from optnav_cli.fix import MatchKind, MatchRow
from optnav_cli.navigate.descent.landmark import LandmarkMatch
from optnav_cli.navigate.descent.relative_landmarks import SoughtLandmark
from optnav_cli.navigate.descent.windows import SoughtWindow, WindowKey
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

OUTLIER = Reason(ReasonCode.OUTLIER, "disagrees with the others")


def match_rows(
    frame: FrameContext,
    windows: Sequence[SoughtWindow],
    landmarks: Sequence[SoughtLandmark],
    used: dict[WindowKey | int, bool],
    pose: Pose,
) -> tuple[MatchRow, ...]:
    """The rows of a frame's windows and landmarks.

    used  of those that were found, whether the solution keeps them;  pose  of the solution
    """
    rows = []
    for window in windows:
        key, place = window.window.key, window.window.place_m
        good = used.get(key, False)
        made = _row(frame, pose, place, window.match, window.expected_px, good=good)
        if made is not None:
            rows.append(replace(made, cp_id=key.number, level=key.level, kind=MatchKind.WINDOW))
    for one in landmarks:
        number, place = one.landmark.number, one.landmark.place_m
        good = used.get(number, False)
        made = _row(frame, pose, place, one.match, one.expected_px, good=good)
        if made is not None:
            rows.append(replace(made, cp_id=number, kind=MatchKind.LANDMARK))
    return tuple(rows)


def _row(
    frame: FrameContext,
    pose: Pose,
    place_m: FloatArray,
    match: PointMatch | LandmarkMatch,
    expected_px: FloatArray,
    *,
    good: bool,
) -> MatchRow | None:
    """The row of a place that was looked for; None where the pose does not see it."""
    turn = pose.camera_from_body.as_matrix()
    predicted = frame.camera.project_from_body(place_m, pose.position_m, turn)
    if not np.isfinite(predicted).all():
        return None
    found = match.pixel is not None and not match.reason
    reason = match.reason or (NO_REASON if good else OUTLIER)
    sine = float(frame.sun_body @ unit(place_m))
    return MatchRow(
        file=frame.observation.file,
        cp_id=0,
        level=0,
        cp_position_m=place_m,
        predicted_px=predicted,
        measured_px=match.pixel if found else None,
        score=match.score,
        runner_up=match.runner_up,
        used=good,
        reason=reason.text,
        sun_elevation_deg=float(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))),
        residual_px=match.pixel - predicted if good and match.pixel is not None else None,
        prior_px=expected_px if np.isfinite(expected_px).all() else None,
        reason_code=reason.code,
    )
