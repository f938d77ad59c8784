"""Where chunks of work run: in this process, in worker processes, or where an executor sends them.

Only the standard library is imported up here: a worker limits the threads of the numeric libraries
before it loads them.
"""

import hashlib
import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol, TypeVar

from catalog.errors import OptnavError

T = TypeVar("T")
R = TypeVar("R")

AHEAD = 2  # chunks a worker waits on or works at; more would only be lost by a kill
# A worker that dies takes unfinished chunks with it; they are tried again while work gets done.
DEATHS_WITHOUT_PROGRESS = 2
THREAD_LIMITS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Workers(Protocol):
    """Runs a function on chunks in any order."""

    count: int

    def run(
        self, function: Callable[[Any, T], R], context: Any, chunks: Sequence[T]
    ) -> Iterator[tuple[int, R]]:
        """Yield (position in chunks, function(context, chunk)) as results come."""

    def close(self) -> None:
        """Let the workers go."""


class SerialWorkers:
    """All work in this process, in order."""

    count = 1

    def run(
        self, function: Callable[[Any, T], R], context: Any, chunks: Sequence[T]
    ) -> Iterator[tuple[int, R]]:
        """See Workers."""
        for position, chunk in enumerate(chunks):
            yield position, function(context, chunk)

    def close(self) -> None:
        """See Workers."""


class ExecutorWorkers:
    """Work sent to a concurrent.futures.Executor; `make` gives a new one after a worker died.

    The executor lives from the first run to `close`, so that workers load their libraries once.
    """

    def __init__(self, make: Callable[[], Executor], count: int) -> None:
        self.count = count
        self._make = make
        self._executor: Executor | None = None
        self._others: set[int | None] = set()  # child processes that are not this one's workers

    def run(
        self, function: Callable[[Any, T], R], context: Any, chunks: Sequence[T]
    ) -> Iterator[tuple[int, R]]:
        """See Workers. Raises OptnavError when workers die again and again."""
        todo = list(range(len(chunks)))
        blob = pickle.dumps(context)
        deaths = 0
        while todo:
            try:
                for position, result in self._once(function, blob, chunks, todo):
                    deaths = 0
                    todo.remove(position)
                    yield position, result
            except BrokenProcessPool:
                deaths += 1
                if deaths > DEATHS_WITHOUT_PROGRESS:
                    raise OptnavError(
                        f"worker processes died {deaths} times without finishing a piece of work "
                        "(out of memory?); what is done is kept: try again with fewer --workers"
                    ) from None

    def _once(
        self, function: Callable[[Any, T], R], blob: bytes, chunks: Sequence[T], todo: list[int]
    ) -> Iterator[tuple[int, R]]:
        if self._executor is None:
            self._others = {child.pid for child in multiprocessing.active_children()}
            self._executor = self._make()
        waiting = iter(list(todo))
        under_way: dict[Future[R], int] = {}
        finished = False
        try:
            while True:
                while len(under_way) < AHEAD * self.count:
                    position = next(waiting, None)
                    if position is None:
                        break
                    future = self._executor.submit(call_in_worker, blob, function, chunks[position])
                    under_way[future] = position
                if not under_way:
                    break
                done, _ = wait(under_way, return_when=FIRST_COMPLETED)
                # sorted: a death must not hide results that came with it
                for future in sorted(done, key=lambda f: f.exception() is not None):
                    yield under_way.pop(future), future.result()
            finished = True
        finally:
            if not finished:
                self._abandon()

    def _abandon(self) -> None:
        """End the workers at once: an interrupt or an error wants no chunk any more."""
        if self._executor is not None:
            self._executor.shutdown(wait=False, cancel_futures=True)
            self._executor = None
        for child in multiprocessing.active_children():
            if child.pid not in self._others:
                child.terminate()

    def close(self) -> None:
        """See Workers."""
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None


def workers_of(count: int | None) -> Workers:
    """One process for 1; so many worker processes otherwise; None means one for each core."""
    wanted = count if count is not None else available_cores()
    if wanted <= 1:
        return SerialWorkers()

    def make() -> Executor:
        # spawned, not forked: a fork copies locks and threads of the numeric libraries
        return ProcessPoolExecutor(
            wanted, mp_context=multiprocessing.get_context("spawn"), initializer=start_worker
        )

    return ExecutorWorkers(make, wanted)


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def start_worker() -> None:
    """Make this process a worker: one thread, and no life without its parent."""
    # an interrupt from the terminal reaches the parent, which ends its workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for name in THREAD_LIMITS:
        os.environ[name] = "1"
    import cv2

    cv2.setNumThreads(1)
    parent = multiprocessing.parent_process()
    if parent is not None:
        sentinel = parent.sentinel

        def follow() -> None:
            multiprocessing.connection.wait([sentinel])
            os._exit(1)

        # a killed parent cannot say goodbye, and its workers would wait for work for ever
        threading.Thread(target=follow, daemon=True).start()


_context: tuple[bytes, Any] = (b"", None)


def call_in_worker(blob: bytes, function: Callable[[Any, T], R], chunk: T) -> R:
    """Run a chunk with a pickled context, which is kept, with its open files, for the next."""
    global _context
    digest = hashlib.sha256(blob).digest()
    if _context[0] != digest:
        _context = (digest, pickle.loads(blob))
    return function(_context[1], chunk)
