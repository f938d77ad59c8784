"""A dask scheduler and its workers on this machine, for the tests of cluster builds.

Each worker is a process of its own, as `dask worker` starts it, so that it can be killed.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import pytest

from catalog.jobs import cluster
from catalog.jobs.cluster import start_cluster_workers

needs_distributed = pytest.mark.skipif(
    find_spec("distributed") is None, reason="needs distributed (optnav[dist])"
)


@dataclass
class Cluster:
    """A scheduler and its workers, each a process."""

    folder: Path
    path: str
    scheduler: "subprocess.Popen[bytes]" = field(init=False)
    address: str = field(init=False)
    workers: "list[subprocess.Popen[bytes]]" = field(default_factory=list)

    def __post_init__(self) -> None:
        file = self.folder / "scheduler.json"
        self.scheduler = self._start(
            "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file)
        )
        until(lambda: file.is_file() and file.stat().st_size > 0)
        self.address = json.loads(file.read_text())["address"]

    def _start(self, what: str, *options: str) -> "subprocess.Popen[bytes]":
        # a worker's working folder is another one than the build's
        with (self.folder / f"{what}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.{what}", "--no-dashboard", *options],
                cwd=self.folder,
                env={**os.environ, "PYTHONPATH": self.path, "DASK_LOGGING__DISTRIBUTED": "warning"},
                stdout=log,
                stderr=log,
            )

    def start_worker(self, *options: str) -> "subprocess.Popen[bytes]":
        threads = () if "--nthreads" in options else ("--nthreads", "1")
        place = ("--host", "127.0.0.1", "--local-directory", str(self.folder))
        worker = self._start("dask_worker", self.address, *place, *threads, *options)
        self.workers.append(worker)
        return worker

    def all_there(self) -> None:
        """Wait for the workers, which take seconds to load on a busy machine."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cluster, "ARRIVE_S", 60.0)
            with workers_at(self.address) as workers:
                until(lambda: pool_sees(workers, len(self.workers)))

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


def until(true: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


@contextmanager
def workers_at(address: str):
    workers = start_cluster_workers(address)
    try:
        yield workers
    finally:
        workers.close()


def pool_sees(workers, count: int) -> bool:
    workers._pool._looked = 0.0
    workers._pool.look()
    return workers.count == count


@contextmanager
def cluster_of(folder: Path, path: str, workers: int) -> Iterator[Cluster]:
    found = Cluster(folder, path)
    try:
        for _ in range(workers):
            found.start_worker("--no-nanny")
        if workers:
            found.all_there()
        yield found
    finally:
        found.stop()
