"""The list of all points, from the packed table or, where that is damaged, the feature layer."""

import sqlite3
from collections.abc import Callable

import numpy as np

from catalog.arrays import RecordArray
from catalog.errors import DataError
from catalog.store.features import record_from_row
from catalog.store.manifest import CatalogMeta
from catalog.store.records import Record, checksum, record_type
from catalog.store.schema import POINT_COLUMNS, POINTS, RECORDS, srs_of

Report = Callable[[str, object], None]  # told of damage: place, what is wrong


def packed_records(db: sqlite3.Connection, meta: CatalogMeta) -> RecordArray:
    """The points from the packed table. Raises DataError when it is damaged."""
    layout = record_type(meta.levels)
    parts: list[bytes] = []
    try:
        rows = db.execute(f"SELECT id, count, checksum, data FROM {RECORDS} ORDER BY id").fetchall()
    except sqlite3.Error as error:
        raise DataError(f"cannot be read: {error}") from None
    for number, (key, count, stored, data) in enumerate(rows):
        if (
            key != number
            or not isinstance(data, bytes)
            or stored != checksum(data)
            or len(data) != count * layout.itemsize
        ):
            raise DataError(f"row {number} does not fit its checksum")
        parts.append(data)
    records = np.frombuffer(b"".join(parts), dtype=layout)
    if len(records) != meta.count:
        raise DataError(f"holds {len(records)} points of {meta.count}")
    return records


def feature_records(db: sqlite3.Connection, meta: CatalogMeta, report: Report) -> RecordArray:
    """The points whose row in the feature layer is whole; the others are reported.

    Raises DataError when the table cannot be read or no point of it is whole.
    """
    srs_id = srs_of(meta.body, meta.radius_m)[0]
    good: dict[int, Record] = {}
    try:
        for row in db.execute(f"SELECT {', '.join(POINT_COLUMNS)} FROM {POINTS} ORDER BY id"):
            try:
                record = record_from_row(row, meta.levels, meta.point_sources, srs_id)
            except DataError as error:
                report(f"{POINTS} {row[0]}", f"left out: {error}")
                continue
            good[int(record["id"])] = record
    except sqlite3.Error as error:
        raise DataError(f"the catalog is damaged: {error}; restore it or build it again") from None
    if meta.count and not good:
        raise DataError("the catalog is damaged: no control point is whole; build it again")
    records = np.zeros(len(good), dtype=record_type(meta.levels))
    for row_number, key in enumerate(sorted(good)):
        records[row_number] = good[key]
    return records


def read_records(db: sqlite3.Connection, meta: CatalogMeta, report: Report) -> RecordArray:
    """The points in the order of their ids; damage is reported.

    Raises DataError when they cannot be listed at all.
    """
    try:
        return packed_records(db, meta)
    except DataError as error:
        report(RECORDS, f"{error}; reading the feature layer instead")
        return feature_records(db, meta, report)
