"""Where chunks of work run: in this process, in worker processes, or where an executor sends them.

Only the standard library is imported up here: a worker limits the threads of the numeric libraries
before it loads them.
"""

import gc
import hashlib
import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from queue import Empty, SimpleQueue
from types import FrameType
from typing import Any, Protocol, TypeVar

from catalog.cache import Cache
from catalog.errors import WorkersError

T = TypeVar("T")
R = TypeVar("R")

HELD = (signal.SIGINT, signal.SIGTERM)
# An interrupt that comes just before a wait begins is seen only when the wait is over.
NOTICE_S = 0.5
# Workers without work end within so long, and are looked at so often.
GOODBYE_S, LOOK_S = 20.0, 0.02
AHEAD = 2  # chunks a worker waits on or works at; more would only be lost by a kill
# A worker that dies takes unfinished chunks with it; they are tried again while work gets done.
DEATHS_WITHOUT_PROGRESS = 2
THREAD_LIMITS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def mask_signals() -> Iterator[None]:
    """Hold SIGINT and SIGTERM back until the block is left; for short blocks.

    Python raises KeyboardInterrupt between any two steps, also just after a library took a lock and
    before it could promise to release it. Whoever needs that lock then waits for ever.
    Does nothing outside the main thread, where no signal arrives, or for a signal whose handler
    is not a Python function.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with ExitStack() as stack:
        for number in HELD:
            stack.enter_context(_mask_signal(number))
        yield


@contextmanager
def _mask_signal(number: signal.Signals) -> Iterator[None]:
    handler = signal.getsignal(number)
    if not callable(handler):
        yield
        return
    came: list[FrameType | None] = []
    signal.signal(number, lambda _, frame: came.append(frame))
    try:
        yield
    finally:
        signal.signal(number, handler)
        if came:  # also when the block failed: who handles its error may go on with the work
            handler(number, came[0])


class Workers(Protocol):
    """Runs a function on chunks in any order."""

    @property
    def count(self) -> int:
        """Chunks that can be worked on at once."""

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
        for position, chunk in enumerate(chunks):
            yield position, function(context, chunk)

    def close(self) -> None:
        pass


class Pool(Protocol):
    """Where an ExecutorWorkers gets its executor from, and what it does when workers die.

    lost        what a future raises whose worker, not whose work, failed
    patience_s  seconds to wait for a result before a look
    call        call(packed context, function, chunk) in a worker
    """

    lost: tuple[type[Exception], ...]
    patience_s: float
    call: Callable[..., Any]

    @property
    def count(self) -> int:
        """Chunks that can be worked on at once; may change while work goes on."""

    def pack(self, context: Any) -> bytes:
        """The context as it travels with each chunk: kilobytes, for it holds paths and numbers."""

    def executor(self) -> Executor:
        """The executor, made when there is none."""

    def look(self) -> None:
        """See whether results can still come. Raises OptnavError, or one of `lost`, if not."""

    def handle_loss(self, loss: Exception, losses: int) -> None:
        """Go on after a loss, so many without a result between; raises OptnavError if not."""

    def stop_now(self) -> None:
        """End the executor at once: an interrupt or an error wants no chunk any more."""

    def close(self) -> None:
        """Let the workers go."""


class ExecutorWorkers:
    """Work sent to the concurrent.futures.Executor of a pool.

    The executor lives from the first run to `close`, so that workers load their libraries once.
    """

    def __init__(self, pool: Pool) -> None:
        self._pool = pool

    @property
    def count(self) -> int:
        return self._pool.count

    def run(
        self, function: Callable[[Any, T], R], context: Any, chunks: Sequence[T]
    ) -> Iterator[tuple[int, R]]:
        """Raise OptnavError when workers die again and again."""
        todo = list(range(len(chunks)))
        lost: Counter[int] = Counter()  # how often each piece took a worker with it
        packed = self._pool.pack(context)
        losses = 0
        while todo:
            try:
                for position, result in self._run_once(function, packed, chunks, todo, lost):
                    losses = 0
                    todo.remove(position)
                    yield position, result
            except self._pool.lost as loss:
                losses += 1
                # none is given up while a piece that was lost less often may yet go through
                least = min((lost[piece] for piece in todo if piece in lost), default=losses)
                self._pool.handle_loss(loss, min(losses, least))

    def _run_once(
        self,
        function: Callable[[Any, T], R],
        packed: bytes,
        chunks: Sequence[T],
        todo: list[int],
        lost: Counter[int],
    ) -> Iterator[tuple[int, R]]:
        pool = self._pool
        waiting = deque(todo)
        under_way: dict[Future[R], int] = {}
        # not concurrent.futures.wait: an interrupt in it can leave a future locked, and the thread
        # that wants to end it then keeps the whole process from ending
        ended: SimpleQueue[Future[R]] = SimpleQueue()
        finished = False
        try:
            executor = pool.executor()
            while True:
                while waiting and len(under_way) < AHEAD * pool.count:
                    # what took its worker with it goes alone, or it takes others' results with it
                    if under_way and waiting[0] in lost:
                        break
                    position = waiting.popleft()
                    with mask_signals():
                        future = executor.submit(pool.call, packed, function, chunks[position])
                        under_way[future] = position
                        future.add_done_callback(ended.put)
                if not under_way:
                    break
                done = _collect_ended(ended, pool.patience_s)
                pool.look()
                for future in filter(_has_failed, done):  # next time last: it may be what kills
                    position = under_way[future]
                    todo.append(todo.pop(todo.index(position)))
                    lost[position] += 1
                todo.sort(key=lost.__getitem__)
                # sorted: a death must not hide results that came with it
                for future in sorted(done, key=_has_failed):
                    yield under_way.pop(future), future.result()
            finished = True
        finally:
            if not finished:
                with mask_signals():
                    pool.stop_now()

    def close(self) -> None:
        self._pool.close()


def _collect_ended(ended: "SimpleQueue[Future[R]]", patience_s: float) -> "list[Future[R]]":
    """Wait for a first future to end and return all that have; none after `patience_s` seconds."""
    taken: list[Future[R]] = []
    try:
        taken.append(ended.get(timeout=patience_s))
        while True:
            taken.append(ended.get_nowait())
    except Empty:
        return taken


def _has_failed(future: "Future[Any]") -> bool:
    return future.cancelled() or future.exception() is not None


class LocalPool:
    """Worker processes on this machine; new ones are started after one died."""

    lost: tuple[type[Exception], ...] = (BrokenProcessPool,)
    patience_s: float = NOTICE_S

    def __init__(self, count: int) -> None:
        self.count = count
        self.call: Callable[..., Any] = run_in_worker
        self._executor: Executor | None = None
        self._others: set[int | None] = set()  # child processes that are not this one's workers

    def pack(self, context: Any) -> bytes:
        return pickle.dumps(context)

    def executor(self) -> Executor:
        if self._executor is None:
            self._others = {child.pid for child in multiprocessing.active_children()}
            # spawned, not forked: a fork copies locks and threads of the numeric libraries
            spawn = multiprocessing.get_context("spawn")
            self._executor = ProcessPoolExecutor(
                self.count, mp_context=spawn, initializer=start_worker
            )
        return self._executor

    def look(self) -> None:
        """Do nothing: futures tell of a dead process."""

    def handle_loss(self, loss: Exception, losses: int) -> None:
        if losses > DEATHS_WITHOUT_PROGRESS:
            raise WorkersError(
                f"worker processes died {losses} times without finishing a piece of work "
                "(out of memory?); what is done is kept: try again with fewer --workers"
            ) from None

    def stop_now(self) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=False, cancel_futures=True)
            self._executor = None
        for worker in self._workers():
            worker.terminate()

    def close(self) -> None:
        if self._executor is None:
            return
        workers = self._workers()
        self._executor.shutdown(wait=False)
        self._executor = None
        until = time.monotonic() + GOODBYE_S
        while any(worker.is_alive() for worker in workers):
            # one that was killed as it took the goodbye keeps the others from theirs
            if time.monotonic() > until:
                for worker in workers:
                    worker.kill()
            time.sleep(LOOK_S)

    def _workers(self) -> list[multiprocessing.process.BaseProcess]:
        return [c for c in multiprocessing.active_children() if c.pid not in self._others]


def make_workers(count: int | None) -> Workers:
    """One process for 1; so many worker processes otherwise; None means one for each core."""
    wanted = count if count is not None else count_cores()
    return SerialWorkers() if wanted <= 1 else ExecutorWorkers(LocalPool(wanted))


def count_cores() -> int:
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
    # looking for circles of objects, of which the stages make none, took a tenth of their time
    gc.set_threshold(100_000, 20, 100)
    parent = multiprocessing.parent_process()
    if parent is not None:
        sentinel = parent.sentinel

        def follow() -> None:
            multiprocessing.connection.wait([sentinel])
            os._exit(1)

        # a killed parent cannot say goodbye, and its workers would wait for work for ever
        threading.Thread(target=follow, daemon=True).start()


_contexts: Cache[bytes, Any] = Cache(1)


def run_in_worker(blob: bytes, function: Callable[[Any, T], R], chunk: T) -> R:
    """Run a chunk with a pickled context, which is kept, with its open files, for the next."""
    context = _contexts.get(hashlib.sha256(blob).digest(), lambda: pickle.loads(blob))
    return function(context, chunk)
