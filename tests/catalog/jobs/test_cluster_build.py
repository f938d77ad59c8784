"""Builds on a real scheduler and real workers: the same content, whoever dies."""

import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import pytest

from catalog.config import resource
from catalog.errors import WorkersError
from catalog.pipeline.build import run
from tests.catalog.jobs.dask_cluster import needs_distributed, until
from tests.catalog.pipeline.coarse_tycho import BBOX, CONFIG


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("build")
    (folder / "tycho.tif").write_bytes(resource("data/tycho_gld100_256ppd.tif").read_bytes())
    path = folder / "tycho.toml"
    path.write_text(CONFIG.replace("bundled:tycho_gld100_256ppd.tif", "tycho.tif"))
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
    """Progress that strikes once in each of some stages, at its second step."""

    def __init__(self, strikes: dict[str, Callable[[], None]]) -> None:
        self.strikes, self.steps = strikes, Counter()

    @contextmanager
    def stage(self, name, total, unit):
        self.now = name
        yield self

    def keep(self, n):
        pass

    def advance(self, n=1, note=""):
        self.steps[self.now] += 1
        if self.steps[self.now] == 2 and self.now in self.strikes:
            self.strikes[self.now]()


@needs_distributed
def test_workers_killed_in_mid_build_are_survived(own, config, digest, tmp_path):
    for _ in range(3):
        own.start_worker("--no-nanny")
    own.all_there()
    progress = Striking({"render": own.workers[0].kill, "check": own.workers[1].kill})
    report = run(
        config, output=tmp_path / "c.gpkg", scheduler=own.address, bbox=BBOX, progress=progress
    )
    for worker in own.workers[:2]:
        assert worker.wait(timeout=10.0) == -signal.SIGKILL
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
