"""Rows of solution.csv (one a frame) and of matches.csv (one a control point tried)."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.geometry.ellipsoid import geodetic_from_xyz
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from catalog.geometry.rotations import ARCSEC, quaternion_from_rotation, rotation_from_quaternion
from catalog.tables import CsvRow, CsvTable
from optnav_cli.fix import (
    Evidence,
    Fix,
    LensEstimate,
    MatchKind,
    MatchRow,
    Method,
    NoFix,
    Solution,
    hash_name,
)
from optnav_cli.frames.frames import MAX_DISTANCE_M
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.frames.tables import (
    ADJUSTED_MATCHES,
    COVARIANCE,
    GROUND_COVARIANCE,
    LANDMARKS,
    LENS_SHIFT,
    LENS_SHIFT_SIGMA,
    MATCHES,
    POSITION,
    QUATERNION,
    SOLUTION,
    SOLUTION_LENS,
    SOLUTION_SPHEROID,
)
from optnav_cli.reasons import Reason, ReasonCode

MAX_SOLVED_M = 1e3 * MAX_DISTANCE_M  # a wrong solution may lie beyond any prior
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # where COVARIANCE stands in the matrix
# Columns that hold what the attributes of the same names do.
EVIDENCE = ("n_predicted", "n_matched", "n_used", "residual_rms_px", "n_limb", "arc_deg")
DESCENT_EVIDENCE = ("n_windows", "n_landmarks")
SAME_IN_SOLUTION = (
    *EVIDENCE,
    *DESCENT_EVIDENCE,
    "file",
    "utc",
    "status",
    "method",
    "prior",
    "reason",
    "reason_code",
    "attitude_source",
)
SAME_IN_MATCH = (
    *("file", "catalog", "level", "score", "runner_up", "sun_elevation_deg", "used"),
    *("reason", "reason_code", "kind"),
)


class LandmarkRow(NamedTuple):
    """A landmark of a descent: number, pictures, place (3,), covariance (3, 3) east, north, up."""

    number: int
    first_file: str
    last_file: str
    n_seen: int
    place_m: FloatArray
    covariance_m2: FloatArray
    reason: Reason


class AdjustedMatch(NamedTuple):
    """A match of an adjustment; its residuals (2,) from the stated pose, without and with what is
    common, NaN where no pose is stated."""

    row: MatchRow
    stated_px: FloatArray
    constants_px: FloatArray
    weight: float


def write_solutions(path: Path, solutions: Iterable[Solution], attitude: FileAttitude) -> None:
    """Write solution.csv; latitude, longitude and height refer to the body's reference sphere.

    Geodetic ones follow for a spheroid, and what was estimated of lenses where it was.
    """
    rows = list(solutions)
    columns = SOLUTION.columns
    if attitude.body.flattening:
        columns += SOLUTION_SPHEROID.columns
    if any(row.evidence.lens for row in rows):
        columns += SOLUTION_LENS.columns
    CsvTable(columns).write(path, (_list_solution_cells(row, attitude) for row in rows))


def read_solutions(path: Path, attitude: FileAttitude) -> list[Solution]:
    """Read solution.csv back. Raises DataError naming the row that is damaged."""
    table = CsvTable((*SOLUTION.columns, *SOLUTION_LENS.columns))
    return table.read(path, lambda row: _read_solution(row, attitude))


def write_matches(path: Path, matches: Iterable[MatchRow]) -> None:
    """Write matches.csv; a point's place is planetocentric."""
    MATCHES.write(path, map(_list_match_cells, matches))


def write_landmarks(path: Path, landmarks: Iterable[LandmarkRow], attitude: FileAttitude) -> None:
    """Write landmarks.csv; a landmark's place is planetocentric."""
    LANDMARKS.write(path, (_list_landmark_cells(landmark, attitude) for landmark in landmarks))


def write_adjusted_matches(path: Path, matches: Iterable[AdjustedMatch]) -> None:
    """Write the matches.csv of adjusted runs."""
    ADJUSTED_MATCHES.write(path, map(_list_adjusted_cells, matches))


def read_matches(path: Path) -> list[MatchRow]:
    """Read matches.csv back. Raises DataError naming the row that is damaged."""
    return MATCHES.read(path, _read_match)


def format_fixed(value: float | None, decimals: int) -> str:
    """Format a number with so many decimals, never "-0"; empty for None."""
    return "" if value is None else f"{value:z.{decimals}f}"


def _list_solution_cells(solution: Solution, attitude: FileAttitude) -> dict[str, object]:
    cells: dict[str, object] = {name: getattr(solution, name) for name in SAME_IN_SOLUTION}
    if solution.position_m is not None:
        position = attitude.places.transform_to_stated(solution.position_m)
        cells |= zip(POSITION, position, strict=True)
        cells |= _list_place_cells(position)
        cells["height_m"] = float(cast(float, cells["radius_m"])) - attitude.body.radius_m
        if attitude.body.flattening:
            lat, _, height = geodetic_from_xyz(position, attitude.body.radii_m)
            cells["lat_geodetic_deg"] = float(np.degrees(lat))
            cells["height_ellipsoid_m"] = float(height)
    if solution.covariance_m2 is not None:
        covariance = attitude.places.transform_covariance_to_stated(solution.covariance_m2)
        cells |= {name: covariance[at] for name, at in zip(COVARIANCE, UPPER)}
    if solution.camera_from_body is not None:
        written = attitude.convert_for_file(solution.camera_from_body, solution.utc)
        cells |= zip(QUATERNION, quaternion_from_rotation(written), strict=True)
    if solution.attitude_sigma_rad is not None:
        cells["attitude_sigma_arcsec"] = solution.attitude_sigma_rad / ARCSEC
    return cells | _list_lens_cells(solution.evidence.lens)


def _list_lens_cells(lens: LensEstimate | None) -> dict[str, object]:
    if lens is None:
        return {}
    cells: dict[str, object] = {
        "focal_scale": lens.focal_scale,
        "focal_scale_sigma": lens.focal_scale_sigma,
    }
    if lens.shift_px is not None and lens.shift_sigma_px is not None:
        cells |= zip(LENS_SHIFT, lens.shift_px, strict=True)
        cells |= zip(LENS_SHIFT_SIGMA, lens.shift_sigma_px, strict=True)
    return cells


def _read_lens(row: CsvRow) -> LensEstimate | None:
    focal = row.number("focal_scale"), row.number("focal_scale_sigma")
    shift, sigma = row.vector(LENS_SHIFT), row.vector(LENS_SHIFT_SIGMA)
    if focal[0] is None and shift is None:
        return None
    if shift is None or sigma is None:
        return LensEstimate(*focal)
    (x, y), (sigma_x, sigma_y) = shift.tolist(), sigma.tolist()
    return LensEstimate(*focal, (x, y), (sigma_x, sigma_y))


def _list_place_cells(position_m: FloatArray) -> dict[str, float]:
    lat, lon, radius = (float(v) for v in latlon_from_xyz(position_m))
    # Rounded first: 179.9999999999 would be written as 180, which is -180 here.
    lon_deg = round(float(np.degrees(lon)), 9)
    lon_deg = -180.0 if lon_deg >= 180.0 else lon_deg
    return {"lat_deg": float(np.degrees(lat)), "lon_deg": lon_deg, "radius_m": radius}


def _read_solution(row: CsvRow, attitude: FileAttitude) -> Solution:
    if row["status"] not in ("solved", "unsolved"):
        raise DataError(f"status is '{row['status']}'; wanted solved or unsolved")
    position, upper = row.vector(POSITION), row.vector(COVARIANCE)
    quaternion, sigma = row.vector(QUATERNION), row.number("attitude_sigma_arcsec")
    written = None if quaternion is None else rotation_from_quaternion(*quaternion)
    reason = Reason(read_reason_code(row), row["reason"])
    evidence = Evidence(
        n_predicted=row.count("n_predicted"),
        n_matched=row.count("n_matched"),
        n_used=row.count("n_used"),
        residual_rms_px=row.number("residual_rms_px"),
        n_limb=row.count("n_limb"),
        arc_deg=row.number("arc_deg"),
        n_windows=row.count("n_windows"),
        n_landmarks=row.count("n_landmarks"),
        lens=_read_lens(row),
    )
    method = _read_method(row)
    outcome: Fix | NoFix = NoFix(reason, method, evidence)
    if position is not None and not 0.0 < np.abs(position).max() <= MAX_SOLVED_M:
        raise DataError(f"the position lies at the centre or beyond {MAX_SOLVED_M:g} m")
    if row["status"] == "solved":
        if position is None or upper is None or method is None:
            raise DataError(
                "a solved frame without method, position or covariance; run navigate again"
            )
        camera_from_body = None if written is None else attitude.read(written, row["utc"])
        sigma_rad = None if sigma is None else sigma * ARCSEC
        covariance = attitude.places.transform_covariance_to_catalog(_read_covariance(upper))
        position_m = attitude.places.transform_to_catalog(position)
        outcome = Fix(method, position_m, covariance, camera_from_body, sigma_rad, evidence, reason)
    source = row["attitude_source"]
    return Solution(row["file"], row["utc"], outcome, row["prior"], attitude_source=source)


def _read_method(row: CsvRow) -> Method | None:
    try:
        return Method(row["method"]) if row["method"] else None
    except ValueError:
        raise DataError(f"method is '{row['method']}'; wanted {', '.join(Method)}") from None


def read_reason_code(row: CsvRow) -> ReasonCode:
    """Read the code of a row's reason. Raises DataError."""
    try:
        return ReasonCode(row["reason_code"])
    except ValueError:
        raise DataError(f"'{row['reason_code']}' is no reason code") from None


def _read_covariance(upper: FloatArray) -> FloatArray:
    matrix = np.empty((3, 3))
    for value, (i, j) in zip(upper, UPPER, strict=True):
        matrix[i, j] = matrix[j, i] = value
    if np.linalg.eigvalsh(matrix)[0] <= 0.0:
        raise DataError("the covariance is not positive definite; run navigate again")
    return matrix


def _list_match_cells(match: MatchRow) -> dict[str, object]:
    cells: dict[str, object] = {name: getattr(match, name) for name in SAME_IN_MATCH}
    cells["id"] = match.label
    cells |= _list_place_cells(match.cp_position_m)
    for name in ("predicted", "measured", "residual", "prior"):
        pixel = getattr(match, f"{name}_px")
        if pixel is not None:
            cells |= zip(_list_columns(name), pixel, strict=True)
    return cells


def _list_landmark_cells(landmark: LandmarkRow, attitude: FileAttitude) -> dict[str, object]:
    cells: dict[str, object] = {
        "id": landmark.number,
        "first_file": landmark.first_file,
        "last_file": landmark.last_file,
        "n_seen": landmark.n_seen,
        "status": "retired" if landmark.reason else "tracked",
        "reason": landmark.reason.text,
    }
    cells |= _list_place_cells(attitude.places.transform_to_stated(landmark.place_m))
    cells |= {name: landmark.covariance_m2[at] for name, at in zip(GROUND_COVARIANCE, UPPER)}
    return cells


def _list_adjusted_cells(match: AdjustedMatch) -> dict[str, object]:
    cells = _list_match_cells(match.row) | {"weight": match.weight}
    for name in ("stated", "constants"):
        cells |= zip(_list_columns(name), getattr(match, f"{name}_px"), strict=True)
    return cells


def _read_match(row: CsvRow) -> MatchRow:
    kind, level = _read_kind(row), row.count("level")
    name = row["id"] if kind is MatchKind.PICKED_POINT else ""
    cp_id = hash_name(name) if name else row.count("id")
    geographic = row.vector(("lat_deg", "lon_deg", "radius_m"))
    predicted = row.vector(_list_columns("predicted"))
    if cp_id is None or level is None or geographic is None or predicted is None:
        raise DataError("id, level, place or predicted pixel is empty; run navigate again")
    lat, lon, radius = geographic
    return MatchRow(
        file=row["file"],
        cp_id=cp_id,
        level=level,
        cp_position_m=xyz_from_latlon(np.radians(lat), np.radians(lon), radius),
        predicted_px=predicted,
        measured_px=row.vector(_list_columns("measured")),
        score=row.number("score"),
        runner_up=row.number("runner_up"),
        used=row.flag("used"),
        reason=row["reason"],
        sun_elevation_deg=row.number("sun_elevation_deg"),
        residual_px=row.vector(_list_columns("residual")),
        prior_px=row.vector(_list_columns("prior")),
        catalog=row["catalog"],
        reason_code=read_reason_code(row),
        kind=kind,
        name=name,
    )


def _read_kind(row: CsvRow) -> MatchKind:
    try:
        return MatchKind(row["kind"]) if row["kind"] else MatchKind.CONTROL_POINT
    except ValueError:
        raise DataError(f"kind is '{row['kind']}'; wanted {', '.join(MatchKind)}") from None


def _list_columns(name: str) -> tuple[str, str]:
    return f"{name}_x_px", f"{name}_y_px"
