"""What a build used and what came of it: by stage, for people, benchmarks and `account.json`.

Memory is the high-water mark that the system keeps of a process's life. It is not reset for each
stage, though Linux can do that: whoever watches the process from outside would see the reset
mark. So a stage's own peak is known where it raised the mark, else it is at most the mark.

Bytes are those of a process's read and write calls, from the page cache and through pipes between
processes too; mapped files are not among them. Systems other than Linux do not tell.
"""

import os
import resource
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec

from catalog.control_point import Flag

R = TypeVar("R")

FILE = "account.json"
MAXRSS_UNIT = 1 if sys.platform == "darwin" else 1024  # getrusage(2) of each system


class Peak(msgspec.Struct, frozen=True):
    """Greatest memory of a process, bytes; not `is_own`: a bound, reached before the work."""

    bytes: int
    is_own: bool = msgspec.field(name="own")


class Usage(msgspec.Struct, frozen=True):
    """Resources that a process used for a piece of work; bytes are None where not counted."""

    process: str
    cpu_s: float
    peak: Peak
    read_bytes: int | None
    written_bytes: int | None


class StageAccount(msgspec.Struct):
    """Work and resources of one stage.

    done, kept        pieces of work done now, and found done by earlier runs
    seconds           by the clock
    cpu_s             processor time of all processes; workers_cpu_s: of it, the workers' share
    peak              memory of the coordinating process; worker_peak: of the greatest worker
    read_bytes, written_bytes  of all processes
    """

    name: str
    done: int = 0
    kept: int = 0
    seconds: float = 0.0
    cpu_s: float = 0.0
    workers_cpu_s: float = 0.0
    peak: Peak = Peak(0, True)
    worker_peak: Peak | None = None
    read_bytes: int | None = 0
    written_bytes: int | None = 0

    def add(self, usage: Usage) -> None:
        """Count a worker's piece of work; one of this process is counted with the stage itself."""
        if usage.process == _process():
            return
        self.workers_cpu_s += usage.cpu_s
        self.worker_peak = _select_greater(self.worker_peak, usage.peak)
        self._add_all(usage)

    @contextmanager
    def measure_block(self) -> Iterator[None]:
        """Count what this process uses meanwhile, and the time."""
        before, started = _read_state(), time.monotonic()
        yield
        usage = _subtract_states(before, _read_state())
        self.seconds += time.monotonic() - started
        self.peak = usage.peak
        self._add_all(usage)

    def _add_all(self, usage: "Usage | StageAccount") -> None:
        self.cpu_s += usage.cpu_s
        self.read_bytes = _sum(self.read_bytes, usage.read_bytes)
        self.written_bytes = _sum(self.written_bytes, usage.written_bytes)


class Account(msgspec.Struct):
    """Result and resources of a run.

    cells           that have ground
    points, usable  of the checked points; None as long as they are not checked
    reasons         points that are not usable, by reason; a point can have several
    stages          those of this run; what earlier runs used is not known any more
    """

    software: str
    workers: int
    cells: int = 0
    points: int | None = None
    usable: int | None = None
    reasons: dict[str, int] = {}
    stages: list[StageAccount] = []

    def judge(self, points: Iterable[tuple[bool, Flag]]) -> None:
        """Count points (usable, flags) and what keeps them from use, the most frequent first."""
        judged = list(points)
        bad = [flags for good, flags in judged if not good]
        reasons = Counter(flag.label for flags in bad for flag in flags)
        self.points, self.usable = len(judged), len(judged) - len(bad)
        self.reasons = dict(reasons.most_common())

    def total(self) -> StageAccount:
        """All stages together; pieces of different stages are not added up."""
        summed = StageAccount("total")
        for stage in self.stages:
            summed.seconds += stage.seconds
            summed.workers_cpu_s += stage.workers_cpu_s
            summed.peak = _select_greater(summed.peak, stage.peak)
            if stage.worker_peak is not None:
                summed.worker_peak = _select_greater(summed.worker_peak, stage.worker_peak)
            summed._add_all(stage)
        return summed


def _sum(a: int | None, b: int | None, sign: int = 1) -> int | None:
    return None if a is None or b is None else a + sign * b


def _select_greater(a: Peak | None, b: Peak) -> Peak:
    # of equal marks the one that is known to be the work's own
    return b if a is None or (b.bytes, b.is_own) > (a.bytes, a.is_own) else a


class _State(NamedTuple):
    """Resources that this process has used since it began."""

    cpu_s: float
    mark_bytes: int
    read_bytes: int | None
    written_bytes: int | None


def _read_state() -> _State:
    return _State(time.process_time(), _read_memory_mark(), *_read_byte_counts())


def _read_memory_mark() -> int:
    """Greatest memory in this process's life, bytes."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return 1024 * int(status.partition("VmHWM:")[2].split(maxsplit=1)[0])
    except (OSError, ValueError, IndexError):
        # only here: on Linux a new process begins with its parent's mark
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * MAXRSS_UNIT


def _read_byte_counts() -> tuple[int | None, int | None]:
    """Bytes that this process read and wrote, as Linux counts them."""
    try:
        lines = Path("/proc/self/io").read_text(encoding="ascii").splitlines()
        counts = dict(line.split(": ") for line in lines)
        return int(counts["rchar"]), int(counts["wchar"])
    except (OSError, ValueError, KeyError):
        return None, None


def _subtract_states(before: _State, after: _State) -> Usage:
    return Usage(
        process=_process(),
        cpu_s=after.cpu_s - before.cpu_s,
        peak=Peak(after.mark_bytes, after.mark_bytes > before.mark_bytes),
        read_bytes=_sum(after.read_bytes, before.read_bytes, -1),
        written_bytes=_sum(after.written_bytes, before.written_bytes, -1),
    )


def _process() -> str:
    """Name of this process among those of all machines of a cluster."""
    return f"{socket.gethostname()}:{os.getpid()}"


class _Meter:
    """Shares out what this process uses among the threads that work at the same time.

    Each reports what was used since the last report, so that their sum is right.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._under_way = 0
        self._reported = _State(0.0, 0, None, None)

    def start(self) -> None:
        with self._lock:
            if self._under_way == 0:
                self._reported = _read_state()
            self._under_way += 1

    def stop(self) -> Usage:
        with self._lock:
            self._under_way -= 1
            before, self._reported = self._reported, _read_state()
            return _subtract_states(before, self._reported)


_meter = _Meter()


def measure_usage(work: Callable[[], R]) -> tuple[R, Usage]:
    """Do work and tell what it used; a process counts as a whole."""
    _meter.start()
    try:
        result = work()
    finally:
        usage = _meter.stop()
    return result, usage
