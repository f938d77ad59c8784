"""Every command that writes: where it may not write, it ends with 3 and leaves what is there."""

import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from catalog.config import resource
from catalog.places import lock_output
from optnav_cli.main import run
from tests.catalog.made_catalogs import make_world
from tests.optnav_cli.made_runs import write_run

TYCHO = str(resource("configs/catalogs/tycho.toml"))
DEMO = str(resource("configs/scenarios/demo.toml"))
# by command: its words, with the place of its output last
COMMANDS = {
    "build": (["build", TYCHO, "--work", "work", "-o"], "new.gpkg"),
    "write": (["write", TYCHO, "--work", "work", "-o"], "new.gpkg"),
    "simulate": (["simulate", DEMO, "-o"], "new"),
    "navigate": (["navigate", "pictures", "--catalog", "c.gpkg", "-o"], "new"),
    "report": (["report", "run", "-o"], "new.html"),
    "report svg": (["report", "run", "-o"], "new.svg"),
    "report catalog": (["report", "c.gpkg", "-o"], "new.html"),
    "layout": (["report", "run", "--foxglove-layout"], "new.json"),
    "show": (["catalog", "show", "c.gpkg", "ID", "-o"], "new.png"),
    "compare": (["catalog", "compare", "c.gpkg", "c.gpkg", "-o"], "new.csv"),
    "export csv": (["catalog", "export", "c.gpkg", "-o"], "new.csv"),
    "export gpkg": (["catalog", "export", "c.gpkg", "-o"], "new.gpkg"),
    "export geojson": (["catalog", "export", "c.gpkg", "-o"], "new.geojson"),
    "export patch": (["catalog", "export", "c.gpkg", "--point", "ID", "-o"], "new.glb"),
    "folder": (["config", "template", "folder", "-o"], "new"),
    "demo": (["demo", "-o"], "new"),
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a catalog, a run and pictures."""
    folder = tmp_path_factory.mktemp("made")
    make_world().write(folder / "c.gpkg")
    write_run(folder / "run", count=3)
    assert run(["config", "template", "folder", "-o", str(folder / "pictures")]) == 0
    return folder


Call = Callable[[str], tuple[int, str]]


@pytest.fixture
def call(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Call:
    """Runs a command of COMMANDS with links to what is made; gives exit code and messages."""
    for path in made.iterdir():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.chdir(tmp_path)
    point = next(str(p.id) for p, patches in make_world().points if p.id % 3)  # a whole patch

    def called(name: str) -> tuple[int, str]:
        words, place = COMMANDS[name]
        code = run([point if word == "ID" else word for word in [*words, place]])
        return code, capsys.readouterr().err

    return called


@contextmanager
def claimed_elsewhere(place: Path) -> Iterator[None]:
    """Another thread writes to a place: for claims as good as another process."""
    ready, done = threading.Event(), threading.Event()

    def hold() -> None:
        with lock_output(place):
            ready.set()
            done.wait(60)

    thread = threading.Thread(target=hold)
    thread.start()
    ready.wait(60)
    try:
        yield
    finally:
        done.set()
        thread.join()


@pytest.mark.parametrize("name", COMMANDS)
def test_a_pipe_in_the_place_of_an_output_stays(name: str, call: Call, tmp_path: Path) -> None:
    place = tmp_path / COMMANDS[name][1]
    os.mkfifo(place)
    before = os.listdir(tmp_path), os.lstat(place)[:7]  # up to the size: no times
    code, said = call(name)
    assert (code, "Traceback" in said) == (3, False)
    assert f"optnav: {place.name}: is a pipe, which no output replaces" in said
    assert (os.listdir(tmp_path), os.lstat(place)[:7]) == before


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "study folder"])
def test_an_output_that_another_process_writes_is_refused_at_once(
    name: str, call: Call, tmp_path: Path
) -> None:
    place = tmp_path / COMMANDS[name][1]
    with claimed_elsewhere(place):
        before = os.listdir(tmp_path)
        code, said = call(name)
        assert (code, "Traceback" in said) == (3, False)
        assert "another optnav is writing this output; wait for it or name another place" in said
        assert os.listdir(tmp_path) == before


def test_an_output_that_holds_its_own_input_is_refused(made: Path, tmp_path: Path) -> None:
    """It would be gone with the older output that it lies in."""
    old = tmp_path / "old"
    (old / "deep").mkdir(parents=True)
    (old / "manifest.json").write_text('{"made_by": "optnav", "kind": "run"}')
    shutil.copy(made / "c.gpkg", old / "deep")
    (tmp_path / "link.gpkg").symlink_to(old / "deep" / "c.gpkg")
    shutil.copytree(made / "pictures", old / "pictures")
    words = ["navigate", str(made / "pictures"), "--catalog", str(tmp_path / "link.gpkg"), "-o"]
    assert run([*words, str(old)]) == 3
    words[1:4] = [str(old / "pictures"), "--catalog", str(made / "c.gpkg")]
    assert run([*words, str(old)]) == 3
    assert (old / "deep" / "c.gpkg").exists()
    assert (old / "pictures" / "frames.csv").exists()
    (old / "manifest.json").write_text('{"made_by": "optnav", "kind": "pictures"}')
    shutil.copy(DEMO, old)
    assert run(["simulate", str(old / "demo.toml"), "-o", str(old)]) == 3
    assert (old / "demo.toml").exists()


@pytest.mark.parametrize("ending", [".prj", ".csvt"])
def test_a_layer_leaves_the_side_files_of_another_alone(
    ending: str, call: Call, tmp_path: Path
) -> None:
    """A .prj may belong to a shape file of the same name."""
    other = tmp_path / f"new{ending}"
    other.write_text("of points.shp")
    code, said = call("export csv")
    assert code == 3
    assert f"new{ending}: exists and was not made by optnav" in said
    assert other.read_text() == "of points.shp"
    assert not (tmp_path / "new.csv").exists()
    other.unlink()
    assert [call("export csv")[0], call("export csv")[0]] == [0, 0]
    assert {path.name for path in tmp_path.glob("new*")} == {"new.csv", "new.prj", "new.csvt"}
