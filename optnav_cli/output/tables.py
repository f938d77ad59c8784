"""The tables of a run: solution.csv (a row a frame), matches.csv (a row a control point tried).

Lengths are written to 0.1 mm, quaternions to 15 decimals; what is unknown is an empty field.
"""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from catalog.geometry.rotations import ARCSEC, quaternion_from_rotation, rotation_from_quaternion
from optnav_cli.fix import Evidence, Fix, MatchRow, Method, NoFix, Solution
from optnav_cli.frames.csv_table import number, numbers
from optnav_cli.frames.frames import QUATERNION
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.reasons import Reason, ReasonCode

Row = dict[str, str]
COVARIANCE = ("xx", "xy", "xz", "yy", "yz", "zz")
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # where those stand in the matrix
SOLUTION_COLUMNS = (
    *("file", "utc", "status", "method", "x_m", "y_m", "z_m"),
    *(f"cov_{name}_m2" for name in COVARIANCE),
    *("qw", "qx", "qy", "qz", "attitude_sigma_arcsec", "lat_deg", "lon_deg", "height_m"),
    *("n_predicted", "n_matched", "n_used", "residual_rms_px"),
    *("prior", "n_limb", "arc_deg", "reason", "reason_code"),
)
MATCH_COLUMNS = (
    *("file", "catalog", "id", "level", "lat_deg", "lon_deg", "radius_m"),
    *("predicted_x_px", "predicted_y_px", "measured_x_px", "measured_y_px"),
    *("score", "runner_up", "sun_elevation_deg", "residual_x_px", "residual_y_px"),
    *("used", "reason", "reason_code"),
)


def write_solutions(path: Path, solutions: Iterable[Solution], attitude: FileAttitude) -> None:
    """Write solution.csv; latitude, longitude and height refer to the body's reference sphere."""
    write_table(path, SOLUTION_COLUMNS, (_solution_row(s, attitude) for s in solutions))


def read_solutions(path: Path, attitude: FileAttitude) -> list[Solution]:
    """Read solution.csv back. Raises DataError naming the row that is damaged."""
    return [_solution(row, where, attitude) for where, row in read_table(path, SOLUTION_COLUMNS)]


def write_matches(path: Path, matches: Iterable[MatchRow]) -> None:
    """Write matches.csv; a point's place is planetocentric."""
    write_table(path, MATCH_COLUMNS, map(_match_row, matches))


def read_matches(path: Path) -> list[MatchRow]:
    """Read matches.csv back. Raises DataError naming the row that is damaged."""
    return [_match(row, where) for where, row in read_table(path, MATCH_COLUMNS)]


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Row]) -> None:
    """Write a CSV file (UTF-8, line feeds) with a header; rows hold every column as text."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read_table(path: Path, columns: Sequence[str]) -> list[tuple[str, Row]]:
    """The rows of a CSV file, each with its place ("file, row 2") for messages.

    Raises DataError for an unreadable file, a missing column, a row of the wrong length.
    """
    rows = []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            missing = [name for name in columns if name not in (reader.fieldnames or ())]
            if missing:
                raise DataError(
                    f"{path}: column '{missing[0]}' is missing; wanted {','.join(columns)}"
                )
            for row in reader:
                where = f"{path}, line {reader.line_num}"
                if None in row or None in row.values():
                    raise DataError(f"{where}: not as many fields as the header has")
                rows.append((where, row))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: is not a CSV table in UTF-8 ({error})") from error
    return rows


def fixed(value: float | None, decimals: int) -> str:
    """A number with so many decimals, never "-0"; empty for None."""
    if value is None:
        return ""
    text = f"{value:.{decimals}f}"
    return text.lstrip("-") if float(text) == 0.0 else text


def optional_number(row: Row, column: str, where: str) -> float | None:
    """A finite number of a row, None for an empty field. Raises DataError for anything else."""
    return number(row[column], column, f"{where}: ") if row[column].strip() else None


def _vector(row: Row, columns: Sequence[str], where: str) -> FloatArray | None:
    """Numbers that stand or miss together. Raises DataError when only some are there."""
    values = numbers(row, columns, f"{where}: ")
    return None if values is None else np.array(values)


def _quaternion(row: Row, where: str) -> Rotation | None:
    values = _vector(row, QUATERNION, where)
    try:
        return None if values is None else rotation_from_quaternion(*values)
    except ValueError as error:
        raise DataError(f"{where}: {error}") from error


def _solution_row(solution: Solution, attitude: FileAttitude) -> Row:
    row = dict.fromkeys(SOLUTION_COLUMNS, "")
    row.update(file=solution.file, utc=solution.utc, status=solution.status)
    row.update(method=solution.method, reason=solution.reason, prior=solution.prior)
    row["reason_code"] = solution.reason_code
    if solution.position_m is not None:
        lat, lon, radius = latlon_from_xyz(solution.position_m)
        row.update(zip(("x_m", "y_m", "z_m"), _all(solution.position_m, 4), strict=True))
        row["lat_deg"], row["lon_deg"] = _latlon_deg(float(lat), float(lon))
        row["height_m"] = fixed(float(radius) - attitude.body.radius_m, 4)
    if solution.covariance_m2 is not None:
        for name, place in zip(COVARIANCE, UPPER, strict=True):
            row[f"cov_{name}_m2"] = f"{solution.covariance_m2[place]:.9e}"
    if solution.camera_from_body is not None:
        written = attitude.written(solution.camera_from_body, solution.utc)
        values = _all(quaternion_from_rotation(written), 15)
        row.update(zip(QUATERNION, values, strict=True))
    if solution.attitude_sigma_rad is not None:
        row["attitude_sigma_arcsec"] = fixed(solution.attitude_sigma_rad / ARCSEC, 6)
    for column in ("n_predicted", "n_matched", "n_used", "n_limb"):
        count = getattr(solution, column)
        row[column] = "" if count is None else str(count)
    row["residual_rms_px"] = fixed(solution.residual_rms_px, 5)
    row["arc_deg"] = fixed(solution.arc_deg, 2)
    return row


def _solution(row: Row, where: str, attitude: FileAttitude) -> Solution:
    if row["status"] not in ("solved", "unsolved"):
        raise DataError(f"{where}: status is '{row['status']}'; wanted solved or unsolved")
    position = _vector(row, ("x_m", "y_m", "z_m"), where)
    upper = _vector(row, [f"cov_{name}_m2" for name in COVARIANCE], where)
    written = _quaternion(row, where)
    sigma = optional_number(row, "attitude_sigma_arcsec", where)
    reason = Reason(_reason_code(row, where), row["reason"])
    evidence = Evidence(
        n_predicted=_count(row, "n_predicted", where),
        n_matched=_count(row, "n_matched", where),
        n_used=_count(row, "n_used", where),
        residual_rms_px=optional_number(row, "residual_rms_px", where),
        n_limb=_count(row, "n_limb", where),
        arc_deg=optional_number(row, "arc_deg", where),
    )
    method = _method(row, where)
    outcome: Fix | NoFix = NoFix(reason, method, evidence)
    if row["status"] == "solved":
        if position is None or upper is None or method is None:
            raise DataError(
                f"{where}: a solved frame without method, position or covariance; "
                "run navigate again"
            )
        outcome = Fix(
            method,
            position,
            _covariance(upper, where),
            None if written is None else attitude.read(written, row["utc"]),
            None if sigma is None else sigma * ARCSEC,
            evidence,
            reason,
        )
    return Solution(row["file"], row["utc"], outcome, row["prior"])


def _method(row: Row, where: str) -> Method | None:
    try:
        return Method(row["method"]) if row["method"] else None
    except ValueError as error:
        raise DataError(
            f"{where}: method is '{row['method']}'; wanted {', '.join(Method)}"
        ) from error


def _reason_code(row: Row, where: str) -> ReasonCode:
    try:
        return ReasonCode(row["reason_code"])
    except ValueError as error:
        raise DataError(f"{where}: '{row['reason_code']}' is no reason code") from error


def _covariance(upper: FloatArray, where: str) -> FloatArray:
    matrix = np.empty((3, 3))
    for value, (i, j) in zip(upper, UPPER, strict=True):
        matrix[i, j] = matrix[j, i] = value
    if np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise DataError(f"{where}: the covariance is not positive definite; run navigate again")
    return matrix


def _match_row(match: MatchRow) -> Row:
    lat, lon, radius = latlon_from_xyz(match.cp_position_m)
    row = dict.fromkeys(MATCH_COLUMNS, "")
    row.update(file=match.file, catalog=match.catalog)
    row.update(id=str(match.cp_id), level=str(match.level), reason=match.reason)
    row["reason_code"] = match.reason_code
    row["lat_deg"], row["lon_deg"] = _latlon_deg(float(lat), float(lon))
    row["radius_m"] = fixed(float(radius), 4)
    pairs = (
        ("predicted", match.predicted_px),
        ("measured", match.measured_px),
        ("residual", match.residual_px),
    )
    for name, pair in pairs:
        if pair is not None:
            row[f"{name}_x_px"], row[f"{name}_y_px"] = _all(pair, 4)
    row["score"], row["runner_up"] = fixed(match.score, 5), fixed(match.runner_up, 5)
    row["sun_elevation_deg"] = fixed(match.sun_elevation_deg, 4)
    row["used"] = "1" if match.used else "0"
    return row


def _match(row: Row, where: str) -> MatchRow:
    cp_id, level = _count(row, "id", where), _count(row, "level", where)
    place = _vector(row, ("lat_deg", "lon_deg", "radius_m"), where)
    predicted = _pixel(row, "predicted", where)
    if cp_id is None or level is None or place is None or predicted is None:
        raise DataError(
            f"{where}: id, level, place or predicted pixel is empty; run navigate again"
        )
    if row["used"] not in ("0", "1"):
        raise DataError(f"{where}: used is '{row['used']}'; wanted 0 or 1")
    return MatchRow(
        file=row["file"],
        cp_id=cp_id,
        level=level,
        cp_position_m=xyz_from_latlon(np.radians(place[0]), np.radians(place[1]), place[2]),
        predicted_px=predicted,
        measured_px=_pixel(row, "measured", where),
        score=optional_number(row, "score", where),
        runner_up=optional_number(row, "runner_up", where),
        used=row["used"] == "1",
        reason=row["reason"],
        sun_elevation_deg=optional_number(row, "sun_elevation_deg", where),
        residual_px=_pixel(row, "residual", where),
        catalog=row["catalog"],
        reason_code=_reason_code(row, where),
    )


def _pixel(
    row: Row, name: Literal["predicted", "measured", "residual"], where: str
) -> FloatArray | None:
    return _vector(row, (f"{name}_x_px", f"{name}_y_px"), where)


def _count(row: Row, column: str, where: str) -> int | None:
    value = optional_number(row, column, where)
    if value is not None and (value < 0 or value != int(value)):
        raise DataError(f"{where}: {column} is '{row[column]}'; wanted a count")
    return None if value is None else int(value)


def _all(values: FloatArray, decimals: int) -> list[str]:
    return [fixed(float(value), decimals) for value in values]


def _latlon_deg(lat: float, lon: float) -> tuple[str, str]:
    # Rounded first: 179.9999999999 would be written as 180, which is -180 here.
    lon_deg = round(float(np.degrees(lon)), 9)
    return fixed(float(np.degrees(lat)), 9), fixed(-180.0 if lon_deg >= 180.0 else lon_deg, 9)
