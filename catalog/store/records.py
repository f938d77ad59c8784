"""A control point as one record of fixed layout, and as a row of the feature layer.

Checksums, digest and index are made of the records; the feature layer is what GIS programs show.
Numbers are rounded before they are stored, so that a difference in the last bits of a sum cannot
change a catalog's content; what is not finite is stored as unknown (NaN).
"""

import hashlib
import json
import math
import sqlite3
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from catalog.arrays import BoolArray, RecordArray
from catalog.control_point import SHADOW_AZIMUTHS, ComparisonShift, ControlPoint, Flag
from catalog.errors import DATABASE_ERRORS, DataError
from catalog.geometry.cells import CellGrid
from catalog.store.geopackage import encode_point
from catalog.store.schema import COMPARISON, COMPARISON_TABLE, POINT_COLUMNS

T = TypeVar("T")
Record = np.void  # one of them
LATLON_DECIMALS = 7  # degrees: 3 mm on the Moon
RADIUS_DECIMALS = 3  # metres
SCORE_DECIMALS = 4  # localisation, rates and margins
SHADOW_DECIMALS = 2  # degrees
SHIFT_DECIMALS = 2  # metres
EIGENVALUE_DIGITS = 6  # significant: it spans many powers of ten

# fields that a record has under the names, and with the numbers, of a control point
SAME = {
    "id": "<i8",
    "lat_deg": "<f8",
    "lon_deg": "<f8",
    "radius_m": "<f8",
    "localisation_nodes": "<f8",
    "hessian_eigenvalue": "<f8",
    "recognition_rate": "<f8",
    "trials": "<i4",
}
# A contact binary's neck is the nearest that ground comes to a body's centre.
RADIUS_SHARES = (1e-3, 10.0)
ROUNDING_DEG = 1e-6  # that a rounded place may lie outside of its cell
CERTIFICATE_LIMITS = {
    "localisation_nodes": (0.0, 1e30),
    "hessian_eigenvalue": (-1e30, 1e30),
    "recognition_rate": (0.0, 1.0),
    "uniqueness": (-1e6, 1e6),
    "shadow_limit_deg": (-90.0, 90.0),
}
_ROW = struct.Struct("<q2dqd")
Row = tuple[int, float | None, float | None, int, float]


def record_type(levels: int) -> np.dtype[np.void]:
    """Layout of a record, little-endian and unpadded; `levels` uniqueness margins."""
    integers = dict.fromkeys(("flags", "usable", "levels", "source"), "<i4")
    lists = [("uniqueness", "<f4", (levels,)), ("shadow_limit_deg", "<f4", (SHADOW_AZIMUTHS,))]
    return np.dtype([*SAME.items(), *integers.items(), *lists])


def _round_value(value: float, decimals: int) -> float:
    value = float(value)
    # + 0.0 makes -0.0 a 0.0
    return round(value, decimals) + 0.0 if math.isfinite(value) else math.nan


def _round_digits(value: float, digits: int) -> float:
    value = float(value)
    return float(f"{value:.{digits}g}") + 0.0 if math.isfinite(value) else math.nan


def round_latlon(lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """Latitude and longitude of a point as the catalog keeps them."""
    lon = _round_value(lon_deg, LATLON_DECIMALS)
    return _round_value(lat_deg, LATLON_DECIMALS), lon - 360.0 if lon >= 180.0 else lon


def round_point(point: ControlPoint) -> ControlPoint:
    """A point with all numbers as the catalog keeps them."""
    lat, lon = round_latlon(point.lat_deg, point.lon_deg)
    return ControlPoint(
        id=int(point.id),
        lat_deg=lat,
        lon_deg=lon,
        radius_m=_round_value(point.radius_m, RADIUS_DECIMALS),
        localisation_nodes=_round_value(point.localisation_nodes, SCORE_DECIMALS),
        hessian_eigenvalue=_round_digits(point.hessian_eigenvalue, EIGENVALUE_DIGITS),
        recognition_rate=_round_value(point.recognition_rate, SCORE_DECIMALS),
        trials=int(point.trials),
        uniqueness=tuple(_round_value(v, SCORE_DECIMALS) for v in point.uniqueness),
        shadow_limit_deg=tuple(_round_value(v, SHADOW_DECIMALS) for v in point.shadow_limit_deg),
        usable=bool(point.usable),
        flags=Flag(int(point.flags)),
        source=point.source,
        comparison=None if point.comparison is None else round_shift(point.comparison),
        vertical_deg=round_vertical(point.vertical_deg),
    )


def round_shift(shift: ComparisonShift) -> ComparisonShift:
    """A shift with numbers as the catalog keeps them."""
    east, north = (_round_value(value, SHIFT_DECIMALS) for value in (shift.east_m, shift.north_m))
    return ComparisonShift(east, north, int(shift.level), _round_value(shift.score, SCORE_DECIMALS))


def round_vertical(vertical_deg: tuple[float, float] | None) -> tuple[float, float] | None:
    """Latitude and longitude of a vertical as the catalog keeps them."""
    if vertical_deg is None:
        return None
    lat, lon = (_round_value(angle, LATLON_DECIMALS) for angle in vertical_deg)
    return lat, lon


def record_from_point(
    point: ControlPoint, stored_levels: int, source: int, layout: np.dtype[np.void]
) -> Record:
    """The record of a point whose numbers are rounded already.

    stored_levels  patches that the catalog holds for the point
    source         place of the point's `source` in the manifest's `point_sources`
    """
    record: Record = np.zeros(1, dtype=layout)[0]
    for name in (*SAME, "flags", "usable"):
        record[name] = getattr(point, name)
    record["levels"] = stored_levels
    record["source"] = source
    record["uniqueness"] = point.uniqueness or math.nan
    record["shadow_limit_deg"] = point.shadow_limit_deg or math.nan
    return record


def find_impossible(
    records: RecordArray, grid: CellGrid, levels: int, sources: int, radius_m: float
) -> dict[int, str]:
    """Which records (n,) no build can have made, by their row, and why.

    grid, levels, sources, radius_m  of the catalog: cells, levels, texts of sources, sphere
    """
    # not "x > limit": NaN is wrong, too
    placed = (np.abs(records["lat_deg"]) <= 90.0) & (np.abs(records["lon_deg"]) <= 180.0)
    with np.errstate(all="ignore"):  # of numbers as they may stand there
        near = records["radius_m"] / radius_m
        celled = _mark_in_cells(records, grid)
    stored, source = records["levels"], records["source"]
    counts = np.stack([records["trials"], records["flags"], records["usable"]])
    faults = {
        "its place is none": ~placed,
        "its place is not in its cell": ~celled,
        # a place without ground has no radius, and is no point to use
        "its radius is not of the body": ~((near > RADIUS_SHARES[0]) & (near < RADIUS_SHARES[1]))
        & ~(np.isnan(near) & (counts[2] == 0)),
        "its number of levels is wrong": (stored < 0) | (stored > levels),
        "its source is not in the manifest": (source < 0) | (source >= sources),
        "its trials, flags or use are none": (counts < 0).any(axis=0) | (counts[2] > 1),
        "its certificate is impossible": _mark_wrong_certificates(records),
    }
    reasons: dict[int, str] = {}
    for reason, wrong in faults.items():
        for row in np.flatnonzero(wrong).tolist():
            reasons.setdefault(row, reason)
    return reasons


def _mark_in_cells(records: RecordArray, grid: CellGrid) -> BoolArray:
    """Whether places lie in the cells that their numbers name, but for rounding."""
    ids = records["id"]
    known = (ids >= 0) & (ids < grid.total)
    west, south, east, north = grid.compute_bounds_deg(np.where(known, ids, 0))
    lat, lon = records["lat_deg"], records["lon_deg"]
    inside = np.mod(lon - west, 360.0) <= east - west
    outside_deg = np.where(
        inside, 0.0, np.minimum(np.mod(west - lon, 360.0), np.mod(lon - east, 360.0))
    )
    outside_deg = np.maximum(outside_deg, np.maximum(south - lat, lat - north))
    inside_cell: BoolArray = known & (outside_deg <= ROUNDING_DEG)
    return inside_cell


def _mark_wrong_certificates(records: RecordArray) -> BoolArray:
    """Numbers beyond any build's; unknown ones (NaN) are possible."""
    wrong: BoolArray = np.zeros(len(records), dtype=bool)
    for name, (lowest, highest) in CERTIFICATE_LIMITS.items():
        beyond = (records[name] < lowest) | (records[name] > highest)
        wrong |= beyond if beyond.ndim == 1 else beyond.any(axis=1)
    return wrong


def point_from_record(record: Record, sources: Sequence[str]) -> ControlPoint:
    """The point that a record stands for."""
    return ControlPoint(
        **{name: record[name].item() for name in SAME},
        uniqueness=tuple(_round_value(v, SCORE_DECIMALS) for v in record["uniqueness"]),
        shadow_limit_deg=tuple(
            _round_value(v, SHADOW_DECIMALS) for v in record["shadow_limit_deg"]
        ),
        usable=bool(record["usable"]),
        flags=Flag(int(record["flags"])),
        source=sources[int(record["source"])],
    )


def replace_unknown(value: float) -> float | None:
    """A number, or None where it is not finite."""
    return float(value) if math.isfinite(value) else None


def compute_checksum(*parts: bytes) -> int:
    """CRC-32 of some bytes one after the other."""
    return zlib.crc32(b"".join(parts))


def _list_text(values: Sequence[float]) -> str:
    return json.dumps([replace_unknown(v) for v in values], separators=(",", ":"))


def make_feature_row(point: ControlPoint, record: Record, srs_id: int) -> tuple[object, ...]:
    """A row of `control_points` in the order of POINT_COLUMNS."""
    return (
        point.id,
        encode_point(point.lon_deg, point.lat_deg, srs_id),
        point.lat_deg,
        point.lon_deg,
        replace_unknown(point.radius_m),
        int(point.usable),
        int(point.flags),
        point.flags.label,
        replace_unknown(point.localisation_nodes),
        replace_unknown(point.hessian_eigenvalue),
        replace_unknown(point.recognition_rate),
        point.trials,
        min(filter(math.isfinite, point.uniqueness), default=None),
        _list_text(point.uniqueness),
        max(filter(math.isfinite, point.shadow_limit_deg), default=None),
        _list_text(point.shadow_limit_deg),
        point.source,
        int(record["levels"]),
        compute_checksum(record.tobytes(), point.source.encode()),
    )


def record_from_row(
    row: Sequence[object], levels: int, sources: Sequence[str], srs_id: int
) -> Record:
    """The record that a row of the feature layer stands for.

    Raises DataError, naming what is wrong, when the row does not fit its own checksum.
    """
    cells = dict(zip(POINT_COLUMNS, row, strict=True))
    try:
        uniqueness = json.loads(_check_cell(cells["uniqueness"], str, "text"))
        shadows = json.loads(_check_cell(cells["shadow_limit_deg"], str, "text"))
        if len(uniqueness) not in (0, levels) or len(shadows) not in (0, SHADOW_AZIMUTHS):
            raise ValueError("a list of the wrong length")
        source = _check_cell(cells["source"], str, "text")
        same: dict[str, Any] = {
            name: _check_count(cells[name]) if kind.startswith("<i") else _check_number(cells[name])
            for name, kind in SAME.items()
        }
        point = ControlPoint(
            **same,
            uniqueness=tuple(map(_check_number, uniqueness)),
            shadow_limit_deg=tuple(map(_check_number, shadows)),
            usable=bool(_check_count(cells["usable"])),
            flags=Flag(_check_count(cells["flags"])),
            source=source,
        )
        stored = _check_count(cells["levels"])
        record = record_from_point(point, stored, sources.index(source), record_type(levels))
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(f"row of control_points cannot be read: {error}") from None
    # every column counts, those too that only repeat others for people's eyes
    if tuple(row) != make_feature_row(point, record, srs_id):
        raise DataError("row of control_points does not fit its checksum")
    return record


def _check_cell(value: object, type_: type[T], wanted: str) -> T:
    if not isinstance(value, type_):
        raise ValueError(f"{type(value).__name__} where {wanted} should be")
    return value


def _check_count(value: object) -> int:
    return _check_cell(value, int, "a whole number")


def _check_number(value: object) -> float:
    if value is None or isinstance(value, int):
        return math.nan if value is None else float(value)
    return _check_cell(value, float, "a number")


def insert_shifts(db: sqlite3.Connection, shifts: Mapping[int, ComparisonShift]) -> str:
    """Make and fill the table from shifts by point; returns its digest."""
    db.execute(COMPARISON_TABLE)
    rows: list[Row] = [
        (number, replace_unknown(s.east_m), replace_unknown(s.north_m), s.level, s.score)
        for number, s in sorted(shifts.items())
    ]
    db.executemany(f"INSERT INTO {COMPARISON} VALUES (?,?,?,?,?)", rows)
    return _hash_rows(rows)


def read_shifts(db: sqlite3.Connection, digest: str) -> dict[int, ComparisonShift]:
    """The shifts by point. Raises DataError unless they are all there as they were written."""
    try:
        rows = [*_read_rows(db)]
        if _hash_rows(rows) != digest:
            raise DataError(f"{COMPARISON}: does not fit its digest")
    except (*DATABASE_ERRORS, struct.error, TypeError) as error:
        raise DataError(f"{COMPARISON}: cannot be read: {error}") from None
    return {
        number: ComparisonShift(_replace_none(east), _replace_none(north), level, score)
        for number, east, north, level, score in rows
    }


def _read_rows(db: sqlite3.Connection) -> Iterator[Row]:
    columns = "id, comparison_e_m, comparison_n_m, level, score"
    yield from db.execute(f"SELECT {columns} FROM {COMPARISON} ORDER BY id")


def _replace_none(value: float | None) -> float:
    return math.nan if value is None else value


def _hash_rows(rows: Iterable[Row]) -> str:
    """SHA-256 of the rows: id, east, north, level, score, little-endian; NaN for unknown."""
    digest = hashlib.sha256()
    for number, east, north, level, score in rows:
        digest.update(_ROW.pack(number, _replace_none(east), _replace_none(north), level, score))
    return digest.hexdigest()
