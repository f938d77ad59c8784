"""A machine of a cluster: whether it can do a build's work as this one would, and that work.

The functions here run on the workers of a dask.distributed cluster, in processes that this
program did not start: threads may share one, and it may have loaded other code or see other files.
"""

import hashlib
import pickle
import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from catalog.cache import Cache
from catalog.errors import WorkersError
from catalog.jobs.workers import run_in_worker
from catalog.jobs.workspace import hash_package, list_versions

# Of a file that is compared: enough to tell another terrain model or another overview of the same
# size, without reading all of it on every worker. Dates are not compared: copies have others.
SAMPLES = 64
SAMPLE_BYTES = 4096

Needs = dict[str, Any]  # builtin types alone, for the eyes of other versions


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
