"""How long a call takes, for all benches."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import cv2
import numba


def best(call: Callable[[], object], repeats: int) -> float:
    """Shortest time (s) of a call, after one that compiles and fills caches."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
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
