"""A scheduler that cannot be used is told at once, and why."""

import re
import socket
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from catalog.errors import UsageError, WorkersError
from catalog.jobs import cluster
from catalog.jobs.cluster import check_address, start_cluster_workers
from tests.catalog.jobs.dask_cluster import needs_distributed


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
        start_cluster_workers("tcp://localhost:8786")


@needs_distributed
def test_a_scheduler_that_is_not_there_is_told_at_once():
    started = time.monotonic()
    with pytest.raises(WorkersError, match=r"tcp://127.0.0.1:\d+: .*\(connection refused\)"):
        start_cluster_workers(f"tcp://127.0.0.1:{free_port()}")
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
    monkeypatch.setattr(cluster, "ANSWER_S", 1.0)
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
            start_cluster_workers(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        stop.set()
        served.result(timeout=10.0)


@needs_distributed
def test_a_scheduler_without_workers_is_told_after_a_short_wait(own, monkeypatch):
    monkeypatch.setattr(cluster, "ARRIVE_S", 0.5)
    with pytest.raises(WorkersError, match=f"no workers.*dask worker {own.address}"):
        start_cluster_workers(own.address)
