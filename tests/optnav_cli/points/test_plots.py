"""Picked points on the page and in the picture of a run."""

from pathlib import Path

from catalog.progress import SilentProgress
from optnav_cli.main import run
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.output.run_folder import read_run
from optnav_cli.pages import write_report
from optnav_cli.points.plots import draw_picked_sheet, is_picked


def test_a_run_of_picked_points_has_maps_and_error_ellipses(tmp_path: Path) -> None:
    assert run(["-q", "config", "template", "points", "-o", str(tmp_path / "picked")]) == 0
    made = tmp_path / "run"
    navigate_folder(RunInputs(tmp_path / "picked", []), made, SilentProgress(), workers=1)
    found = read_run(made)
    assert is_picked(found)
    drawn = draw_picked_sheet(found)
    for name in ("iss_1.jpg", "iss_2.jpg", "iss_3.jpg"):
        assert f"Picked points of {name}" in drawn
        assert f"Error ellipse of the place of {name}" in drawn
    # the blunder of the second picture is crossed out, with its name and reason
    assert drawn.count('class="mark stroke s4"') >= 1
    assert "site 2-07" in drawn or "<title>site 2" in drawn
    write_report(made, tmp_path / "run.html")
    assert "Error ellipse of the place" in (tmp_path / "run.html").read_text(encoding="utf-8")
    write_report(made, tmp_path / "run.svg")
    assert (tmp_path / "run.svg").read_text(encoding="utf-8") == drawn
