"""How long a call takes, for all benches, and the table of what they found.

`make bench` sets OPTNAV_BENCH=full: full sizes, best of several repeats, and the limits are judged.
Otherwise, so in the usual run of the tests, each bench runs through once at a small size and no
speed is judged, so that a bench that no longer runs is noticed.

`make bench STORE=yes` keeps what it found in figures/bench.json, of which the README's table is
made; a part of the benches (`-k`) replaces its own rows.
"""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numba
import numpy as np

from tests.studies.tables import (
    Cell,
    StudyReport,
    StudyTable,
    checkout_commit,
    columns,
)

FULL = os.environ.get("OPTNAV_BENCH") == "full"
T = TypeVar("T")
STORED = Path(__file__).parent / "figures" / "bench.json"
COLUMNS = columns("what; measured = measured, one core; against; commit")
FOUND: dict[str, tuple[str, str]] = {}


def sized(full: T, small: T) -> T:
    """The first under `make bench`, the second in the usual run of the tests."""
    return full if FULL else small


def within(measured: float, limit: float) -> bool:
    """Whether a measured time or size keeps its limit; True where limits are not judged."""
    return not FULL or measured <= limit


def best(
    call: Callable[[], object], repeats: int, clock: Callable[[], float] = time.process_time
) -> float:
    """Shortest time (s) of a call, after one that compiles and fills caches.

    clock  of the processor, so that other work on the machine does not count; time.perf_counter
           for what runs in processes or threads of its own
    """
    if FULL:
        call()
    times = []
    for _ in range(sized(repeats, 1)):
        start = clock()
        call()
        times.append(clock() - start)
    return min(times)


def result(what: str, measured: str, against: str = "") -> None:
    """Print what a bench found, and keep it for the table: of one name, with what it is held to."""
    FOUND[what] = measured, against
    print(f"\n  {what}: {measured}{'; ' if against else ''}{against}", end="", flush=True)


def store(whole: bool) -> None:
    """Write what was found into the stored table: instead of it, or of its rows of these names."""
    commit = checkout_commit() or ""
    rows: dict[Cell, tuple[Cell, ...]] = {}
    notes: tuple[str, ...] = ()
    if not whole and STORED.exists():
        before = StudyReport.from_json(STORED.read_text(encoding="utf-8"))
        rows = {row[0]: row for row in before.tables[0].rows}
        notes = before.notes
    rows |= {what: (what, *found, commit) for what, found in FOUND.items()}
    table = StudyTable("Speed, one core", COLUMNS, tuple(rows.values()))
    StudyReport((table,), notes).signed("bench", {}).write(STORED)


class Spread(NamedTuple):
    """What several runs gave."""

    median: float
    least: float
    most: float
    runs: int

    def __str__(self) -> str:
        return f"{self.median:.2f} ({self.least:.2f} to {self.most:.2f}, {self.runs} runs)"


def spread(values: Sequence[float]) -> Spread:
    """Median, least and most of some runs."""
    return Spread(float(np.median(values)), min(values), max(values), len(values))


def in_turn(
    calls: Mapping[str, Callable[[], object]],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Times (s) of calls that take turns, so that each meets the same machine.

    clock  of the wall, as programs that are started need it; or of the processor, as in `best`
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(sized(rounds + 1, 1)):
        for name, call in calls.items():
            start = clock()
            call()
            if number or not FULL:  # the first compiles and fills caches
                times[name].append(clock() - start)
    return times


@contextmanager
def one_core() -> Iterator[None]:
    """OpenCV and the compiled kernels on one thread each; as they were afterwards."""
    threads = cv2.getNumThreads(), numba.get_num_threads()
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads[0])
        numba.set_num_threads(threads[1])
