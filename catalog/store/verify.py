"""Reading a whole catalog again and comparing it with everything it says about itself."""

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

from catalog.arrays import RecordArray
from catalog.errors import DATABASE_ERRORS, DataError
from catalog.progress import Progress, SilentProgress, Stage
from catalog.store.codec import decode_counts
from catalog.store.connection import SealState, check_seal, connect, find_live_log, read_meta
from catalog.store.geopackage import APPLICATION_ID, define_srs
from catalog.store.manifest import CatalogMeta
from catalog.store.patches import (
    check_patch,
    hash_catalog,
    hash_patches,
    hash_point,
    stored_patch_from_row,
)
from catalog.store.reader import SELECT_PATCHES, read_records
from catalog.store.records import read_shifts, record_from_row
from catalog.store.relief import hash_relief, list_tiles
from catalog.store.schema import (
    COMPARISON,
    HEIGHT_LAYER,
    IMAGE_LAYER,
    PATCHES,
    POINT_LAYER,
    POINTS,
    RELIEF,
    compute_patch_key,
    list_service_rows,
    select_points,
)

RTREE = POINT_LAYER.rtree
# an R-tree keeps float32 corners, rounded outward
RTREE_TOLERANCE_DEG = 4e-5
MAX_INTEGRITY_LINES = 20


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong: where (table, point, level) and what."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


@dataclass
class Verification:
    """Result of `verify`.

    stated, computed  the digest in the manifest and that of what was read ("" if unreadable)
    points, patches   read and whole
    seal              of the file's bytes; None where it could not be asked
    """

    path: Path
    stated: str = ""
    computed: str = ""
    points: int = 0
    patches: int = 0
    seal: SealState | None = None
    problems: list[Problem] = field(default_factory=list)

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    def add(self, place: str, what: object) -> None:
        """Note a problem."""
        self.problems.append(Problem(place, str(what)))


def verify(path: str | Path, progress: Progress | None = None) -> Verification:
    """Read everything in a catalog and check every checksum.

    Damage is reported, never raised, but for what leaves nothing to compare with: a file that is
    missing, cut short or no catalog, or a damaged manifest, raises DataError.
    """
    path = Path(path)
    verification = Verification(path)
    with closing(connect(path)) as db:
        meta = read_meta(db, path)
        verification.stated = meta.digest
        _check_integrity(db, verification)
        records = _check_records(db, meta, verification)
        if records is not None:
            _check_features(db, meta, records, verification)
            stages = progress or SilentProgress()
            with stages.stage("verify", len(records), "point") as stage:
                _check_contents(
                    db, _read_again(db, meta, verification), records, verification, stage
                )
        if meta.comparison is not None:
            try:
                read_shifts(db, meta.comparison.digest)
            except DataError as error:
                verification.add(COMPARISON, error)
        _check_service_rows(db, meta, verification)
    if verification.sound:
        # with a log beside it the file is not all there is: another program is at work on it
        verification.seal = SealState.OPENED if find_live_log(path) else check_seal(path, meta.seal)
        if verification.seal is SealState.BROKEN:
            verification.add("file", verification.seal.value)
    return verification


def _check_integrity(db: sqlite3.Connection, verification: Verification) -> None:
    """SQLite's own check of pages and indexes; data inside them is ours to check."""
    try:
        (identity,) = db.execute("PRAGMA application_id").fetchone()
        if identity != APPLICATION_ID:
            verification.add("file header", f"application id {identity:#x} is not a GeoPackage's")
        for (line,) in db.execute(f"PRAGMA integrity_check({MAX_INTEGRITY_LINES})").fetchall():
            if line != "ok":
                verification.add("SQLite", line)
    except (sqlite3.Error, ValueError) as error:
        verification.add("SQLite", error)


def _check_records(
    db: sqlite3.Connection, meta: CatalogMeta, verification: Verification
) -> RecordArray | None:
    try:
        records = read_records(db, meta, verification.add)
    except DataError as error:
        verification.add(POINTS, error)
        return None
    if int((records["usable"] != 0).sum()) != meta.usable:
        verification.add("optnav_meta", f"states {meta.usable} usable points; there are others")
    return records


def _check_features(
    db: sqlite3.Connection, meta: CatalogMeta, records: RecordArray, verification: Verification
) -> None:
    """The feature layer and its R-tree must say the same as the packed points."""
    srs_id = define_srs(meta.body, meta.radius_m)[0]
    select = f"{select_points(meta)} WHERE id = ?"
    for record in records:
        number = int(record["id"])
        subject = f"{POINTS} {number}"
        try:
            row = db.execute(select, (number,)).fetchone()
            if row is None:
                verification.add(subject, "is missing")
                continue
            feature = record_from_row(row, meta.levels, meta.point_sources, srs_id)
            if feature.tobytes() != record.tobytes():
                verification.add(subject, "differs from the packed points")
            tree = db.execute(
                f"SELECT minx, maxx, miny, maxy FROM {RTREE} WHERE id = ?", (number,)
            ).fetchone()
            if tree is None or not _is_enclosed(tree, record):
                verification.add(f"{RTREE} {number}", "does not enclose its point")
        except (sqlite3.Error, ValueError, DataError) as error:
            verification.add(subject, error)
    for table in (POINTS, RTREE):
        _count(db, table, len(records), verification)


def _is_enclosed(tree: Sequence[float], record: RecordArray) -> bool:
    west, east, south, north = tree
    near = max(east - west, north - south) <= RTREE_TOLERANCE_DEG
    lon, lat = float(record["lon_deg"]), float(record["lat_deg"])
    return near and west <= lon <= east and south <= lat <= north


def _check_contents(
    db: sqlite3.Connection,
    meta: CatalogMeta,
    records: RecordArray,
    verification: Verification,
    stage: Stage,
) -> None:
    """Decode every patch and compute the content digest."""
    digests = bytearray()
    layers = (HEIGHT_LAYER,) if meta.image is None else (HEIGHT_LAYER, IMAGE_LAYER)
    for record in records:
        number = int(record["id"])
        contents = []
        for layer, level in product(layers, range(record["levels"])):
            subject = f"control point {number}, level {level}"
            try:
                key = compute_patch_key(number, layer, level)
                row = db.execute(SELECT_PATCHES, (key, key)).fetchone()
                if row is None:
                    verification.add(subject, "is missing")
                    continue
                check_patch(row, level, meta)
                patch = stored_patch_from_row(row, number, level, layer)
                counts = decode_counts(patch.encoded.data, patch.encoded.size)
                contents.append((patch.header, counts))
            except (sqlite3.Error, ValueError, DataError) as error:
                verification.add(subject, error)
        digests += hash_point(record.tobytes(), hash_patches(contents))
        verification.points += 1
        verification.patches += len(contents)
        stage.advance()
    verification.computed = hash_catalog(meta, digests)
    if verification.computed != verification.stated:
        verification.add(
            "digest", f"the content gives {verification.computed}; {verification.stated} is stated"
        )
    _count(db, PATCHES, len(layers) * int(records["levels"].sum()), verification)


def _read_again(
    db: sqlite3.Connection, meta: CatalogMeta, verification: Verification
) -> CatalogMeta:
    """The manifest with the digest of the relief as it is found in its tiles."""
    if meta.relief is None:
        return meta
    before = len(verification.problems)
    digest = hash_relief(db, meta.relief, verification.add)
    if digest != meta.relief.digest and len(verification.problems) == before:
        verification.add(RELIEF, f"the tiles give {digest}; {meta.relief.digest} is stated")
    _count(db, RELIEF, len(list_tiles(meta.relief)), verification)
    return replace(meta, relief=replace(meta.relief, digest=digest))


def _count(db: sqlite3.Connection, table: str, wanted: int, verification: Verification) -> None:
    try:
        (count,) = db.execute(f"SELECT count(*) FROM {table}").fetchone()
    except DATABASE_ERRORS as error:
        verification.add(table, error)
        return
    if count != wanted:
        verification.add(table, f"holds {count} rows; wanted {wanted}")


def _check_service_rows(
    db: sqlite3.Connection, meta: CatalogMeta, verification: Verification
) -> None:
    """Our rows in the GeoPackage's service tables; rows of other programs are their own."""
    for table, wanted in list_service_rows(meta).items():
        try:
            rows = set(db.execute(f"SELECT * FROM {table}").fetchall())
        except DATABASE_ERRORS as error:
            verification.add(table, error)
            continue
        # other programs may have added columns behind ours, as for another form of the WKT
        known = {row[: len(wanted[0])] for row in rows}
        for row in wanted:
            if row not in known:
                verification.add(table, f"the row of {row[0]!r} is missing or was changed")
