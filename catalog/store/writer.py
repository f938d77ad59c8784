"""Writing a catalog: a partial file beside its place, made durable, then renamed over it."""

import math
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from catalog.control_point import ComparisonShift, ControlPoint
from catalog.files import replace_file
from catalog.geometry.cells import CellGrid
from catalog.store.connection import SIDECARS, is_catalog_file, write_seal
from catalog.store.geopackage import Box, define_srs
from catalog.store.index import CELL_SLACK_DEG
from catalog.store.manifest import CatalogMeta, rows_from_meta
from catalog.store.patches import PreparedPoint, hash_catalog, hash_point
from catalog.store.records import (
    Record,
    compute_checksum,
    insert_shifts,
    make_feature_row,
    point_from_record,
    record_from_point,
    record_type,
)
from catalog.store.relief import PreparedRelief, ReliefRow
from catalog.store.schema import (
    META,
    PATCHES,
    POINT_LAYER,
    RECORDS,
    RECORDS_A_ROW,
    RELIEF,
    RELIEF_TABLE,
    create_tables,
    insert_service_rows,
)


@dataclass(frozen=True)
class Written:
    """Summary of a written catalog."""

    path: Path
    count: int
    usable: int
    digest: str
    size_bytes: int


def write_catalog(
    path: str | Path,
    meta: CatalogMeta,
    points: Iterable[PreparedPoint],
    relief: PreparedRelief | None = None,
) -> Written:
    """Write prepared points, in the order of their ids, and perhaps a relief as one catalog file.

    A point has `meta.levels` patches, or none at all if it is not usable. The old file at `path`
    stays whole until the new one is complete and on the disk.
    Raises OutputError for a place that cannot be written, a full disk, or a file at `path` that
    is no optnav catalog; ValueError for points out of order or outside their cells.
    """
    path = Path(path)
    # the log of a GIS program that had the old file open must not be applied to the new one
    with replace_file(path, is_catalog_file, SIDECARS) as partial:
        with closing(_open_new(partial)) as db:
            create_tables(db)
            if relief is not None:
                db.execute(RELIEF_TABLE)
                meta = replace(meta, relief=relief.meta)
            meta = _fill(db, meta, points, relief.rows if relief is not None else ())
            db.execute("COMMIT")
        write_seal(partial)
    return Written(path, meta.count, meta.usable, meta.digest, path.stat().st_size)


def _open_new(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, isolation_level=None)
    # nobody reads the file before it is complete, and a broken one is thrown away
    db.executescript(
        "PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; PRAGMA locking_mode = EXCLUSIVE; "
        "PRAGMA temp_store = MEMORY;"
    )
    return db


def _fill(
    db: sqlite3.Connection,
    meta: CatalogMeta,
    points: Iterable[PreparedPoint],
    relief_rows: Sequence[ReliefRow],
) -> CatalogMeta:
    """Insert everything; returns the manifest with counts and digest."""
    db.execute("BEGIN")
    layout = record_type(meta.levels)
    grid = CellGrid(meta.cell_deg)
    sources: dict[str, int] = {}
    digests = bytearray()
    shifts: dict[int, ComparisonShift] = {}
    chunk: list[bytes] = []
    count = usable = chunks = 0
    last_id = -1
    insert_patch = f"INSERT INTO {PATCHES} VALUES (?,?,?,?,?,?,?,?,?,?)"
    for prepared in points:
        point = prepared.point
        _check(prepared, meta, grid, last_id)
        last_id = point.id
        source = sources.setdefault(point.source, len(sources))
        record = record_from_point(point, prepared.levels, source, layout).tobytes()
        digests += hash_point(record, prepared.patches_digest)
        db.executemany(insert_patch, prepared.rows)
        chunk.append(record)
        if point.comparison is not None:
            shifts[point.id] = point.comparison
        count += 1
        usable += point.usable
        if len(chunk) == RECORDS_A_ROW:
            _insert_records(db, chunks, chunk)
            chunks, chunk = chunks + 1, []
    if chunk:
        _insert_records(db, chunks, chunk)
    meta = replace(meta, point_sources=tuple(sources), count=count, usable=usable)
    meta = replace(meta, digest=hash_catalog(meta, digests))
    if meta.comparison is not None:
        compared = replace(meta.comparison, digest=insert_shifts(db, shifts))
        meta = replace(meta, comparison=compared)
    extent = insert_features(db, meta, _read_stored_points(db, meta))
    insert_service_rows(db, meta, extent)
    if relief_rows:
        db.executemany(f"INSERT INTO {RELIEF} VALUES (?,?,?,?,?,?,?,?,?)", relief_rows)
    rows = enumerate(rows_from_meta(meta).items(), start=1)
    db.executemany(f"INSERT INTO {META} VALUES (?,?,?)", [(number, *row) for number, row in rows])
    return meta


def _check(prepared: PreparedPoint, meta: CatalogMeta, grid: CellGrid, last_id: int) -> None:
    point = prepared.point
    if not last_id < point.id < grid.total:
        raise ValueError(f"point {point.id} after {last_id}; ids must ascend below {grid.total}")
    west, south, east, north = grid.bounds_deg(point.id)
    slack = CELL_SLACK_DEG / 2.0
    middle, half = (west + east) / 2.0, (east - west) / 2.0
    aside = abs((point.lon_deg - middle + 180.0) % 360.0 - 180.0)
    if not (south - slack <= point.lat_deg <= north + slack and aside <= half + slack):
        raise ValueError(f"point {point.id} at {point.lat_deg}, {point.lon_deg} is not in its cell")
    if point.usable and not math.isfinite(point.radius_m):
        raise ValueError(f"point {point.id} is usable but its radius is unknown")
    levels = prepared.levels
    if levels != meta.levels and (levels or point.usable):
        raise ValueError(f"point {point.id} has {levels} patches; wanted {meta.levels}")


def _insert_records(db: sqlite3.Connection, number: int, records: Sequence[bytes]) -> None:
    data = b"".join(records)
    row = (number, len(records), compute_checksum(data), data)
    db.execute(f"INSERT INTO {RECORDS} VALUES (?,?,?,?)", row)


def _read_stored_points(
    db: sqlite3.Connection, meta: CatalogMeta
) -> Iterator[tuple[ControlPoint, Record]]:
    layout = record_type(meta.levels)
    for (data,) in db.execute(f"SELECT data FROM {RECORDS} ORDER BY id"):
        for record in np.frombuffer(data, dtype=layout):
            yield point_from_record(record, meta.point_sources), record


def insert_features(
    db: sqlite3.Connection, meta: CatalogMeta, points: Iterable[tuple[ControlPoint, Record]]
) -> Box | None:
    """Fill the feature layer and its R-tree; returns what the points span."""
    srs_id = define_srs(meta.body, meta.radius_m)[0]
    return POINT_LAYER.fill(
        db,
        (
            (make_feature_row(p, record, srs_id), (p.lon_deg, p.lat_deg, p.lon_deg, p.lat_deg))
            for p, record in points
        ),
    )
