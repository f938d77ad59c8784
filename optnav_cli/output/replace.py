"""Output places: written beside, put in place in one step, and never over somebody else's files.

While a command works, its output grows in a hidden sibling (".NAME.optnav-new-..."), locked by
the process. Only a complete output is exchanged with the place the user named, so a command that
is killed leaves the old output whole; the next one removes what the killed one left behind.
"""

import ctypes
import errno
import fcntl
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from catalog.errors import OutputError

MANIFEST = "manifest.json"
MADE_BY = "optnav"
NEW, OLD = "optnav-new-", "optnav-old"
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # of linux/fcntl.h and linux/fs.h
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG)


def made_by_optnav(folder: Path, kind: str) -> bool:
    """Whether a folder's manifest says that optnav made it, as this kind of output."""
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return (
        isinstance(manifest, dict)
        and manifest.get("made_by") == MADE_BY
        and manifest.get("kind") == kind
    )


def check_folder(path: Path, kind: str) -> None:
    """Raise OutputError unless `path` is free, an empty folder, or an output of this kind."""
    if not path.exists():
        return
    if not path.is_dir():
        raise OutputError(f"{path}: a file is in the way of an output folder; name another place")
    if any(path.iterdir()) and not made_by_optnav(path, kind):
        raise OutputError(
            f"{path}: the folder is not empty and holds no {kind} that optnav made, so it is left "
            "alone; name another place, or remove it yourself"
        )


@contextmanager
def replacing_folder(path: Path, kind: str) -> Iterator[Path]:
    """Give a folder to fill; on success it takes the place of `path`, otherwise it vanishes.

    path  where the output shall be: free, an empty folder, or an older output of the same kind
    kind  what the output is ("run", "pictures"); its manifest.json must say so in the end

    Raises OutputError for a place that is taken, locked by another optnav or not writable, and
    for a disk that fills up; ValueError when the caller wrote no manifest.
    """
    path = _resolved(path)
    check_folder(path, kind)
    with _writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(path)
        new = Path(tempfile.mkdtemp(prefix=f".{path.name}.{NEW}", dir=path.parent))
        lock = os.open(new, os.O_RDONLY)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            new.chmod(0o777 & ~_umask())  # mkdtemp makes it private
            yield new
            if not made_by_optnav(new, kind):
                raise ValueError(f"{path}: the {kind} was left without its manifest")
            check_folder(path, kind)  # somebody may have come meanwhile
            _put_in_place(new, path)
        finally:
            os.close(lock)
            shutil.rmtree(new, ignore_errors=True)


@contextmanager
def replacing_file(path: Path, ours: Callable[[Path], bool]) -> Iterator[Path]:
    """Give a file name to write; on success that file takes the place of `path`.

    ours  tells whether an existing file is an output of the same command, to be replaced

    Raises OutputError for a folder or a foreign file in the way, an unwritable place, a full disk.
    """
    path = _resolved(path)
    if path.is_dir():
        raise OutputError(f"{path}: a folder is in the way of an output file; name another place")
    if path.exists() and path.stat().st_size and not ours(path):
        raise OutputError(
            f"{path}: the file was not made by this command, so it is left alone; "
            "name another place, or remove it yourself"
        )
    with _writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(path)
        folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.{NEW}", dir=path.parent))
        lock = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield folder / path.name
            os.replace(folder / path.name, path)
        finally:
            os.close(lock)
            shutil.rmtree(folder, ignore_errors=True)


def starts_with(*prefixes: bytes) -> Callable[[Path], bool]:
    """A test for `replacing_file`: the file begins with one of these bytes."""

    def test(path: Path) -> bool:
        with path.open("rb") as file:
            return file.read(max(map(len, prefixes))).startswith(prefixes)

    return test


def _resolved(path: Path) -> Path:
    path = Path(path)
    if not path.name:
        raise OutputError(f"{path}: this is not a name for an output; name another place")
    return path.resolve()


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn the failures of a place into an OutputError; errors about other files pass through."""
    try:
        yield
    except OSError as error:
        there = str(error.filename or "").startswith(str(path.parent))
        if error.errno in DISK_ERRORS or there:
            reason = error.strerror or str(error)
            raise OutputError(
                f"{path}: cannot be written ({reason}); make room there or name another place"
            ) from error
        raise


def _remove_leftovers(path: Path) -> None:
    """Clean up after a killed command; give back an old output that it had moved aside."""
    old = path.parent / f".{path.name}.{OLD}"
    if old.exists():
        if path.exists():
            shutil.rmtree(old)
        else:
            os.rename(old, path)
    for leftover in sorted(path.parent.glob(f".{_glob_safe(path.name)}.{NEW}*")):
        try:
            handle = os.open(leftover, os.O_RDONLY)
        except FileNotFoundError:  # its own process has just removed it
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                f"{path}: another optnav is writing this output; wait for it or name another place"
            ) from None
        else:
            shutil.rmtree(leftover)
        finally:
            os.close(handle)


def _put_in_place(new: Path, path: Path) -> None:
    """Make `new` the folder at `path`; what was there is left under the name of `new`."""
    if not path.exists():
        os.rename(new, path)
    elif not _exchange(new, path):
        # Two steps where the system cannot exchange: a kill between them leaves the old output
        # under its other name, and the next command gives it back.
        old = path.parent / f".{path.name}.{OLD}"
        os.rename(path, old)
        os.rename(new, path)
        shutil.rmtree(old, ignore_errors=True)


def _exchange(one: Path, other: Path) -> bool:
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


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _glob_safe(name: str) -> str:
    return "".join(f"[{c}]" if c in "*?[" else c for c in name)
