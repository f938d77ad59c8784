"""`--log-file` has one event for each frame and one for each stage, with their fields."""

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from catalog.bodies.body import load_body
from optnav_cli import console
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.frames.truth import Truth, write_truth
from optnav_cli.main import run
from tests.catalog.pipeline.coarse_tycho import BBOX, CONFIG
from tests.optnav_cli.navigate.test_job import UTC, folder_with, good_frame, write_rough
from tests.optnav_cli.simulation.test_simulation import CAMERA, SMALL

Event = dict[str, Any]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("events")
    (folder / "small.toml").write_text(CAMERA)
    (folder / "scenario.toml").write_text(SMALL)
    (folder / "tycho.toml").write_text(CONFIG)
    return folder


@pytest.fixture(autouse=True)
def _logging_is_put_back() -> Iterator[None]:
    yield
    root = logging.getLogger()
    for handler in root.handlers[:]:
        if isinstance(handler, console.PeopleHandler | console.LogFile):
            root.removeHandler(handler)
            handler.close()
    logging.captureWarnings(False)


def events(place: Path, *words: object, code: int = 0) -> tuple[list[Event], list[Event]]:
    """The events of frames and of stages that a command writes."""
    log = place / "log.jsonl"
    log.unlink(missing_ok=True)
    assert run(["-q", "--log-file", str(log), *map(str, words)]) == code
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    found = [line for line in lines if "stage" in line]
    for event in found:
        assert {"time", "level", "logger", "message"} <= event.keys()
    frames = [event for event in found if "frame" in event]
    return frames, [event for event in found if "frame" not in event]


def told(stages: list[Event]) -> list[tuple[str, str]]:
    assert all(event["seconds"] >= 0.0 for event in stages)
    return [(event["stage"], event["status"]) for event in stages]


def test_a_build_has_an_event_for_each_stage_a_simulation_for_each_picture(place: Path) -> None:
    box = ",".join(map(str, BBOX))
    build = "build", place / "tycho.toml", "-o", place / "c.gpkg", "--workers", 1, "--bbox", box
    frames, stages = events(place, *build)
    assert frames == []
    wanted = ["ingest", "render", "select", "check", "write"]
    assert told(stages) == [(name, "done") for name in wanted]
    simulate = "simulate", place / "scenario.toml", "-o", place / "pictures"
    frames, stages = events(place, *simulate)
    assert told(stages) == [("simulate", "done")]
    assert [event["frame"] for event in frames] == [f"frame_000{n}.png" for n in range(4)]
    assert {event["status"] for event in frames} == {"simulated"}
    assert sum(event["seconds"] for event in frames) > 0.0
    (place / "small.toml").unlink()
    frames, stages = events(place, *simulate, code=3)
    assert (frames, told(stages)) == ([], [("simulate", "failed")])


def test_a_run_and_its_evaluation_have_an_event_for_each_frame(
    place: Path, rough_world: Any
) -> None:
    pictures, run_folder, catalog = place / "rough", place / "run", place / "rough.gpkg"
    pose, sun = rough_world.pose(100e3, roll=0.1), rough_world.sun(30.0, 200.0)
    taken = rough_world.picture(pose, sun, noise_seed=7), pose, sun
    names = ["a.png", "b.png", "empty.png"]
    folder_with(pictures, rough_world, [good_frame(name, taken) for name in names])
    for name in names:
        cv2.imwrite(str(pictures / name), taken[0].astype(np.uint8) * (name != "empty.png"))
    write_rough(rough_world, catalog, "moon")
    truths = [Truth(n, UTC, 0.0, pose.position_m, pose.camera_from_body) for n in names]
    attitude = FileAttitude("camera_from_body", load_body("moon"))
    write_truth(pictures / "truth.csv", attitude, truths)

    navigate = "navigate", pictures, "--catalog", catalog, "-o", run_folder, "--workers", 2
    frames, stages = events(place, *navigate)
    assert told(stages) == [("navigate", "done")]
    assert [event["frame"] for event in frames] == names
    assert [event["status"] for event in frames] == ["solved", "solved", "unsolved"]
    assert [event["method"] for event in frames] == ["control_points", "control_points", None]
    assert [event["reason_code"] for event in frames] == [None, None, "bad_picture"]
    assert [event["level"] for event in frames] == ["debug", "debug", "warning"]
    assert sum(event["seconds"] for event in frames) > 0.0

    again, stages = events(place, *navigate)  # nothing to do any more
    assert [event["frame"] for event in again] == names
    assert told(stages) == [("navigate", "done")]
    compared, stages = events(place, "evaluate", run_folder, "--truth", pictures / "truth.csv")
    assert told(stages) == [("evaluate", "done")]
    assert [(e["frame"], e["method"]) for e in compared] == [
        (e["frame"], e["method"]) for e in frames
    ]
    frames, stages = events(place, "report", run_folder, "-o", place / "report.html")
    assert (frames, told(stages)) == ([], [("report", "done")])
