"""The layout for Foxglove: panels that exist, topics that the recording of the run has."""

import json
import os
import shutil

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from catalog.bodies.body import load_body
from catalog.errors import DataError, OutputError, UsageError
from optnav_cli.main import cli
from optnav_cli.output import foxglove
from optnav_cli.output.recording import Recording
from optnav_cli.output.run_folder import read_run
from optnav_cli.report.foxglove_layout import write_layout
from tests.optnav_cli.output.approach import write_approach


@pytest.fixture
def run(tmp_path):
    write_approach(tmp_path / "run", count=6)
    return tmp_path / "run"


def panels_of(tree):
    if isinstance(tree, str):
        return [tree]
    assert set(tree) == {"first", "second", "direction", "splitPercentage"}
    assert tree["direction"] in ("row", "column")
    assert 0.0 < tree["splitPercentage"] < 100.0
    return panels_of(tree["first"]) + panels_of(tree["second"])


def laid_out(run, tmp_path):
    write_layout(run, tmp_path / "layout.json")
    return json.loads((tmp_path / "layout.json").read_text())


def test_every_panel_stands_in_the_layout_once(run, tmp_path):
    found = laid_out(run, tmp_path)
    shown = panels_of(found["layout"])
    assert sorted(shown) == sorted(found["configById"])
    kinds = sorted(name.split("!")[0] for name in shown)
    assert kinds == ["3D", "Image", "Image", "Plot", "Plot", "Plot", "RosOut"]


def test_its_topics_are_those_of_the_recording_and_its_plots_fields_of_its_schema(run, tmp_path):
    loaded = read_run(run)
    with Recording(tmp_path / "run.mcap", load_body("moon")) as recording:
        for solution in loaded.solutions:
            recording.add_frame(solution, (), loaded.cameras[solution.file])
    with (tmp_path / "run.mcap").open("rb") as file:
        recorded = {c.topic for c in make_reader(file).get_summary().channels.values()}
    unread = laid_out(run, tmp_path)["configById"]
    shutil.copyfile(tmp_path / "run.mcap", run / "run.mcap")
    found = laid_out(run, tmp_path)
    assert sorted(panels_of(found["layout"])) == sorted(found["configById"])
    panels = found["configById"]
    # the rows of this run have neither pictures nor a prior
    assert set(unread) - set(panels) == {"Image!0", "Image!1"}
    assert set(panels["3D!scene"]["topics"]) <= recorded
    missing = set(unread["3D!scene"]["topics"]) - recorded
    assert {topic.rsplit("/", 1)[1] for topic in missing} == {"image", "predicted"}
    for panel in panels.values():
        for path in panel.get("paths", ()):
            topic, field = path["value"].rsplit(".", 1)
            assert topic in recorded
            assert foxglove.SOLUTION["properties"][field]["type"] in ("number", "integer")


def test_a_recording_that_cannot_be_read_leaves_all_topics(run, tmp_path):
    whole = laid_out(run, tmp_path)
    for content in (b"", b"no recording", 500 * b"\xff"):
        (run / "run.mcap").write_bytes(content)
        assert laid_out(run, tmp_path) == whole
    (run / "run.mcap").unlink()
    os.mkfifo(run / "run.mcap")
    assert laid_out(run, tmp_path) == whole


def test_a_topic_that_a_message_path_cannot_hold_stands_in_quotes(run, tmp_path):
    text = (run / "cameras" / "unk.toml").read_text().replace('"unk"', '"wide 1.5"')
    (run / "cameras" / "unk.toml").write_text(text)
    paths = laid_out(run, tmp_path)["configById"]["Plot!sigmas"]["paths"]
    assert any(path["value"] == '"/camera/wide 1.5/solution".sigma_up_m' for path in paths)


def test_the_same_run_gives_the_same_layout_and_a_foreign_file_stays(run, tmp_path):
    first = laid_out(run, tmp_path)
    assert laid_out(run, tmp_path) == first
    (tmp_path / "mine.json").write_text("{}")
    with pytest.raises(OutputError):
        write_layout(run, tmp_path / "mine.json")
    with pytest.raises(UsageError, match=r"end in \.json"):
        write_layout(run, tmp_path / "layout.txt")
    with pytest.raises(DataError):
        write_layout(tmp_path, tmp_path / "layout.json")


def test_the_command_writes_a_layout_with_or_without_a_page(run, tmp_path):
    layout, page = tmp_path / "layout.json", tmp_path / "page.html"
    result = CliRunner().invoke(cli, ["report", str(run), "--foxglove-layout", str(layout)])
    assert (result.exit_code, result.stdout) == (0, f"{layout}\n")
    result = CliRunner().invoke(
        cli, ["report", str(run), "-o", str(page), "--foxglove-layout", str(layout)]
    )
    assert result.exit_code == 0
    assert page.is_file()
    result = CliRunner().invoke(cli, ["report", str(run)])
    assert result.exit_code == 2
