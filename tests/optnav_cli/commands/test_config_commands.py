"""`optnav config`: what it lists can be used, what it makes loads and runs."""

import json
from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.config import resolve_config
from catalog.errors import OptnavError
from catalog.pipeline.config import ConfigText
from catalog.terrain.dem.file import resolve_path
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.tables import FRAMES
from optnav_cli.main import run
from optnav_cli.output.run_folder import read_run
from optnav_cli.simulation.scenario import load_scenario

KINDS = ("cameras", "bodies", "scenarios", "catalogs", "orbits", "imports", "data")
# Where the camera of the template's picture was: the simulation's own truth.
TRUE_POSITION_M = (7657076.7529, 5137325.5228, 3129540.0353)


def listed(capsys: pytest.CaptureFixture[str], *kind: str) -> dict[str, list[dict[str, str]]]:
    assert run(["config", "list", *kind, "--json"]) == 0
    found: dict[str, list[dict[str, str]]] = json.loads(capsys.readouterr().out)
    return found


def test_every_name_that_is_listed_can_be_used(capsys: pytest.CaptureFixture[str]) -> None:
    found = listed(capsys)
    assert tuple(found) == KINDS
    for entry in found["cameras"]:
        assert preset_camera(entry["name"]).name
    for entry in found["bodies"]:
        assert load_body(entry["name"]).radius_m > 0.0
    for entry in found["scenarios"]:
        assert load_scenario(resolve_config(Path(entry["name"]), "scenarios"))
    for entry in found["catalogs"]:
        assert ConfigText.read(Path(entry["name"])).load()
    for entry in found["data"]:
        assert resolve_path(entry["name"], Path()).is_file()
    for entries in found.values():
        assert entries
        for entry in entries:
            assert entry["description"]
            assert entry["name"].removeprefix("bundled:") in entry["use"]
            assert Path(entry["path"]).is_file()


@pytest.mark.parametrize("kind", KINDS)
def test_the_lines_for_people_name_what_the_document_holds(
    kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    entries = listed(capsys, kind)[kind]
    assert run(["config", "list", kind]) == 0
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.startswith(f"{kind}: ")
    assert [line.split(maxsplit=1) for line in lines] == [
        [entry["name"], entry["description"]] for entry in entries
    ]


def test_what_ships_not_is_refused_with_what_does(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["simulate", "bundled:dmo", "-o", "nowhere"]) == 3
    assert "demo.toml" in capsys.readouterr().err
    assert run(["config", "list", "pictures"]) == 2


def test_the_folder_template_runs_to_a_clear_answer(tmp_path: Path) -> None:
    place = tmp_path / "pictures"
    assert run(["-q", "config", "template", "folder", "-o", str(place)]) == 0
    folder = read_folder(place)
    assert [frame.problem for frame in folder.frames] == [None]
    assert run(["-q", "navigate", str(place), "-o", str(tmp_path / "run")]) == 0
    (solution,) = read_run(tmp_path / "run").solutions
    assert solution.solved
    off = np.asarray(solution.position_m) - TRUE_POSITION_M
    assert off @ np.linalg.solve(np.asarray(solution.covariance_m2), off) < 11.3  # 99 % of 3 terms
    assert np.linalg.norm(off) < 20e3  # of 8000 km


def test_every_file_of_the_folder_template_says_what_it_holds(tmp_path: Path) -> None:
    place = tmp_path / "pictures"
    assert run(["config", "template", "folder", "-o", str(place)]) == 0
    readme = (place / "README.md").read_text()
    for path in place.rglob("*"):
        if path.is_file():
            assert f"`{path.relative_to(place).as_posix()}`" in readme
            assert path.suffix != ".toml" or path.read_text().startswith("# ")
    for column in FRAMES.columns:
        assert f"| `{column.name}` | {column.unit} | {column.meaning}" in readme


def test_a_folder_template_never_takes_the_place_of_somebodys_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "pictures"
    words = ["config", "template", "folder", "-o", str(place)]
    place.mkdir()
    assert run(words) == 0
    (place / "frames.csv").write_text("my own rows")
    assert run(words) == 3
    assert "is not empty" in capsys.readouterr().err
    assert (place / "frames.csv").read_text() == "my own rows"


@pytest.mark.parametrize("words", [["folder"], ["build", "-o", "x.toml"]])
def test_a_folder_needs_a_place_and_a_config_takes_none(words: list[str]) -> None:
    assert run(["config", "template", *words]) == 2


def test_rasters_alone_make_a_config_that_says_the_same_anywhere(tmp_path: Path) -> None:
    rasters = [tmp_path / "a" / 'fine "1".tif', tmp_path / "b" / "coarse.tif"]
    text = ConfigText.make_from_rasters(rasters, "moon")
    config = text.load()
    assert config.body.name == "moon"
    assert [(dem.path, dem.priority) for dem in config.dem] == [
        ('fine "1".tif', 1),
        ("../b/coarse.tif", 2),
    ]
    bundled = ConfigText.make_from_rasters([Path("bundled:moon_gld100_4ppd.tif")], "moon").load()
    assert bundled.dem[0].path == "bundled:moon_gld100_4ppd.tif"
    own = ConfigText.make_from_rasters(rasters, str(tmp_path / "mine.toml")).load()
    assert own.body.name == "../mine.toml"
    with pytest.raises(OptnavError, match="rename it"):
        ConfigText.make_from_rasters([Path("a\udcff.tif")], "moon")
