"""Results of chunks: made once, found again, and handed over so that a kill cannot jam the way."""

import os
import pickle
import select
import socket
from types import SimpleNamespace

import msgspec
import pytest

from catalog.jobs import workspace as jobs
from catalog.jobs.usage import StageAccount
from catalog.jobs.workers import SerialWorkers, make_workers
from catalog.jobs.workspace import ChunkResults, Workspace
from catalog.progress import SilentProgress


class Thing(msgspec.Struct):
    cell: int
    noise: bytes = b""


def things(context, chunk):
    return [Thing(cell, os.urandom(context)) for cell in chunk]


@pytest.fixture
def results(tmp_path):
    return ChunkResults(Workspace(tmp_path / "work"), "render", "key", Thing)


def made(results, chunks, workers, noise=0):
    account = StageAccount("render")
    with SilentProgress().stage("render", 1, "cell") as shown:
        positions = list(results.make(things, noise, chunks, workers, account, shown))
    return positions, account


def test_every_chunk_is_made_once(results):
    chunks = [[1, 2], [3], [4, 5]]
    positions, account = made(results, chunks[:2], SerialWorkers())
    assert (positions, account.done, account.kept) == ([0, 1], 2, 0)
    positions, account = made(results, chunks, SerialWorkers())
    assert (positions, account.done, account.kept) == ([0, 1, 2], 1, 2)
    assert [thing.cell for thing in results.read_all(3)] == [1, 2, 3, 4, 5]


def test_a_chunk_that_is_missing_is_told(results):
    made(results, [[1], [2]], SerialWorkers())
    results.workspace.path(results.name(0)).unlink()
    assert results.read_all(2) is None


def both(context, chunk):
    return things(context, chunk), [Thing(-cell) for cell in chunk]


@pytest.mark.parametrize("count", [1, 2])
def test_what_a_function_makes_on_its_way_lies_beside_its_own(results, count):
    beside = ChunkResults(results.workspace, "write", "key", Thing)
    workers, account = make_workers(count), StageAccount("render")
    try:
        with SilentProgress().stage("render", 1, "cell") as shown:
            made = results.make(both, 0, [[1, 2], [3]], workers, account, shown, beside)
            assert sorted(made) == [0, 1]
    finally:
        workers.close()
    assert [thing.cell for thing in results.read_all(2)] == [1, 2, 3]
    assert [thing.cell for thing in beside.read_all(2)] == [-1, -2, -3]


def test_a_kill_between_the_files_of_a_chunk_costs_only_the_second(results, monkeypatch):
    beside = ChunkResults(results.workspace, "write", "key", Thing)
    put = results.workspace.put

    def dying(name, data):
        put(name, data)
        raise KeyboardInterrupt

    def run():
        account = StageAccount("render")
        with SilentProgress().stage("render", 1, "cell") as shown:
            list(results.make(both, 0, [[1, 2]], SerialWorkers(), account, shown, beside))
        return account.done, account.kept

    monkeypatch.setattr(results.workspace, "put", dying)
    with pytest.raises(KeyboardInterrupt):
        run()
    monkeypatch.undo()
    assert run() == (0, 1)
    assert beside.read_all(1) is None  # left to the stage that wants them


def test_worker_processes_hand_over_the_same(results):
    workers = make_workers(2)
    try:
        positions, account = made(results, [[cell] for cell in range(6)], workers)
    finally:
        workers.close()
    assert sorted(positions) == list(range(6))
    assert account.done == 6
    assert account.workers_cpu_s > 0.0
    assert [thing.cell for thing in results.read_all(6)] == list(range(6))


def test_an_answer_through_a_pipe_is_too_short_to_be_torn_by_a_kill(results, monkeypatch):
    # as in a worker process whose parent coordinates
    monkeypatch.setattr(
        jobs.multiprocessing, "parent_process", lambda: SimpleNamespace(pid=os.getpid())
    )
    here = (socket.gethostname(), os.getpid())
    answer = jobs._make_results(things, results.workspace, here, 10**6, ([results.name(0)], [7]))
    assert len(pickle.dumps(answer)) < select.PIPE_BUF / 2
    assert [thing.cell for thing in results.read(0)] == [7]


def test_a_worker_elsewhere_answers_with_the_bytes_and_writes_nothing(results, monkeypatch):
    monkeypatch.setattr(
        jobs.multiprocessing, "parent_process", lambda: SimpleNamespace(pid=os.getpid())
    )
    elsewhere = ("another-machine", os.getpid())
    data, _ = jobs._make_results(
        things, results.workspace, elsewhere, 100, ([results.name(0)], [7])
    )
    assert len(data) == 1
    assert results.read(0) is None
