"""Streams that nobody may read: closed, full, or left by their reader.

What cannot be written is dropped, and the first failure kept. So neither the work nor its files nor
its verdict depend on who reads what is said beside them.
"""

import codecs
import errno
import io
import os
import sys
from pathlib import Path
from typing import TextIO

from catalog.errors import OutputError

LEFT = (errno.EPIPE, errno.EIO)  # the reader went, or the terminal was hung up
LOG_BEGINNING = b'{"time": '


class PatientStream(io.TextIOWrapper):
    """Text to a descriptor, a line at a time; from the first failure on it goes nowhere."""

    def __init__(
        self, handle: int, encoding: str = "utf-8", errors: str = "backslashreplace"
    ) -> None:
        self.failure: OSError | None = None
        os.set_blocking(handle, True)  # who shares it may have changed that
        raw = io.FileIO(handle, "w", closefd=handle > 2)
        super().__init__(
            io.BufferedWriter(raw), encoding, errors, newline="\n", line_buffering=True
        )

    def write(self, text: str, /) -> int:
        """Write, or only say so."""
        try:
            super().write(text)
        except OSError as error:
            self._drop(error)
        return len(text)

    def flush(self) -> None:
        """Hand on what is held, or let it go."""
        try:
            super().flush()
        except OSError as error:
            self._drop(error)

    def _drop(self, error: OSError) -> None:
        self.failure = self.failure or error
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())  # what is held yet goes there, too
        os.close(nowhere)


def _as_printed(error: UnicodeError) -> tuple[str | bytes, int]:
    """What an encoding lacks: names of files that are no text as their bytes, all else escaped."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)


def make_patient() -> None:
    """Make stdout and stderr of this process patient; what is closed goes nowhere."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
    codecs.register_error("optnav", _as_printed)
    for number, name in ((1, "stdout"), (2, "stderr")):
        old: TextIO | None = getattr(sys, name)
        encoding = "utf-8" if old is None else old.encoding
        setattr(sys, name, PatientStream(number, encoding, "optnav"))


def undelivered() -> OSError | None:
    """Why stdout did not take all; None where it did, or its reader had seen enough."""
    sys.stdout.flush()
    failure = sys.stdout.failure if isinstance(sys.stdout, PatientStream) else None
    return None if failure is None or failure.errno in LEFT else failure


def open_log(path: Path) -> PatientStream:
    """Open a log to add to; it may be a terminal, or a pipe that is read.

    Raises OutputError for a place that cannot be written, and for a file that is no log of ours.
    """
    try:
        foreign = path.is_block_device() or path.is_socket()
        if path.is_file():
            with path.open("rb") as file:
                foreign = not LOG_BEGINNING.startswith(file.read(len(LOG_BEGINNING)))
        if foreign:
            raise OutputError(f"{path}: is there and no log of optnav; name another --log-file")
        # without waiting for the reader of a pipe
        handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK, 0o666)
    except OSError as error:
        reason = "nobody reads this pipe" if error.errno == errno.ENXIO else error.strerror
        raise OutputError(
            f"{path}: cannot write the log: {reason}; name another --log-file"
        ) from None
    return PatientStream(handle)
