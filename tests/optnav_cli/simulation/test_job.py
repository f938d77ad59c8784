"""A simulated folder appears whole or not at all, goes on after a stop, spares others' files."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from catalog.config import resource
from catalog.errors import DataError, OutputError
from catalog.progress import SilentProgress
from optnav_cli.output.manifest import read_manifest
from optnav_cli.simulation.job import simulate_folder
from optnav_cli.simulation.run import Simulation
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.scenario_base import ScenarioBase
from tests.catalog.jobs.dask_cluster import cluster_of, needs_distributed
from tests.catalog.pipeline.killing import wait_for_the_end_of
from tests.optnav_cli.navigate.test_resume import Stopping
from tests.optnav_cli.simulation.test_simulation import CAMERA, SMALL

SCENARIO = resource("configs/scenarios/demo.toml")


def draw(word: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands for the rendering, which takes long and has its own tests."""

    def picture(self: Simulation, number: int) -> bytes:
        if number == 3 and word == "damaged":
            raise DataError("terrain.tif: is truncated")
        return f"{word} {number}".encode()

    monkeypatch.setattr(Simulation, "picture", picture)


@pytest.fixture
def other() -> ScenarioBase:
    return load_scenario(SCENARIO).shortened(6)


def test_pictures_are_put_in_place_with_their_manifest(
    tmp_path: Path, other: ScenarioBase, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "pictures"
    for word, scenario in (("first", other), ("second", SCENARIO)):  # the second replaces the first
        draw(word, monkeypatch)
        simulate_folder(scenario, place, SilentProgress())
        assert (place / "frame_0003.png").read_text() == f"{word} 3"
    manifest = read_manifest(place)
    assert manifest["kind"] == "pictures"
    assert manifest["inputs"]["scenario"]["name"] == "demo.toml"
    assert [path.name for path in tmp_path.iterdir()] == ["pictures"]


def test_a_failure_leaves_the_earlier_pictures_and_what_is_done(
    tmp_path: Path, other: ScenarioBase, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "pictures"
    draw("first", monkeypatch)
    simulate_folder(other, place, SilentProgress())
    draw("damaged", monkeypatch)
    with pytest.raises(DataError):
        simulate_folder(SCENARIO, place, SilentProgress())
    assert (place / "frame_0000.png").read_text() == "first 0"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pictures", "pictures.work"]
    draw("mended", monkeypatch)
    simulate_folder(SCENARIO, place, SilentProgress())
    words = [path.read_text() for path in sorted(place.glob("*.png"))]
    assert words == [f"{'mended' if n > 2 else 'damaged'} {n}" for n in range(12)]


def test_pictures_of_the_same_scenario_are_left_as_they_are_until_one_is_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "pictures"
    draw("first", monkeypatch)
    simulate_folder(SCENARIO, place, SilentProgress())
    before = (place / "manifest.json").stat()
    draw("second", monkeypatch)
    simulate_folder(SCENARIO, place, SilentProgress())
    assert os.path.samestat(before, (place / "manifest.json").stat())
    (place / "frame_0003.png").write_text("")
    simulate_folder(SCENARIO, place, SilentProgress())
    assert (place / "frame_0000.png").read_text() == "second 0"


def test_another_scenario_starts_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw("first", monkeypatch)
    scenario = load_scenario(SCENARIO)
    with pytest.raises(KeyboardInterrupt):
        simulate_folder(scenario, tmp_path / "pictures", Stopping(3))
    progress = Stopping(1)
    with pytest.raises(KeyboardInterrupt):
        simulate_folder(scenario.shortened(5), tmp_path / "pictures", progress)
    assert progress.kept == 0


def test_somebody_elses_folder_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    monkeypatch.setattr(Simulation, "picture", lambda *_: pytest.fail("worked"))
    with pytest.raises(OutputError, match="not empty"):
        simulate_folder(SCENARIO, tmp_path, SilentProgress())
    assert (tmp_path / "letter.txt").read_text() == "dear"


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario of four small pictures."""
    folder = tmp_path_factory.mktemp("small")
    (folder / "small.toml").write_text(CAMERA)
    (folder / "scenario.toml").write_text(SMALL)
    return folder / "scenario.toml"


@pytest.fixture(scope="module")
def undisturbed(small: Path) -> dict[str, bytes]:
    """What one process makes that nobody stops."""
    simulate_folder(small, small.parent / "pictures", SilentProgress())
    return files_of(small.parent / "pictures")


def files_of(place: Path) -> dict[str, bytes]:
    """The bytes of each file but the manifest with its times."""
    paths = [path for path in place.rglob("*") if path.is_file() and path.name != "manifest.json"]
    assert len(paths) == 9
    return {str(path.relative_to(place)): path.read_bytes() for path in paths}


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_killed_command_goes_on_where_it_was(
    small: Path, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "optnav_cli.main", "simulate", str(small), "-o", "pictures"]
    with subprocess.Popen(
        command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        while not list(tmp_path.glob("pictures.work/*/*.bin")) and process.poll() is None:
            time.sleep(0.01)
        process.kill()
        process.communicate(timeout=20)
    wait_for_the_end_of(process.pid, 10.0)
    assert process.returncode == -signal.SIGKILL
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "done before" in done.stderr
    assert files_of(tmp_path / "pictures") == undisturbed


@needs_distributed
def test_a_cluster_takes_the_same_pictures(
    small: Path, undisturbed: dict[str, bytes], tmp_path: Path
) -> None:
    (tmp_path / "cluster").mkdir()
    with cluster_of(tmp_path / "cluster", os.pathsep.join(sys.path), 1) as cluster:
        place = tmp_path / "pictures"
        simulate_folder(small, place, SilentProgress(), scheduler=cluster.address)
    assert files_of(tmp_path / "pictures") == undisturbed
