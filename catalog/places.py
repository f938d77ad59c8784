"""Output places: what lies there already, and which process alone may write there.

Only regular files and folders are ever replaced: no device, no pipe, no socket, no link to nothing.
A process that writes to a place holds a lock file beside it (".NAME.optnav-lock"), which is gone
afterwards; the lock of a killed process goes with it.
"""

import errno
import fcntl
import hashlib
import os
import stat
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from catalog.errors import OutputError
from catalog.inputs import make_printable

LOCK = "optnav-lock"
# Longer names do not fit into 255 bytes with what hidden siblings add; a hash stands for them then.
MAX_NAME_BYTES = 200
LOOK_S = 0.01  # longer than another process looks whether a lock is held
NOT_REPLACED = {
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
}

_claims = threading.local()  # .places: what this thread may write to


def find_kind(path: Path) -> int:
    """Return the kind of file at a path, links followed: stat.S_IFREG, stat.S_IFDIR, 0 for nothing.

    Raises OutputError for anything else that lies there, a link to nothing, a name that is none.
    """
    if not path.name:
        raise OutputError(f"{str(path)!r}: is not a name for an output; name one")
    if make_printable(path) != str(path):  # it could not be read again: SQLite and GDAL take text
        raise OutputError(f"{make_printable(path)}: the name is not UTF-8 text; name another place")
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except FileNotFoundError:
        if path.is_symlink():
            raise OutputError(
                f"{path}: is a link to {os.readlink(path)}, which does not exist; remove the link "
                "or name another place"
            ) from None
        return 0
    except OSError as error:
        raise make_output_error(path, error) from None
    if kind in NOT_REPLACED:
        raise OutputError(
            f"{path}: is {NOT_REPLACED[kind]}, which no output replaces; name another place"
        )
    return kind


def make_folder(path: Path) -> None:
    """Make a folder to put outputs into, unless it is there. Raises OutputError."""
    if find_kind(path) == stat.S_IFREG:
        raise OutputError(f"{path}: a file is in the way of an output folder; name another place")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise make_output_error(path, error) from None


def check_apart(folder: Path, inputs: Iterable[Path]) -> None:
    """Raise OutputError for an output folder that would replace what goes into it."""
    target = os.path.realpath(folder)
    for path in inputs:
        if "\0" not in str(path) and Path(os.path.realpath(path)).is_relative_to(target):
            raise OutputError(
                f"{folder}: holds {path}, which is read, and would be replaced; name another place"
            )


def make_output_error(path: Path, error: OSError) -> OutputError:
    """Return the error to raise when an output path fails."""
    return OutputError(f"{path}: cannot be written ({error.strerror}); name another place")


def hidden_sibling(path: Path, ending: str) -> Path:
    """The hidden sibling of a place with an ending."""
    name = path.name
    if len(os.fsencode(name)) > MAX_NAME_BYTES:
        name = hashlib.sha256(os.fsencode(name)).hexdigest()[:32]
    return path.with_name(f".{name}.{ending}")


@contextmanager
def lock_file(path: Path) -> Iterator[int]:
    """Hold a lock file, made where it is missing; gives its handle.

    The lock goes with the process, so that a killed one leaves none behind.
    Raises BlockingIOError when another process holds it, OSError when it cannot be opened.
    """
    # neither through a link into a file of somebody else, nor waiting for the reader of a pipe
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
    handle = os.open(path, flags, 0o644)
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EEXIST, "no lock file, but a pipe or a device", path)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise OSError(error.errno, error.strerror, path) from None
        yield handle
    finally:
        os.close(handle)


@contextmanager
def lock_output(path: Path) -> Iterator[Path]:
    """Keep other processes from an output; gives its place, links followed.

    `replace_file` and `replace_folder` claim their place; work that takes long claims it before
    it begins, for a thread may claim again what it has. Folders above the place that are made here
    and stay empty go afterwards.
    Raises OutputError at once where another process writes, to the place, into it or around it, and
    where nobody can.
    """
    with ExitStack() as stack:
        try:
            path = path.resolve()
            places: set[Path] = _claims.__dict__.setdefault("places", set())
            if path not in places:
                for folder in [f for f in reversed(path.parents) if not f.exists()]:
                    folder.mkdir(exist_ok=True)
                    stack.callback(_remove_quietly, folder.rmdir)  # unless something is in it
                stack.enter_context(_lock_sibling(path))
                _check_around(path, places)
                places.add(path)
                stack.callback(places.remove, path)
        except OSError as error:
            raise make_output_error(path, error) from None
        yield path


@contextmanager
def _lock_sibling(path: Path) -> Iterator[None]:
    """Hold the lock file beside a place."""
    lock = hidden_sibling(path, LOCK)
    with ExitStack() as held:
        for last in (False, True):
            try:
                while not _is_open_at(held.enter_context(lock_file(lock)), lock):
                    held.close()  # its last holder removed it before we had it
                break
            except BlockingIOError:
                if last:
                    raise _make_taken_error(path) from None
                time.sleep(LOOK_S)
        held.callback(_remove_quietly, lock.unlink)  # while it is held: nobody else's
        yield


def _check_around(path: Path, own: set[Path]) -> None:
    """Refuse a place in a folder that another process replaces, or one that it writes into."""
    for other in list(path.parents)[:-1]:
        if other not in own and _is_held(hidden_sibling(other, LOCK)):
            raise _make_taken_error(other)
    known = {hidden_sibling(path_held, LOCK) for path_held in own}
    for lock in path.rglob(f".*.{LOCK}") if path.is_dir() else ():
        if lock not in known and _is_held(lock):
            raise _make_taken_error(lock.with_name(lock.name[1 : -len(LOCK) - 1]))


def _is_held(lock: Path) -> bool:
    """Whether another process holds a lock file; looking disturbs nobody who looks as well."""
    try:
        handle = os.open(lock, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    return False


def _make_taken_error(path: Path) -> OutputError:
    return OutputError(
        f"{path}: another optnav is writing this output; wait for it or name another place"
    )


def _is_open_at(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except FileNotFoundError:
        return False


def _remove_quietly(remove: Callable[[], None]) -> None:
    with suppress(OSError):
        remove()
