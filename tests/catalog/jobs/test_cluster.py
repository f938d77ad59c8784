"""Chunks of work on a real scheduler and real workers: all come back, or a clear error."""

import time

import pytest

from catalog.errors import DataError, WorkersError
from catalog.jobs import cluster
from catalog.jobs.cluster import collect_needs, start_cluster_workers
from tests.catalog.jobs.dask_cluster import cluster_of, needs_distributed, until, workers_at


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
    monkeypatch.setattr(
        cluster, "collect_needs", lambda files: {**collect_needs(files), "code": "0" * 64}
    )
    with pytest.raises(WorkersError, match=r"worker tcp://127.*: runs other code.*\(and 1 more of"):
        start_cluster_workers(two.address)


@needs_distributed
def test_a_file_that_workers_cannot_read_is_named_at_the_start(two, tmp_path, monkeypatch):
    path = tmp_path / "dem.tif"
    path.write_bytes(b"here alone")

    def needs_of_what_goes(files):
        needs = collect_needs(files)
        path.unlink()
        return needs

    monkeypatch.setattr(cluster, "collect_needs", needs_of_what_goes)
    told = rf"worker tcp://127.*: {path}: cannot be read there \(No such file or directory\)"
    with pytest.raises(WorkersError, match=told):
        start_cluster_workers(two.address, [path])


@needs_distributed
def test_a_worker_that_comes_later_is_asked_too(two, work, monkeypatch):
    with workers_at(two.address) as workers:
        bad = {**collect_needs([]), "code": "0" * 64}
        monkeypatch.setattr(cluster, "collect_needs", lambda files: bad)
        monkeypatch.setattr(workers._pool, "_check_workers", lambda: None)  # it was not there then
        with pytest.raises(WorkersError, match=r"worker tcp://127.*: runs other code"):
            list(workers.run(work.double, {"factor": 1}, [[5]]))


@needs_distributed
def test_a_piece_of_work_that_kills_worker_after_worker_is_a_clear_error(
    tmp_path, modules, work, monkeypatch
):
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "0")
    # pieces that wait on a worker would be counted as its killers, too
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__WORKER_SATURATION", "1.0")
    # one for each death, and one that is left to say so
    with cluster_of(tmp_path, modules, 4) as own, workers_at(own.address) as workers:
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
