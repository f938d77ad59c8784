"""What a person sees of a run, on stderr, and what a log file keeps of it.

Results go to stdout; messages, warnings and progress go to stderr. On a terminal a stage is a bar,
otherwise it is a plain line now and then. The log file has one JSON object a line.

Streams may be closed, full, or left by their reader. What cannot be written is dropped, and the
first failure kept, so neither the work nor its files nor its verdict depend on who reads what is
said beside them.
"""

import codecs
import errno
import io
import json
import logging
import os
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

from catalog.errors import OutputError
from catalog.progress import Stage
from optnav_cli.output.wording import format_duration, format_plural, format_speed

LEFT = (errno.EPIPE, errno.EIO)  # the reader went, or the terminal was hung up
LOG_BEGINNING = b'{"time": '


class BestEffortStream(io.TextIOWrapper):
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


def _replace_unencodable(error: UnicodeError) -> tuple[str | bytes, int]:
    """Replace what an encoding lacks: undecodable names by their bytes, all else by escapes."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)


def install_safe_streams() -> None:
    """Make stdout and stderr of this process patient; what is closed goes nowhere."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free: this one
    codecs.register_error("optnav", _replace_unencodable)
    for number, name in ((1, "stdout"), (2, "stderr")):
        old: TextIO | None = getattr(sys, name)
        encoding = "utf-8" if old is None else old.encoding
        setattr(sys, name, BestEffortStream(number, encoding, "optnav"))


def find_output_failure() -> OSError | None:
    """Why stdout did not take all; None where it did, or its reader had seen enough."""
    sys.stdout.flush()
    failure = sys.stdout.failure if isinstance(sys.stdout, BestEffortStream) else None
    return None if failure is None or failure.errno in LEFT else failure


def open_log(path: Path) -> BestEffortStream:
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
    return BestEffortStream(handle)


if TYPE_CHECKING:
    from tqdm import tqdm

PACKAGES = ("catalog", "optnav_cli")
LINE_LETTERS = 2000  # at most, in a message for people
LINE_S = 60.0  # between plain progress lines
# Of an event for a frame or, without `frame`, for a stage; optnav_cli/README.md describes them.
EVENT_FIELDS = ("stage", "frame", "status", "method", "reason_code", "seconds")

_log = logging.getLogger(__name__)


class JsonLines(logging.Formatter):
    """One JSON object a record: time (UTC), level, logger, message; if any, event and traceback."""

    def format(self, record: logging.LogRecord) -> str:
        entry: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        entry |= {name: vars(record)[name] for name in EVENT_FIELDS if name in vars(record)}
        if record.exc_info:
            entry["traceback"] = self.formatException(record.exc_info)
        return json.dumps(entry, ensure_ascii=False)


def _limit_lines(message: str) -> str:
    """A message without the middle of lines that are very long: a name may have 5000 letters."""
    half = LINE_LETTERS // 2
    return "\n".join(
        line if len(line) <= LINE_LETTERS else f"{line[:half]} [...] {line[-half:]}"
        for line in message.split("\n")
    )


class PeopleHandler(logging.Handler):
    """Writes messages to stderr, above a bar if one is being shown."""

    def emit(self, record: logging.LogRecord) -> None:
        kind = "warning: " if record.levelno == logging.WARNING else ""
        line = f"optnav: {kind}{_limit_lines(record.getMessage())}"
        shown = sys.modules.get("tqdm")  # no bar without its module
        if shown is not None:
            shown.tqdm.write(line, file=sys.stderr)
        else:
            print(line, file=sys.stderr)  # noqa: T201 -- this is the place that prints


class LogFile(logging.StreamHandler[TextIO]):
    """Writes JSON lines to a file; when that fails, a warning says so once and the work goes on."""

    def __init__(self, path: Path) -> None:
        self.path, self.warned = path, False
        self.file = open_log(path)
        super().__init__(self.file)
        self.setFormatter(JsonLines())

    def emit(self, record: logging.LogRecord) -> None:
        super().emit(record)
        if self.file.failure is not None and not self.warned:
            self.warned = True
            reason = self.file.failure.strerror
            _log.warning("%s: cannot write the log: %s; going on without it", self.path, reason)

    def close(self) -> None:
        self.file.close()
        super().close()


def set_up_logging(*, quiet: bool, verbose: bool, log_file: Path | None) -> None:
    """Send the packages' messages to stderr and, if named, to a file of JSON lines.

    quiet shows warnings and errors only, verbose shows details. The file always has the details.
    Raises OutputError when the file cannot be written.
    """
    root = logging.getLogger()
    for old in root.handlers[:]:
        if isinstance(old, PeopleHandler | LogFile):
            root.removeHandler(old)
            old.close()
    people = PeopleHandler()
    people.setLevel(logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO)
    root.addHandler(people)
    if log_file is not None:
        root.addHandler(LogFile(log_file))
    for package in PACKAGES:  # of libraries below us warnings alone
        logging.getLogger(package).setLevel(logging.DEBUG)
    logging.captureWarnings(True)


def is_set_up() -> bool:
    """Whether messages reach people through the log."""
    return any(isinstance(handler, PeopleHandler) for handler in logging.getLogger().handlers)


class _LineStage:
    """A stage whose progress is logged as plain lines now and then."""

    def __init__(self, name: str, total: int, unit: str) -> None:
        self.name, self.total, self.unit = name, total, unit
        self.done = self.kept = 0
        self.started = self._logged = time.monotonic()
        self._logged_done = 0

    def keep(self, n: int) -> None:
        self.kept += n

    def advance(self, n: int = 1, note: str = "") -> None:
        self.done += n
        now = time.monotonic()
        there = self.kept + self.done
        if now - self._logged < LINE_S or there >= self.total:
            return
        rate = (self.done - self._logged_done) / (now - self._logged)
        left = f", {format_duration((self.total - there) / rate)} left" if rate > 0 else ""
        share = 100 * there // max(self.total, 1)
        done = f"{there} of {self.total} {format_plural(self.unit, self.total)} ({share} %)"
        note = f"; {note}" if note else ""
        _log.info("%s: %s, %s%s%s", self.name, done, format_speed(rate, self.unit), left, note)
        self._logged, self._logged_done = now, self.done

    def close(self) -> None:
        took = time.monotonic() - self.started
        rate = (
            f" ({format_speed(self.done / took, self.unit)})" if took >= 1.0 and self.done else ""
        )
        kept = f"; {self.kept} done before" if self.kept else ""
        done = f"{self.done} {format_plural(self.unit, self.done)} in {format_duration(took)}"
        _log.info("%s: %s%s%s", self.name, done, rate, kept)


class _BarStage(_LineStage):
    """A stage shown as a bar on a terminal; its last line stays in the log."""

    def __init__(self, name: str, total: int, unit: str, bar: "tqdm[Any]") -> None:
        super().__init__(name, total, unit)
        self.bar = bar

    def keep(self, n: int) -> None:
        super().keep(n)
        # the bar's own speed is of what was done since its beginning
        self.bar.initial += n
        self.bar.n += n
        self.bar.last_print_n += n
        self.bar.refresh()

    def advance(self, n: int = 1, note: str = "") -> None:
        self.done += n
        if note:
            self.bar.set_postfix_str(note, refresh=False)
        self.bar.update(n)

    def close(self) -> None:
        self.bar.close()
        super().close()


class ConsoleProgress:
    """Shows stages to people: a bar where `stream` is a terminal, plain lines elsewhere."""

    def __init__(self, stream: TextIO | None = None, *, quiet: bool = False) -> None:
        self.stream = stream if stream is not None else sys.stderr
        self.quiet = quiet

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[Stage]:
        """Open a stage; a failed or interrupted one leaves no last line."""
        if self.stream.isatty() and not self.quiet:
            from tqdm import tqdm

            bar = tqdm(
                total=total, desc=name, unit=unit, file=self.stream, leave=False, dynamic_ncols=True
            )
            stage: _LineStage = _BarStage(name, total, unit, bar)
        else:
            bar = None
            stage = _LineStage(name, total, unit)
            if total > 0:
                _log.info("%s: %d %s", name, total, format_plural(unit, total))
        try:
            yield stage
        except BaseException:
            if bar is not None:
                bar.close()
            raise
        stage.close()


def report_lines(lines: Iterable[str]) -> None:
    """Print lines, such as a table, for people and for the log file."""
    for line in lines:
        _log.info("%s", line)


# Hands a command the group's progress; a command that is run alone, as in a test, makes its own.
pass_progress = click.make_pass_decorator(ConsoleProgress, ensure=True)


def report_compilation() -> None:
    """Log once, before or when it happens, that numba compiles its kernels in this run.

    Later runs find them in numba's cache and start at once.
    """
    if not has_cached_kernels():
        _log_compilation()
        return
    numba_event: Any = import_module("numba.core.event")
    numba_event.Listener.register(_CompilationListener)
    numba_event.register("numba:compile", _CompilationListener())


class _CompilationListener:
    """Listener of numba's compilations, that is of kernels missing in its cache."""

    def notify(self, event: Any) -> None:
        if event.is_start:
            _log_compilation()


def has_cached_kernels() -> bool:
    """Whether numba's cache has an index of any kernel of the catalog, a look of a millisecond."""
    from importlib.resources import files

    override = os.environ.get("NUMBA_CACHE_DIR")
    base = Path(override) if override else Path(str(files("catalog")))
    if not os.access(base, os.W_OK):
        return True  # numba then caches elsewhere, if at all; its event says if it compiles
    return next(base.rglob("*.nbi"), None) is not None


@cache
def _log_compilation() -> None:
    """Log, the first time that it is called, that kernels are compiled."""
    _log.info("compiling numerical kernels, once on this machine; later runs start at once")
