"""`optnav demo` where nothing is compiled yet; the wheel's test runs all of it."""

import multiprocessing
import tempfile
import time
from pathlib import Path

import pytest

from catalog.config import resource
from optnav_cli.commands import demo
from optnav_cli.simulation.run import Simulation

SCENARIO = resource("configs/scenarios/demo.toml")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary folders are made, by this process and those beside it."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_two_pictures_are_simulated_ahead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("logging.disable", lambda: None)
    monkeypatch.setattr(Simulation, "picture", lambda self, number: b"drawn")
    demo._simulate_ahead(SCENARIO, tmp_path)
    pictures = sorted(path.name for path in (tmp_path / "pictures").glob("*.png"))
    assert pictures == ["frame_0000.png", "frame_0001.png"]


def test_a_process_that_compiles_ahead_may_fail_and_leaves_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "has_cached_kernels", lambda: False)
    before = set(multiprocessing.active_children())
    with demo._compile_ahead(folder / "missing.toml", 2) as is_built:
        (process,) = set(multiprocessing.active_children()) - before
        assert len(list(folder.iterdir())) == 1
        is_built(folder / "missing.gpkg")
    assert not process.is_alive()
    assert list(folder.iterdir()) == []


def test_an_interrupt_ends_the_process_beside_at_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "has_cached_kernels", lambda: False)
    before = set(multiprocessing.active_children())
    beside = set()

    def interrupted() -> None:
        with demo._compile_ahead(SCENARIO, 2):
            beside.update(set(multiprocessing.active_children()) - before)
            raise KeyboardInterrupt

    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    (process,) = beside
    assert not process.is_alive()
    assert list(folder.iterdir()) == []
    assert time.monotonic() - started < 20.0  # the two pictures alone would take longer, cold


@pytest.mark.parametrize(("workers", "cached"), [(1, False), (2, True)])
def test_nothing_runs_beside_one_worker_or_when_all_is_compiled(
    folder: Path, monkeypatch: pytest.MonkeyPatch, workers: int, cached: bool
) -> None:
    monkeypatch.setattr(demo, "has_cached_kernels", lambda: cached)
    before = set(multiprocessing.active_children())
    with demo._compile_ahead(SCENARIO, workers) as is_built:
        is_built(folder / "missing.gpkg")
        assert set(multiprocessing.active_children()) == before
        assert list(folder.iterdir()) == []
