"""Keeps the table of the benches when it is asked for."""

import os

import pytest

from tests.bench import timing


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Store what the benches found, also where a limit was missed."""
    if timing.FULL and os.environ.get("OPTNAV_BENCH_STORE") and timing.FOUND:
        timing.store(whole=not session.config.getoption("keyword"))
