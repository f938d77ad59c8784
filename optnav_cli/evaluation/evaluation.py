"""Solutions against the truth: each frame's error in R, N, B and its share of wrong matches."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from optnav_cli.camera.camera import Camera
from optnav_cli.evaluation.figures import (
    Figures,
    Forward,
    FrameError,
    MethodFigures,
    compute_figures,
    compute_method_figures,
    find_motion_axes,
    make_unsolved_figures,
)
from optnav_cli.fix import MatchKind, MatchRow, Solution
from optnav_cli.frames.truth import Truth

WRONG_PX = 3.0  # a match further than this from the truth is a wrong one


@dataclass(frozen=True)
class Evaluation:
    """Frames against their truth, of one run or of several, and a remark on what is left out."""

    frames: tuple[FrameError, ...]
    remarks: tuple[str, ...] = ()

    def figures(self) -> Figures:
        """Add the frames up. Raises NothingToDoError when none is solved."""
        return compute_figures(self.frames)

    def figures_if_any(self) -> Figures:
        """Add the frames up; NaN figures where none is solved."""
        return self.figures() if self.any_solved else make_unsolved_figures(self.frames)

    @property
    def any_solved(self) -> bool:
        """Whether there is a frame to add up."""
        return any(frame.error_rnb_m is not None for frame in self.frames)

    def without_attitudes(self, remark: str) -> "Evaluation":
        """Drop what true attitudes say when they are of another frame."""
        frames = (
            replace(frame, attitude_error_rad=None, n_checked=None, n_wrong=None)
            for frame in self.frames
        )
        return Evaluation(tuple(frames), (*self.remarks, remark))

    def by_method(self) -> list[MethodFigures]:
        """Add the frames up for each method and camera, from afar to near."""
        return compute_method_figures(self.frames)


def evaluate(
    solutions: Sequence[Solution],
    truths: Sequence[Truth],
    reference_radius_m: float,
    matches: Iterable[MatchRow] = (),
    cameras: Mapping[str, Camera] | None = None,
) -> Evaluation:
    """Compare solutions with the truth of the same frames.

    truths   frames that the run does not have are left out with a remark
    matches  the control points tried; counted as right or wrong where `cameras` (by file name)
             has the frame's camera
    Raises DataError when a frame has no truth or one of another time.
    """
    cameras = cameras or {}
    by_file = {truth.file: truth for truth in truths}
    _check_same_frames(solutions, by_file)
    # The direction of motion rests on all true positions, also of frames that the run lacks.
    axes = dict(zip(by_file, find_motion_axes(truths), strict=True))
    kept: dict[str, list[MatchRow]] = {}
    for match in matches:
        # near the ground metres are many pixels, and a landmark has no known place
        known = match.kind is MatchKind.CONTROL_POINT
        if known and match.used and match.measured_px is not None:
            kept.setdefault(match.file, []).append(match)
    frames = tuple(
        _compare_frame(s, by_file[s.file], *axes[s.file], reference_radius_m, kept, cameras)
        for s in solutions
    )
    extra = len(truths) - len(solutions)
    remark = f"{extra} frames of the truth are not in the run and are left out"
    return Evaluation(frames, (remark,) if extra else ())


def combine_evaluations(evaluations: Iterable[Evaluation]) -> Evaluation:
    """Combine evaluations; each frame keeps its own truth and axes."""
    evaluations = list(evaluations)
    return Evaluation(
        tuple(frame for evaluation in evaluations for frame in evaluation.frames),
        tuple(remark for evaluation in evaluations for remark in evaluation.remarks),
    )


def _check_same_frames(solutions: Sequence[Solution], truths: Mapping[str, Truth]) -> None:
    missing = [s.file for s in solutions if s.file not in truths]
    if missing:
        more = f" and {len(missing) - 1} more frames" if len(missing) > 1 else ""
        raise DataError(
            f"the truth has no {missing[0]}{more} of the run's {len(solutions)}; "
            "wanted the truth.csv of the folder that was navigated"
        )
    for solution in solutions:
        truth = truths[solution.file]
        if solution.solved and abs(utc_to_tdb_s(solution.utc) - truth.tdb_s) > 0.01:
            raise DataError(
                f"{solution.file}: the run has the time {solution.utc}, the truth {truth.utc}; "
                "wanted the truth.csv of the folder that was navigated"
            )


def _count_wrong(
    kept: Sequence[MatchRow], truth: Truth, camera: Camera | None
) -> tuple[int | None, int | None]:
    """Count kept matches, and those more than WRONG_PX from the point's true pixel."""
    if camera is None or not truth.has_attitude:
        return None, None
    if not kept:
        return 0, 0
    points = np.array([match.cp_position_m for match in kept])
    measured = np.array([match.measured_px for match in kept])
    true_px = camera.project_from_body(points, truth.position_m, truth.camera_from_body.as_matrix())
    off = np.linalg.norm(measured - true_px, axis=1)
    # not <=, so that a point which truly is out of view (NaN) counts as wrong
    return len(kept), int((~(off <= WRONG_PX)).sum())


def _compare_frame(
    solution: Solution,
    truth: Truth,
    axes: FloatArray,
    forward: Forward,
    reference_radius_m: float,
    kept: Mapping[str, Sequence[MatchRow]],
    cameras: Mapping[str, Camera],
) -> FrameError:
    camera = cameras.get(solution.file)
    distance = float(np.linalg.norm(truth.position_m))
    height, name = distance - reference_radius_m, camera.name if camera is not None else ""
    frame = FrameError(
        solution.file, solution.utc, solution, forward, height, distance_m=distance, camera=name
    )
    if solution.position_m is None or solution.covariance_m2 is None or not solution.solved:
        return frame
    error = solution.position_m - truth.position_m
    angle = None
    if solution.camera_from_body is not None and truth.has_attitude:
        angle = float((solution.camera_from_body * truth.camera_from_body.inv()).magnitude())
    n_checked, n_wrong = _count_wrong(kept.get(solution.file, ()), truth, camera)
    return replace(
        frame,
        error_rnb_m=axes @ error,
        sigma_rnb_m=np.sqrt(np.diag(axes @ solution.covariance_m2 @ axes.T)),
        nees=float(error @ np.linalg.solve(solution.covariance_m2, error)),
        attitude_error_rad=angle,
        n_checked=n_checked,
        n_wrong=n_wrong,
    )
