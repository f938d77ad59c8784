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
from optnav_cli.frames.folder import make_observation
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.run_settings import InertialSettings
from optnav_cli.navigate.answers import Answers, FrameMethods, NavigationInputs
from optnav_cli.navigate.descent.altimeter import Range, update_by_range
from optnav_cli.navigate.descent.filter import GATE
from optnav_cli.navigate.descent.relative_landmarks import (
    Landmark,
    LandmarkTracks,
    SoughtLandmark,
    Updated,
    join_sightings,
    make_match_rows,
)
from optnav_cli.navigate.descent.state import (
    JointState,
    WindowError,
    WindowSpread,
    convert_track_errors,
)
from optnav_cli.navigate.descent.windows import (
    MAX_SEARCH_NODES,
    OVERSAMPLED,
    SoughtWindow,
    WindowField,
    WindowKey,
    choose_windows,
    find_view,
    match_window,
)
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

# So many windows must agree at first, when nothing but they bears the position out.
MIN_FIRST = 5
# Windows scatter with longer tails than the filter's Gaussian: of right ones this gate takes one in
# 90 and most of those that would draw the solution along. Where fewer than half pass, GATE decides.
WINDOW_GATE = 9.0
# With at least so many windows found, most of which the track contradicts, it carries no frame on.
MIN_AGAINST = 6
PRIOR_SOURCE = "inertial track"
BORESIGHT: FloatArray = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class DescentMemory:
    """State of a descent after a frame, for a run that was stopped and continues.

    state, covariance, nominal_m  of the joint filter
    keys       of its points: a landmark's number, or a window's level, side, row and column
    errors     of the windows among them, and of what they have in common
    spread     of the windows
    solved     whether any frame was
    last_s, last_m, velocity  time, place and velocity of the track as it was last stated
    ranged_m   (3,) place of the track at the last range that was used
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
    ranged_m: FloatArray | None = None


class DescentNavigator:
    """Solves the frames of a descent one after the other.

    ground  all points of the catalog that have patches; None without a catalog
    middle_m (3,) a place that the descent goes over, m, body frame
    beam     (3,) unit vector of the altimeter, camera frame
    windows_above_m  nearer to the ground no windows are sought: relative landmarks alone
    """

    def __init__(
        self,
        inputs: NavigationInputs,
        ground: ControlPointField | None,
        track: InertialSettings,
        middle_m: FloatArray,
        windows_above_m: float = 0.0,
        beam: FloatArray = BORESIGHT,
    ) -> None:
        self._inputs, self._ground = inputs, ground
        self._windows = None if ground is None else WindowField(ground, middle_m)
        self._state = JointState(convert_track_errors(track))
        self._tracks, self._windows_above_m = LandmarkTracks(), windows_above_m
        self._solved, self._start_m = False, track.position_sigma_m
        self._last: tuple[float, FloatArray] | None = None
        self._velocity: FloatArray | None = None
        self._beam = beam
        self._ranged_m: FloatArray | None = None

    def solve(
        self, frame: Frame, camera: Camera, picture: Picture, answers: Answers | None = None
    ) -> Solution:
        """Solve a frame; the reason of an unsolved row says what is wrong.

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
        jump = self._propagate(observation.tdb_s, stated.position_m)
        loaded = replace(observation, picture=picture.load())
        values = PicturePyramid(loaded.picture.values)
        inputs = self._inputs
        context = FrameContext(loaded, values, self._ground, inputs.settings, inputs.matcher)
        seen = None
        if frame.range_m is not None and frame.range_sigma_m is not None:
            seen = Range(self._beam, frame.range_m, frame.range_sigma_m)
        row = self._solve_frame(context, self._windows, stated, seen)
        return row.with_remark(jump) if jump else row

    def ground_m(self, place_m: FloatArray) -> float | None:
        """Return the model's height over the sphere below a point (3,); None outside it."""
        return None if self._windows is None else self._windows.ground_m(place_m)

    @property
    def landmarks(self) -> list[Landmark]:
        """All landmarks so far."""
        return self._tracks.all

    def save_memory(self) -> DescentMemory:
        """Return all that the next frames depend on."""
        joint, state = self._state.filter, self._state
        keys = [[key] if isinstance(key, int) else list(key) for key in state.keys]
        arrays = joint.state, joint.covariance, joint.nominal_m
        landmarks = [
            landmark if not landmark.reason else landmark.drop_patch()
            for landmark in self._tracks.all
        ]
        last_s, last_m = self._last or (None, None)
        windows = keys, state.errors, state.spread
        memory = DescentMemory(
            *arrays, *windows, landmarks, self._solved, last_s, last_m, self._velocity
        )
        return replace(memory, ranged_m=self._ranged_m)

    def restore(self, memory: DescentMemory) -> None:
        """Go on as the descent that gave this memory."""
        self._state.filter.restore(memory.state, memory.covariance, memory.nominal_m)
        keys = [WindowKey(*key) if len(key) > 1 else key[0] for key in memory.keys]
        self._state.restore(keys, memory.errors, memory.spread)
        self._tracks.all = list(memory.landmarks)
        self._solved, self._velocity = memory.solved, memory.velocity
        self._ranged_m = memory.ranged_m
        if memory.last_s is not None and memory.last_m is not None:
            self._last = memory.last_s, memory.last_m

    def _propagate(self, tdb_s: float, position_m: FloatArray) -> Reason:
        """Propagate the filter to a frame; return why the track is not continuous, if so."""
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
        jump_m = float(np.linalg.norm(velocity - known)) * seconds
        # No craft changes its velocity by more than 20 m/s^2.
        if jump_m < 50.0 + 20.0 * seconds * seconds:
            return NO_REASON
        self._state.filter.add_jump(jump_m, 0.0)
        self._velocity = None
        text = (
            f"the inertial track jumps by {jump_m / 1e3:.1f} km in {seconds:.0f} s: a manoeuvre "
            "that it does not hold, or rows of another track"
        )
        return Reason(ReasonCode.TRACK_JUMP, text)

    def _solve_frame(
        self, frame: FrameContext, windows: WindowField, stated: Pose, ranged: Range | None
    ) -> Solution:
        seen = frame.observation
        prior_m = self._state.filter.pose(stated).position_m
        sought = self._search(frame, windows, stated)
        tracks = self._search_landmarks(frame, stated, sought)
        try:
            made = self._update(frame, stated, sought, tracks)
        except NoSolutionError as error:
            reason = Reason.from_error(error)
            shows_ground = find_view(frame.camera, self._state.filter.pose(stated), windows)
            if shows_ground is None or not self._is_carried(sought):
                rows = make_match_rows(frame, sought, tracks, {}, self._state.filter.pose(stated))
                n_found = sum(row.measured_px is not None for row in rows)
                evidence = Evidence(len(rows), n_found, 0, matches=rows)
                nothing = NoFix(reason, Method.DESCENT, evidence)
                return Solution(seen.file, seen.utc, nothing, PRIOR_SOURCE, prior_m)
            text = f"carried on by the inertial track: {reason}"
            made = Updated(self._state.copy(), {}, Reason(ReasonCode.CARRIED, text))
        if ranged is not None:
            made = self._use_range(made, windows, stated, ranged)
        self._state, self._solved = made.state, True
        fix = self._make_fix(frame, stated, sought, tracks, made)
        used = {key for key, good in made.used.items() if good and isinstance(key, int)}
        self._tracks.settle(frame, stated, self._state, tracks, used)
        rows = fix.evidence.matches
        taken = [row.measured_px for row in rows if row.used and row.measured_px is not None]
        self._tracks.add(frame, stated, self._state, windows, np.array(taken).reshape(-1, 2))
        return Solution(seen.file, seen.utc, fix, PRIOR_SOURCE, prior_m)

    def _use_range(
        self, made: Updated, windows: WindowField, stated: Pose, ranged: Range
    ) -> Updated:
        """Update what the picture gave by the altimeter's range, or say why not."""
        before, here = self._ranged_m, stated.position_m
        moved_m = np.inf if before is None else float(np.linalg.norm(here - before))
        state, refused = update_by_range(made.state, windows, stated, ranged, moved_m)
        if refused:
            return replace(made, remark=made.remark.add_sentence(refused))
        self._ranged_m = here
        return replace(made, state=state)

    def _is_carried(self, sought: Sequence[SoughtWindow]) -> bool:
        """Whether a frame that measures nothing is known from those before it.

        Not one that shows no window of those in view, or much that contradicts the track, and not
        a track that is known no better than at its start.
        """
        seen = [sight.match.reason for sight in sought]
        n_found = sum(not reason for reason in seen)
        if seen and all(reason.code == ReasonCode.OUT_OF_VIEW for reason in seen):
            return False
        if not self._solved or n_found >= MIN_AGAINST:
            return False
        covariance = self._state.filter.compute_pose_covariance()[:3, :3]
        return bool(np.linalg.eigvalsh(covariance)[-1] < self._start_m**2)

    def _make_fix(
        self,
        frame: FrameContext,
        stated: Pose,
        sought: Sequence[SoughtWindow],
        tracks: Sequence[SoughtLandmark],
        made: Updated,
    ) -> Fix:
        """Make the frame's fix after its update."""
        pose, covariance = (
            made.state.filter.pose(stated),
            made.state.filter.compute_pose_covariance(),
        )
        rows = make_match_rows(frame, sought, tracks, made.used, pose)
        residuals = [r.residual_px for r in rows if r.used and r.residual_px is not None]
        rms = float(np.sqrt(np.mean(np.square(residuals)))) if residuals else None
        windows = sum(row.used for row in rows if row.kind is MatchKind.WINDOW)
        kept = sum(row.used for row in rows)
        counts = len(rows), len(made.used), kept
        landmarks = kept - windows
        evidence = Evidence(*counts, rms, matches=rows, n_windows=windows, n_landmarks=landmarks)
        sigma = float(np.sqrt(np.trace(covariance[3:, 3:]) / 3.0))
        position, turn = pose.position_m, pose.camera_from_body
        method = Method.DESCENT if windows else Method.RELATIVE_LANDMARKS
        return Fix(method, position, covariance[:3, :3], turn, sigma, evidence, made.remark)

    def _search_landmarks(
        self, frame: FrameContext, stated: Pose, sought: Sequence[SoughtWindow]
    ) -> list[SoughtLandmark]:
        """Search earlier frames' landmarks from the pose that this frame's windows give."""
        if not self._tracks.tracked:
            return []
        state = self._state
        with suppress(NoSolutionError):  # without windows the track has to do
            state = self._update(frame, stated, sought, []).state
        return self._tracks.search(frame, stated, state, state.filter.pose(stated))

    def _search(
        self, frame: FrameContext, windows: WindowField, stated: Pose
    ) -> list[SoughtWindow]:
        """Search a frame's windows from the filter's pose or one nearer to the truth."""
        joint = self._state.filter
        view = find_view(frame.camera, joint.pose(stated), windows)
        if view is None or view.distance_m(frame.camera) < self._windows_above_m:
            return []
        pose, covariance = joint.pose(stated), joint.compute_pose_covariance()
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        level, _ = windows.choose_level(view, frame.camera) or (0, 0)
        finest = windows.posting_m(level) / OVERSAMPLED
        if sigma_m * frame.settings.match.search_sigmas > MAX_SEARCH_NODES * finest:
            fix = self._solve_by_points(frame, pose, sigma_m)
            if fix is not None:
                pose = Pose(fix.position_m, pose.camera_from_body)
                covariance[:3, :3] = fix.covariance_m2 + finest**2 * np.eye(3)
                sigma_m = finest
        sought = self._match_windows(frame, windows, pose, covariance)
        # A search wider than five nodes is repeated about its own result, so that templates fit.
        if sigma_m < 5.0 * finest:
            return sought
        try:
            trial = self._update(frame, stated, sought, []).state.filter
        except NoSolutionError:
            return sought
        # the same pixels again, better laid: the update that counts begins from before them
        return self._match_windows(
            frame, windows, trial.pose(stated), trial.compute_pose_covariance()
        )

    def _solve_by_points(self, frame: FrameContext, pose: Pose, sigma_m: float) -> Fix | None:
        """Solve by control points where the track predicts too uncertainly."""
        if self._inputs.points is None:
            return None
        prior = PositionPrior.isotropic(pose.position_m, sigma_m, PRIOR_SOURCE)
        return FrameMethods(self._inputs, frame.observation, {}).solve_by_points(prior).fix

    def _match_windows(
        self, frame: FrameContext, windows: WindowField, pose: Pose, covariance: FloatArray
    ) -> list[SoughtWindow]:
        """Match the windows of a frame about a pose with its covariance (6, 6)."""
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

    def _update(
        self,
        frame: FrameContext,
        stated: Pose,
        sought: Sequence[SoughtWindow],
        tracks: Sequence[SoughtLandmark],
    ) -> Updated:
        """Update the state by the matched windows and landmarks. Raises NoSolutionError."""
        matched = [sight for sight in sought if not sight.match.reason]
        landmarks = [sight for sight in tracks if not sight.match.reason]
        if not matched and (not landmarks or not self._solved):
            text = "neither a window of the terrain model nor a landmark was found"
            raise NoSolutionError(text, ReasonCode.FEW_POINTS)
        if not self._solved and len(matched) < MIN_FIRST:
            text = f"{len(matched)} windows were found; the first frame needs {MIN_FIRST}"
            raise NoSolutionError(text, ReasonCode.FEW_POINTS)
        seen = len(matched) + len(landmarks)
        for gate in (WINDOW_GATE, GATE) if matched else (GATE,):
            try:
                made = join_sightings(self._state, frame, stated, matched, landmarks, gate)
            except NoSolutionError as error:
                reason = error
                continue
            agreeing = sum(made.used.values())  # landmarks bear the track out as well
            if 2 * agreeing >= seen and (self._solved or agreeing >= MIN_FIRST):
                return made
            text = f"{agreeing} of {seen} windows and landmarks agree with the inertial track"
            reason = NoSolutionError(text, ReasonCode.POINTS_DISAGREE)
        if not self._solved or len(matched) < MIN_AGAINST:
            raise reason
        return self._update_after_jump(frame, stated, matched)

    def _update_after_jump(
        self, frame: FrameContext, stated: Pose, found: Sequence[SoughtWindow]
    ) -> Updated:
        """Update with a track that may have jumped. Raises NoSolutionError."""
        offsets = np.array([sight.match.pixel for sight in found]) - [
            sight.expected_px for sight in found
        ]
        camera_m = self._state.filter.pose(stated).position_m
        distance = float(np.linalg.norm(found[0].window.place_m - camera_m))
        offset_m = float(np.median(np.linalg.norm(offsets, axis=1)))
        offset_m = offset_m * distance / frame.camera.coarse_focal_px
        free = self._state.copy()
        free.filter.add_jump(3.0 * offset_m, 0.0)
        made = join_sightings(free, frame, stated, found, [])
        agreeing = sum(made.used.values())
        # A jump that the track's own positions do not show needs eight windows that agree: six near
        # the ground have agreed on a position 77 m off.
        wanted = max(8, len(found) // 2 + 1)
        if agreeing < wanted:
            text = (
                f"{agreeing} of {len(found)} windows agree with each other, against the inertial "
                f"track; a jump of it wants {wanted}"
            )
            raise NoSolutionError(text, ReasonCode.POINTS_DISAGREE)
        text = (
            f"the ground lies {offset_m:.0f} m from where the inertial track leads: it has jumped, "
            "by a manoeuvre that it does not hold"
        )
        return replace(made, remark=Reason(ReasonCode.TRACK_JUMP, text))
