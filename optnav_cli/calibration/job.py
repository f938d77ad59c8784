"""A picture folder and a catalog to a calibration: the camera's lens, mounting and clock.

The frames are navigated with sigmas that bear a camera which is not as stated; then the matches of
all are adjusted together (`estimation.adjustment`), with positions and attitudes of frames.csv as
measurements.
"""

import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError, NothingToDoError
from catalog.files import hash_file, replace_folder
from catalog.geometry.rotations import ARCSEC
from catalog.places import check_apart
from catalog.progress import Progress, log_stage
from optnav_cli.calibration.adjust_job import collect_rows, compute_stated_residuals
from optnav_cli.calibration.adjusted_folder import AdjustedRow, StatedResiduals, correct_camera
from optnav_cli.calibration.adjustment import AdjustedFrame, Adjustment, adjust
from optnav_cli.calibration.model import (
    CalibrateSettings,
    Direction,
    estimate_frame_motions,
    find_inseparable,
    find_tied_pairs,
)
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import write_camera
from optnav_cli.estimation.models.common import Common, CommonNumber
from optnav_cli.frames.folder import Folder, read_folder, write_folder
from optnav_cli.frames.frames import Frame, picture_path
from optnav_cli.frames.tables import CALIBRATION_RESIDUALS
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.output.manifest import hash_files, open_workspace, write_manifest
from optnav_cli.output.run_folder import CAMERAS, read_run
from optnav_cli.output.wording import align_table, format_json

KIND, STAGE = "calibration", "calibrate"
RESIDUALS_CSV, CALIBRATION_JSON = "residuals.csv", "calibration.json"
# Points are found by a wrong lens first, then by the lens found: patches that are drawn through a
# lens without its distortion are matched off by up to 0.1 px at the corners.
PASSES = 2
WEIGHINGS = 2  # of the matches by the residuals of the adjustment before
MIN_POINTS, MIN_FRAMES = 12, 2
MIN_WIDTH = 0.02  # of the points' spread in the picture, across over along: less is a line
# Poses of a right camera lie 1 sigma and less from what is stated of them; a wrong lens moves the
# poses, and leaves the residuals small.
MAX_OFF_STATEMENTS = 2.0
KINDS = (Common.FOCAL, Common.CENTRE, Common.DISTORTION, Common.MOUNTING, Common.CLOCK)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Result of a calibration.

    sigma_px     of a match, a coordinate, as the adjustment took it
    before_px, after_px  residuals of the matches kept, rms a coordinate
    """

    adjustment: Adjustment
    cameras: Mapping[str, Camera]
    frames: int
    matches: int
    used: int
    sigma_px: float
    before_px: float
    after_px: float

    @property
    def directions(self) -> list[Direction]:
        """Combinations of numbers that the frames do not separate."""
        common = self.adjustment.common
        return find_inseparable(common.numbers, self.adjustment.covariance)

    @property
    def notes(self) -> list[str]:
        """Notes on what the frames hardly observe."""
        common, focal = self.adjustment.common, {}
        for camera in self.cameras.values():
            focal[camera.name] = camera.focal_length_px
        groups = self.adjustment.find_inseparable()
        unseen = dict.fromkeys(name for names in groups for name in names)
        notes = [f"{name} is not observed" for name in unseen]
        notes += [direction.describe() for direction in self.directions]
        pairs = find_tied_pairs(common.numbers, self.adjustment.covariance, focal)
        return self._list_contradictions() + notes + [pair.describe() for pair in pairs]

    def _list_contradictions(self) -> list[str]:
        """List signs that something wrong was not solved for; its error is in no sigma here."""
        off = self.adjustment.off_statements
        if off < MAX_OFF_STATEMENTS:
            return []
        solved = {number.kind for number in self.adjustment.common.numbers}
        others = [kind.value for kind in KINDS if kind not in solved]
        other = f"{', '.join(others)} may be wrong: solve for them too; or " if others else ""
        return [
            f"the poses lie {off:.1f} sigmas (rms) from the positions and "
            f"attitudes that frames.csv states: {other}its sigmas are too small; the sigmas here "
            "do not hold that error"
        ]

    def rows(self) -> list[dict[str, object]]:
        """Build a row per number: value, sigma, and whether it is observed."""
        common, sigmas = self.adjustment.common, self.adjustment.sigmas
        unseen = {label for labels in self.adjustment.find_inseparable() for label in labels}
        together = {index for direction in self.directions for index in direction.places}
        rows: list[dict[str, object]] = []
        for index, (number, value) in enumerate(zip(common.numbers, common.values, strict=True)):
            camera = self.cameras[number.camera]
            unit, per, zero = _describe_unit(number, camera)
            rows.append(
                {
                    "name": number.kind.value,
                    "axis": number.axis,
                    "camera": number.camera,
                    "value": zero + per * float(value),
                    "change": per * float(value),
                    "sigma": per * float(sigmas[index]),
                    "prior_sigma": per * number.prior_sigma,
                    "unit": unit,
                    "observed": number.label not in unseen,
                    "told_apart": index not in together,
                }
            )
        return rows

    def document(self) -> dict[str, object]:
        """Build calibration.json."""
        covariance, sigmas = self.adjustment.covariance, self.adjustment.sigmas
        return {
            "numbers": self.rows(),
            "correlations": covariance / np.outer(sigmas, sigmas),
            "not_told_apart": [
                {"numbers": d.places, "labels": d.labels, "words": d.describe()}
                for d in self.directions
            ],
            "notes": self.notes,
            "frames": self.frames,
            "matches": self.matches,
            "matches_used": self.used,
            "sigma_px": self.sigma_px,
            "residual_rms_px": {"before": self.before_px, "after": self.after_px},
            "off_statements_sigmas": self.adjustment.off_statements,
            "variance_by_shared_points": self.adjustment.point_excess,
        }

    def lines(self) -> list[str]:
        """List the result for people."""
        head = ("", "", "value", "change", "sigma", "")
        table = [
            (
                f"{row['name']} {row['axis']}".strip(),
                str(row["camera"]),
                f"{row['value']:.7g}",
                f"{row['change']:.4g}",
                f"{row['sigma']:.2g}",
                str(row["unit"]),
            )
            for row in self.rows()
        ]
        return [
            f"calibrated by {self.used} of {self.matches} matches in {self.frames} frames",
            *align_table([head, *table], left=(0, 1, 5)),
            f"residuals, rms a coordinate, px: {self.before_px:.2f} as stated, "
            f"{self.after_px:.2f} after",
            *self.notes,
        ]


def calibrate_folder(
    given: RunInputs,
    output: Path,
    kinds: Sequence[Common],
    settings: CalibrateSettings,
    progress: Progress,
    workers: int | None = 1,
) -> Calibration:
    """Calibrate the cameras of a picture folder by its control points.

    given  the folder, the catalogs, and how points are searched
    kinds  what to solve for
    Raises DataError for a folder without positions or attitudes, NothingToDoError for too few
    frames or points, or points on a line, NoSolutionError where the frames leave something open.
    """
    started = datetime.now(UTC)
    check_apart(output, [given.pictures, *given.catalogs])
    folder = read_folder(given.pictures, given.kernels)
    _check_stated(folder, kinds)
    with log_stage(STAGE), open_workspace(output, KIND) as workspace:
        cameras: Mapping[str, Camera] = folder.cameras
        for number in range(PASSES):
            wide = workspace.folder / f"pictures-{number}"
            _write_wide(folder, wide, settings, cameras)
            run = workspace.folder / f"run-{number}"
            with suppress(NothingToDoError):  # said below, with what a calibration wants
                navigate_folder(replace(given, pictures=wide), run, progress, workers=workers)
            rows = _add_statements(collect_rows([read_run(run)], dict(cameras)), folder)
            result, stages = solve_calibration(rows, kinds, settings)
            corrected = {
                c.name: correct_camera(c, result.adjustment) for c in result.cameras.values()
            }
            cameras = {**folder.cameras, **corrected}
        with replace_folder(output, KIND) as work:
            write_calibration(work, rows, result, stages)
            write_manifest(
                work,
                KIND,
                command="calibrate",
                options={"solve": [kind.value for kind in kinds]},
                inputs={
                    "folder": given.pictures,
                    "files_sha256": hash_files(given.pictures, ["run.toml", "frames.csv"]),
                    "catalogs": [
                        {"path": path, "sha256": hash_file(path)} for path in given.catalogs
                    ],
                },
                results={"frames": result.frames, "matches": result.used},
                started=started,
            )
    return result


def solve_calibration(
    rows: Sequence[AdjustedRow], kinds: Sequence[Common], settings: CalibrateSettings
) -> tuple[Calibration, list[StatedResiduals]]:
    """Adjust frames with their statements; return the residuals of each before, too."""
    frames = [row.adjusted for row in rows if row.adjusted is not None]
    check_points(frames)
    cameras = {frame.camera.name: frame.camera for frame in frames}
    known = {name: camera for name, camera in cameras.items() if isinstance(camera, Camera)}
    numbers = settings.list_numbers(list(kinds), sorted(known))
    adjustment = adjust(frames, numbers, by_direction=True)
    # matches were weighed by residuals of a wrong lens: now by those of the right one
    for _ in range(WEIGHINGS):
        variance = _estimate_variance(adjustment, len(numbers))
        frames = [_replace_covariances(frame, variance) for frame in frames]
        adjustment = adjust(frames, numbers, by_direction=True)
    stages = [compute_stated_residuals(frame, adjustment.common) for frame in frames]
    kept = [result_of_frame.weights > 0.0 for result_of_frame in adjustment.frames]
    before = np.concatenate([s.stated[k] for s, k in zip(stages, kept, strict=True)])
    after = np.concatenate(
        [f.residuals_px[k] for f, k in zip(adjustment.frames, kept, strict=True)]
    )
    result = Calibration(
        adjustment,
        known,
        len(frames),
        sum(len(frame.sightings) for frame in frames),
        int(sum(k.sum() for k in kept)),
        float(np.sqrt(variance)),
        _compute_rms(before),
        _compute_rms(after),
    )
    return result, stages


def check_points(frames: Sequence[AdjustedFrame]) -> None:
    """Raise NothingToDoError for frames and points that cannot calibrate a camera."""
    count = sum(len(frame.sightings) for frame in frames)
    if len(frames) < MIN_FRAMES or count < MIN_POINTS:
        raise NothingToDoError(
            f"{len(frames)} frames are solved by control points, with {count} points; a "
            f"calibration wants {MIN_FRAMES} frames and {MIN_POINTS} points, and should have many "
            "more: see why in a run of `optnav navigate`"
        )
    pixels = np.concatenate([frame.sightings.pixels for frame in frames])
    spread = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)
    if spread[1] < MIN_WIDTH * spread[0]:
        raise NothingToDoError(
            "the control points of all frames lie on a line in the picture: they tell nothing of "
            "the lens across it; add frames with points elsewhere"
        )


def _check_stated(folder: Folder, kinds: Sequence[Common]) -> None:
    """Raise DataError for frames.csv without what a calibration measures against."""
    where = folder.path / "frames.csv"
    good = [frame for frame in folder.frames if frame.problem is None]
    bad = [f"; {frame.file}: {frame.problem}" for frame in folder.frames if frame.problem]
    placed = [f for f in good if f.position_m is not None and f.position_sigma_m is not None]
    if len(placed) < MIN_FRAMES:
        raise DataError(
            f"{where}: {len(placed)} of {len(folder.frames)} rows have a position with its sigma, "
            f"and {MIN_FRAMES} or more are wanted; a calibration measures the camera against known "
            f"positions: fill in x_m, y_m, z_m and position_sigma_m{''.join(bad[:1])}"
        )
    turned = [frame for frame in placed if frame.camera_from_body is not None]
    if len(turned) < MIN_FRAMES:
        raise DataError(
            f"{where}: {len(turned)} of {len(folder.frames)} rows have an attitude with their "
            f"position, and {MIN_FRAMES} or more are wanted; a calibration measures the camera "
            "against known attitudes: fill in qw, qx, qy, qz and attitude_sigma_arcsec"
        )
    known = sum(frame.own_attitude_sigma_rad is not None for frame in turned)
    if Common.MOUNTING in kinds and known < MIN_FRAMES:
        raise DataError(
            f"{where}: {known} rows have a sigma of their attitude; the mounting is measured "
            "against known attitudes: fill in attitude_sigma_arcsec, or leave mounting out of "
            "--solve"
        )


def _write_wide(
    folder: Folder, place: Path, settings: CalibrateSettings, cameras: Mapping[str, Camera]
) -> None:
    """Write a copy of a folder with other cameras, and sigmas wide enough for wrong ones."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    search = settings.search
    frames: list[Frame] = []
    for frame in folder.frames:
        if frame.problem is not None or frame.position_m is None:
            continue
        sigma_m = float(np.hypot(frame.position_sigma_m or 0.0, search.position_m))
        angle = search.attitude_arcsec * ARCSEC
        sigma = float(np.hypot(frame.attitude_sigma_rad or 0.0, angle))
        turn, camera = frame.camera_from_body, cameras[frame.camera]
        if turn is not None:
            turn = camera.apply_boresight(folder.cameras[frame.camera].remove_boresight(turn))
        changed = replace(frame, camera_from_body=turn, position_sigma_m=sigma_m)
        frames.append(replace(changed, attitude_sigma_rad=sigma))
        target = picture_path(place, frame.file)
        target.parent.mkdir(parents=True, exist_ok=True)
        source = folder.picture_path(frame).absolute()
        if source.exists():
            try:
                target.symlink_to(source)
            except OSError:  # no links there
                shutil.copyfile(source, target)
    write_folder(place, folder.settings, cameras.values(), frames, folder.motion)


def _add_statements(rows: Sequence[AdjustedRow], folder: Folder) -> list[AdjustedRow]:
    """Add what frames.csv states of the rows, as measurements."""
    stated = {frame.file: frame for frame in folder.frames}
    updated: list[AdjustedRow] = list(rows)
    for name in folder.cameras:
        indices = [n for n, row in enumerate(rows) if row.frame.camera == name]
        frames = [stated[rows[n].frame.file] for n in indices]
        motions = estimate_frame_motions(
            [f.tdb_s or 0.0 for f in frames], [f.position_m for f in frames]
        )
        for number, frame, motion in zip(indices, frames, motions, strict=True):
            adjusted = rows[number].adjusted
            if adjusted is None:
                continue
            adjusted = replace(
                adjusted,
                camera=folder.cameras[name],
                position_m=frame.position_m,
                position_sigma_m=frame.position_sigma_m,
                attitude=frame.camera_from_body,
                # what all frames have in common is solved for
                attitude_sigma_rad=frame.own_attitude_sigma_rad,
                motion=motion,
            )
            updated[number] = replace(rows[number], frame=frame, adjusted=adjusted)
    return updated


def _estimate_variance(adjustment: Adjustment, numbers: int) -> float:
    """Estimate the variance of a match's coordinate, px², by the residuals of the matches kept."""
    total, free = 0.0, -float(numbers)
    for frame in adjustment.frames:
        kept = frame.weights > 0.0
        total += float((frame.residuals_px[kept] ** 2).sum())
        # statements hold a part of the six numbers of a pose: half of them on the average
        free += 2.0 * float(kept.sum()) - 3.0
    return total / max(free, 1.0)


def _replace_covariances(frame: AdjustedFrame, variance: float) -> AdjustedFrame:
    tiles = np.tile(np.eye(2) * variance, (len(frame.sightings), 1, 1))
    return replace(frame, sightings=replace(frame.sightings, covariances_px2=tiles))


def _compute_rms(residuals: FloatArray) -> float:
    finite = residuals[np.isfinite(residuals)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else 0.0


def _describe_unit(number: CommonNumber, camera: Camera) -> tuple[str, float, float]:
    """Return the unit that a number is written in, how many make the state's, and its zero."""
    x, y = camera.principal_point_px
    if number.kind == Common.FOCAL:
        return "px", camera.focal_length_px, camera.focal_length_px
    if number.kind == Common.CENTRE:
        return "px", 1.0, x if number.axis == "x" else y
    if number.kind == Common.DISTORTION:
        return "", 1.0, camera.coefficients[0] if camera.coefficients else 0.0
    return ("s", 1.0, 0.0) if number.kind == Common.CLOCK else ("arcsec", 1.0 / ARCSEC, 0.0)


def write_calibration(
    place: Path, rows: Sequence[AdjustedRow], result: Calibration, stages: Sequence[StatedResiduals]
) -> None:
    """Write the folder but for its manifest."""
    (place / CAMERAS).mkdir()
    for camera in result.cameras.values():
        write_camera(place / CAMERAS, correct_camera(camera, result.adjustment))
    (place / CALIBRATION_JSON).write_text(format_json(result.document()) + "\n", encoding="utf-8")
    cells: list[dict[str, object]] = []
    solved = [row for row in rows if row.adjusted is not None]
    for row, frame_result, stage in zip(solved, result.adjustment.frames, stages, strict=True):
        for k, match in enumerate(row.matches):
            cells_of_match: dict[str, object] = {"file": row.frame.file, "camera": row.frame.camera}
            cells_of_match |= {
                "catalog": match.catalog,
                "id": match.cp_id,
                "weight": frame_result.weights[k],
            }
            for name, values in (
                ("measured", match.measured_px),
                ("before", stage.stated[k]),
                ("after", frame_result.residuals_px[k]),
            ):
                if values is not None and np.isfinite(values).all():
                    cells_of_match |= {f"{name}_x_px": values[0], f"{name}_y_px": values[1]}
            cells.append(cells_of_match)
    CALIBRATION_RESIDUALS.write(place / RESIDUALS_CSV, cells)
