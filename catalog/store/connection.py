"""Opening a catalog file for reading, and nothing but reading."""

import os
import sqlite3
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from catalog.errors import DataError
from catalog.store.manifest import CatalogMeta, meta_from_rows
from catalog.store.schema import META, PAGE_SIZE, POINT_COLUMNS, POINTS

SQLITE_MAGIC = b"SQLite format 3\0"
SIDECARS = ("-wal", "-shm", "-journal")
CACHE_KIB = 8192


def connect(path: Path) -> sqlite3.Connection:
    """Open a catalog read-only.

    Raises DataError for a file that is missing, cut short or no SQLite database.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            header = file.read(100)
    except FileNotFoundError:
        raise DataError(f"{path}: there is no such file; check the path") from None
    except IsADirectoryError:
        raise DataError(f"{path}: is a folder; name a catalog file") from None
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
        ) from None
    if len(header) < 100 or not header.startswith(SQLITE_MAGIC):
        raise DataError(f"{path}: is not an optnav catalog; make one with `optnav build`")
    log = live_log(path)
    if log is None:
        _check_length(path, header, size)
    # Without a log beside it nobody is writing, and `immutable` spares locks and works on
    # read-only media; with one (a GIS program has the file open) SQLite must read both.
    uri = f"file:{quote(os.fsencode(path.absolute()))}?mode=ro" + (
        "&immutable=1" if log is None else ""
    )
    try:
        # SQLite serialises calls itself, so that threads may share a catalog
        db = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
        db.execute(f"PRAGMA cache_size = -{CACHE_KIB}")
    except sqlite3.Error as error:
        left = (
            f"; a program was stopped while it wrote to it and left {log.name}: open and close the "
            "catalog once with that program, where it can be written"
            if log is not None
            else "; restore it or build it again"
        )
        raise DataError(f"{path}: cannot be opened: {error}{left}") from None
    return db


def read_meta(db: sqlite3.Connection, path: Path) -> CatalogMeta:
    """The manifest. Raises DataError for another format, a newer version or damage."""
    try:
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


def is_catalog_file(path: Path) -> bool:
    """Whether a file is a catalog of ours, even one that is damaged or cut short."""
    with path.open("rb") as file:
        first_page = file.read(PAGE_SIZE)
    # the first page holds the text of the schema
    return first_page.startswith(SQLITE_MAGIC) and META.encode() in first_page


def is_points_file(path: Path) -> bool:
    """Whether a file is an exported layer of ours: our points without a catalog around them."""
    uri = f"file:{quote(os.fsencode(path.absolute()))}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as db:
            points = db.execute(f"SELECT name FROM pragma_table_info('{POINTS}')").fetchall()
            meta = db.execute(f"SELECT name FROM pragma_table_info('{META}')").fetchall()
    except sqlite3.Error:
        return False
    return tuple(name for (name,) in points) == POINT_COLUMNS and not meta


def live_log(path: Path) -> Path | None:
    """The log in which another program has changes to the file, beside it; None for none."""
    for suffix in ("-wal", "-journal"):
        log = path.with_name(path.name + suffix)
        if log.exists() and log.stat().st_size > 0:
            return log
    return None


def _check_length(path: Path, header: bytes, size: int) -> None:
    """Compare the file's length with the page count in its header (SQLite file format, 1.3)."""
    page_size = int.from_bytes(header[16:18], "big")
    page_size = 65536 if page_size == 1 else page_size
    pages = int.from_bytes(header[28:32], "big")
    # the count is kept only by programs that write both version numbers alike
    if header[24:28] == header[92:96] and size < pages * page_size:
        raise DataError(
            f"{path}: is cut short: {size} bytes of {pages * page_size}; copy it again or "
            "build it again"
        )
