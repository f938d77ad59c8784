"""A catalog file as a whole: whether it is one, opening it to read, and the seal of all its bytes.

SQLite leaves room in its pages, most of a small file. A bit that flips there harms nothing, yet the
medium that flipped it is not to be trusted. The seal is a row of the manifest, `COUNTER:SHA-256`,
both in hexadecimal: the change counter of SQLite's header and the hash of the file with the
seal's own characters taken as zeros. It holds until another program, such as a GIS that keeps its
styles in the file, writes to it through SQLite, which moves the counter on. SQLite keeps the
counter twice, so that one flipped bit never looks like such a visit.
"""

import hashlib
import os
import sqlite3
from enum import Enum
from pathlib import Path
from typing import BinaryIO
from urllib.parse import quote

from catalog.errors import DATABASE_ERRORS, DataError
from catalog.inputs import check_input
from catalog.store.geopackage import list_columns
from catalog.store.manifest import COUNTER_DIGITS, OPEN_SEAL, SEAL, CatalogMeta, meta_from_rows
from catalog.store.schema import FORMER_POINT_COLUMNS, META, PAGE_SIZE, POINT_COLUMNS, POINTS

SQLITE_MAGIC = b"SQLite format 3\0"
SIDECARS = ("-wal", "-shm", "-journal")
CACHE_KIB = 8192
MAX_CELL_BYTES = 64 << 20  # of one value; rows of packed points and relief tiles have 1-2 MB
# Where SQLite's header keeps its change counter, and the counter that its page count goes with.
COUNTER, COUNTER_AGAIN = slice(24, 28), slice(92, 96)
PAGES = slice(16, 18), slice(28, 32)  # their size and number
PIECE = 1 << 20


class SealState(Enum):
    """State of a file's bytes by its seal."""

    NONE = "the file carries no seal"
    WHOLE = "as it was written, byte for byte"
    OPENED = "whole in content; another program, such as a GIS, wrote to the file since"
    BROKEN = "bytes between the data are not as they were written; its medium may be failing"


def connect(path: Path) -> sqlite3.Connection:
    """Open a catalog read-only.

    Raises DataError for a file that is missing, cut short or no SQLite database.
    """
    size = check_input(path)
    try:
        with path.open("rb") as file:
            header = file.read(100)
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from None
    if len(header) < 100 or not header.startswith(SQLITE_MAGIC):
        raise DataError(f"{path}: is not an optnav catalog; make one with `optnav build`")
    log = find_live_log(path)
    if log is None:
        _check_length(path, header, size)
    # Without a log beside it nobody is writing, and `immutable` spares locks and works on
    # read-only media; with one (a GIS program has the file open) SQLite must read both.
    mode = "ro&immutable=1" if log is None else "ro"
    uri = f"file:{quote(os.fsencode(path.absolute()))}?mode={mode}"
    try:
        # SQLite serialises calls itself, so that threads may share a catalog
        db = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_CELL_BYTES)
        db.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
        db.execute("PRAGMA trusted_schema = OFF")
    except DATABASE_ERRORS as error:
        left = "restore it or build it again"
        if log is not None:
            left = (
                f"a program was stopped while it wrote to it and left {log.name}: open and close "
                "the catalog once with that program, where it can be written"
            )
        raise DataError(f"{path}: cannot be opened: {error}; {left}") from None
    return db


def read_meta(db: sqlite3.Connection, path: Path) -> CatalogMeta:
    """The manifest. Raises DataError for another format, a newer version or damage."""
    try:
        _check_tables(db)
        rows = dict(db.execute(f"SELECT key, value FROM {META}").fetchall())
    except (sqlite3.Error, ValueError) as error:
        if "no such table" in str(error):
            raise DataError(
                f"{path}: is not an optnav catalog (it has no table {META}); make one with "
                "`optnav build`"
            ) from None
        raise DataError(
            f"{path}: the catalog is damaged: {error}; restore it or build it again"
        ) from None
    return meta_from_rows(rows, str(path))


def _check_tables(db: sqlite3.Connection) -> None:
    """Refuse what is computed where a table should be: a view can be endless."""
    computed = db.execute(
        "SELECT name FROM sqlite_schema"
        " WHERE (name LIKE 'optnav%' OR name LIKE 'gpkg%' OR name = ?) AND (type = 'view'"
        " OR sql LIKE 'CREATE VIRTUAL%' OR sql LIKE '%GENERATED ALWAYS%' OR sql LIKE '% AS (%')",
        (POINTS,),
    ).fetchone()
    if computed is not None:
        raise sqlite3.DatabaseError(f"{computed[0]} is no plain table")


def is_catalog_file(path: Path) -> bool:
    """Whether a file is a catalog of ours, even one that is damaged or cut short."""
    with path.open("rb") as file:
        first_page = file.read(PAGE_SIZE)
    # the first page holds the text of the schema
    return first_page.startswith(SQLITE_MAGIC) and META.encode() in first_page


def is_points_file(path: Path) -> bool:
    """Whether a file is an exported layer of ours: our points without a catalog around them."""
    ours = list_columns(path, POINTS) in (POINT_COLUMNS, FORMER_POINT_COLUMNS)
    return ours and not list_columns(path, META)


def find_live_log(path: Path) -> Path | None:
    """The log in which another program has changes to the file, beside it; None for none."""
    for suffix in ("-wal", "-journal"):
        log = path.with_name(path.name + suffix)
        if log.exists() and log.stat().st_size > 0:
            return log
    return None


def _check_length(path: Path, header: bytes, size: int) -> None:
    """Compare the file's length with the page count in its header (SQLite file format, 1.3)."""
    page_size, pages = (int.from_bytes(header[part], "big") for part in PAGES)
    wanted = pages * (65536 if page_size == 1 else page_size)
    # the count is kept only by programs that write both version numbers alike
    if header[COUNTER] == header[COUNTER_AGAIN] and size < wanted:
        raise DataError(
            f"{path}: is cut short: {size} bytes of {wanted}; copy it again or build it again"
        )


def write_seal(path: Path) -> None:
    """Write the seal into a closed catalog file whose manifest has OPEN_SEAL in its place."""
    with path.open("r+b") as file:
        offset = _find(file, f"{SEAL}{OPEN_SEAL}".encode("ascii"))
        if offset < 0:
            raise ValueError(f"{path}: its manifest has no place for a seal")
        offset += len(SEAL)
        seal = f"{_read_counters(file)[0]}:{_hash(file, offset)}".encode("ascii")
        file.seek(offset)
        file.write(seal)


def check_seal(path: Path, seal: str) -> SealState:
    """Compare a closed file with the seal that its manifest states; "" is no seal."""
    if not seal:
        return SealState.NONE
    with path.open("rb") as file:
        offset = _find(file, f"{SEAL}{seal}".encode("utf-8", "surrogatepass"))
        intact = offset >= 0 and _hash(file, offset + len(SEAL)) == seal[COUNTER_DIGITS + 1 :]
        counter, again = _read_counters(file)
    moved = counter != seal[:COUNTER_DIGITS]
    if intact and not moved:
        return SealState.WHOLE
    return SealState.OPENED if moved and not intact and counter == again else SealState.BROKEN


def _read_counters(file: BinaryIO) -> tuple[str, str]:
    """Both change counters of the header, hexadecimal."""
    file.seek(0)
    header = file.read(COUNTER_AGAIN.stop)
    return header[COUNTER].hex(), header[COUNTER_AGAIN].hex()


# Read piece by piece: a mapped file would count as memory of the process, all of it.
def _find(file: BinaryIO, text: bytes) -> int:
    """Where a text first stands in a file; -1 for nowhere."""
    file.seek(0)
    start, data = 0, b""
    while piece := file.read(PIECE):
        data += piece
        index = data.find(text)
        if index >= 0:
            return start + index
        kept = min(len(text) - 1, len(data))
        start, data = start + len(data) - kept, data[len(data) - kept :]
    return -1


def _hash(file: BinaryIO, place: int) -> str:
    """SHA-256 of a file with the seal at `place` taken as open."""
    digest = hashlib.sha256()
    file.seek(0)
    left = place
    while piece := file.read(min(PIECE, left)):
        digest.update(piece)
        left -= len(piece)
    digest.update(OPEN_SEAL.encode("ascii"))
    file.seek(place + len(OPEN_SEAL))
    while piece := file.read(PIECE):
        digest.update(piece)
    return digest.hexdigest()
