"""Work comes back whatever happens to the processes that do it."""

import os
import signal
import subprocess
import sys
import time

import pytest

from catalog.errors import DataError, WorkersError
from catalog.jobs.workers import SerialWorkers, count_cores, make_workers

WORK = """
import os
from pathlib import Path
from catalog.errors import DataError

def double(context, chunk):
    return [context["factor"] * value for value in chunk]

def process(context, chunk):
    return os.getpid(), os.environ.get("NUMBA_NUM_THREADS")

def threads(context, chunk):
    import cv2, numba
    return cv2.getNumThreads(), numba.config.NUMBA_NUM_THREADS

def refuse(context, chunk):
    raise DataError(f"chunk {chunk}: is bad")

def die_once(context, chunk):
    mark = Path(context["folder"]) / "died"
    if chunk == 3 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), 9)
    return chunk

def die(context, chunk):
    os.kill(os.getpid(), 9)
"""


@pytest.fixture
def work(tmp_path, monkeypatch):
    """Functions in a module that worker processes can import too."""
    (tmp_path / "work_for_workers.py").write_text(WORK)
    monkeypatch.syspath_prepend(tmp_path)
    import work_for_workers

    yield work_for_workers
    del sys.modules["work_for_workers"]


@pytest.fixture
def two():
    workers = make_workers(2)
    yield workers
    workers.close()


def test_one_worker_is_this_process(work):
    workers = make_workers(1)
    assert isinstance(workers, SerialWorkers)
    assert [r[0] for _, r in workers.run(work.process, {}, [1, 2])] == [os.getpid()] * 2


def test_no_number_means_all_cores():
    workers = make_workers(None)
    assert workers.count == count_cores()
    workers.close()


def test_every_chunk_comes_back_once_with_its_position(work, two):
    chunks = [[i, i + 1] for i in range(20)]
    found = dict(two.run(work.double, {"factor": 3}, chunks))
    assert found == {i: [3 * i, 3 * i + 3] for i in range(20)}


def test_workers_stay_between_runs_and_use_one_thread_each(work, two):
    first: set[int] = set()
    while len(first) < 2:  # on a busy machine one worker may do all before the other is there
        first |= {pid for _, (pid, _) in two.run(work.process, {}, range(20))}
    second = {pid for _, (pid, _) in two.run(work.process, {}, range(20))}
    assert os.getpid() not in first
    assert second <= first
    assert {limits for _, limits in two.run(work.threads, {}, [1])} == {(1, 1)}


def test_an_error_in_a_worker_arrives_as_itself(work, two):
    with pytest.raises(DataError, match="is bad"):
        list(two.run(work.refuse, {}, [1, 2, 3]))
    # and the workers can be used again
    assert dict(two.run(work.double, {"factor": 1}, [[5]])) == {0: [5]}


def test_a_worker_that_dies_is_replaced_and_nothing_is_lost(work, two, tmp_path):
    found = sorted(two.run(work.die_once, {"folder": str(tmp_path)}, list(range(10))))
    assert found == [(i, i) for i in range(10)]
    assert (tmp_path / "died").exists()


def test_a_worker_that_does_not_answer_is_not_waited_for(work, monkeypatch):
    monkeypatch.setattr("catalog.jobs.workers.GOODBYE_S", 1.0)
    two, pids = make_workers(2), set()
    while len(pids) < 2:
        pids |= {pid for _, (pid, _) in two.run(work.process, {}, range(20))}
    os.kill(min(pids), signal.SIGSTOP)
    before = time.monotonic()
    two.close()
    assert time.monotonic() - before < 10.0
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_workers_that_die_again_and_again_are_a_clear_error(work, two):
    with pytest.raises(WorkersError, match="fewer --workers"):
        list(two.run(work.die, {}, [1, 2]))


LONG = """
import sys, time
from contextlib import closing
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from catalog.jobs.workers import make_workers
def main():
    import slow_work
    print("go", flush=True)
    # an interrupt while a result is printed must end the run, too, not leave it to the traceback
    with closing(make_workers(2).run(slow_work.sleep, {}, range(10))) as results:
        for position, pid in results:
            print(pid, flush=True)
if __name__ == "__main__":
    main()
"""
SLOW = """
import os, time
def sleep(context, chunk):
    if chunk > 1:
        time.sleep(60)
    return os.getpid()
"""


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_workers_go_with_their_parent(tmp_path, sign):
    (tmp_path / "slow_work.py").write_text(SLOW)
    script = tmp_path / "long.py"
    script.write_text(LONG)
    parent = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    try:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "go\n"
        pids = {int(parent.stdout.readline()) for _ in range(2)}
        parent.send_signal(sign)
        started = time.monotonic()
        parent.wait(timeout=20)
        while any(map(alive, pids)) and time.monotonic() - started < 20:
            time.sleep(0.05)
        assert not any(map(alive, pids))
        # long before the work of a minute would have ended
        assert time.monotonic() - started < 10
    finally:
        parent.kill()
        parent.communicate()
