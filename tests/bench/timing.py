"""How long a call takes, for all benches.

`make bench` sets OPTNAV_BENCH=full: full sizes, best of several repeats, and the limits are judged.
Otherwise, so in the usual run of the tests, each bench runs through once at a small size and no
speed is judged, so that a bench that no longer runs is noticed.
"""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import cv2
import numba

FULL = os.environ.get("OPTNAV_BENCH") == "full"
T = TypeVar("T")


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
