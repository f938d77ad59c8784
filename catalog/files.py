"""Writing files and folders: built beside their place, made durable, put there in one step.

The output of a command grows in a hidden sibling (".NAME.optnav-new-..."). Only when it is complete
and on the disk does it take the place that the user named, and never that of a file or folder of
somebody else. A killed command leaves the old output whole; the next one removes what it left.

In a work folder, which is optnav's own and locked as a whole, parts are named NAME.partial.
"""

import ctypes
import errno
import glob
import hashlib
import os
import shutil
import sqlite3
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TypeVar

import msgspec

from catalog.errors import DataError, OutputError
from catalog.places import find_kind, hidden_sibling, lock_output, make_output_error

MANIFEST = "manifest.json"
MADE_BY = "optnav"
NEW, OLD, PARTIAL = "optnav-new-", "optnav-old", ".partial"
MAX_MANIFEST_BYTES = 1 << 26  # a hash a picture: half a million pictures
PIECE = 1_000_000  # bytes that are read at once
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of linux/fcntl.h and linux/fs.h
SPARE_FILES = 4  # open folders, one in another, while one is removed
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)
SQLITE_DISK_ERRORS = ("SQLITE_FULL", "SQLITE_IOERR", "SQLITE_CANTOPEN", "SQLITE_READONLY")

T = TypeVar("T")
IsOurs = Callable[[Path], bool]  # whether a file is an older output of the same kind


def make_prefix_test(*prefixes: bytes) -> IsOurs:
    """A test for `replace_file`: the file begins with one of these bytes."""

    def test(path: Path) -> bool:
        with path.open("rb") as file:
            return file.read(max(map(len, prefixes))).startswith(prefixes)

    return test


def check_file(path: Path, ours: IsOurs, sidecars: Sequence[str] = ()) -> None:
    """Raise OutputError for a place where `replace_file` could not put a file.

    Nothing is touched; long work asks before it begins.
    """
    kind = find_kind(path)
    if kind == stat.S_IFDIR:
        raise OutputError(f"{path}: a folder is in the way of an output file; name another place")
    try:
        for ending in sidecars:  # whose names must fit
            with suppress(FileNotFoundError):
                path.with_name(path.name + ending).lstat()
        foreign = kind == stat.S_IFREG and path.stat().st_size > 0 and not ours(path)
    except OSError as error:
        raise make_output_error(path, error) from None
    if foreign:
        raise OutputError(
            f"{path}: exists and was not made by optnav as such an output; move it away or "
            "name another file"
        )


@contextmanager
def replace_file(path: Path, ours: IsOurs, sidecars: Sequence[str] = ()) -> Iterator[Path]:
    """Give a file name to write; on success that file takes the place of `path`.

    ours      whether an existing file may be replaced; an empty one always may
    sidecars  endings of files beside `path` that belong to the old file and go with it

    A link stays, and the file it leads to is replaced.
    Raises OutputError for a folder or anything foreign in the way, another process that writes
    there, an unwritable place, a full disk (of SQLite in the body, too).
    """
    check_file(path, ours, sidecars)
    with lock_output(path) as path, _report_write_errors(path), _make_new_folder(path) as folder:
        new = folder / f"new{path.suffix}"  # short: SQLite appends to names
        yield new
        _sync(new)
        check_file(path, ours)  # somebody may have come meanwhile
        for ending in sidecars:
            sidecar = path.with_name(path.name + ending)
            if sidecar.is_file():
                sidecar.unlink()
        os.replace(new, path)
        _sync(path.parent)


def write_output(path: Path, data: bytes, ours: IsOurs) -> None:
    """Write a file in one go, as `replace_file` does."""
    with replace_file(path, ours) as new:
        new.write_bytes(data)


def decode_stored_json(data: bytes, type_: type[T]) -> T | None:
    """Decode a JSON file of ours; None where it is damaged or of another kind."""
    try:
        return msgspec.json.decode(data, type=type_)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


class _ManifestHead(msgspec.Struct):
    made_by: str
    kind: str


def is_made_by_optnav(folder: Path, kind: str) -> bool:
    """Whether a folder's manifest says that optnav made it, as this kind of output."""
    path = folder / MANIFEST
    try:
        state = path.stat()
        if not stat.S_ISREG(state.st_mode) or state.st_size > MAX_MANIFEST_BYTES:
            return False
        head = decode_stored_json(path.read_bytes(), _ManifestHead)
    except OSError:
        return False
    return head is not None and (head.made_by, head.kind) == (MADE_BY, kind)


def check_folder(path: Path, kind: str) -> None:
    """Raise OutputError unless `path` is free, an empty folder, or an output of this kind."""
    entry = find_kind(path)
    if entry == stat.S_IFREG:
        raise OutputError(f"{path}: a file is in the way of an output folder; name another place")
    try:
        foreign = entry != 0 and any(path.iterdir()) and not is_made_by_optnav(path, kind)
    except OSError as error:
        raise make_output_error(path, error) from None
    if foreign:
        raise OutputError(
            f"{path}: the folder is not empty and holds no {kind} that optnav made, so it is left "
            "alone; name another place, or remove it yourself"
        )


@contextmanager
def replace_folder(path: Path, kind: str) -> Iterator[Path]:
    """Give a folder to fill; on success it takes the place of `path`, otherwise it vanishes.

    path  where the output shall be: free, an empty folder, or an older output of the same kind
    kind  what the output is ("run", "pictures"); its manifest.json must say so in the end

    Raises OutputError for a place that is taken, locked by another optnav or not writable, and
    for a disk that fills up; ValueError when the caller wrote no manifest.
    """
    check_folder(path, kind)
    with lock_output(path) as path, _report_write_errors(path), _make_new_folder(path) as new:
        yield new
        if not is_made_by_optnav(new, kind):
            raise ValueError(f"{path}: the {kind} was left without its manifest")
        check_folder(path, kind)  # somebody may have come meanwhile
        for folder, _, names in os.walk(new):
            for name in names:
                _sync(Path(folder, name))
            _sync(Path(folder))
        _move_into_place(new, path)


def write_work_file(path: Path, data: bytes) -> None:
    """Write a file of a work folder: whole or not at all, also after a loss of power.

    Raises OSError.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}{PARTIAL}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(data)
        _sync(partial)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def replace_work_folder(path: Path) -> Iterator[Path]:
    """Give a folder to fill in a work folder; on success it takes the place of `path`."""
    partial = path.with_name(path.name + PARTIAL)
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        yield partial
        shutil.rmtree(path, ignore_errors=True)
        os.replace(partial, path)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def hash_file(path: Path, piece_done: Callable[[], object] = lambda: None) -> str:
    """SHA-256 of a file's bytes, hex. Raises DataError when it cannot be read.

    piece_done  called after each MB
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while data := file.read(PIECE):
                digest.update(data)
                piece_done()
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror or error}); check its permissions"
        ) from error
    return digest.hexdigest()


@contextmanager
def _report_write_errors(path: Path) -> Iterator[None]:
    """Turn the failures of a place into an OutputError; errors about other files pass through."""
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        if isinstance(error, OSError):
            there = str(error.filename or "").startswith(str(path.parent))
            failed, reason = there or error.errno in DISK_ERRORS, error.strerror
        else:
            name = getattr(error, "sqlite_errorname", "")
            failed, reason = name.startswith(SQLITE_DISK_ERRORS), None
        if not failed:
            raise
        raise OutputError(
            f"{path}: cannot be written ({reason or error}); free some space there or name "
            "another place"
        ) from error


@contextmanager
def _make_new_folder(path: Path) -> Iterator[Path]:
    """A hidden folder beside a claimed `path` that is gone afterwards."""
    _remove_leftovers(path)
    # A command that fails for want of open files wants some to remove the folder.
    with ExitStack() as spare:
        for _ in range(SPARE_FILES):
            spare.callback(os.close, os.open(os.devnull, os.O_RDONLY))
        new = Path(tempfile.mkdtemp(prefix=hidden_sibling(path, NEW).name, dir=path.parent))
        try:
            mask = os.umask(0)
            os.umask(mask)
            new.chmod(0o777 & ~mask)  # mkdtemp makes it private
            yield new
        finally:
            spare.close()
            shutil.rmtree(new, ignore_errors=True)


def _remove_leftovers(path: Path) -> None:
    """Clean up after a killed command; give back an old output that it had moved aside."""
    old = hidden_sibling(path, OLD)
    if old.exists():
        if path.exists():
            shutil.rmtree(old)
        else:
            os.rename(old, path)
    for leftover in path.parent.glob(f"{glob.escape(hidden_sibling(path, NEW).name)}*"):
        if leftover.is_dir() and not leftover.is_symlink():
            shutil.rmtree(leftover)


def _move_into_place(new: Path, path: Path) -> None:
    """Make `new` the folder at `path`; what was there is left under the name of `new`."""
    if not path.exists():
        os.rename(new, path)
    elif not _swap_folders(new, path):
        # Two steps where the system cannot exchange: a kill between them leaves the old output
        # under its other name, and the next command gives it back.
        old = hidden_sibling(path, OLD)
        os.rename(path, old)
        os.rename(new, path)
        shutil.rmtree(old, ignore_errors=True)
    _sync(path.parent)


def _swap_folders(one: Path, other: Path) -> bool:
    """Exchange two folders in one step; False where the system or file system cannot."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except AttributeError:
        return False
    result: int = rename(
        AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), ctypes.c_uint(RENAME_EXCHANGE)
    )
    return result == 0


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
