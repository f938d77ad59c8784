"""Reports about runs: whole pages with nothing loaded from outside, for good and odd ones."""

import re
import xml.etree.ElementTree as ET

import cv2
import numpy as np
import pytest

from catalog.errors import DataError, OutputError
from optnav_cli.evaluation.files import evaluate_run, write_evaluation
from optnav_cli.output.overlay import write_overlay
from optnav_cli.output.run_folder import read_run
from optnav_cli.reasons import ReasonCode
from optnav_cli.report import write_report
from optnav_cli.report.error_plots import frames_of
from tests.optnav_cli.output.approach import write_approach
from tests.optnav_cli.report.browser import Browser
from tests.optnav_cli.report.pages import report_of


@pytest.fixture
def run(tmp_path, make_run):
    folder = tmp_path / "run <1>"
    make_run(folder, count=20, unsolved_from=18)
    rng = np.random.default_rng(1)
    picture = cv2.GaussianBlur(rng.normal(size=(512, 512)).astype(np.float32), (0, 0), 5)
    loaded = read_run(folder)
    for solution in loaded.solutions[:4]:
        rows = [m for m in loaded.matches if m.file == solution.file]
        write_overlay(folder / "overlays", picture, solution, rows)
    return folder


def test_a_run_without_a_truth_says_so_and_shows_its_stated_sigmas(run, tmp_path):
    page = report_of(run, tmp_path)
    assert "18 of 20" in page.text
    assert "Not compared with a truth" in page.text
    assert "Moon: run run <1>" in page.text
    assert page.counts["img"] == 4
    assert "fewer than two control points matched" in page.text


def test_an_evaluated_run_shows_errors_by_axis_with_their_bands(run, tmp_path):
    evaluation = evaluate_run(run, run / "truth.csv")
    write_evaluation(evaluation, run)
    page = report_of(run, tmp_path)
    figures = evaluation.figures()
    assert f"{figures.horizontal_rms_m:.1f} m" in page.text
    assert f"{figures.height_rms_m:.1f} m" in page.text
    text = (tmp_path / "report.html").read_text()
    assert len(re.findall(r'class="band s1"', text)) == 3
    assert "Of 144 control points used, 18 were found more than 3 px" in page.text


def test_the_same_run_gives_the_same_page(run, tmp_path):
    for name in ("one.html", "other.html"):
        write_report(run, tmp_path / name)
    assert (tmp_path / "one.html").read_bytes() == (tmp_path / "other.html").read_bytes()


def test_what_users_wrote_cannot_become_markup(run, tmp_path):
    table = (run / "solution.csv").read_text()
    (run / "solution.csv").write_text(table.replace("fewer than two", "<script>alert(1)</script>"))
    page = report_of(run, tmp_path)
    assert "<script>alert(1)</script>" in page.text


def test_a_run_without_a_solved_frame_still_gets_a_page(tmp_path, make_run):
    make_run(tmp_path / "run", count=3, unsolved_from=0)
    page = report_of(tmp_path / "run", tmp_path)
    assert "0 of 3" in page.text
    assert "Unsolved frames" in page.text


def test_one_solved_frame_is_enough_for_all_drawings(tmp_path, make_run):
    make_run(tmp_path / "run", count=1)
    write_evaluation(evaluate_run(tmp_path / "run", tmp_path / "run/truth.csv"), tmp_path / "run")
    page = report_of(tmp_path / "run", tmp_path)
    assert "N is local north for 1 frames" in page.text


def test_damaged_and_foreign_sources_are_named(run, tmp_path):
    (run / "evaluation.json").write_text("{}")
    with pytest.raises(DataError, match=r"evaluation\.json: is damaged .*evaluate` again"):
        write_report(run, tmp_path / "report.html")
    with pytest.raises(DataError, match="there is no such run or catalog"):
        write_report(tmp_path / "nothing", tmp_path / "report.html")
    (tmp_path / "letter.txt").write_text("Dear Sir")
    with pytest.raises(DataError, match=r"letter\.txt"):
        write_report(tmp_path / "letter.txt", tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()


def test_an_older_report_is_replaced_and_another_page_is_not(run, tmp_path):
    report_of(run, tmp_path)
    report_of(run, tmp_path)
    (tmp_path / "index.html").write_text("<!doctype html><p>mine</p>")
    with pytest.raises(OutputError, match="was not made by optnav"):
        write_report(run, tmp_path / "index.html")


def test_a_browser_draws_the_page_of_a_run_without_a_complaint(run, tmp_path):
    write_evaluation(evaluate_run(run, run / "truth.csv"), run)
    write_report(run, tmp_path / "report.html")
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(tmp_path / "report.html")
        drawn = browser.picture()
    finally:
        browser.close()
    assert browser.complaints == []
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 50


def test_an_approach_shows_methods_over_time_and_height_and_why_frames_are_unsolved(tmp_path):
    folder = tmp_path / "run"
    planted = write_approach(folder)
    stated = report_of(folder, tmp_path)
    assert sum(label.startswith("Stated sigma") for label in stated.labels) == 5
    write_evaluation(evaluate_run(folder, folder / "truth.csv"), folder)
    page = report_of(folder, tmp_path)
    assert sum(label.startswith("Error of the") for label in page.labels) == 2
    assert "By method" in page.text
    assert "brightness centre, shnk: " in page.text
    assert "2 × only the terminator is in view; 2 × the body is cut" in page.text
    text = (tmp_path / "report.html").read_text()
    unsolved = [file for file, (_, method, _) in planted.items() if method is None]
    # a cross in each of three plots over time and two over height
    for file in unsolved:
        assert text.count(f"<title>{file}: ") == 5
    assert text.count('class="mark s3 hollow"') == 5 * 5 + 2  # brightness centre, and legends


def test_a_run_at_one_height_is_not_drawn_over_height(run, tmp_path):
    write_evaluation(evaluate_run(run, run / "truth.csv"), run)
    page = report_of(run, tmp_path)
    assert not any("over the height" in label for label in page.labels)


def test_errors_of_one_kind_are_drawn_with_their_signs(run, tmp_path):
    write_evaluation(evaluate_run(run, run / "truth.csv"), run)
    frames = frames_of(read_run(run))
    errors = np.array([row.error_rnb_m for row in frames.rows if row.solved])
    assert errors.min() < 0.0 < errors.max()
    report_of(run, tmp_path)
    text = (tmp_path / "report.html").read_text()
    first = text[text.index("<svg ") :].split("</svg>")[0]
    places = [float(y) for y in re.findall(r'class="mark s1"[^>]*cy="([^"]+)"', first)]
    assert len(places) == 18
    # up is up: the greatest error is drawn highest
    assert int(np.argmin(places)) == int(np.argmax(errors[:, 0]))


def test_the_errors_of_a_run_can_be_had_as_a_picture_alone(tmp_path):
    folder = tmp_path / "run"
    write_approach(folder)
    write_evaluation(evaluate_run(folder, folder / "truth.csv"), folder)
    write_report(folder, tmp_path / "errors.svg")
    root = ET.parse(tmp_path / "errors.svg").getroot()
    labels = [e.get("aria-label") for e in root.findall("{http://www.w3.org/2000/svg}svg")]
    assert len(labels) == 5
    assert "over the height" in labels[-1]
    with pytest.raises(DataError, match=r"only the errors of a run are drawn as SVG"):
        write_report(tmp_path / "errors.svg", tmp_path / "other.svg")


def test_a_run_without_a_solved_frame_has_no_picture(tmp_path, make_run):
    make_run(tmp_path / "run", count=3, unsolved_from=0)
    with pytest.raises(DataError, match=r"no frame is solved"):
        write_report(tmp_path / "run", tmp_path / "errors.svg")


def test_matches_refused_for_one_reason_are_counted_together(tmp_path, make_run):
    make_run(tmp_path / "run", count=2)
    table = (tmp_path / "run" / "matches.csv").read_text()
    assert table.count("score below the threshold") == 4
    for number in range(4):
        table = table.replace("score below the threshold", f"score 0.1{number} below 0.30", 1)
    (tmp_path / "run" / "matches.csv").write_text(table)
    assert f"{ReasonCode.LOW_SCORE.meaning} 4" in report_of(tmp_path / "run", tmp_path).text
