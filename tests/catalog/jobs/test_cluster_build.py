"""Builds on a real scheduler and real workers: the same content, whoever dies."""

import os
import signal
import subprocess
import sys
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
