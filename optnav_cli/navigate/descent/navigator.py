"""A descent: all frames of one inertial track, solved jointly in the order of time.

Each frame is matched with windows of the terrain model, sought where the track, corrected by the
frames before, puts them. Where the picture shows ground without a window, landmarks carry on. All
that a frame shows enters one update of the joint filter (`navigate/descent/filter.py`).
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.expectation import FrameContext
from optnav_cli.control_points.field import ControlPointField
from optnav_cli.control_points.picture_pyramid import PicturePyramid
from optnav_cli.estimation.models.points import Pose, predict
from optnav_cli.fix import Evidence, Fix, MatchKind, Method, NoFix, PositionPrior, Solution
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.observation import make_observation
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.run_settings import InertialSettings
from optnav_cli.navigate.answers import Answers, FrameMethods, NavigationInputs
from optnav_cli.navigate.descent.errors import SCALES, WindowError, WindowSpread, window_ground
from optnav_cli.navigate.descent.filter import GATE
from optnav_cli.navigate.descent.relative_landmarks import Landmark, LandmarkTracks, SoughtLandmark
from optnav_cli.navigate.descent.rows import match_rows
from optnav_cli.navigate.descent.state import JointState, Sighting, track_sigmas
from optnav_cli.navigate.descent.windows import (
    MAX_SEARCH_NODES,
    OVERSAMPLED,
    SoughtWindow,
    WindowField,
    WindowKey,
    choose_windows,
    match_window,
    view_of,
)
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

# A wider search than so many nodes is repeated about its own result, so that templates fit.
WIDE_NODES = 5.0
# So many windows must agree at first, when nothing but they bears the position out.
MIN_FIRST = 5
# Windows scatter with longer tails than the filter's Gaussian: of right ones this gate takes one in
# 90 and most of those that would draw the solution along. Where fewer than half pass, GATE decides.
WINDOW_GATE = 9.0
# With at least so many windows found, most of which the track contradicts, it carries no frame on.
MIN_AGAINST = 6
# So many of them, that agree with each other, show a jump that the track's own places do not: six
# near the ground have agreed on a place 77 m off.
MIN_JUMPED = 8
# No craft turns its velocity faster than by so many m/s^2; a track that does so jumps.
MAX_ACCELERATION, MIN_JUMP_M = 20.0, 50.0
PRIOR_SOURCE = "inertial track"
# An update is repeated, so often at most, while its windows change the scale of their errors by
# more than this. The first is made with the largest scale, so that no right window is left out.
MAX_CHANGE, SCALED_UPDATES = 1.1, 6


@dataclass(frozen=True, eq=False)
class _Updated:
    """The state after a frame, what was found by its key and whether it was kept, and a remark."""

    state: JointState
    used: dict[WindowKey | int, bool]
    remark: Reason = NO_REASON


@dataclass(frozen=True, eq=False)
class DescentMemory:
    """What a descent knows after a frame, to go on from when it was stopped.

    state, covariance, nominal_m  of the joint filter
    keys       of its points: a landmark's number, or a window's level, side, row and column
    errors     of the windows among them, and of what they have in common
    spread     of the windows
    solved     whether any frame was
    last_s, last_m, velocity  time, place and velocity of the track as it was last stated
    """

    state: FloatArray
    covariance: FloatArray
    nominal_m: FloatArray
    keys: list[list[int]]
    errors: list[WindowError]
    spread: WindowSpread
    landmarks: list[Landmark]
    solved: bool
    last_s: float | None
    last_m: FloatArray | None
    velocity: FloatArray | None


class DescentNavigator:
    """Solves the frames of a descent one after the other.

    ground  all points of the catalog that have patches; None without a catalog
    middle_m (3,) a place that the descent goes over, m, body frame
    windows_above_m  nearer to the ground no windows are sought: landmarks alone, for studies
    """

    def __init__(
        self,
        inputs: NavigationInputs,
        ground: ControlPointField | None,
        track: InertialSettings,
        middle_m: FloatArray,
        windows_above_m: float = 0.0,
    ) -> None:
        self._inputs, self._ground = inputs, ground
        self._windows = None if ground is None else WindowField(ground, middle_m)
        self._state = JointState(track_sigmas(track))
        self._tracks, self._windows_above_m = LandmarkTracks(), windows_above_m
        self._solved, self._start_m = False, track.position_sigma_m
        self._last: tuple[float, FloatArray] | None = None
        self._velocity: FloatArray | None = None

    def solve(
        self, frame: Frame, camera: Camera, picture: Picture, answers: Answers | None = None
    ) -> Solution:
        """A frame's row; what is wrong with it is the reason of an unsolved one.

        answers  none are kept: a frame of a track depends on all before it
        """
        try:
            observation = make_observation(frame, camera, picture)
            if observation.prior is None:
                raise NoSolutionError(
                    "no position: [inertial] says that frames.csv is a track", ReasonCode.NO_PRIOR
                )
            if self._ground is None or self._windows is None:
                raise NoSolutionError("no catalog was given", ReasonCode.NO_CATALOG)
        except NoSolutionError as error:
            return Solution(frame.file, frame.utc, NoFix(Reason.from_error(error)))
        stated = Pose(observation.prior.position_m, observation.camera_from_body)
        jump = self._advance(observation.tdb_s, stated.position_m)
        loaded = replace(observation, picture=picture.load())
        values = PicturePyramid(loaded.picture.values)
        inputs = self._inputs
        context = FrameContext(loaded, values, self._ground, inputs.settings, inputs.matcher)
        row = self._row(context, self._windows, stated)
        return row.with_remark(jump) if jump else row

    def ground_m(self, place_m: FloatArray) -> float | None:
        """Height of the model's ground over the sphere below a place (3,); None outside it."""
        return None if self._windows is None else self._windows.ground_m(place_m)

    @property
    def landmarks(self) -> list[Landmark]:
        """All landmarks so far."""
        return self._tracks.all

    def memory(self) -> DescentMemory:
        """All that the frames to come depend on."""
        joint, own = self._state.filter, self._state
        keys = [[key] if isinstance(key, int) else list(key) for key in own.keys]
        arrays = joint.state, joint.covariance, joint.nominal_m
        landmarks = [one if not one.reason else one.without_patch() for one in self._tracks.all]
        last_s, last_m = self._last or (None, None)
        windows = keys, own.errors, own.spread
        return DescentMemory(
            *arrays, *windows, landmarks, self._solved, last_s, last_m, self._velocity
        )

    def restore(self, memory: DescentMemory) -> None:
        """Go on as the descent that gave this memory."""
        self._state.filter.restore(memory.state, memory.covariance, memory.nominal_m)
        keys = [WindowKey(*key) if len(key) > 1 else key[0] for key in memory.keys]
        self._state.restore(keys, memory.errors, memory.spread)
        self._tracks.all = list(memory.landmarks)
        self._solved, self._velocity = memory.solved, memory.velocity
        if memory.last_s is not None and memory.last_m is not None:
            self._last = memory.last_s, memory.last_m

    def _advance(self, tdb_s: float, position_m: FloatArray) -> Reason:
        """Carry the filter to a frame; why the track there is no continuous one, if so."""
        if self._last is None:
            self._last = tdb_s, position_m
            return NO_REASON
        seconds = tdb_s - self._last[0]
        self._state.filter.propagate(seconds)
        velocity = (position_m - self._last[1]) / max(seconds, 1e-3)
        self._last = tdb_s, position_m
        known, self._velocity = self._velocity, velocity
        if known is None:
            return NO_REASON
        away = float(np.linalg.norm(velocity - known)) * seconds
        if away < MIN_JUMP_M + MAX_ACCELERATION * seconds * seconds:
            return NO_REASON
        self._state.filter.jumped(away, 0.0)
        self._velocity = None
        text = (
            f"the inertial track jumps by {away / 1e3:.1f} km in {seconds:.0f} s: a manoeuvre that "
            "it does not hold, or rows of another track"
        )
        return Reason(ReasonCode.TRACK_JUMP, text)

    def _row(self, frame: FrameContext, windows: WindowField, stated: Pose) -> Solution:
        seen = frame.observation
        prior_m = self._state.filter.pose(stated).position_m
        sought = self._search(frame, windows, stated)
        tracks = self._search_landmarks(frame, stated, sought)
        try:
            made = self._updated(frame, stated, sought, tracks)
        except NoSolutionError as error:
            reason = Reason.from_error(error)
            if not self._is_carried(sought, tracks):
                rows = match_rows(frame, sought, tracks, {}, self._state.filter.pose(stated))
                n_found = sum(row.measured_px is not None for row in rows)
                evidence = Evidence(len(rows), n_found, 0, matches=rows)
                nothing = NoFix(reason, Method.DESCENT, evidence)
                return Solution(seen.file, seen.utc, nothing, PRIOR_SOURCE, prior_m)
            text = f"carried on by the inertial track: {reason}"
            made = _Updated(self._state.copy(), {}, Reason(ReasonCode.CARRIED, text))
        self._state, self._solved = made.state, True
        fix = self._fix(frame, stated, sought, tracks, made)
        used = {key for key, good in made.used.items() if good and isinstance(key, int)}
        self._tracks.settle(frame, stated, self._state, tracks, used)
        rows = fix.evidence.matches
        taken = [row.measured_px for row in rows if row.used and row.measured_px is not None]
        self._tracks.add(frame, stated, self._state, windows, np.array(taken).reshape(-1, 2))
        return Solution(seen.file, seen.utc, fix, PRIOR_SOURCE, prior_m)

    def _is_carried(self, sought: Sequence[SoughtWindow], tracks: Sequence[SoughtLandmark]) -> bool:
        """Whether a frame that measures nothing is known from those before it.

        Not one that shows no ground, or much that contradicts the track, and not a track that is
        known no better than at its start.
        """
        found = sum(not one.match.reason for one in sought)
        seen = [one.match.reason for one in sought] + [one.match.reason for one in tracks]
        if all(reason.code == ReasonCode.OUT_OF_VIEW for reason in seen):
            return False
        if not self._solved or found >= MIN_AGAINST:
            return False
        covariance = self._state.filter.pose_covariance()[:3, :3]
        return bool(np.linalg.eigvalsh(covariance)[-1] < self._start_m**2)

    def _fix(
        self,
        frame: FrameContext,
        stated: Pose,
        sought: Sequence[SoughtWindow],
        tracks: Sequence[SoughtLandmark],
        made: _Updated,
    ) -> Fix:
        """The frame's fix after its update."""
        pose, covariance = made.state.filter.pose(stated), made.state.filter.pose_covariance()
        rows = match_rows(frame, sought, tracks, made.used, pose)
        residuals = [r.residual_px for r in rows if r.used and r.residual_px is not None]
        rms = float(np.sqrt(np.mean(np.square(residuals)))) if residuals else None
        windows = sum(row.used for row in rows if row.kind is MatchKind.WINDOW)
        kept = sum(row.used for row in rows)
        evidence = Evidence(
            len(rows),
            len(made.used),
            kept,
            rms,
            matches=rows,
            n_windows=windows,
            n_landmarks=kept - windows,
        )
        sigma = float(np.sqrt(np.trace(covariance[3:, 3:]) / 3.0))
        place, turn = pose.position_m, pose.camera_from_body
        method = Method.DESCENT if windows else Method.RELATIVE_LANDMARKS
        return Fix(method, place, covariance[:3, :3], turn, sigma, evidence, made.remark)

    def _search_landmarks(
        self, frame: FrameContext, stated: Pose, sought: Sequence[SoughtWindow]
    ) -> list[SoughtLandmark]:
        """The landmarks of the frames before, from the pose that this frame's windows give."""
        if not self._tracks.tracked:
            return []
        state = self._state
        with suppress(NoSolutionError):  # without windows the track has to do
            state = self._updated(frame, stated, sought, []).state
        return self._tracks.search(frame, stated, state, state.filter.pose(stated))

    def _search(
        self, frame: FrameContext, windows: WindowField, stated: Pose
    ) -> list[SoughtWindow]:
        """The windows of a frame, sought from the filter's pose or one nearer to the truth."""
        joint = self._state.filter
        view = view_of(frame.camera, joint.pose(stated), windows)
        if view is None or view.distance_m(frame.camera) < self._windows_above_m:
            return []
        pose, covariance = joint.pose(stated), joint.pose_covariance()
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        level = windows.level(view.metres_per_pixel)
        finest = windows.posting_m(level or 0) / OVERSAMPLED
        if sigma_m * frame.settings.match.search_sigmas > MAX_SEARCH_NODES * finest:
            fix = self._by_points(frame, pose, sigma_m)
            if fix is not None:
                pose = Pose(fix.position_m, pose.camera_from_body)
                covariance[:3, :3] = fix.covariance_m2 + finest**2 * np.eye(3)
                sigma_m = finest
        sought = self._sought(frame, windows, pose, covariance)
        if sigma_m < WIDE_NODES * finest:
            return sought
        try:
            trial = self._updated(frame, stated, sought, []).state.filter
        except NoSolutionError:
            return sought
        # the same pixels again, better laid: the update that counts begins from before them
        return self._sought(frame, windows, trial.pose(stated), trial.pose_covariance())

    def _by_points(self, frame: FrameContext, pose: Pose, sigma_m: float) -> Fix | None:
        """A position from whole control points where the track leads too uncertainly."""
        if self._inputs.points is None:
            return None
        prior = PositionPrior.isotropic(pose.position_m, sigma_m, PRIOR_SOURCE)
        return FrameMethods(self._inputs, frame.observation, {}).by_points(prior).fix

    def _sought(
        self, frame: FrameContext, windows: WindowField, pose: Pose, covariance: FloatArray
    ) -> list[SoughtWindow]:
        """The windows of a frame matched about a pose with its covariance (6, 6)."""
        chosen = choose_windows(frame, pose, windows, self._state.windows)
        if not chosen:
            return []
        places = np.array([window.place_m for window in chosen])
        pixels, by_pose = predict(frame.camera, pose, places)
        spread = by_pose @ covariance @ np.swapaxes(by_pose, 1, 2)
        sigmas = np.sqrt(np.maximum(np.linalg.eigvalsh(spread)[:, -1], 0.0))
        return [
            SoughtWindow(window, match_window(frame, pose, window, float(sigma)), expected)
            for window, sigma, expected in zip(chosen, sigmas, pixels, strict=True)
        ]

    def _updated(
        self,
        frame: FrameContext,
        stated: Pose,
        sought: Sequence[SoughtWindow],
        tracks: Sequence[SoughtLandmark],
    ) -> _Updated:
        """The state after what was found of windows and landmarks. Raises NoSolutionError."""
        found = [one for one in sought if not one.match.reason]
        landmarks = [one for one in tracks if not one.match.reason]
        if not found and (not landmarks or not self._solved):
            text = "neither a window of the terrain model nor a landmark was found"
            raise NoSolutionError(text, ReasonCode.FEW_POINTS)
        if not self._solved and len(found) < MIN_FIRST:
            text = f"{len(found)} windows were found; the first frame needs {MIN_FIRST}"
            raise NoSolutionError(text, ReasonCode.FEW_POINTS)
        seen = len(found) + len(landmarks)
        for gate in (WINDOW_GATE, GATE) if found else (GATE,):
            try:
                made = _joined(self._state, frame, stated, found, landmarks, gate)
            except NoSolutionError as error:
                reason = error
                continue
            agreeing = sum(made.used.values())  # landmarks bear the track out as well
            if 2 * agreeing >= seen and (self._solved or agreeing >= MIN_FIRST):
                return made
            text = f"{agreeing} of {seen} windows and landmarks agree with the inertial track"
            reason = NoSolutionError(text, ReasonCode.POINTS_DISAGREE)
        if not self._solved or len(found) < MIN_AGAINST:
            raise reason
        return self._after_jump(frame, stated, found)

    def _after_jump(
        self, frame: FrameContext, stated: Pose, found: Sequence[SoughtWindow]
    ) -> _Updated:
        """The update with a track that is free to have jumped. Raises NoSolutionError."""
        offsets = np.array([one.match.pixel for one in found]) - [one.expected_px for one in found]
        camera_m = self._state.filter.pose(stated).position_m
        distance = float(np.linalg.norm(found[0].window.place_m - camera_m))
        away = float(np.median(np.linalg.norm(offsets, axis=1)))
        away = away * distance / frame.camera.coarse_focal_px
        free = self._state.copy()
        free.filter.jumped(3.0 * away, 0.0)
        made = _joined(free, frame, stated, found, [])
        agreeing = sum(made.used.values())
        wanted = max(MIN_JUMPED, len(found) // 2 + 1)
        if agreeing < wanted:
            text = (
                f"{agreeing} of {len(found)} windows agree with each other, against the inertial "
                f"track; a jump of it wants {wanted}"
            )
            raise NoSolutionError(text, ReasonCode.POINTS_DISAGREE)
        text = (
            f"the ground lies {away:.0f} m from where the inertial track leads: it has jumped, by "
            "a manoeuvre that it does not hold"
        )
        return replace(made, remark=Reason(ReasonCode.TRACK_JUMP, text))


def _joined(
    state: JointState,
    frame: FrameContext,
    stated: Pose,
    found: Sequence[SoughtWindow],
    landmarks: Sequence[SoughtLandmark],
    gate: float = GATE,
) -> _Updated:
    """A copy of a state updated by windows and landmarks; windows that do not agree leave it.

    Again from before them while the new ones show that the model is worse or better than was known.
    """
    by_position = np.zeros((0, 2, 3))
    if found:
        places = np.array([one.window.place_m for one in found])
        by_position = predict(frame.camera, state.filter.pose(stated), places)[1][:, :, :3]
    new = [k for k, one in enumerate(found) if one.window.key not in state.keys]
    grounds = [window_ground(found[k].window, found[k].match, by_position[k]) for k in new]
    places_m = np.array([found[k].window.place_m for k in new]).reshape(-1, 3)
    scale = state.spread.scale if state.spread.count else float(SCALES[-1])
    for _ in range(SCALED_UPDATES):
        joined = state.copy()
        if new:
            joined.join_windows([each.error(state.sizes, scale) for each in grounds], places_m)
        seen = _sightings(state, frame, found, by_position, landmarks, scale)
        update = joined.update(frame.camera, stated, seen, gate)
        if 2 * int(update.used[: len(found)].sum()) < len(found):
            break  # a track that jumped or wrong matches, not windows that scatter
        joined.spread = state.spread.with_windows(grounds, update.squares[new], scale, state.sizes)
        change = joined.spread.scale / scale
        if 1.0 / MAX_CHANGE < change < MAX_CHANGE:
            break
        scale = joined.spread.scale
    kept = {one.key: bool(good) for one, good in zip(seen, update.used, strict=True)}
    joined.keep({key for key in joined.keys if isinstance(key, int) or kept.get(key, False)})
    return _Updated(joined, kept)


def _sightings(
    state: JointState,
    frame: FrameContext,
    found: Sequence[SoughtWindow],
    by_position: FloatArray,
    landmarks: Sequence[SoughtLandmark],
    scale: float,
) -> list[Sighting]:
    """What an update takes: all windows in their order, then the landmarks."""
    seen: list[Sighting] = []
    for one, rows in zip(found, by_position, strict=True):
        if one.match.pixel is not None:
            pixel = one.match.pixel - state.sunward_px(one.window, rows, frame.sun_body)
            own = state.fresh_covariance_px2(one.match, scale)
            seen.append(Sighting(one.window.key, pixel, own))
    fresh = state.sizes.landmark_px**2 * np.eye(2)
    for track in landmarks:
        match = track.match
        if match.pixel is not None and match.covariance_px2 is not None:
            own = fresh + match.covariance_px2
            seen.append(Sighting(track.landmark.number, match.pixel, own))
    return seen
