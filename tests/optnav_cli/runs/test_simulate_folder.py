"""A simulated folder appears whole or not at all, and never over somebody else's files."""

from pathlib import Path
from typing import Any

import pytest

from catalog.config import resource
from catalog.errors import DataError, OutputError
from catalog.progress import SilentProgress
from optnav_cli.output.manifest import read_manifest
from optnav_cli.runs import simulate_folder as module
from optnav_cli.runs.simulate_folder import simulate_folder

SCENARIO = resource("configs/scenarios/demo.toml")


def draw(word: str) -> Any:
    """Stands for the rendering, which takes long and has its own tests."""

    def simulate(scenario: object, folder: Path, progress: object, workers: int | None) -> None:
        (folder / "frame_0000.png").write_text(word)
        if word == "damaged":
            raise DataError("terrain.tif: is truncated")

    return simulate


def test_pictures_are_put_in_place_with_their_manifest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "pictures"
    for word in ("first", "second"):  # the second replaces the first
        monkeypatch.setattr(module, "simulate", draw(word))
        simulate_folder(SCENARIO, place, SilentProgress())
        assert (place / "frame_0000.png").read_text() == word
    manifest = read_manifest(place)
    assert manifest["kind"] == "pictures"
    assert manifest["inputs"]["scenario"]["name"] == "demo.toml"
    assert [path.name for path in tmp_path.iterdir()] == ["pictures"]


def test_a_failure_leaves_the_earlier_pictures_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "pictures"
    monkeypatch.setattr(module, "simulate", draw("first"))
    simulate_folder(SCENARIO, place, SilentProgress())
    monkeypatch.setattr(module, "simulate", draw("damaged"))
    with pytest.raises(DataError):
        simulate_folder(SCENARIO, place, SilentProgress())
    assert (place / "frame_0000.png").read_text() == "first"
    assert [path.name for path in tmp_path.iterdir()] == ["pictures"]


def test_somebody_elses_folder_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "letter.txt").write_text("dear")
    monkeypatch.setattr(module, "simulate", lambda *_: pytest.fail("worked"))
    with pytest.raises(OutputError, match="not empty"):
        simulate_folder(SCENARIO, tmp_path, SilentProgress())
    assert (tmp_path / "letter.txt").read_text() == "dear"
