"""How far a second terrain model moves the points: a table of its own, beside the points."""

import hashlib
import math
import sqlite3
import struct
from collections.abc import Iterable, Iterator, Mapping

from catalog.control_point import ComparisonShift
from catalog.errors import DATABASE_ERRORS, DataError
from catalog.store.records import replace_unknown
from catalog.store.schema import COMPARISON, COMPARISON_TABLE

_ROW = struct.Struct("<q2dqd")
Row = tuple[int, float | None, float | None, int, float]


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
