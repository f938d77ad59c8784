"""Reports about runs: whole pages with nothing loaded from outside, for good and odd ones."""

import base64
import csv
import json
import os
import re
import struct
import xml.etree.ElementTree as ET
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.errors import DataError, OutputError
from catalog.files import MADE_BY
from optnav_cli.evaluation.files import evaluate_run, write_evaluation
from optnav_cli.navigate.page import read_evaluation
from optnav_cli.output.canvas import scale_to_eight_bits
from optnav_cli.output.overlay import encode_overlay, overlay_path
from optnav_cli.output.run_folder import read_run
from optnav_cli.pages import write_report
from optnav_cli.reasons import ReasonCode
from optnav_cli.report.error_plots import collect_frames
from optnav_cli.report.relief import plot_ground
from tests.optnav_cli.output.approach import write_approach
from tests.optnav_cli.report.browser import Browser
from tests.optnav_cli.report.pages import a_catalog, report_of


@pytest.fixture
def run(tmp_path, make_run):
    folder = tmp_path / "run <1>"
    make_run(folder, count=20, unsolved_from=18)
    rng = np.random.default_rng(1)
    picture = cv2.GaussianBlur(rng.normal(size=(512, 512)).astype(np.float32), (0, 0), 5)
    loaded = read_run(folder)
    for solution in loaded.solutions[:4]:
        rows = tuple(m for m in loaded.matches if m.file == solution.file)
        tried = replace(solution.outcome, evidence=replace(solution.evidence, matches=rows))
        place = overlay_path(folder / "overlays", solution.file)
        place.parent.mkdir(exist_ok=True)
        place.write_bytes(
            encode_overlay(scale_to_eight_bits(picture), replace(solution, outcome=tried))
        )
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
    assert len(re.findall(r'class="band s1"', text)) == 2 * 3  # for wide pages and for telephones
    assert "Of 144 control points used, 18 were found more than 3 px" in page.text


def svg_of(text, label):
    """The drawings whose description begins so."""
    parts = re.findall(r"<svg .*?</svg>", text, re.DOTALL)
    return [part for part in parts if f'aria-label="{label}' in part]


def test_frames_more_than_ten_minutes_apart_are_not_joined(tmp_path, make_run):
    folder = tmp_path / "run"
    make_run(folder, count=8)
    write_evaluation(evaluate_run(folder, folder / "truth.csv"), folder)
    report_of(folder, tmp_path)
    whole = (tmp_path / "report.html").read_text()
    for name in ("solution.csv", "truth.csv"):  # the last three frames come a day later
        lines = (folder / name).read_text().splitlines(keepends=True)
        later = [line.replace("2023-08-17T", "2023-08-18T") for line in lines[6:]]
        (folder / name).write_text("".join(lines[:6] + later))
    write_evaluation(evaluate_run(folder, folder / "truth.csv"), folder)
    report_of(folder, tmp_path)
    cut = (tmp_path / "report.html").read_text()
    for text, passes in ((whole, 1), (cut, 2)):
        (ground,) = svg_of(text, "Map of the run")
        assert ground.count('class="line s2 thin"') == passes
        assert text.count('class="band s1"') == passes * 2 * 3


def test_the_map_of_a_wide_run_has_the_relief_of_the_bundled_moon(tmp_path, make_run):
    make_run(tmp_path / "run", count=4)
    run = read_run(tmp_path / "run")
    assert "Relief" not in plot_ground(run)  # over 200 km it would be a blur
    turned = Rotation.from_euler("z", [[0.0], [60.0], [120.0], [180.0]], degrees=True)
    far = [
        replace(s, outcome=replace(s.outcome, position_m=turn.apply(s.position_m)))
        for s, turn in zip(run.solutions, turned, strict=True)
    ]
    drawn = plot_ground(replace(run, solutions=far))
    assert "bundled" in drawn
    assert 'class="pale"' in drawn


def test_the_map_has_the_relief_of_the_catalog_if_that_is_still_there(tmp_path, make_run):
    folder = tmp_path / "run"
    make_run(folder, count=2)
    foreign = tmp_path / "letter.txt"
    foreign.write_text("Dear Sir")
    named = [tmp_path / "gone.gpkg", foreign, crowded_catalog(tmp_path / "c.gpkg")]
    manifest = {"made_by": MADE_BY, "inputs": {"catalogs": [{"path": str(p)} for p in named]}}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    assert "own height grids" in plot_ground(read_run(folder))


def crowded_catalog(path):
    """Points so near to each other that their patches cover the ground between them."""
    return a_catalog(path, 900, (-44.0, -40.0), (-14.0, -8.0), step_deg=0.2, levels=4)


def test_there_is_one_figure_of_the_residuals(run, tmp_path):
    text = report_of(run, tmp_path).text
    figures = set(re.findall(r"(\d+\.\d+) px", text))
    used = np.array([m.residual_px for m in read_run(run).matches if m.used])
    assert figures == {f"{np.sqrt(np.mean(used**2)):.2f}"}
    assert text.count("rms a coordinate") == 2  # at the top, and beside the cloud


def test_each_overlay_is_on_the_page_once_and_whole_on_a_click(run, tmp_path):
    page = report_of(run, tmp_path)
    text = (tmp_path / "report.html").read_text()
    uris = re.findall(r'<img src="data:image/jpeg;base64,([^"]+)"', text)
    assert len(uris) == len(set(uris)) == 4
    first = cv2.imdecode(np.frombuffer(base64.b64decode(uris[0]), np.uint8), 1)
    assert first.shape[1] == 512  # the overlay's own size
    ids = set(re.findall(r'id="([^"]+)"', text))
    links = {ref[1:] for ref in page.references if ref.startswith("#")}
    assert {"pictures", *(f"picture{k}" for k in range(4))} <= links <= ids


def test_pictures_take_a_bounded_part_of_the_page(tmp_path, make_run):
    make_run(tmp_path / "run", count=26)
    noise = np.random.default_rng(3).integers(0, 255, (700, 700, 3), np.uint8)
    (tmp_path / "run" / "overlays").mkdir()
    for number in range(26):
        cv2.imwrite(str(tmp_path / "run" / "overlays" / f"frame_{number:04d}.png.png"), noise)
    page = report_of(tmp_path / "run", tmp_path)
    assert page.counts["img"] == 24
    assert (tmp_path / "report.html").stat().st_size < 8e6


def test_a_run_that_tried_no_control_points_says_nothing_of_them(tmp_path):
    folder = tmp_path / "run"
    write_approach(folder)
    lines = (folder / "solution.csv").read_text().splitlines(keepends=True)
    rows = [line for line in lines if "control_points" not in line]
    (folder / "solution.csv").write_text("".join(rows))
    page = report_of(folder, tmp_path)
    assert "brightness centre" in page.text
    assert "control point" not in page.text
    assert "predicted" not in page.text


def test_a_damaged_evaluation_is_noted_and_the_page_made_without_it(run, tmp_path):
    write_evaluation(evaluate_run(run, run / "truth.csv"), run)
    for text in (b"[]", b"{", 100_000 * b"[", b"7", b"null", b'"r"', b"\xff\xfe", b"{}"):
        (run / "evaluation.json").write_bytes(text)
        figures, note = read_evaluation(run)
        assert figures is None
        assert "evaluation.json is damaged" in note
    (run / "evaluation.json").unlink()
    os.mkfifo(run / "evaluation.json")  # opening it would wait for ever
    page = report_of(run, tmp_path)
    assert "evaluation.json is damaged" in page.text
    assert "run `optnav evaluate` again" in page.text
    assert "18 of 20" in page.text


def test_pipes_in_the_place_of_a_run_s_files_are_not_waited_for(run, tmp_path):
    os.mkfifo(run / "evaluation.json")
    overlay = overlay_path(run / "overlays", "frame_0000.png")
    overlay.parent.mkdir(exist_ok=True)
    overlay.unlink(missing_ok=True)
    os.mkfifo(overlay)
    assert "evaluation.json is damaged" in report_of(run, tmp_path).text


@pytest.mark.parametrize("key", ["horizontal_rms_m", "normalised_error_squared", "bias_m"])
def test_no_figure_of_an_evaluation_that_is_no_number_is_shown(run, key):
    write_evaluation(evaluate_run(run, run / "truth.csv"), run)
    stored = (run / "evaluation.json").read_text()
    for value in ("NaN", "Infinity", "1e999", '"seven"', "null", "[]"):
        damaged = re.sub(rf'("{key}": )[-\d.]+', rf"\g<1>{value}", stored)
        (run / "evaluation.json").write_text(damaged)
        figures, note = read_evaluation(run)
        assert figures is None
        assert "evaluation.json is damaged" in note


@pytest.mark.parametrize("value", ["nan", "1e308", "what", "-1e200"])
def test_damaged_errors_of_frames_are_left_out_or_noted(run, tmp_path, value):
    write_evaluation(evaluate_run(run, run / "truth.csv"), run)
    lines = (run / "evaluation.csv").read_text().splitlines()
    column = lines[0].split(",").index("error_r_m")
    cells = lines[3].split(",")
    cells[column] = value
    (run / "evaluation.csv").write_text("\n".join([*lines[:3], ",".join(cells), *lines[4:], ""]))
    page = report_of(run, tmp_path)
    assert ("error_r_m" in page.text) == (value in ("nan", "what"))
    cells = re.sub(r"\d+\.\d+", value, "\n".join(lines[1:]))
    (run / "evaluation.csv").write_text(f"{lines[0]}\n{cells}\n")
    assert "run `optnav evaluate` again" in report_of(run, tmp_path).text


def test_a_residual_beyond_all_bounds_is_left_out(run, tmp_path):
    lines = (run / "matches.csv").read_text().splitlines()
    cells = lines[1].split(",")
    cells[lines[0].split(",").index("residual_x_px")] = "1e308"
    (run / "matches.csv").write_text("\n".join([lines[0], ",".join(cells), *lines[2:], ""]))
    used = sum(m.used for m in read_run(run).matches)
    assert f"Residuals of the {used - 1} matches used" in report_of(run, tmp_path).text


def test_overlays_that_cannot_be_read_are_named(run, tmp_path):
    overlays = run / "overlays"
    (overlays / "frame_0000.png.png").write_bytes(b"\x89PNG\r\n\x1a\n" + 40 * b"x")
    (overlays / "frame_0001.png.png").write_bytes(b"no picture")
    huge = struct.pack(">II", 60_000, 60_000)
    whole = (overlays / "frame_0002.png.png").read_bytes()
    (overlays / "frame_0002.png.png").write_bytes(whole[:16] + huge + whole[24:])
    page = report_of(run, tmp_path)
    assert page.counts["img"] == 1
    names = "frame_0000.png, frame_0001.png, frame_0002.png"
    assert f"3 overlays cannot be read: {names}" in page.text


def test_a_damaged_manifest_is_noted(run, tmp_path):
    (run / "manifest.json").write_text('{"made_by": "somebody"}')
    assert "was not written by optnav" in report_of(run, tmp_path).text
    made = {"made_by": MADE_BY, "inputs": {"catalogs": [3, {"path": 4}, {"path": "\0"}]}}
    (run / "manifest.json").write_text(json.dumps(made))
    assert "manifest.json" in report_of(run, tmp_path).text


def test_the_plots_over_time_are_there_again_for_telephones(run, tmp_path):
    write_report(run, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    for kind, width in (("wider", 960), ("narrow", 400)):
        drawings = re.findall(rf'<div class="{kind}">(.*?)</div>', text, re.DOTALL)
        sizes = [
            float(size) for part in drawings for size in re.findall(r'viewBox="0 0 (\d+)', part)
        ]
        # numbers of 11 units on the 368 px that a page of 390 px has for a drawing
        assert sizes == [width] * 3
    assert 11.0 * 368.0 / 400.0 > 10.0


def test_letters_of_all_drawings_are_legible_on_a_telephone(run, tmp_path):
    write_evaluation(evaluate_run(run, run / "truth.csv"), run)
    write_report(run, tmp_path / "report.html")
    browser = Browser(tmp_path / "profile")
    try:
        browser.open(tmp_path / "report.html", width=390)
        sizes = browser.ask(
            "[...document.querySelectorAll('main svg text')]"
            ".filter(t => t.getClientRects().length).map(t => { const s = t.closest('svg');"
            " const scale = s.getBoundingClientRect().width / s.viewBox.baseVal.width;"
            " return parseFloat(getComputedStyle(t).fontSize) * scale; })"
        )
        wide = browser.ask("document.documentElement.scrollWidth")
    finally:
        browser.close()
    assert len(sizes) > 50
    assert min(sizes) >= 10.0
    assert wide <= 390


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


def test_foreign_sources_are_named(tmp_path):
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


@pytest.mark.parametrize(
    ("least", "most"), [("5e-324", "1.0"), ("1e-320", "1e308"), ("3.0", "5.0")]
)
def test_sigmas_of_any_size_can_be_drawn(tmp_path, least, most):
    folder = tmp_path / "run"
    write_approach(folder)
    write_evaluation(evaluate_run(folder, folder / "truth.csv"), folder)
    rows = list(csv.DictReader((folder / "evaluation.csv").read_text().splitlines()))
    solved = [row for row in rows if row["status"] == "solved"]
    for row, size in zip(solved, (least, most), strict=False):
        row.update(dict.fromkeys(("sigma_r_m", "sigma_n_m", "sigma_b_m"), size))
    with (folder / "evaluation.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    assert "Error of the" in " ".join(report_of(folder, tmp_path).labels)


def test_an_approach_shows_methods_over_time_and_height_and_why_frames_are_unsolved(tmp_path):
    folder = tmp_path / "run"
    planted = write_approach(folder)
    stated = report_of(folder, tmp_path)
    assert sum(label.startswith("Stated sigma") for label in stated.labels) == 2 * 5
    write_evaluation(evaluate_run(folder, folder / "truth.csv"), folder)
    page = report_of(folder, tmp_path)
    assert sum(label.startswith("Error of the") for label in page.labels) == 2 * 2
    assert "By method" in page.text
    assert "brightness centre, shnk: " in page.text
    assert "2 × no limb; 2 × cut disc" in page.text
    text = (tmp_path / "report.html").read_text()
    unsolved = [file for file, (_, method, _) in planted.items() if method is None]
    # a cross in each of three plots over time and two over height
    for file in unsolved:
        assert text.count(f"<title>{file}: ") == 2 * 5
    assert text.count('class="mark s3 hollow"') == 2 * 5 * 5 + 2  # brightness centre, and legends


def test_a_run_at_one_height_is_not_drawn_over_height(run, tmp_path):
    write_evaluation(evaluate_run(run, run / "truth.csv"), run)
    page = report_of(run, tmp_path)
    assert not any("over the height" in label for label in page.labels)


def test_errors_of_one_kind_are_drawn_with_their_signs(run, tmp_path):
    write_evaluation(evaluate_run(run, run / "truth.csv"), run)
    frames = collect_frames(read_run(run))
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
