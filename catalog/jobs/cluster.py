"""Workers of an existing dask.distributed cluster, through their concurrent.futures.Executor.

The build itself, its workspace and its results stay on this machine: workers read terrain models
and overviews by their paths and send records back.
"""

import asyncio
import hashlib
import logging
import pickle
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError, Executor
from pathlib import Path
from typing import Any, Protocol, runtime_checkable
from urllib.parse import urlsplit

from catalog.cache import Cache
from catalog.errors import UsageError, WorkersError
from catalog.jobs.workers import ExecutorWorkers, Workers, run_in_worker
from catalog.jobs.workspace import hash_package, list_versions

# Of a file that is compared: enough to tell another terrain model or another overview of the same
# size, without reading all of it on every worker. Dates are not compared: copies have others.
SAMPLES = 64
SAMPLE_BYTES = 4096

Needs = dict[str, Any]  # builtin types alone, for the eyes of other versions
log = logging.getLogger(__name__)

ANSWER_S = 5.0  # for a scheduler to answer
ARRIVE_S = 10.0  # for a first worker to be there at the start
RETURN_S = 60.0  # for a worker to come back when all have gone: a nanny starts new ones in seconds
LOOK_S = 2.0  # between two looks at the cluster
# A piece of work is given up by the scheduler after some workers died over it (4 by default). It is
# tried once more, last, for they may have died of something else.
LOSSES_WITHOUT_PROGRESS = 1
KEPT = "what is done is kept: give the same command again"
# What these would say on stderr is said in a message of our own.
NOISY = ("distributed", "tornado", "asyncio")


def collect_needs(files: Iterable[Path]) -> Needs:
    """List what a worker must have: this code, these libraries, and files with the same content."""
    return {
        "code": hash_package(),
        "surroundings": list_versions(),
        "files": {str(path): _sample_file(path) for path in files},
    }


@runtime_checkable
class HasFiles(Protocol):
    """A context whose chunks are worked from files.

    Such a context may name further packages whose code the work needs, as `packages`.
    """

    def files(self) -> list[Path]:
        """These files."""


def list_files(context: Any) -> list[Path]:
    """The files that the chunks of a context are worked from."""
    return context.files() if isinstance(context, HasFiles) else []


def hash_packages(context: Any) -> dict[str, str]:
    """Packages besides this one whose code the chunks of a context need, with its hash."""
    return {name: hash_package(name) for name in getattr(context, "packages", ())}


def find_misfit(needs: Needs) -> str | None:
    """Why this process cannot do the work of one with these needs; None when it can."""
    for (name, present), (_, wanted) in zip(list_versions(), needs["surroundings"], strict=True):
        if present != wanted:
            return (
                f"has {name} {present}, the build {wanted}: results could differ; "
                "install the same versions (requirements.lock) on all machines"
            )
    code = {"catalog": needs["code"], **needs.get("packages", {})}
    if any(key != hash_package(name) for name, key in code.items()):
        return (
            "runs other code of optnav than the build; "
            "install the same version there and start the worker again"
        )
    for name, wanted in needs["files"].items():
        try:
            here = _sample_file(Path(name))
        except OSError as error:
            return (
                f"{name}: cannot be read there ({error.strerror or error}); terrain models and the "
                "work folder must have the same path on all machines (a shared folder, or copies)"
            )
        if here != wanted:
            return (
                f"{name}: is another file there ({here[0]} bytes; the build's has {wanted[0]} "
                "bytes" + (" of other content" if here[0] == wanted[0] else "") + "); "
                "give all machines the same file"
            )
    return None


def _sample_file(path: Path) -> tuple[int, str]:
    """Size and a hash of samples spread over a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        size = path.stat().st_size
        last = max(size - SAMPLE_BYTES, 0)
        for at in sorted({last * i // (SAMPLES - 1) for i in range(SAMPLES)}):
            file.seek(at)
            digest.update(file.read(SAMPLE_BYTES))
    return size, digest.hexdigest()


_turn = threading.Lock()
_met: Cache[bytes, None] = Cache(1)  # the last needs that were met, by their hash


def run_on_node(packed: bytes, function: Callable[[Any, Any], Any], chunk: Any) -> Any:
    """Run a chunk on a worker that is fit for it; one at a time in a process.

    A context's open files and caches are not safe across threads, and its memory is bounded for
    one chunk at a time.
    """
    with _turn:
        needs, blob = pickle.loads(packed)
        # a worker that came while the build went on was not asked at its start
        _met.get(hashlib.sha256(repr(needs).encode()).digest(), lambda: _require(needs))
        import cv2
        import numba

        # cores are the workers' to share out
        cv2.setNumThreads(1)
        numba.set_num_threads(1)  # of this thread
        return run_in_worker(blob, function, chunk)


def _require(needs: Needs) -> None:
    """Raise WorkersError unless this worker meets the needs."""
    reason = find_misfit(needs)
    if reason is not None:
        from distributed import get_worker

        raise WorkersError(f"worker {get_worker().address}: {reason}")


class _SchedulerLostError(Exception):
    """The scheduler does not answer any more."""


def start_cluster_workers(address: str, files: Sequence[Path] = ()) -> Workers:
    """The workers of the scheduler at an address, all of which must be able to read some files.

    address  tcp://HOST:PORT
    files    absolute paths that the workers will read, as far as they are known and there already
    Raises UsageError for an address that is none or without the package `distributed`, and
    WorkersError for a scheduler that does not answer, has no workers, or has one that would not
    do the work as this process does.
    """
    check_address(address)
    pool = ClusterPool(address)
    try:
        pool.require_fit(collect_needs(path for path in files if path.is_file()))
    except BaseException:
        pool.close()
        raise
    return ExecutorWorkers(pool)


def check_address(address: str) -> None:
    """Raise UsageError unless this is tcp://HOST:PORT."""
    try:
        parts = urlsplit(address)
        good = parts.scheme == "tcp" and bool(parts.hostname) and bool(parts.port)
        good = good and address.lower() == f"tcp://{parts.netloc}".lower() and "@" not in address
    except ValueError:  # a port that is no number, or half an IPv6 address
        good = False
    if not good:
        raise UsageError(
            f"--scheduler {address!r}: wanted tcp://HOST:PORT, such as tcp://host:8786"
        )


def load_distributed() -> Any:
    """The package `distributed`. Raises UsageError where it is not installed."""
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise UsageError(
            f"--scheduler needs the package {error.name!r}, which is not installed; "
            "install it with: pip install 'optnav[dist]'"
        ) from None
    return distributed


def make_unreachable_error(address: str, reason: str) -> WorkersError:
    return WorkersError(
        f"{address}: no scheduler can be reached ({reason}); "
        "check the address and that `dask scheduler` runs there"
    )


def find_scheduler(address: str) -> None:
    """Raise WorkersError unless a scheduler answers within ANSWER_S.

    Asked before there is a Client, which would wait for ever for what is no scheduler.
    """
    parts = urlsplit(address)
    try:
        # refused at once where a Client would go on trying
        socket.create_connection((parts.hostname, parts.port), timeout=ANSWER_S).close()
    except OSError as error:
        raise make_unreachable_error(address, (error.strerror or str(error)).lower()) from None
    task = asyncio.run(_query_identity(address))
    if task.cancelled() or isinstance(task.exception(), OSError):
        raise make_unreachable_error(address, f"no word within {ANSWER_S:.0f} s")
    # whatever else went wrong, it did on reading words that are no scheduler's
    if task.exception() is not None or task.result().get("type") != "Scheduler":
        raise make_unreachable_error(address, "what answers there is no scheduler")


async def _query_identity(address: str) -> "asyncio.Task[Any]":
    async def identity() -> Any:
        async with load_distributed().rpc(address, timeout=ANSWER_S) as scheduler:
            return await scheduler.identity()

    task = asyncio.ensure_future(identity())
    done, _ = await asyncio.wait({task}, timeout=ANSWER_S)
    if not done:
        task.cancel()
        await asyncio.wait({task}, timeout=1.0)
    return task


class Silence:
    """Keeps what dask logs off stderr, from `start` to `stop`; not in a run that tells details."""

    def __init__(self) -> None:
        self._levels: dict[str, int] = {}

    def start(self) -> None:
        """Raise the levels of their loggers."""
        if log.isEnabledFor(logging.DEBUG) or self._levels:
            return
        known = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in NOISY]
        for name in {*NOISY, *known}:
            logger = logging.getLogger(name)
            if name in NOISY or logger.level != logging.NOTSET:
                self._levels[name] = logger.level
                logger.setLevel(logging.CRITICAL + 1)

    def stop(self) -> None:
        """Put the levels back."""
        for name, level in self._levels.items():
            logging.getLogger(name).setLevel(level)
        self._levels = {}


class ClusterPool:
    """A Pool (see workers.py) of a cluster's worker processes, one chunk at a time each."""

    patience_s: float = LOOK_S

    def __init__(self, address: str) -> None:
        self.address = address
        self.call: Callable[..., Any] = run_on_node
        self._distributed = load_distributed()
        from distributed.scheduler import KilledWorker

        errors = KilledWorker, CancelledError, ImportError, _SchedulerLostError
        self.lost: tuple[type[Exception], ...] = errors
        self._client: Any = None
        self._executor: Executor | None = None
        self._needs: Needs = {}
        self._workers: set[str] = set()
        self._looked = self._seen_workers = 0.0
        self._silence = Silence()

    @property
    def count(self) -> int:
        """Worker processes at the last look; 1 while there are none."""
        return max(1, len(self._workers))

    def require_fit(self, needs: Needs) -> None:
        """Ask all workers, now and whenever the cluster is connected to, whether they are fit."""
        self._needs = needs
        if self._client is None:
            self._connect()
        else:
            self._check_workers()

    def pack(self, context: Any) -> bytes:
        # 6 kB for one terrain model: no trouble to send with each chunk of seconds of work
        self.require_fit({**collect_needs(list_files(context)), "packages": hash_packages(context)})
        return pickle.dumps((self._needs, pickle.dumps(context)))

    def executor(self) -> Executor:
        if self._client is None:
            self._connect()
        if self._executor is None:
            # pure: equal chunks of two builds must not share a result
            self._executor = self._client.get_executor(pure=False)
        return self._executor

    def look(self) -> None:
        """Keep `count`, name who left; raise WorkersError when all left for good."""
        now = time.monotonic()
        if now - self._looked < LOOK_S:
            return
        self._looked = now
        before, self._workers = self._workers, set(self._list_by_address())
        for address in sorted(before - self._workers):
            log.warning("worker %s has left; its pieces of work go to others", address)
        if self._workers:
            self._seen_workers = now
        elif now - self._seen_workers > RETURN_S:
            raise WorkersError(
                f"{self.address}: all workers have left and none came back within {RETURN_S:.0f} s "
                f"(out of memory?); {KEPT} when there are workers"
            )

    def handle_loss(self, loss: Exception, losses: int) -> None:
        if isinstance(loss, ImportError):
            raise WorkersError(
                f"{self.address}: a worker cannot load what it needs ({loss}); install the same "
                f"version of optnav for all workers; {KEPT}"
            ) from None
        if isinstance(loss, _SchedulerLostError | CancelledError):
            log.warning("the scheduler at %s is gone; looking for it", self.address)
            try:
                self._connect()
            except WorkersError as error:
                raise WorkersError(f"{error}; it was lost in mid-build: {KEPT}") from None
        if losses > LOSSES_WITHOUT_PROGRESS:
            raise WorkersError(
                f"{self.address}: workers died again and again over the same piece of work (out of "
                f"memory?); see their logs, give them more memory; {KEPT}"
            ) from None

    def stop_now(self) -> None:
        """Leave: a scheduler forgets the work of a client that is gone."""
        client, self._client, self._executor = self._client, None, None
        if client is not None:
            client.close(timeout=ANSWER_S)

    def close(self) -> None:
        self.stop_now()
        self._silence.stop()

    def _connect(self) -> None:
        self._silence.start()
        try:
            find_scheduler(self.address)
            with warnings.catch_warnings():
                # of versions that differ: those that matter are compared by `find_misfit`
                warnings.simplefilter("ignore")
                self._client = self._distributed.Client(
                    self.address, timeout=ANSWER_S, set_as_default=False, name="optnav"
                )
            self._wait_for_workers()
            try:  # the scheduler too loads the functions that it hands to workers
                self._client.run_on_scheduler(hash_package)
            except (ImportError, AttributeError) as error:
                raise WorkersError(
                    f"{self.address}: the scheduler cannot load optnav ({error}); start it from an "
                    "environment with the same version installed"
                ) from None
            except (OSError, RuntimeError) as error:
                raise _SchedulerLostError from error
            self._check_workers()
        except _SchedulerLostError:
            self.stop_now()
            raise make_unreachable_error(self.address, "it stopped answering") from None
        except BaseException:
            self.stop_now()
            raise

    def _wait_for_workers(self) -> None:
        until = time.monotonic() + ARRIVE_S
        while not (listed := self._list_by_address()) and time.monotonic() < until:
            time.sleep(0.2)
        if not listed:
            raise WorkersError(
                f"{self.address}: the scheduler has no workers (waited {ARRIVE_S:.0f} s); start "
                f"some on each machine: dask worker {self.address} --nworkers N --nthreads 1"
            )
        self._workers = set(listed)
        self._looked = self._seen_workers = time.monotonic()
        threads = max(int(worker["nthreads"]) for worker in listed.values())
        if threads > 1:
            log.warning(
                "workers of %(n)d threads use one of them for a build; start them with "
                "--nworkers %(n)d --nthreads 1",
                {"n": threads},
            )

    def _list_by_address(self) -> dict[str, Any]:
        """The workers that the scheduler knows. Raises _SchedulerLostError."""
        try:
            identity = self._client.sync(self._client.scheduler.identity, callback_timeout=ANSWER_S)
        except (OSError, RuntimeError) as error:  # RuntimeError: the client has closed itself
            raise _SchedulerLostError from error
        by_address: dict[str, Any] = identity["workers"]
        return by_address

    def _check_workers(self) -> None:
        """Raises WorkersError, naming the first, when workers are not fit for the work."""
        try:
            replies = self._client.run(find_misfit, self._needs, on_error="return")
        except (OSError, RuntimeError) as error:
            raise _SchedulerLostError from error
        # a worker that died since it was listed is no reason to stop
        there = {at: reply for at, reply in replies.items() if not isinstance(reply, OSError)}
        bad = sorted(at for at, reply in there.items() if reply is not None)
        if bad:
            reply = there[bad[0]]
            if isinstance(reply, BaseException):
                reply = f"cannot load optnav ({reply}); install the same version there"
            others = f" (and {len(bad) - 1} more of {len(there)} workers)" if len(bad) > 1 else ""
            raise WorkersError(f"worker {bad[0]}: {reply}{others}")
