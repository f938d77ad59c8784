"""Adjust runs: their frames and matches in one least squares, and the folder that comes of it."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError, NoSolutionError, NothingToDoError
from catalog.files import MANIFEST
from catalog.geometry.rotations import ARCSEC
from optnav_cli.calibration.adjusted_folder import (
    MIN_MATCHES,
    AdjustedRow,
    AdjustedRuns,
    StatedResiduals,
    write_adjusted,
)
from optnav_cli.calibration.adjustment import (
    AdjustedFrame,
    Adjustment,
    adjust,
    compute_residuals,
    compute_stated_pose,
    estimate_shared_errors,
)
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.models.common import OF_THE_CATALOG, Common, CommonState, common_numbers
from optnav_cli.estimation.models.points import Pose, Sightings
from optnav_cli.estimation.robust import STATED_DEGREES_OF_FREEDOM
from optnav_cli.fix import MatchRow, Method, Solution
from optnav_cli.frames.folder import read_cameras
from optnav_cli.frames.frames import Frame, read_frames
from optnav_cli.output.manifest import hash_files, output_folder, read_manifest
from optnav_cli.output.run_folder import CAMERAS, FRAMES, MATCHES, SOLUTION, RunFolder, read_run
from optnav_cli.reasons import ReasonCode

KIND = "adjusted run"
MIN_SIGMA_PX = 0.02  # of a match, whatever the residuals say


class LabelScatter(NamedTuple):
    """Scatter of statements, 1 sigma per component; None: that of frames.csv.

    A search needs sigmas that hold what all statements have in common as well.
    """

    position_sigma_m: float | None = None
    attitude_sigma_arcsec: float | None = None


NO_SCATTER = LabelScatter()


def adjust_runs(
    runs: Sequence[Path], output: Path, kinds: Sequence[Common], scatter: LabelScatter = NO_SCATTER
) -> AdjustedRuns:
    """Adjust the frames of runs together and write the folder of the adjusted run.

    kinds    what is common to the frames and to be solved for
    scatter  of the stated positions and attitudes once that is taken out
    Raises DataError for runs that do not belong together, NothingToDoError without a frame to
    adjust, NoSolutionError when the frames leave something open.
    """
    with output_folder(output, KIND, "adjust", runs, "adjust") as out:
        read = [read_run(path) for path in runs]
        first = read[0]
        _check_together(read, kinds)
        cameras = _read_all_cameras(read)
        rows = collect_rows(read, cameras)
        if Common.BORESIGHT in kinds or Common.BODY_ROTATION in kinds:
            rows = [_subtract_common_sigma(row) for row in rows]
        rows = [_replace_sigmas(row, scatter) for row in rows]
        frames = [row.adjusted for row in rows if row.adjusted is not None]
        if not frames:
            raise NothingToDoError(
                f"{', '.join(map(str, runs))}: no frame is solved by {MIN_MATCHES} or more control "
                "points, so there is nothing to adjust; navigate with a catalog first"
            )
        names = sorted({frame.camera.name for frame in frames})
        numbers = common_numbers(kinds, names, first.attitude.body.radius_m)
        adjustment = adjust(frames, numbers)
        focal_px = {camera.name: camera.focal_length_px for camera in cameras.values()}
        stages = [compute_stated_residuals(frame, adjustment.common) for frame in frames]
        result = AdjustedRuns(
            adjustment,
            len(frames),
            cameras,
            _compute_stage_rms(adjustment, stages),
            _compute_misfit(frames, adjustment, stages, focal_px),
        )
        write_adjusted(out.path, first, rows, cameras, result, stages)
        out.options = {"solve": [kind.value for kind in kinds], **scatter._asdict()}
        files = [SOLUTION, MATCHES, FRAMES]
        out.inputs = {
            "runs": [{"path": str(path), "files_sha256": hash_files(path, files)} for path in runs]
        }
        out.results = {"frames": len(rows), "adjusted": len(frames)}
    return result


def _check_together(runs: Sequence[RunFolder], kinds: Sequence[Common]) -> None:
    """Raise DataError for runs of several bodies, or that have nothing in common."""
    first = runs[0]
    places = Counter(run.path.resolve() for run in runs)
    for run in runs:
        if places[run.path.resolve()] > 1:
            raise DataError(f"{run.path}: is named twice; name each run once")
    for run in runs[1:]:
        if run.attitude.body != first.attitude.body:
            raise DataError(
                f"{run.path}: its body ({run.attitude.body.name}) is not that of {first.path} "
                f"({first.attitude.body.name}), or of another file; adjust runs of one body file"
            )
        catalogs, others = _list_catalogs(run), _list_catalogs(first)
        apart = not catalogs & others
        shared = {c.name for c in run.cameras.values()} & {c.name for c in first.cameras.values()}
        if apart and not shared:
            raise DataError(
                f"{run.path} and {first.path}: share neither a catalog nor a camera, so nothing is "
                "common to them; adjust each by itself"
            )
        wanted = [kind.value for kind in kinds if kind in OF_THE_CATALOG]
        if apart and wanted:
            raise DataError(
                f"{run.path}: rests on {_describe_catalogs(catalogs)}, {first.path} on "
                f"{_describe_catalogs(others)}; "
                f"{', '.join(wanted)} can be common to runs of one catalog only: leave them out of "
                "--solve, or adjust each run by itself"
            )


def _list_catalogs(run: RunFolder) -> set[tuple[str, str]]:
    """Names and digests of the catalogs that the matches of a run rest on."""
    digests: dict[str, str] = {}
    if (run.path / MANIFEST).exists():
        listed = read_manifest(run.path).get("inputs", {}).get("catalogs", [])
        digests = {Path(entry["path"]).name: entry["digest"] for entry in listed}
    return {(name, digests.get(name, "")) for name in {m.catalog for m in run.matches if m.used}}


def _describe_catalogs(catalogs: set[tuple[str, str]]) -> str:
    names = sorted(f"{name} ({digest[:8]})" if digest else name for name, digest in catalogs)
    return " and ".join(names) or "no catalog"


def _read_all_cameras(runs: Sequence[RunFolder]) -> dict[str, Camera]:
    """All cameras by name. Raises DataError for two of one name."""
    cameras: dict[str, Camera] = {}
    for run in runs:
        for name, camera in read_cameras(run.path / CAMERAS).items():
            if cameras.setdefault(name, camera) != camera:
                raise DataError(
                    f"{run.path}: its camera '{name}' is another than that of {runs[0].path}; give "
                    "it another name, or navigate both with one camera file"
                )
    return cameras


def collect_rows(runs: Sequence[RunFolder], cameras: dict[str, Camera]) -> list[AdjustedRow]:
    """Collect the frames of all runs; prefix their names by the run where two are equal."""
    files = Counter(solution.file for run in runs for solution in run.solutions)
    prefixed = max(files.values(), default=1) > 1
    points: dict[tuple[str, int], int] = {}
    rows = []
    for run in runs:
        stated = {f.file: f for f in read_frames(run.path / FRAMES, run.attitude, cameras)}
        matches: dict[str, list[MatchRow]] = {}
        for match in run.matches:
            matches.setdefault(match.file, []).append(match)
        for solution in run.solutions:
            if solution.file not in stated:
                raise DataError(f"{run.path / FRAMES}: has no row for {solution.file}")
            candidates = [m for m in matches.get(solution.file, []) if _is_candidate(m)]
            frame = stated[solution.file]
            adjusted = _make_adjusted_frame(solution, frame, candidates, cameras, points)
            row = AdjustedRow(solution, frame, candidates, adjusted)
            rows.append(_rename(row, f"{run.path.name}/{solution.file}") if prefixed else row)
    return _weigh_rows(rows)


def _is_candidate(match: MatchRow) -> bool:
    return match.measured_px is not None and (match.used or match.reason_code == ReasonCode.OUTLIER)


def _rename(row: AdjustedRow, name: str) -> AdjustedRow:
    return AdjustedRow(
        replace(row.solution, file=name),
        replace(row.frame, file=name),
        [replace(match, file=name) for match in row.matches],
        row.adjusted,
    )


def _make_adjusted_frame(
    solution: Solution,
    frame: Frame,
    matches: list[MatchRow],
    cameras: Mapping[str, Camera],
    points: dict[tuple[str, int], int],
) -> AdjustedFrame | None:
    """Make the frame that goes into the adjustment; None where it cannot.

    points  numbers of control points, to which those of the frame are added
    """
    fix, used = solution.fix, [match.used for match in matches]
    if fix is None or fix.method != Method.CONTROL_POINTS or sum(used) < MIN_MATCHES:
        return None
    if fix.camera_from_body is None or frame.camera not in cameras:
        return None
    numbered = [points.setdefault((m.catalog, m.cp_id), len(points)) for m in matches]
    sightings = Sightings(
        np.array([m.cp_position_m for m in matches]),
        np.array([m.measured_px for m in matches], dtype=np.float64),
        np.tile(np.eye(2), (len(matches), 1, 1)),
    )
    adjusted = AdjustedFrame(
        cameras[frame.camera],
        sightings,
        np.array(numbered),
        Pose(fix.position_m, fix.camera_from_body),
        frame.position_m,
        frame.position_sigma_m,
        frame.camera_from_body,
        frame.attitude_sigma_rad,
    )
    return adjusted


def _weigh_rows(rows: Sequence[AdjustedRow]) -> list[AdjustedRow]:
    """Add the scatter of the matches to frames, and what their runs state beyond it."""
    squares, freedom = [], []
    for row in rows:
        if row.adjusted is None:
            continue
        residuals = _compute_own_residuals(row, row.adjusted)
        squares.append(float((residuals**2).sum()))
        unknowns = 3 if row.adjusted.attitude_sigma_rad == 0.0 else 6
        freedom.append(max(residuals.size - unknowns, 1))
    if not squares:
        return list(rows)
    pooled = sum(squares) / sum(freedom)
    weighted, each = [], iter(zip(squares, freedom, strict=True))
    for row in rows:
        frame, fix = row.adjusted, row.solution.fix
        if frame is not None and fix is not None:
            total, free = next(each)
            # few matches say little of their scatter: all frames' counts as so many more
            variance = total + STATED_DEGREES_OF_FREEDOM * pooled
            variance /= free + STATED_DEGREES_OF_FREEDOM
            tiles = np.tile(np.eye(2) * max(variance, MIN_SIGMA_PX**2), (len(row.matches), 1, 1))
            frame = replace(frame, sightings=replace(frame.sightings, covariances_px2=tiles))
            used = np.array([match.used for match in row.matches])
            seen = replace(frame, sightings=frame.sightings.subset(used))
            try:
                shared = estimate_shared_errors(seen, fix.covariance_m2)
                frame = replace(frame, shared_m2=shared)
            except NoSolutionError:
                frame = None
        weighted.append(replace(row, adjusted=frame))
    return weighted


def _replace_sigmas(row: AdjustedRow, scatter: LabelScatter) -> AdjustedRow:
    """Replace the sigmas of a frame's statements, where others are given."""
    frame = row.adjusted
    if frame is None:
        return row
    position_m, attitude = frame.position_sigma_m, frame.attitude_sigma_rad
    if scatter.position_sigma_m is not None and position_m is not None:
        position_m = scatter.position_sigma_m
    if scatter.attitude_sigma_arcsec is not None and attitude is not None:
        attitude = scatter.attitude_sigma_arcsec * ARCSEC
    return replace(
        row, adjusted=replace(frame, position_sigma_m=position_m, attitude_sigma_rad=attitude)
    )


def _subtract_common_sigma(row: AdjustedRow) -> AdjustedRow:
    """Subtract from the attitude's sigma what the common numbers are solved for."""
    frame, common = row.adjusted, row.frame.common_sigma_rad
    if frame is None or not frame.attitude_sigma_rad or not common:
        return row
    sigma_rad = float(np.sqrt(max(frame.attitude_sigma_rad**2 - common**2, 0.0)))
    return replace(row, adjusted=replace(frame, attitude_sigma_rad=sigma_rad))


def _compute_own_residuals(row: AdjustedRow, frame: AdjustedFrame) -> FloatArray:
    """Compute residuals (n, 2), px, of the matches used, from the run's own pose."""
    used = np.array([match.used for match in row.matches])
    nothing = CommonState((), np.empty(0))
    residuals = compute_residuals(frame, frame.start, nothing)
    kept: FloatArray = np.where(np.isfinite(residuals), residuals, 0.0)[used]
    return kept


def compute_stated_residuals(frame: AdjustedFrame, common: CommonState) -> StatedResiduals:
    nothing = CommonState(common.numbers, np.zeros_like(common.values))
    stages = []
    for state in (nothing, common):
        pose = compute_stated_pose(frame, state)
        unknown = np.full((len(frame.sightings), 2), np.nan)
        stages.append(unknown if pose is None else compute_residuals(frame, pose, state))
    return StatedResiduals(*stages)


def _compute_stage_rms(
    adjustment: Adjustment, stages: Sequence[StatedResiduals]
) -> dict[str, float]:
    """Compute residuals of the matches kept, rms per coordinate, for each stage."""
    kept = [frame.weights > 0.0 for frame in adjustment.frames]
    parts = {
        "as stated": [stage.stated for stage in stages],
        "with what is common": [stage.constants for stage in stages],
        "adjusted": [frame.residuals_px for frame in adjustment.frames],
    }
    rms_px = {}
    for name, residuals in parts.items():
        all_of = np.concatenate([r[k] for r, k in zip(residuals, kept, strict=True)])
        finite = all_of[np.isfinite(all_of)]
        if finite.size:
            rms_px[name] = float(np.sqrt(np.mean(finite**2)))
    return rms_px


def _compute_misfit(
    frames: Sequence[AdjustedFrame],
    adjustment: Adjustment,
    stages: Sequence[StatedResiduals],
    focal_px: Mapping[str, float],
) -> dict[str, float]:
    """Compute the errors of statements, rms over frames, with the common numbers taken out."""
    left, weights = [], []
    for frame, result, stage in zip(frames, adjustment.frames, stages, strict=True):
        kept = (result.weights > 0.0) & np.isfinite(stage.constants).all(axis=1)
        if kept.sum() < MIN_MATCHES:
            continue
        out = frame.sightings.pixels[kept] - np.array(frame.camera.principal_point_px)
        middle = out.mean(axis=0)
        x, y = (out - middle).T
        zeros, ones = np.zeros_like(x), np.ones_like(x)
        # a shift, a roll and a stretch about the middle of the matches
        rows = np.stack([ones, zeros, -y, x, zeros, ones, x, y]).reshape(2, 4, -1)
        design = rows.transpose(2, 0, 1).reshape(-1, 4)
        normal = design.T @ design
        solved = np.linalg.solve(normal, design.T @ stage.constants[kept].ravel())
        variances = np.diag(np.linalg.inv(normal)) * frame.sightings.covariances_px2[0, 0, 0]
        range_m = float(np.linalg.norm(result.pose.position_m))
        metres = float(np.hypot(*solved[:2])) * range_m / focal_px[frame.camera.name]
        left.append(
            [float(np.hypot(*solved[:2])), metres, np.degrees(solved[2]), 100.0 * solved[3]]
        )
        weights.append(1.0 / variances[[0, 0, 2, 3]])  # few matches say little of a roll
    if not left:
        return {}
    rms = np.sqrt(np.average(np.square(left), axis=0, weights=np.array(weights)))
    names = ("shift_px", "shift_m", "roll_deg", "range_percent")
    return {name: float(value) for name, value in zip(names, rms, strict=True)}
