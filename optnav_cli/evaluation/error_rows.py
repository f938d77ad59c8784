"""The rows of evaluation.csv, one a frame, and the same of a run without a truth."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from catalog.geometry.rotations import ARCSEC
from catalog.tables import Row
from optnav_cli.evaluation.figures import FrameError
from optnav_cli.evaluation.motion import directions_of_motion
from optnav_cli.frames.tables import ERRORS, EVALUATION, SIGMAS
from optnav_cli.output.run_folder import RunFolder


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


def error_cells(frame: FrameError) -> dict[str, object]:
    """A frame as a row of evaluation.csv."""
    solution = frame.solution
    cells: dict[str, object] = {
        "file": frame.file,
        "utc": frame.utc,
        "status": solution.status,
        "method": solution.method,
        "camera": frame.camera,
        "forward": frame.forward,
        "truth_height_m": frame.height_m,
        "normalised_error_squared": frame.nees,
        "n_predicted": solution.n_predicted,
        "n_matched": solution.n_matched,
        "n_used": solution.n_used,
        "n_wrong": frame.n_wrong,
        "reason": solution.reason,
    }
    for columns, values in ((ERRORS, frame.error_rnb_m), (SIGMAS, frame.sigma_rnb_m)):
        if values is not None:
            cells |= zip(columns, values, strict=True)
    if frame.range_error is not None:
        error, sigma = (100.0 * share for share in frame.range_error)
        cells |= {"range_error_percent": error, "range_sigma_percent": sigma}
    if frame.direction_error is not None:
        error, sigma = (angle / ARCSEC for angle in frame.direction_error)
        cells |= {"direction_error_arcsec": error, "direction_sigma_arcsec": sigma}
    if frame.attitude_error_rad is not None:
        cells["attitude_error_arcsec"] = frame.attitude_error_rad / ARCSEC
    return cells


def read_error_rows(path: Path) -> list[ErrorRow]:
    """The frames of an evaluation.csv. Raises DataError for a damaged table or an old one."""
    try:
        return EVALUATION.read(path, _error_row)
    except DataError as error:
        raise DataError(f"{error}; run `optnav evaluate` again") from error


def _error_row(row: Row) -> ErrorRow:
    return ErrorRow(
        file=row["file"],
        utc=row["utc"],
        solved=row["status"] == "solved",
        method=row["method"],
        camera=row["camera"],
        reason=row["reason"],
        height_m=row.number("truth_height_m"),
        error_rnb_m=row.vector(ERRORS),
        sigma_rnb_m=row.vector(SIGMAS),
        range_percent=row.number("range_error_percent"),
        range_sigma=row.number("range_sigma_percent"),
        direction_arcsec=row.number("direction_error_arcsec"),
        direction_sigma=row.number("direction_sigma_arcsec"),
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
