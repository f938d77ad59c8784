"""Reading the files that a user names: regular files alone, of a size that can be held.

A pipe or a device in the place of a file would be waited for without end.
"""

import errno
import os
import stat
from pathlib import Path

from catalog.errors import DataError, OptnavError

MEGABYTE = 1 << 20
MAX_TEXT_BYTES = 256 * MEGABYTE  # of a table or a label; a year of frames, one a second, is less
MAX_CONFIG_BYTES = 4 * MEGABYTE


def check_input(
    path: Path,
    what: str = "file",
    remedy: str = "check the path",
    error: type[OptnavError] = DataError,
) -> int:
    """The size of a regular file in bytes; nothing is opened.

    what, remedy  of the messages: "there is no such WHAT; REMEDY"
    Raises `error` for what is missing, a folder, a pipe, a device, a link that leads nowhere, and
    for a name that is no text.
    """
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError:
        raise error(
            f"{make_printable(path)}: the name is not UTF-8 text; rename the file or its folder"
        ) from None
    try:
        state = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        raise error(f"{path}: there is no such {what}; {remedy}") from None
    except ValueError:
        raise error(f"{make_printable(path)!r}: is not a name of a {what}; {remedy}") from None
    except OSError as failed:
        if failed.errno in (errno.ELOOP, errno.ENAMETOOLONG):
            remedy = f"name a {what} that is there"
        raise error(f"{path}: cannot be read ({failed.strerror}); {remedy}") from None
    if stat.S_ISDIR(state.st_mode):
        raise error(f"{path}: is a folder; name a {what}")
    if not stat.S_ISREG(state.st_mode):
        raise error(f"{path}: is a pipe or a device; name a {what} on a disk")
    return state.st_size


def read_input(
    path: Path,
    what: str = "file",
    remedy: str = "check the path",
    error: type[OptnavError] = DataError,
    limit: int = MAX_TEXT_BYTES,
) -> bytes:
    """The bytes of a file of at most `limit` bytes. Raises `error` as `check_input` does."""
    size = check_input(path, what, remedy, error)
    if size > limit:
        raise error(
            f"{path}: has {size / MEGABYTE:.0f} MiB; a {what} has at most "
            f"{limit // MEGABYTE}: is it another kind of file?"
        )
    try:
        return path.read_bytes()
    except OSError as failed:
        raise error(f"{path}: cannot be read ({failed.strerror}); check its permissions") from None


def make_printable(path: Path) -> str:
    """A path as text that every terminal and file takes."""
    return str(path).encode("utf-8", "backslashreplace").decode("utf-8")
