"""The rows of evaluation.csv, one a frame, and the same of a run without a truth."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.evaluation.figures import FrameError
from optnav_cli.evaluation.motion import directions_of_motion
from optnav_cli.output.run_folder import RunFolder
from optnav_cli.output.tables import Row, fixed, optional_number, read_table

EVALUATION_COLUMNS = (
    *("file", "utc", "status", "method", "camera", "forward", "truth_height_m"),
    *("error_r_m", "error_n_m", "error_b_m", "sigma_r_m", "sigma_n_m", "sigma_b_m"),
    *("range_error_percent", "range_sigma_percent"),
    *("direction_error_arcsec", "direction_sigma_arcsec"),
    *("normalised_error_squared", "attitude_error_arcsec"),
    *("n_predicted", "n_matched", "n_used", "n_wrong", "reason"),
)
ERROR_COLUMNS, SIGMA_COLUMNS = EVALUATION_COLUMNS[7:10], EVALUATION_COLUMNS[10:13]


@dataclass(frozen=True, eq=False)
class ErrorRow:
    """One frame of a run as it is drawn; what is not known or does not apply is None.

    height_m                      above the reference sphere: true, or solved where there is no
                                  truth
    error_rnb_m, sigma_rnb_m      (3,) along R, N, B
    range_percent, range_sigma    error along R and its sigma, percent of the height
    direction_arcsec, direction_sigma  of the direction to the centre
    """

    file: str
    utc: str
    solved: bool
    method: str
    camera: str
    reason: str
    height_m: float | None
    error_rnb_m: FloatArray | None = None
    sigma_rnb_m: FloatArray | None = None
    range_percent: float | None = None
    range_sigma: float | None = None
    direction_arcsec: float | None = None
    direction_sigma: float | None = None


def row_of(frame: FrameError) -> Row:
    """A frame as a row of evaluation.csv."""
    solution = frame.solution
    row = dict.fromkeys(EVALUATION_COLUMNS, "")
    row.update(file=frame.file, utc=frame.utc, status=solution.status, forward=frame.forward)
    row.update(method=solution.method, camera=frame.camera)
    row.update(truth_height_m=fixed(frame.height_m, 3), reason=solution.reason)
    for columns, values in ((ERROR_COLUMNS, frame.error_rnb_m), (SIGMA_COLUMNS, frame.sigma_rnb_m)):
        if values is not None:
            row.update(zip(columns, (fixed(float(v), 3) for v in values), strict=True))
    if frame.range_error is not None:
        for name, value in zip(("error", "sigma"), frame.range_error, strict=True):
            row[f"range_{name}_percent"] = fixed(100.0 * value, 6)
    if frame.direction_error is not None:
        for name, value in zip(("error", "sigma"), frame.direction_error, strict=True):
            row[f"direction_{name}_arcsec"] = fixed(value / ARCSEC, 4)
    row["normalised_error_squared"] = fixed(frame.nees, 6)
    if frame.attitude_error_rad is not None:
        row["attitude_error_arcsec"] = fixed(frame.attitude_error_rad / ARCSEC, 4)
    counts = {
        "n_predicted": solution.n_predicted,
        "n_matched": solution.n_matched,
        "n_used": solution.n_used,
        "n_wrong": frame.n_wrong,
    }
    row.update({name: "" if value is None else str(value) for name, value in counts.items()})
    return row


def read_error_rows(path: Path) -> list[ErrorRow]:
    """The frames of an evaluation.csv. Raises DataError for a damaged table or an old one."""
    try:
        table = read_table(path, EVALUATION_COLUMNS)
    except DataError as error:
        raise DataError(f"{error}; run `optnav evaluate` again") from error
    return [_error_row(row, where) for where, row in table]


def _error_row(row: Row, where: str) -> ErrorRow:
    def vector(columns: tuple[str, ...]) -> FloatArray | None:
        values = [optional_number(row, column, where) for column in columns]
        known = [value for value in values if value is not None]
        return np.array(known) if len(known) == len(columns) else None

    return ErrorRow(
        file=row["file"],
        utc=row["utc"],
        solved=row["status"] == "solved",
        method=row["method"],
        camera=row["camera"],
        reason=row["reason"],
        height_m=optional_number(row, "truth_height_m", where),
        error_rnb_m=vector(ERROR_COLUMNS),
        sigma_rnb_m=vector(SIGMA_COLUMNS),
        range_percent=optional_number(row, "range_error_percent", where),
        range_sigma=optional_number(row, "range_sigma_percent", where),
        direction_arcsec=optional_number(row, "direction_error_arcsec", where),
        direction_sigma=optional_number(row, "direction_sigma_arcsec", where),
    )


@dataclass(frozen=True, eq=False)
class _Place:
    tdb_s: float
    position_m: FloatArray


def stated_rows(run: RunFolder) -> list[ErrorRow]:
    """The frames of a run that was not compared with a truth: what its solutions state.

    R, N, B follow the solved positions.
    """
    solved = [s for s in run.solutions if s.position_m is not None and s.covariance_m2 is not None]
    places = [_Place(_time(s.utc), np.asarray(s.position_m)) for s in solved]
    axes = dict(zip((s.file for s in solved), directions_of_motion(places), strict=True))
    rows = []
    for s in run.solutions:
        camera = run.cameras.get(s.file)
        row = ErrorRow(
            s.file, s.utc, s.file in axes, s.method, camera.name if camera else "", s.reason, None
        )
        if s.position_m is not None and s.covariance_m2 is not None:
            turn, _ = axes[s.file]
            sigma = np.sqrt(np.diag(turn @ s.covariance_m2 @ turn.T))
            distance = float(np.linalg.norm(s.position_m))
            height = distance - run.attitude.body.radius_m
            across = math.hypot(float(sigma[1]), float(sigma[2])) / distance
            row = ErrorRow(
                row.file, row.utc, True, row.method, row.camera, row.reason, height,
                sigma_rnb_m=sigma,
                range_sigma=100.0 * float(sigma[0]) / height if height > 0.0 else None,
                direction_sigma=across / ARCSEC,
            )  # fmt: skip
        rows.append(row)
    return rows


def _time(utc: str) -> float:
    """Seconds; a time that is not understood puts its frame before all others."""
    try:
        return utc_to_tdb_s(utc)
    except DataError:
        return -math.inf
