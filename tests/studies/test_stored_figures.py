"""The figures that the documents show are those of the studies, as far as it is cheap to see."""

import re

import pytest

from catalog.config import resource
from catalog.pipeline.build import run
from catalog.progress import SilentProgress
from tests.golden.documents import BENCHES, CHECKOUT, FIGURES, PART
from tests.studies import apollo, photometry
from tests.studies.registry import STUDIES
from tests.studies.tables import StudyReport

README = (CHECKOUT / "tests" / "studies" / "README.md").read_text(encoding="utf-8")
STORED = {path.stem: path for path in sorted(FIGURES.glob("*.json"))}


def stored(name):
    return StudyReport.from_json(STORED[name].read_text(encoding="utf-8"))


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


def test_all_stored_figures_are_shown_and_every_study_has_some():
    assert {words.strip() for _, part, words in PART.findall(README) if part == "study"} == set(
        STORED
    )
    assert {stored(name).study for name in STORED} == {study.name for study in STUDIES}
    shown = (CHECKOUT / "tests" / "bench" / "README.md").read_text(encoding="utf-8")
    benches = {words.strip() for _, part, words in PART.findall(shown) if part == "bench"}
    assert benches == {path.stem for path in BENCHES.glob("*.json")}


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
    (text,) = re.findall(r"\((\d+) of (\d+) usable\)", README)
    report = run(resource("configs/catalogs/phobos.toml"), output=tmp_path / "p.gpkg", workers=2)
    assert (report.usable, report.points) == tuple(map(int, text))
