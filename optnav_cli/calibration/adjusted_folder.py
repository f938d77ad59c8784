"""The folder of an adjusted run: solution, matches, what is common, corrected body and cameras."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import CatalogFrame, is_body_file
from catalog.config import resource
from catalog.geometry.rotations import ARCSEC
from optnav_cli.calibration.adjustment import AdjustedFrame, Adjustment, FrameResult
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import write_camera
from optnav_cli.estimation.models.common import OF_THE_CATALOG, Common, CommonNumber, CommonState
from optnav_cli.fix import Evidence, Fix, MatchRow, Method, NoFix, Solution
from optnav_cli.frames.frames import Frame, write_frames
from optnav_cli.frames.run_settings import RunSettings, write_run_settings
from optnav_cli.frames.tables import COMMON_NUMBERS
from optnav_cli.output.run_folder import (
    CAMERAS,
    COMMON_CSV,
    COMMON_JSON,
    FRAMES,
    MATCHES,
    SOLUTION,
    RunFolder,
)
from optnav_cli.output.tables import AdjustedMatch, write_adjusted_matches, write_solutions
from optnav_cli.output.wording import align_table
from optnav_cli.reasons import Reason, ReasonCode

MIN_MATCHES = 3  # of a frame
OUTLIER = Reason(ReasonCode.OUTLIER, "disagrees with the others")
DISAGREES = Reason(
    ReasonCode.POINTS_DISAGREE, "its control points disagree with those of the other frames"
)
SECTION = re.compile(r"\s*\[{1,2}([\w.-]+)\]{1,2}\s*(#.*)?")  # the head of one, in a TOML file
NOT_ADJUSTED = Reason(ReasonCode.FEW_POINTS, "not adjusted: too few control points")
UNITS = {
    Common.BODY_ROTATION: ("deg", math.degrees(1.0)),
    Common.ORIGIN: ("m", 1.0),
    Common.SCALE: ("", 1.0),
    Common.BORESIGHT: ("arcsec", 1.0 / ARCSEC),
}


@dataclass(frozen=True, eq=False)
class AdjustedRow:
    """A frame of a run with what goes into the adjustment; None where it does not."""

    solution: Solution
    frame: Frame
    matches: list[MatchRow]
    adjusted: AdjustedFrame | None = None


@dataclass(frozen=True, eq=False)
class StatedResiduals:
    """Residuals (n, 2), px, of a frame from its statements, without and with what is common."""

    stated: FloatArray
    constants: FloatArray


@dataclass(frozen=True, eq=False)
class AdjustedRuns:
    """Result of an adjustment.

    misfit  what the statements leave with the common numbers taken out, rms over the frames: a
            shift in the picture (shift_px; shift_m on the ground), a roll and a range
    """

    adjustment: Adjustment
    frames: int
    cameras: Mapping[str, Camera]
    residuals_px: Mapping[str, float]
    misfit: Mapping[str, float] = field(default_factory=dict)

    @property
    def notes(self) -> list[str]:
        """Notes on what the frames do not observe."""
        notes = []
        for names in self.adjustment.find_inseparable():
            if len(names) == 1:
                notes.append(f"{names[0]} is not observed: these frames tell little of it")
            else:
                words = f"{', '.join(names[:-1])} and {names[-1]}"
                notes.append(f"{words} are not separable with these frames")
        if self.frames == 1 and self.adjustment.common.numbers:
            notes.append(
                "one frame: what is common is told from its own errors by the stated sigmas alone"
            )
        return notes

    def rows(self) -> list[dict[str, object]]:
        """Build the rows of common.csv."""
        unseen = {name for names in self.adjustment.find_inseparable() for name in names}
        common = self.adjustment.common
        rows: list[dict[str, object]] = []
        columns = zip(common.numbers, common.values, self.adjustment.sigmas, strict=True)
        for number, value, sigma in columns:
            unit, per = self.find_unit(number)
            zero = per if number.kind in (Common.SCALE, Common.FOCAL) else 0.0
            rows.append(
                {
                    "name": number.kind.value,
                    "camera": number.camera,
                    "axis": number.axis,
                    "value": float(zero + per * value),
                    "sigma": float(per * sigma),
                    "prior_sigma": per * number.prior_sigma,
                    "unit": unit,
                    "observed": number.label not in unseen,
                }
            )
        return rows

    def find_unit(self, number: CommonNumber) -> tuple[str, float]:
        """Find the unit that a number is written in, and how many make one of the state's."""
        if number.kind == Common.FOCAL:
            return "px", self.cameras[number.camera].focal_length_px
        return UNITS[number.kind]

    def lines(self) -> list[str]:
        """List the result for people."""
        lines = [f"adjusted {self.frames} frames in {self.adjustment.steps} steps"]
        if self.adjustment.common.numbers:
            head = ("common to them", "", "value", "sigma", "")
            table = [
                (
                    f"{row['name']} {row['camera']}".strip(),
                    str(row["axis"]),
                    f"{row['value']:.6g}",
                    f"{row['sigma']:.2g}",
                    str(row["unit"]),
                )
                for row in self.rows()
            ]
            lines += align_table([head, *table], left=(0, 1, 4))
        stages = ", ".join(f"{name} {value:.2f}" for name, value in self.residuals_px.items())
        lines.append(f"residuals of the matches, rms a coordinate, px: {stages}")
        if self.misfit:
            lines.append(
                "what is left of the statements, rms: {shift_px:.2f} px ({shift_m:.1f} m), roll "
                "{roll_deg:.3f} deg, range {range_percent:.3f} %".format(**self.misfit)
            )
        return [*lines, *self.notes]


def write_adjusted(
    place: Path,
    first: RunFolder,
    rows: Sequence[AdjustedRow],
    cameras: Mapping[str, Camera],
    result: AdjustedRuns,
    stages: Sequence[StatedResiduals],
) -> None:
    """Fill the folder but for its manifest."""
    common = result.adjustment.common
    _write_body(place, first, common)
    (place / CAMERAS).mkdir()
    for camera in cameras.values():
        write_camera(place / CAMERAS, correct_camera(camera, result.adjustment))
    known = [r.frame if r.frame.problem is None else _strip_frame(r.frame) for r in rows]
    write_frames(place / FRAMES, first.attitude, known, cameras)
    results = iter(zip(result.adjustment.frames, stages, strict=True))
    solutions, matches = [], []
    for row in rows:
        if row.adjusted is None:
            note = row.solution.with_remark(NOT_ADJUSTED) if row.solution.solved else row.solution
            solutions.append(note)
            continue
        frame_result, stage = next(results)
        matches += _build_matches(row, row.adjusted, frame_result, stage)
        solutions.append(replace(row.solution, outcome=_make_outcome(row.solution, frame_result)))
    write_solutions(place / SOLUTION, solutions, first.attitude)
    write_adjusted_matches(place / MATCHES, matches)
    COMMON_NUMBERS.write(place / COMMON_CSV, result.rows())
    (place / COMMON_JSON).write_text(_format_document(result), encoding="utf-8")


def _build_matches(
    row: AdjustedRow, frame: AdjustedFrame, frame_result: FrameResult, stage: StatedResiduals
) -> list[AdjustedMatch]:
    """Build the matches of a frame with their residuals."""
    made = []
    for k, match in enumerate(row.matches):
        kept = bool(frame_result.weights[k] > 0.0)
        reason = Reason() if kept else OUTLIER
        changed = replace(
            match,
            used=kept,
            predicted_px=frame.sightings.pixels[k] - frame_result.residuals_px[k],
            residual_px=frame_result.residuals_px[k],
            reason=reason.text,
            reason_code=reason.code,
        )
        weight = float(frame_result.weights[k])
        made.append(AdjustedMatch(changed, stage.stated[k], stage.constants[k], weight))
    return made


def _make_outcome(before: Solution, frame_result: FrameResult) -> Fix | NoFix:
    """Make the outcome of a frame."""
    kept_px = frame_result.residuals_px[frame_result.weights > 0.0]
    evidence = Evidence(
        n_predicted=before.n_predicted,
        n_matched=before.n_matched,
        n_used=len(kept_px),
        residual_rms_px=float(np.sqrt(np.mean(kept_px**2))) if len(kept_px) else None,
    )
    if len(kept_px) < MIN_MATCHES:
        return NoFix(DISAGREES, Method.CONTROL_POINTS, evidence)
    return Fix(
        Method.CONTROL_POINTS,
        frame_result.pose.position_m,
        frame_result.covariance[:3, :3],
        frame_result.pose.camera_from_body,
        float(np.sqrt(np.trace(frame_result.covariance[3:, 3:]) / 3.0)),
        evidence,
    )


def _strip_frame(frame: Frame) -> Frame:
    return Frame(frame.file, frame.utc, frame.camera)


def _format_document(result: AdjustedRuns) -> str:
    adjustment = result.adjustment
    scale = np.array([result.find_unit(number)[1] for number in adjustment.common.numbers])
    document = {
        "numbers": result.rows(),
        "covariance": (adjustment.covariance * np.outer(scale, scale)).tolist(),
        "not_observed": result.notes,
        "frames": result.frames,
        "matches": int(sum(frame.weights.size for frame in adjustment.frames)),
        "matches_used": int(sum((frame.weights > 0.0).sum() for frame in adjustment.frames)),
        "residual_rms_px": dict(result.residuals_px),
        "left_of_the_statements": dict(result.misfit),
        "variance_by_shared_points": adjustment.point_excess,
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def correct_camera(camera: Camera, adjustment: Adjustment) -> Camera:
    """Correct a camera by what the adjustment found."""
    common = adjustment.common
    lens = common.lens(camera)
    kinds = (Common.BORESIGHT, Common.MOUNTING)
    places = np.concatenate([common.places(kind, camera.name) for kind in kinds])
    if places.size:
        turn: Rotation = common.boresight(camera.name) * camera.boresight
        x, y, z = (float(angle) for angle in turn.as_rotvec() / ARCSEC)
        sigma = float(np.sqrt(np.mean(adjustment.sigmas[places] ** 2))) / ARCSEC
        lens = replace(lens, boresight_arcsec=(x, y, z), boresight_sigma_arcsec=sigma)
    return lens


def _write_body(place: Path, run: RunFolder, common: CommonState) -> None:
    """Write run.toml, and the body's file with the catalog's frame as the adjustment finds it."""
    body, settings = run.attitude.body, run.settings
    if not any(common.part(kind).size for kind in OF_THE_CATALOG):
        write_run_settings(settings, place)
        return
    before = body.catalog_frame
    turn = before.stated_from_catalog * common.turn
    offset = before.transform_to_stated(common.origin_m)
    frame = CatalogFrame(
        turn_deg=_unpack_vector(np.degrees(turn.as_rotvec())),
        offset_m=_unpack_vector(offset),
        scale=before.scale * common.scale,
    )
    named = is_body_file(settings.body)
    source = Path(settings.body) if named else resource(f"configs/bodies/{settings.body}.toml")
    kept, inside = [], False
    for line in source.read_text(encoding="utf-8").splitlines():
        if head := SECTION.fullmatch(line):
            inside = head[1] == "catalog_frame"
        if not inside:
            kept.append(line)
    text = "\n".join(kept).rstrip("\n") + "\n\n[catalog_frame]  # by optnav adjust\n"
    for key in ("turn_deg", "offset_m"):
        text += f"{key} = [{', '.join(repr(value) for value in getattr(frame, key))}]\n"
    text += f"scale = {frame.scale!r}\n"
    file = place / (source.name if named else f"{settings.body}.toml")
    file.write_text(text, encoding="utf-8")
    write_run_settings(RunSettings(str(file), settings.attitude), place)


def _unpack_vector(vector: FloatArray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in vector)
    return x, y, z
