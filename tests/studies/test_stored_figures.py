"""The figures that the documents show are those of the studies, as far as it is cheap to see."""

import re

import pytest
from click.testing import CliRunner

from catalog.config import resource
from catalog.pipeline.build import run
from catalog.progress import SilentProgress
from tests.golden.documents import BENCHES, CHECKOUT, PART, headlines, pick_cells
from tests.golden.headlines import HEADLINES
from tests.studies import apollo, photometry
from tests.studies.__main__ import studies
from tests.studies.registry import STUDIES
from tests.studies.stored import list_stored
from tests.studies.stored import read_stored as stored

README = (CHECKOUT / "tests" / "studies" / "README.md").read_text(encoding="utf-8")
STORED = list_stored()
PLACES = [(name, text, place) for name, texts in HEADLINES.items() for text, place in texts.items()]
NUMBER = re.compile(r"\d+(?:\.\d+)?")
# The figure that each limit column bounds; the stored rows beyond their limit.
BOUNDED = {
    "horizontal_limit_m": "horizontal_rms_m",
    "height_limit_m": "height_rms_m",
    "across_limit_m": "across_rms_m",
    "range_share_limit": "range_share",
    "d_asked": "d_rms",
    "theta_asked": "theta_rms",
}
MISSED = {
    ("navigation_real_mare", 0, "horizontal_rms_m"),
    ("navigation_real_mare", 0, "height_rms_m"),
    ("navigation_real_mare", 1, "height_rms_m"),
    ("points", 27, "found"),
}


def assert_same_tables(found, wanted):
    """The same words, and numbers to 0.1 %."""
    assert [table.title for table in found.tables] == [table.title for table in wanted.tables]
    for table, other in zip(found.tables, wanted.tables, strict=True):
        assert table.columns == other.columns
        for row, other_row in zip(table.rows, other.rows, strict=True):
            for cell, other_cell in zip(row, other_row, strict=True):
                same = isinstance(cell, str) or cell is None
                assert cell == (other_cell if same else pytest.approx(other_cell, rel=1e-3))


@pytest.mark.parametrize("name", STORED)
def test_stored_figures_say_which_run_they_are_from(name):
    report = stored(name)
    assert report.study in {study.name for study in STUDIES}
    assert re.fullmatch(r"[0-9a-f]{12}", report.commit)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", report.date)


def test_all_stored_figures_are_named_and_every_study_has_a_row() -> None:
    names = {study.name for study in STUDIES}
    assert {stored(name).study for name in STORED} == names
    assert set(HEADLINES) == names
    rows = {row.split("`")[1]: row for row in headlines().splitlines()[2:]}
    assert list(rows) == list(HEADLINES)
    assert headlines() in README
    shown = (CHECKOUT / "tests" / "bench" / "README.md").read_text(encoding="utf-8")
    benches = {words.strip() for _, part, words in PART.findall(shown) if part == "bench"}
    assert benches == {path.stem for path in BENCHES.glob("*.json")}


@pytest.mark.parametrize("name", STORED)
def test_every_stored_figure_is_shown_on_demand(name: str) -> None:
    report = stored(name)
    done = CliRunner().invoke(studies, ["show", name])
    assert done.exit_code == 0
    for table in report.tables:
        for line in (table.title, *table.to_markdown().splitlines()):
            assert line in done.stdout
        for row in table.rows:
            cells = (c.shown(cell) for c, cell in zip(table.columns, row, strict=True))
            assert all(cell in done.stdout for cell in cells)
    assert all(note in done.stdout for note in report.notes)
    assert f"at commit {report.commit}, {report.date}." in done.stdout


@pytest.mark.parametrize(("name", "text", "place"), PLACES)
def test_a_headline_is_of_its_study_and_its_numbers_are_stored(
    name: str, text: str, place: str
) -> None:
    """Numbers typed into the text, such as what was asked for, are those of the stored run."""
    report = stored(place.split()[0])
    assert report.study == name
    assert text.count("{}") == len(pick_cells(place))
    known = set(NUMBER.findall(report.to_text()))
    assert set(NUMBER.findall(text)) <= known


@pytest.mark.parametrize("name", STORED)
def test_stored_figures_reach_their_limits_but_for_the_named_rows(name: str) -> None:
    missed = set()
    for table in stored(name).tables:
        names = [column.name for column in table.columns]
        for number, row in enumerate(table.rows):
            cells = dict(zip(names, row, strict=True))
            for limit, value in BOUNDED.items():
                bound, figure = cells.get(limit), cells.get(value)
                if bound in (None, "-") or figure is None:
                    continue
                if float(figure) > float(bound):
                    missed.add((name, number, value))
            wanted, found = str(cells.get("wanted", "")), cells.get("found")
            if re.fullmatch(r"[≤≥] [\d.e-]+", wanted):
                sign, bound = (1 if wanted[0] == "≤" else -1), float(wanted[2:])
                if sign * float(found) > sign * bound:
                    missed.add((name, number, "found"))
    assert missed == {row for row in MISSED if row[0] == name}


def test_the_photometry_of_today_is_the_stored_one():
    report = photometry.report(photometry.run(SilentProgress()))
    assert_same_tables(report, stored("photometry"))
    assert report.notes == stored("photometry").notes


@pytest.mark.slow
def test_the_apollo_picture_of_today_is_the_stored_one(tmp_path):
    """Figures near zero, such as an angle of 0.002 deg, differ by more than 0.1 % at a whim."""
    report = apollo.report(apollo.run(tmp_path, SilentProgress()))
    (found,), (wanted,) = report.tables[0].rows, stored("apollo").tables[0].rows
    assert found[:3] == wanted[:3]
    assert found[3:] == pytest.approx(wanted[3:], rel=1e-3, abs=1e-3)


@pytest.mark.slow
def test_the_phobos_catalog_of_today_is_the_one_of_the_documents(tmp_path):
    (text,) = re.findall(r"(\d+) of (\d+) points usable", stored("phobos").notes[0])
    report = run(resource("configs/catalogs/phobos.toml"), output=tmp_path / "p.gpkg", workers=2)
    assert (report.usable, report.points) == tuple(map(int, text))
