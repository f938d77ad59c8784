"""Runs of `stars` and `cylinder` against a truth: attitudes, distances and light angles.

The truth of stars is a CSV of file and quaternion: camera_from_inertial, or what the run.toml
beside it names as `attitude`. The truth of a cylinder is one of file, d_m and, where they are to be
compared, theta_deg, bearing_deg, vx_m_s and vy_m_s.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError, NothingToDoError
from catalog.files import make_prefix_test, replace_file
from catalog.geometry.rotations import ARCSEC, rotation_from_quaternion
from catalog.progress import log_stage
from catalog.tables import CsvRow, CsvTable
from optnav_cli.evaluation.files import EVALUATION_CSV, EVALUATION_JSON
from optnav_cli.frames.run_settings import RUN_TOML, FileAttitude, read_run_settings
from optnav_cli.frames.tables import (
    ATTITUDES,
    CYLINDER,
    CYLINDER_TRUTH,
    MEASURED,
    QUATERNION,
    STAR_TRUTH,
)
from optnav_cli.output.wording import align_table, format_json

# Columns of a run of a cylinder with the columns of their sigmas, and the unit.
CYLINDER_QUANTITIES = {
    "d_m": ("d_sigma_m", "m"),
    "theta_deg": ("theta_sigma_deg", "deg"),
    "bearing_deg": ("", "deg"),
    "vx_m_s": ("v_sigma_m_s", "m/s"),
    "vy_m_s": ("v_sigma_m_s", "m/s"),
}


@dataclass(frozen=True)
class MeasuredError:
    """The error of one quantity of a picture, and its stated sigma; None without one."""

    file: str
    quantity: str
    unit: str
    error: float
    sigma: float | None

    def make_row(self) -> dict[str, object]:
        """Make the row of evaluation.csv."""
        return {
            "file": self.file, "quantity": self.quantity, "unit": self.unit,
            "error": self.error, "sigma": self.sigma,
        }  # fmt: skip


@dataclass(frozen=True)
class MeasuredEvaluation:
    """Errors of a run of star pictures or of a lit cylinder.

    pictures, solved  of the run;  remark  what was not compared, or ""
    """

    kind: str
    pictures: int
    solved: int
    errors: tuple[MeasuredError, ...]
    remark: str = ""

    def figures(self) -> list[dict[str, object]]:
        """Compute rms, mean, greatest and the mean of (error / sigma)^2 of each quantity."""
        rows: list[dict[str, object]] = []
        for name in dict.fromkeys(error.quantity for error in self.errors):
            some = [error for error in self.errors if error.quantity == name]
            values = np.array([error.error for error in some])
            stated = np.array(
                [e.error / e.sigma for e in some if e.sigma is not None and e.sigma > 0.0]
            )
            rows.append(
                {
                    "quantity": name,
                    "unit": some[0].unit,
                    "compared": len(some),
                    "rms": float(np.sqrt(np.mean(values**2))),
                    "mean": float(values.mean()),
                    "max": float(np.abs(values).max()),
                    "normalised_error_squared": float(np.mean(stated**2)) if len(stated) else None,
                    "share_inside_3_sigma": (
                        float(np.mean(np.abs(stated) <= 3.0)) if len(stated) else None
                    ),
                }
            )
        return rows

    def summary(self) -> dict[str, object]:
        """Return the document of evaluation.json."""
        return {
            "kind": self.kind, "frames": self.pictures, "solved": self.solved,
            "quantities": self.figures(), "remarks": [self.remark] if self.remark else [],
        }  # fmt: skip

    def to_text(self) -> str:
        """Return a table for people."""
        table: list[tuple[str, ...]] = [("", "compared", "rms", "mean", "max", "chi2", "unit")]
        for row in self.figures():
            chi = row["normalised_error_squared"]
            numbers = [f"{row[name]:.4g}" for name in ("rms", "mean", "max")]
            shown = "" if chi is None else f"{chi:.2f}"
            table.append(
                (str(row["quantity"]), str(row["compared"]), *numbers, shown, str(row["unit"]))
            )
        lines = [f"solved {self.solved} of {self.pictures}", *align_table(table, left=(0, 6))]
        return "\n".join([*lines, *([self.remark] if self.remark else [])])


def evaluate_stars(run: Path, truth: Path) -> MeasuredEvaluation:
    """Compare the attitudes of a run of `stars` with true ones.

    Raises DataError for a damaged table, a truth of other pictures or without quaternions, and
    NothingToDoError where no picture has an attitude.
    """
    with log_stage("evaluate"):
        rows, true = ATTITUDES.rows(run / "attitudes.csv"), _read_true_rows(truth, STAR_TRUTH)
        attitude = None
        if (truth.parent / RUN_TOML).exists():
            settings, body = read_run_settings(truth.parent / RUN_TOML)
            attitude = FileAttitude(settings.attitude, body)
        errors: list[MeasuredError] = []
        for row in _select_solved(rows):
            other = _find_true_row(row, true, truth)
            quaternion, measured = other.vector(QUATERNION), row.vector(QUATERNION)
            if quaternion is None or measured is None:
                where = other.where if quaternion is None else row.where
                raise DataError(f"{where}: has no quaternion; fill in {', '.join(QUATERNION)}")
            turn = _convert_to_inertial(rotation_from_quaternion(*quaternion), attitude, row["utc"])
            off = rotation_from_quaternion(*measured) * turn.inv()
            for axis, error in zip("xyz", off.as_rotvec() / ARCSEC, strict=True):
                sigma = row.number(f"sigma_{axis}_arcsec")
                errors.append(
                    MeasuredError(row["file"], f"attitude_{axis}", "arcsec", float(error), sigma)
                )
        return _make_evaluation("stars", rows, errors)


def evaluate_cylinder(run: Path, truth: Path) -> MeasuredEvaluation:
    """Compare distances, light angles and velocities of a run of `cylinder` with true ones.

    Raises DataError for a damaged table or a truth of other pictures, NothingToDoError where no
    picture is solved.
    """
    with log_stage("evaluate"):
        rows, true = CYLINDER.rows(run / "cylinder.csv"), _read_true_rows(truth, CYLINDER_TRUTH)
        errors: list[MeasuredError] = []
        for row in _select_solved(rows):
            other = _find_true_row(row, true, truth)
            for name, (sigma, unit) in CYLINDER_QUANTITIES.items():
                value, wanted = row.number(name), other.number(name)
                if value is None or wanted is None:
                    continue
                off = value - wanted
                if unit == "deg":
                    off = (off + 180.0) % 360.0 - 180.0
                stated = row.number(sigma) if sigma else None
                errors.append(MeasuredError(row["file"], name, unit, off, stated))
        return _make_evaluation("cylinder", rows, errors)


def write_measured(evaluation: MeasuredEvaluation, folder: Path) -> None:
    """Write evaluation.json and evaluation.csv into a run folder."""
    with replace_file(folder / EVALUATION_CSV, make_prefix_test(b"file,quantity,")) as path:
        MEASURED.write(path, (error.make_row() for error in evaluation.errors))
    with replace_file(folder / EVALUATION_JSON, make_prefix_test(b'{\n  "kind"')) as path:
        path.write_text(format_json(evaluation.summary()) + "\n", encoding="utf-8")


def _make_evaluation(
    kind: str, rows: Sequence[CsvRow], errors: Sequence[MeasuredError]
) -> MeasuredEvaluation:
    solved = len(_select_solved(rows))
    if not solved:
        raise NothingToDoError(f"none of {len(rows)} pictures is solved: nothing to compare")
    if not errors:
        raise NothingToDoError("the truth has no value that the run has: nothing to compare")
    return MeasuredEvaluation(kind, len(rows), solved, tuple(errors))


def _select_solved(rows: Sequence[CsvRow]) -> list[CsvRow]:
    return [row for row in rows if row["status"] == "solved"]


def _read_true_rows(path: Path, table: CsvTable) -> dict[str, CsvRow]:
    rows: dict[str, CsvRow] = {}
    for row in table.rows(path):
        if row.problem:
            raise DataError(f"{row.where}: {row.problem}")
        if row["file"] in rows:
            raise DataError(f"{row.where}: {row['file']} stands there twice; keep one row")
        rows[row["file"]] = row
    return rows


def _find_true_row(row: CsvRow, true: Mapping[str, CsvRow], path: Path) -> CsvRow:
    """Find the true row of a picture. Raises DataError for none, or one of another time."""
    other = true.get(row["file"])
    if other is None:
        raise DataError(
            f"{path}: the truth has no {row['file']} of the run; wanted the truth.csv of the "
            "folder that was measured"
        )
    times = row["utc"], other["utc"]
    if all(times) and abs(math.fsum((utc_to_tdb_s(times[0]), -utc_to_tdb_s(times[1])))) > 1e-3:
        raise DataError(
            f"{other.where}: has the time {times[1]}, the run {times[0]}; wanted the truth.csv of "
            "the folder that was measured"
        )
    return other


def _convert_to_inertial(written: Rotation, attitude: FileAttitude | None, utc: str) -> Rotation:
    """Return camera_from_inertial of a written quaternion.

    Raises DataError for a body-fixed one without a time.
    """
    if attitude is None or attitude.name == "camera_from_inertial":
        return written
    if not utc:
        raise DataError(
            "a body-fixed truth of a picture without a time says nothing of the stars; state "
            'attitude = "camera_from_inertial"'
        )
    return attitude.read(written, utc) * attitude.inertial_from_body(utc_to_tdb_s(utc)).inv()
