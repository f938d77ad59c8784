"""Landmarks of a descent: chosen where no window is, tracked, cut anew, retired with a reason.

Also the sightings of windows and landmarks for an update, and their rows of matches.csv.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.latlon import body_from_local, latlon_from_xyz
from catalog.geometry.vectors import unit
from optnav_cli.control_points.expectation import FrameContext
from optnav_cli.control_points.point_match import PointMatch
from optnav_cli.estimation.models.points import Pose, predict
from optnav_cli.fix import MatchKind, MatchRow
from optnav_cli.navigate.descent.filter import GATE
from optnav_cli.navigate.descent.landmark import (
    MARGIN_NODES,
    NODE_PX,
    PATCH_NODES,
    LandmarkMatch,
    LandmarkPatch,
    choose_pixels,
    cut_patch,
    match_patch,
)
from optnav_cli.navigate.descent.state import SCALES, JointState, Sighting, make_window_ground
from optnav_cli.navigate.descent.windows import SoughtWindow, WindowField, WindowKey
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

SQUARES = 7
# Half the base of the ground's slope about a landmark: postings of the model, or half its patch if
# that is more. A plane of less ground than its patch shows made matches twice as far off.
PLANE_NODES = 0.5 * PATCH_NODES
# An update is repeated, so often at most, while its windows change the scale of their errors by
# more than this. The first is made with the largest scale, so that no right window is left out.
MAX_CHANGE, SCALED_UPDATES = 1.1, 6
LOST = Reason(ReasonCode.LOST, "not found in two pictures in a row")
OUT_OF_VIEW = Reason(ReasonCode.OUT_OF_VIEW, "left the picture")


@dataclass(eq=False)
class Landmark:
    """A landmark while it is tracked, and its row of landmarks.csv.

    place_m, covariance_m2  at its end or by now: body frame; east, north, up
    reason                  why it was retired; empty while it is tracked
    """

    number: int
    first_file: str
    last_file: str
    patch: LandmarkPatch
    normal: FloatArray
    place_m: FloatArray
    covariance_m2: FloatArray
    n_seen: int = 1
    missed: int = 0
    reason: Reason = NO_REASON

    def drop_patch(self) -> "Landmark":
        """Return a copy without its patch: all that a retired one needs for its row."""
        bare = np.zeros((0, 0), np.float32)
        return replace(self, patch=replace(self.patch, brightness=bare))


@dataclass(frozen=True, eq=False)
class SoughtLandmark:
    """A landmark that was looked for in a frame, and where, px."""

    landmark: Landmark
    match: LandmarkMatch
    expected_px: FloatArray


class LandmarkTracks:
    """All landmarks of a descent."""

    def __init__(self) -> None:
        self.all: list[Landmark] = []

    @property
    def tracked(self) -> list[Landmark]:
        """Those that are in the state."""
        return [landmark for landmark in self.all if not landmark.reason]

    def search(
        self, frame: FrameContext, stated: Pose, state: JointState, pose: Pose
    ) -> list[SoughtLandmark]:
        """Search all landmarks where a state and its pose predict them."""
        tracked = self.tracked
        if not tracked:
            return []
        numbers = np.array([state.keys.index(landmark.number) for landmark in tracked])
        pixels, spread = state.filter.predict(frame.camera, stated, numbers)
        sights = []
        for landmark, number, pixel, covariance in zip(
            tracked, numbers, pixels, spread, strict=True
        ):
            point = state.filter.places_m[number]
            sigma = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
            match = LandmarkMatch(OUT_OF_VIEW)
            if np.isfinite(pixel).all() and frame.camera.contains(pixel):
                match = match_patch(landmark.patch, frame.picture, frame.camera, pose, point, sigma)
            sights.append(SoughtLandmark(landmark, match, pixel))
        return sights

    def settle(
        self,
        frame: FrameContext,
        stated: Pose,
        state: JointState,
        sought: Sequence[SoughtLandmark],
        used: set[int],
    ) -> None:
        """After an update: count what was found, cut patches anew, retire what is lost."""
        pose = state.filter.pose(stated)
        places = state.filter.places_m
        for sight in sought:
            landmark, match = sight.landmark, sight.match
            number = state.keys.index(landmark.number)
            landmark.place_m = places[number]
            landmark.covariance_m2 = _compute_local_covariance(landmark, state)
            if landmark.number in used:
                landmark.last_file, landmark.missed = frame.observation.file, 0
                landmark.n_seen += 1
                self._update_patch(frame, pose, state, number, sight)
                continue
            landmark.missed += 1
            if match.reason.code == ReasonCode.OUT_OF_VIEW:
                landmark.reason = OUT_OF_VIEW
            elif landmark.missed >= 2:
                landmark.reason = LOST
        gone = {landmark.number for landmark in self.all if landmark.reason}
        state.keep({key for key in state.keys if key not in gone})

    def add(
        self,
        frame: FrameContext,
        stated: Pose,
        state: JointState,
        windows: WindowField,
        taken_px: FloatArray,
    ) -> None:
        """Add landmarks in the squares of the picture that have neither window nor landmark.

        taken_px (n, 2) pixels of windows and landmarks that the frame's solution keeps
        """
        camera, pose = frame.camera, state.filter.pose(stated)
        size = np.array([camera.width_px, camera.height_px])
        free = np.ones((SQUARES, SQUARES), dtype=bool)
        if len(taken_px):
            at = np.clip((taken_px / size * SQUARES).astype(int), 0, SQUARES - 1)
            free[at[:, 1], at[:, 0]] = False
        room = 60 - len(self.tracked)
        border = int(NODE_PX * (PATCH_NODES / 2 + MARGIN_NODES + 3) * 1.5)
        values = frame.observation.picture.values
        pixels = choose_pixels(values, free, border)[: max(room, 0)]
        made = [self._make_landmark(frame, pose, windows, pixel) for pixel in pixels]
        fresh = [landmark for landmark in made if landmark is not None]
        if not fresh:
            return
        for number, landmark in enumerate(fresh, len(self.all) + 1):
            landmark.number = number
        places = np.array([landmark.place_m for landmark in fresh])
        pixel = np.tile(state.sizes.fresh_px**2 * np.eye(2), (len(fresh), 1, 1))
        sigma = state.sizes.landmark_height_postings * windows.posting_m(0)
        numbers = [landmark.number for landmark in fresh]
        state.add_landmarks(numbers, frame.camera, stated, places, pixel, sigma)
        for landmark in fresh:
            landmark.covariance_m2 = _compute_local_covariance(landmark, state)
        self.all += fresh

    def _make_landmark(
        self, frame: FrameContext, pose: Pose, windows: WindowField, pixel: FloatArray
    ) -> Landmark | None:
        """Make a landmark at a pixel; None where its ray meets no known ground or it is cut."""
        ray = frame.camera.unproject(pixel[None])[0] @ pose.camera_from_body.as_matrix()
        point = windows.meet_ray(pose.position_m, ray)
        if point is None:
            return None
        up = unit(point)
        sight, distance = unit(pose.position_m - point), np.linalg.norm(pose.position_m - point)
        posting = NODE_PX * float(distance) / frame.camera.coarse_focal_px
        normal = windows.fit_normal(point, PLANE_NODES * posting)
        if min(sight @ up, sight @ normal) < np.cos(np.radians(65.0)):
            return None
        patch = cut_patch(frame.picture, frame.camera, pose, point, normal)
        if patch is None:
            return None
        file = frame.observation.file
        return Landmark(0, file, file, patch, normal, point, np.eye(3))

    def _update_patch(
        self, frame: FrameContext, pose: Pose, state: JointState, number: int, sight: SoughtLandmark
    ) -> None:
        """Replace a stale patch where this picture shows the landmark."""
        landmark, match = sight.landmark, sight.match
        point = landmark.place_m
        if match.pixel is None or match.covariance_px2 is None:
            return
        if not landmark.patch.is_stale(point, frame.camera, pose):
            return
        # about the pixel that was measured, on the landmark's own plane
        ray = frame.camera.unproject(match.pixel[None])[0] @ pose.camera_from_body.as_matrix()
        offset = point - pose.position_m
        seen = pose.position_m + ray * float(offset @ landmark.normal) / float(
            ray @ landmark.normal
        )
        patch = cut_patch(frame.picture, frame.camera, pose, seen, landmark.normal)
        if patch is None:
            return
        landmark.patch = patch
        # what this match was off by is off from now on
        spread = patch.gsd_m**2 * 0.5 * float(np.trace(match.covariance_px2))
        state.filter.add_point_noise(number, spread * np.eye(3))


def _compute_local_covariance(landmark: Landmark, state: JointState) -> FloatArray:
    """Compute (3, 3) of a landmark's position in the state, east, north, up, m^2."""
    axes = body_from_local(*(float(v) for v in latlon_from_xyz(landmark.place_m)[:2]))
    body_covariance = state.filter.get_point_covariance(state.keys.index(landmark.number))
    covariance: FloatArray = axes.T @ body_covariance @ axes
    return covariance


def make_sightings(
    state: JointState,
    frame: FrameContext,
    found: Sequence[SoughtWindow],
    by_position: FloatArray,
    landmarks: Sequence[SoughtLandmark],
    scale: float,
) -> list[Sighting]:
    """Make the sightings of an update: all windows in their order, then the landmarks."""
    seen: list[Sighting] = []
    for sight, rows in zip(found, by_position, strict=True):
        if sight.match.pixel is not None:
            pixel = sight.match.pixel - state.compute_sunward_px(sight.window, rows, frame.sun_body)
            covariance = state.compute_fresh_covariance_px2(sight.match, scale)
            seen.append(Sighting(sight.window.key, pixel, covariance))
    fresh = state.sizes.landmark_px**2 * np.eye(2)
    for track in landmarks:
        match = track.match
        if match.pixel is not None and match.covariance_px2 is not None:
            covariance = fresh + match.covariance_px2
            seen.append(Sighting(track.landmark.number, match.pixel, covariance))
    return seen


@dataclass(frozen=True, eq=False)
class Updated:
    """The state after a frame, what was found by its key and whether it was kept, and a remark."""

    state: JointState
    used: dict[WindowKey | int, bool]
    remark: Reason = NO_REASON


def join_sightings(
    state: JointState,
    frame: FrameContext,
    stated: Pose,
    found: Sequence[SoughtWindow],
    landmarks: Sequence[SoughtLandmark],
    gate: float = GATE,
) -> Updated:
    """Update a copy of a state by windows and landmarks; drop windows that do not agree.

    Repeated from the start while new windows change the scale of the model's error.
    """
    by_position = np.zeros((0, 2, 3))
    if found:
        places = np.array([sight.window.place_m for sight in found])
        by_position = predict(frame.camera, state.filter.pose(stated), places)[1][:, :, :3]
    new = [k for k, sight in enumerate(found) if sight.window.key not in state.keys]
    grounds = [make_window_ground(found[k].window, found[k].match, by_position[k]) for k in new]
    places_m = np.array([found[k].window.place_m for k in new]).reshape(-1, 3)
    scale = state.spread.scale if state.spread.count else float(SCALES[-1])
    for _ in range(SCALED_UPDATES):
        joined = state.copy()
        if new:
            joined.join_windows(
                [each.compute_error(state.sizes, scale) for each in grounds], places_m
            )
        seen = make_sightings(state, frame, found, by_position, landmarks, scale)
        update = joined.update(frame.camera, stated, seen, gate)
        if 2 * int(update.used[: len(found)].sum()) < len(found):
            break  # a track that jumped or wrong matches, not windows that scatter
        joined.spread = state.spread.add_windows(grounds, update.squares[new], scale, state.sizes)
        change = joined.spread.scale / scale
        if 1.0 / MAX_CHANGE < change < MAX_CHANGE:
            break
        scale = joined.spread.scale
    kept = {sight.key: bool(good) for sight, good in zip(seen, update.used, strict=True)}
    joined.keep({key for key in joined.keys if isinstance(key, int) or kept.get(key, False)})
    return Updated(joined, kept)


OUTLIER = Reason(ReasonCode.OUTLIER, "disagrees with the others")


def make_match_rows(
    frame: FrameContext,
    windows: Sequence[SoughtWindow],
    landmarks: Sequence[SoughtLandmark],
    used: dict[WindowKey | int, bool],
    pose: Pose,
) -> tuple[MatchRow, ...]:
    """Make the rows of a frame's windows and landmarks.

    used  of those that were found, whether the solution keeps them;  pose  of the solution
    """
    rows = []
    for window in windows:
        key, point = window.window.key, window.window.place_m
        good = used.get(key, False)
        made = _make_row(frame, pose, point, window.match, window.expected_px, good=good)
        if made is not None:
            rows.append(replace(made, cp_id=key.number, level=key.level, kind=MatchKind.WINDOW))
    for sight in landmarks:
        number, point = sight.landmark.number, sight.landmark.place_m
        good = used.get(number, False)
        made = _make_row(frame, pose, point, sight.match, sight.expected_px, good=good)
        if made is not None:
            rows.append(replace(made, cp_id=number, kind=MatchKind.LANDMARK))
    return tuple(rows)


def _make_row(
    frame: FrameContext,
    pose: Pose,
    place_m: FloatArray,
    match: PointMatch | LandmarkMatch,
    expected_px: FloatArray,
    *,
    good: bool,
) -> MatchRow | None:
    """Make the row of a point that was searched; None where the pose does not see it."""
    turn = pose.camera_from_body.as_matrix()
    predicted = frame.camera.project_from_body(place_m, pose.position_m, turn)
    if not np.isfinite(predicted).all():
        return None
    is_found = match.pixel is not None and not match.reason
    reason = match.reason or (NO_REASON if good else OUTLIER)
    sine = float(frame.sun_body @ unit(place_m))
    return MatchRow(
        file=frame.observation.file,
        cp_id=0,
        level=0,
        cp_position_m=place_m,
        predicted_px=predicted,
        measured_px=match.pixel if is_found else None,
        score=match.score,
        runner_up=match.runner_up,
        used=good,
        reason=reason.text,
        sun_elevation_deg=float(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))),
        residual_px=match.pixel - predicted if good and match.pixel is not None else None,
        prior_px=expected_px if np.isfinite(expected_px).all() else None,
        reason_code=reason.code,
    )
