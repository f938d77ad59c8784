"""Reports: whole pages with nothing loaded from outside, for runs and catalogs, good and odd."""

import re
import shutil
import subprocess
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from catalog.control_point import ControlPoint, Flag, Patch
from catalog.errors import DataError, OutputError
from catalog.geometry.cells import CellGrid
from catalog.store.manifest import CatalogMeta
from catalog.store.writer import write_catalog
from optnav_cli.output.evaluation_files import evaluate_run, write_evaluation
from optnav_cli.output.overlay import write_overlay
from optnav_cli.output.report import catalog_plots, write_report
from optnav_cli.output.run_folder import read_run

RADIUS_M = 1737400.0
VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """Checks that tags close in order, and gathers text, images and outside references."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.references, self.counts = [], [], [], {}
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.references += [v for k, v in attributes if k in ("href", "src", "xlink:href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.counts[tag] = self.counts.get(tag, 0) + 1
        self.references += [v for k, v in attributes if k in ("href", "src")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def report_of(source, tmp_path):
    out = tmp_path / "report.html"
    write_report(source, out)
    text = out.read_text(encoding="utf-8")
    page = Page(text)
    assert [r for r in page.references if not r.startswith(("data:", "#"))] == []
    assert "<script" not in text
    assert "@import" not in text
    assert "nan" not in "".join(re.findall(r'(?:points|cx|cy|x|y|height|width)="[^"]*"', text))
    return page


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
    with pytest.raises(OutputError, match="left alone"):
        write_report(run, tmp_path / "index.html")


def a_catalog(path, count=40, lat=(-48.0, -38.0), lon=(-17.0, -5.0), step_deg=0.5, usable=True):
    """A made-up catalog over a region; every fifth point is flat."""
    rng = np.random.default_rng(8)
    grid = CellGrid(step_deg)
    places = np.column_stack([rng.uniform(*lat, 6 * count), rng.uniform(*lon, 6 * count)])
    cells = np.asarray(grid.cell_of(places[:, 0], places[:, 1]))
    ids, first = np.unique(cells, return_index=True)
    pyramids = []
    for number, (cell, index) in enumerate(zip(ids[:count], first[:count], strict=True)):
        flat = number % 5 == 0 or not usable
        hills = cv2.GaussianBlur(rng.normal(size=(32, 32)).astype(np.float32), (0, 0), 3) * 900.0
        pyramids.append(
            (
                ControlPoint(
                    id=int(cell),
                    lat_deg=float(places[index, 0]),
                    lon_deg=float(places[index, 1]),
                    radius_m=RADIUS_M,
                    localisation_px=float(rng.uniform(0.1, 0.5)),
                    hessian_eigenvalue=float(rng.uniform(0.1, 3.0)),
                    recognition_rate=float(rng.integers(3, 6)) / 5.0,
                    trials=5,
                    uniqueness=(0.3, 0.4),
                    shadow_limit_deg=tuple(rng.uniform(0.0, 12.0, 36)),
                    usable=not flat,
                    flags=Flag.FLAT if flat else Flag.NONE,
                    source="dem.tif",
                ),
                tuple(Patch(118.0 * 2**level, hills) for level in range(2)),
            )
        )
    meta = CatalogMeta(
        "moon", RADIUS_M, step_deg, 2, 32, 118.0, 0.1, {"dem.tif": "<sha>"}, "[body]\n",
        "optnav 0", "", ("dem.tif",),
    )  # fmt: skip
    write_catalog(path, meta, pyramids)
    return path


def test_a_catalog_shows_its_points_scores_patches_and_sources(tmp_path):
    page = report_of(a_catalog(tmp_path / "c.gpkg"), tmp_path)
    assert "40 control points, 32 usable; 2 levels of 32 nodes" in page.text
    assert page.counts["img"] == 6 * 2
    assert "too flat to be located 8" in page.text
    assert "<sha>" in page.text
    text = (tmp_path / "report.html").read_text()
    assert len(re.findall('<circle class="dot s1"', text)) == 32


def test_a_catalog_without_a_usable_point_still_gets_a_page(tmp_path):
    page = report_of(a_catalog(tmp_path / "c.gpkg", usable=False), tmp_path)
    assert "40 control points, 0 usable" in page.text


@pytest.mark.parametrize(
    ("lat", "lon"), [((-90.0, 90.0), (-180.0, 180.0)), ((80.0, 90.0), (-180.0, 180.0))]
)
def test_many_points_are_painted_and_all_of_a_body_or_a_pole_fits(tmp_path, monkeypatch, lat, lon):
    monkeypatch.setattr(catalog_plots, "MOST_DOTS", 10)
    page = report_of(a_catalog(tmp_path / "c.gpkg", lat=lat, lon=lon, step_deg=2.0), tmp_path)
    assert page.counts["image"] == 1
    text = (tmp_path / "report.html").read_text()
    assert 'class="dot' not in text


def test_a_browser_draws_the_page_without_a_complaint(run, tmp_path):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("needs chromium to draw the page")
    write_evaluation(evaluate_run(run, run / "truth.csv"), run)
    write_report(run, tmp_path / "report.html")
    flags = [
        *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync"),
        *("--disable-background-networking", "--enable-logging=stderr", "--hide-scrollbars"),
        f"--user-data-dir={tmp_path / 'profile'}",
        "--window-size=1000,1600",
        f"--screenshot={tmp_path / 'page.png'}",
    ]
    done = subprocess.run(
        [browser, *flags, (tmp_path / "report.html").as_uri()],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert done.returncode == 0
    assert "CONSOLE" not in done.stderr
    drawn = cv2.imread(str(tmp_path / "page.png"))
    assert drawn.shape == (1600, 1000, 3)
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 50
