"""A file that is written aside and takes its place only when it is whole and on the disk."""

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from urllib.parse import quote

from catalog.errors import OutputError
from catalog.store.schema import META, PAGE_SIZE, POINT_COLUMNS, POINTS

SQLITE_MAGIC = b"SQLite format 3\0"
_SIDECARS = ("-wal", "-shm", "-journal")
_PLACE_ERRORS = ("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_CANTOPEN", "SQLITE_READONLY")


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


@contextmanager
def replacing(path: Path, may_replace: Callable[[Path], bool] = is_catalog_file) -> Iterator[Path]:
    """Give a partial file that takes the place of `path` at the end, or vanishes on any error.

    may_replace  whether an existing file may be replaced; an empty one always may

    Raises OutputError for all that the place can do wrong: a folder, someone else's file, no
    permission, a full disk (of SQLite in the body, too).
    """
    path = Path(os.path.realpath(path)) if path.name else path  # a link stays, its file is replaced
    partial = path.with_name(path.name + ".partial") if path.name else path
    check_place(path, may_replace)
    try:
        _prepare(path, partial)
        try:
            yield partial
        except sqlite3.Error as error:
            if str(getattr(error, "sqlite_errorname", "")).startswith(_PLACE_ERRORS):
                raise OutputError(
                    f"{path}: cannot be written: {error}; free some space or name another place"
                ) from error
            raise
        _publish(partial, path)
    finally:
        with suppress(OSError):
            _remove_with_sidecars(partial)


def check_place(path: Path, may_replace: Callable[[Path], bool] = is_catalog_file) -> None:
    """Raise OutputError for a place where `replacing` could not put a file; nothing is touched.

    Long work asks before it begins.
    """
    if not path.name:
        raise OutputError(f"{str(path)!r}: is not a name for a file; name one")
    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; name a file in it")
        if path.exists() and path.stat().st_size > 0 and not may_replace(path):
            raise OutputError(
                f"{path}: exists and was not made by optnav; move it away or name another file"
            )
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror}); name another place"
        ) from None


def _prepare(path: Path, partial: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_with_sidecars(partial)
        partial.touch(exist_ok=False)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror}); name another place"
        ) from None


def _publish(partial: Path, path: Path) -> None:
    try:
        _sync(partial)
        # the log of a GIS program that had the old file open must not be applied to the new one
        for suffix in _SIDECARS:
            path.with_name(path.name + suffix).unlink(missing_ok=True)
        os.replace(partial, path)
        _sync(path.parent)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror}); free some space or name another place"
        ) from error


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _remove_with_sidecars(path: Path) -> None:
    for suffix in ("", *_SIDECARS):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
