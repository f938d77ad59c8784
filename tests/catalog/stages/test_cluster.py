"""A real scheduler and real workers on this machine: same content, and no end without a word.

Each worker is a process of its own, as `dask worker` starts it, so that it can be killed.
"""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import pytest

from catalog.config import resource
from catalog.errors import DataError, UsageError, WorkersError
from catalog.stages import cluster, scheduler
from catalog.stages.build import run
from catalog.stages.cluster import cluster_workers
from catalog.stages.cluster_node import needs_of, unfit
from catalog.stages.scheduler import check_address

needs_distributed = pytest.mark.skipif(
    find_spec("distributed") is None, reason="needs distributed (optnav[dist])"
)

# coarse and small, so that a build takes a second or two
CONFIG = """
[body]
name = "moon"
[[dem]]
path = "tycho.tif"
[pyramid]
levels = 3
posting_m = 474.0
size = 64
[render]
candidates = 2
window_nodes = 32
sun_elevations = 2
sun_azimuths = 2
"""
BBOX = (-14.0, -45.0, -9.0, -42.0)

WORK = """
import os, time
from pathlib import Path
from catalog.errors import DataError

def double(context, chunk):
    return [context["factor"] * value for value in chunk]

def process(context, chunk):
    time.sleep(0.05)
    return os.getpid()

def threads(context, chunk):
    import cv2, numba
    return cv2.getNumThreads(), numba.get_num_threads()

def alone(context, chunk):
    mark = Path(context["folder"]) / f"busy-{os.getpid()}"
    mark.touch(exist_ok=False)
    time.sleep(0.05)
    mark.unlink()

def refuse(context, chunk):
    raise DataError(f"chunk {chunk}: is bad")

def wait_for(context, chunk):
    folder = Path(context["folder"])
    (folder / f"begun-{chunk}-{os.getpid()}").touch()
    while chunk > 1 and not (folder / "go").exists():
        time.sleep(0.02)
    return chunk

def die(context, chunk):
    if chunk == 0:
        os.kill(os.getpid(), 9)
    return chunk
"""


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
    workers = cluster_workers(address)
    try:
        yield workers
    finally:
        workers.close()


def pool_sees(workers, count: int) -> bool:
    workers._pool._looked = 0.0
    workers._pool.look()
    return workers.count == count


@pytest.fixture(scope="module")
def modules(tmp_path_factory: pytest.TempPathFactory) -> str:
    """PYTHONPATH of workers, with a module of functions for them."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "work_for_cluster.py").write_text(WORK)
    return os.pathsep.join([str(folder), *sys.path])


@pytest.fixture(scope="module")
def work(modules):
    sys.path.insert(0, modules.split(os.pathsep)[0])
    import work_for_cluster

    yield work_for_cluster
    sys.path.remove(modules.split(os.pathsep)[0])
    del sys.modules["work_for_cluster"]


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


@pytest.fixture(scope="module")
def two(tmp_path_factory, modules):
    """A cluster of two workers that tests leave alive."""
    with cluster_of(tmp_path_factory.mktemp("two"), modules, 2) as found:
        yield found


@pytest.fixture
def own(tmp_path, modules):
    """A scheduler of the test's own, to which it adds workers."""
    with cluster_of(tmp_path, modules, 0) as found:
        yield found


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.mark.parametrize(
    "address",
    ["", "host", "host:8786", "tcp://host", "tcp://host:", "tcp://:8786", "tcp://host:none",
     "tcp://host:70000", "tcp://host:0", "http://host:8786", "tcp://host:8786/x", "tcp://[::1:8786",
     "tcp://me@host:8786", "tcp://host:8786?a=b"],
)  # fmt: skip
def test_an_address_that_is_none_is_refused(address):
    with pytest.raises(UsageError, match=re.escape(repr(address)) + ".*tcp://host:8786"):
        check_address(address)


@pytest.mark.parametrize("address", ["tcp://host:8786", "tcp://10.0.0.1:1", "tcp://[::1]:65535"])
def test_an_address_is_taken(address):
    check_address(address)


def test_without_distributed_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"pip install 'optnav\[dist\]'"):
        cluster_workers("tcp://localhost:8786")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"code": "0" * 64}, "runs other code of optnav"),
        ({"files": {"/no/such/dem.tif": (1, "")}}, "/no/such/dem.tif: cannot be read there"),
    ],
)
def test_a_worker_that_is_not_fit_says_why(change, reason):
    needs = needs_of([])
    assert unfit(needs) is None
    assert reason in (unfit({**needs, **change}) or "")


def test_a_worker_with_other_libraries_is_not_fit():
    needs = needs_of([])
    needs["surroundings"] = tuple(
        (name, "1.0" if name == "numpy" else found) for name, found in needs["surroundings"]
    )
    assert re.match(r"has numpy [2-9].*, the build 1\.0:", unfit(needs) or "")


@pytest.mark.parametrize("change", [b"short", b"longer than it was before", None])
def test_a_file_of_other_content_is_told_by_its_path(tmp_path, change):
    path = tmp_path / "dem.tif"
    path.write_bytes(b"0" * 300_000)
    needs = needs_of([path])
    os.utime(path, (1, 1))  # copies have other dates
    assert unfit(needs) is None
    data = bytearray(b"0" * 300_000) if change is None else change
    if change is None:
        data[150_000:160_000] = b"1" * 10_000
    path.write_bytes(data)
    assert (unfit(needs) or "").startswith(f"{path}: is another file there")


@needs_distributed
def test_a_scheduler_that_is_not_there_is_told_at_once():
    started = time.monotonic()
    with pytest.raises(WorkersError, match=r"tcp://127.0.0.1:\d+: .*\(connection refused\)"):
        cluster_workers(f"tcp://127.0.0.1:{free_port()}")
    assert time.monotonic() - started < 3.0


@needs_distributed
@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (b"", "no word within 1 s"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n" * 9, "what answers there is no scheduler"),
    ],
)
def test_what_answers_but_is_no_scheduler_is_told_in_seconds(monkeypatch, answer, reason):
    monkeypatch.setattr(scheduler, "ANSWER_S", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as threads:

        def serve() -> None:
            held = [server.accept()[0] for _ in range(2)]  # the first only knocks
            held[1].sendall(answer)
            held[1].recv(1)
            stop.wait(10.0)
            for one in held:
                one.close()

        stop = threading.Event()
        served = threads.submit(serve)
        with pytest.raises(WorkersError, match=reason):
            cluster_workers(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        stop.set()
        served.result(timeout=10.0)


@needs_distributed
def test_a_scheduler_without_workers_is_told_after_a_short_wait(own, monkeypatch):
    monkeypatch.setattr(cluster, "ARRIVE_S", 0.5)
    with pytest.raises(WorkersError, match=f"no workers.*dask worker {own.address}"):
        cluster_workers(own.address)


@needs_distributed
def test_every_chunk_comes_back_once_from_both_workers(two, work):
    with workers_at(two.address) as workers:
        found = dict(workers.run(work.double, {"factor": 3}, [[i, i + 1] for i in range(20)]))
        assert found == {i: [3 * i, 3 * i + 3] for i in range(20)}
        pids = {pid for _, pid in workers.run(work.process, {}, range(20))}
        assert pids == {process.pid for process in two.workers}
        assert {limits for _, limits in workers.run(work.threads, {}, [1])} == {(1, 1)}


@needs_distributed
def test_an_error_on_a_worker_arrives_as_itself(two, work):
    with workers_at(two.address) as workers:
        with pytest.raises(DataError, match="is bad"):
            list(workers.run(work.refuse, {}, [1, 2, 3]))
        # and the workers can be used again
        assert dict(workers.run(work.double, {"factor": 1}, [[5]])) == {0: [5]}


@needs_distributed
def test_what_has_not_begun_is_dropped_with_an_interrupt(two, work, tmp_path):
    with workers_at(two.address) as workers:
        going = workers.run(work.wait_for, {"folder": str(tmp_path)}, list(range(12)))
        assert next(going)[0] in (0, 1)
        until(lambda: len(list(tmp_path.glob("begun-*"))) >= 4)
        going.close()  # as an exception in the build does
        begun = set(tmp_path.glob("begun-*"))
        (tmp_path / "go").touch()
        assert len(list(workers.run(work.process, {}, range(8)))) == 8
    assert set(tmp_path.glob("begun-*")) == begun
    assert len(begun) < 12


@needs_distributed
def test_threads_of_one_worker_take_turns(own, work, tmp_path):
    own.start_worker("--no-nanny", "--nthreads", "4")
    own.all_there()
    with workers_at(own.address) as workers:
        assert workers.count == 1
        assert len(list(workers.run(work.alone, {"folder": str(tmp_path)}, range(8)))) == 8


@needs_distributed
def test_a_worker_that_is_not_fit_is_named_at_the_start(two, monkeypatch):
    monkeypatch.setattr(cluster, "needs_of", lambda files: {**needs_of(files), "code": "0" * 64})
    with pytest.raises(WorkersError, match=r"worker tcp://127.*: runs other code.*\(and 1 more of"):
        cluster_workers(two.address)


@needs_distributed
def test_a_file_that_workers_cannot_read_is_named_at_the_start(two, tmp_path, monkeypatch):
    path = tmp_path / "dem.tif"
    path.write_bytes(b"here alone")

    def needs_of_what_goes(files):
        needs = needs_of(files)
        path.unlink()
        return needs

    monkeypatch.setattr(cluster, "needs_of", needs_of_what_goes)
    told = rf"worker tcp://127.*: {path}: cannot be read there \(No such file or directory\)"
    with pytest.raises(WorkersError, match=told):
        cluster_workers(two.address, [path])


@needs_distributed
def test_a_worker_that_comes_later_is_asked_too(two, work, monkeypatch):
    with workers_at(two.address) as workers:
        bad = {**needs_of([]), "code": "0" * 64}
        monkeypatch.setattr(cluster, "needs_of", lambda files: bad)
        monkeypatch.setattr(workers._pool, "_ask_all", lambda: None)  # it was not there then
        with pytest.raises(WorkersError, match=r"worker tcp://127.*: runs other code"):
            list(workers.run(work.double, {"factor": 1}, [[5]]))


@needs_distributed
def test_a_piece_of_work_that_kills_worker_after_worker_is_a_clear_error(
    tmp_path, modules, work, monkeypatch
):
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    with cluster_of(tmp_path, modules, 3) as own, workers_at(own.address) as workers:
        going = workers.run(work.die, {}, list(range(6)))
        # it is tried again when the others are done
        assert {next(going)[0] for _ in range(5)} == {1, 2, 3, 4, 5}
        with pytest.raises(WorkersError, match="died again and again over the same piece"):
            next(going)


@needs_distributed
def test_when_all_workers_go_the_next_takes_over_or_a_clear_error_comes_in_bounded_time(
    own, work, tmp_path, monkeypatch
):
    monkeypatch.setattr(cluster, "LOOK_S", 0.1)
    monkeypatch.setattr(cluster.ClusterPool, "patience_s", 0.1)
    own.start_worker("--no-nanny")
    own.all_there()
    with workers_at(own.address) as workers:
        going = workers.run(work.wait_for, {"folder": str(tmp_path)}, list(range(8)))
        found = [next(going), next(going)]
        own.workers[0].kill()
        own.start_worker("--no-nanny")
        (tmp_path / "go").touch()
        assert sorted([*found, *going]) == [(i, i) for i in range(8)]

        (tmp_path / "go").unlink()
        monkeypatch.setattr(cluster, "RETURN_S", 0.5)
        going = workers.run(work.wait_for, {"folder": str(tmp_path)}, list(range(8)))
        next(going)
        own.workers[1].kill()
        started = time.monotonic()
        with pytest.raises(WorkersError, match=r"all workers have left.*what is done is kept"):
            list(going)
        assert time.monotonic() - started < 10.0


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("build")
    (folder / "tycho.tif").write_bytes(resource("data/tycho_gld100_256ppd.tif").read_bytes())
    path = folder / "tycho.toml"
    path.write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def digest(config):
    """Content of the undisturbed build by one process."""
    return run(config, output=config.with_name("one.gpkg"), bbox=BBOX, workers=1).digest


@needs_distributed
def test_a_cluster_writes_what_one_process_writes(two, config, digest, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a relative output: workers have another working folder
    report = run(config, output=Path("c.gpkg"), scheduler=two.address, bbox=BBOX)
    assert report.digest == digest
    assert report.account.workers == 2


class Striking:
    """Progress that strikes once, when a stage has told so many times."""

    def __init__(self, stage: str, times: int, strike: Callable[[], None]) -> None:
        self.name, self.left, self.strike = stage, times, strike

    @contextmanager
    def stage(self, name, total, unit):
        self.now = name
        yield self

    def keep(self, n):
        pass

    def advance(self, n=1, note=""):
        self.left -= self.now == self.name
        if self.left == 0 and self.now == self.name:
            self.strike()


@needs_distributed
@pytest.mark.parametrize("stage", ["render", "check"])
def test_a_worker_killed_in_mid_build_is_survived(own, config, digest, tmp_path, stage):
    for _ in range(2):
        own.start_worker("--no-nanny")
    own.all_there()
    progress = Striking(stage, 2, own.workers[0].kill)
    report = run(
        config, output=tmp_path / "c.gpkg", scheduler=own.address, bbox=BBOX, progress=progress
    )
    assert own.workers[0].wait(timeout=10.0) == -signal.SIGKILL
    assert report.digest == digest


@needs_distributed
def test_a_scheduler_killed_in_mid_build_is_told_and_what_is_done_is_kept(
    own, config, digest, tmp_path
):
    own.start_worker("--no-nanny")
    own.all_there()
    box = ",".join(f"{value:g}" for value in BBOX)
    build = subprocess.Popen(
        [sys.executable, "-m", "optnav_cli.main", "build", str(config), "-o", "c.gpkg",
         "--scheduler", own.address, "--bbox", box],
        cwd=tmp_path, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": own.path},
    )  # fmt: skip
    try:
        until(lambda: len(list(tmp_path.glob("c.gpkg.work/check-*/chunk-*.bin"))) >= 2)
        own.scheduler.kill()
        _, told = build.communicate(timeout=30.0)
    finally:
        build.kill()
    assert build.returncode == WorkersError.exit_code
    last = told.strip().splitlines()[-1]
    assert "no scheduler can be reached (connection refused)" in last
    assert "what is done is kept" in last
    assert "Traceback" not in told
    assert "distributed" not in told
    assert not (tmp_path / "c.gpkg").exists()
    report = run(config, output=tmp_path / "c.gpkg", bbox=BBOX, workers=1)
    assert report.digest == digest
    kept = {stage.name: stage.kept for stage in report.account.stages}
    assert kept["render"] > 5
    assert kept["check"] >= 2
