"""A study's tables on the screen, in a document and in JSON, and the studies' registry."""

import inspect
import json
import re
from datetime import UTC, datetime
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

import catalog
from catalog.errors import DataError
from optnav_cli.main import run
from tests.studies.__main__ import studies
from tests.studies.registry import STUDIES
from tests.studies.stored import list_stored, read_stored
from tests.studies.study import Study
from tests.studies.tables import StudyColumn, StudyReport, StudyTable, checkout_commit

TABLE = StudyTable(
    "errors",
    (
        StudyColumn("case", "case"),
        StudyColumn("error_m", "error", "m", ".1f"),
        StudyColumn("frames", "frames"),
    ),
    (("near", 1.23456789, 12), ("far", float("nan"), 3)),
)


def test_a_table_is_aligned_on_the_screen_and_a_missing_number_is_a_dash() -> None:
    assert TABLE.to_text().splitlines() == [
        "errors",
        "case  error  frames",
        "          m",
        "near    1.2      12",
        "far       -       3",
    ]


def test_a_single_long_row_is_shown_as_a_list() -> None:
    columns = tuple(StudyColumn(f"x{n}", f"quantity {n}", "m", ".1f") for n in range(12))
    lines = StudyTable("", columns, (tuple(map(float, range(12))),)).to_text().splitlines()
    assert lines[3] == "quantity 3   3.0 m"


def test_a_document_s_table_has_units_in_its_head() -> None:
    head, rule, *rows = TABLE.to_markdown().splitlines()
    assert head == "| case | error, m | frames |"
    assert rule == "| --- | ---: | ---: |"
    assert rows == ["| near | 1.2 | 12 |", "| far | - | 3 |"]


def test_rows_must_fit_the_columns() -> None:
    with pytest.raises(ValueError, match="2 cells for 3 columns"):
        StudyTable("", TABLE.columns, (("near", 1.0),))


@pytest.mark.parametrize("tables", [(TABLE,), (TABLE, TABLE)])
def test_stored_figures_come_back_as_they_were(tables: tuple[StudyTable, ...]) -> None:
    options = {"output": Path("/somewhere"), "kernels": (Path("/a/b.bsp"),), "trials": 3}
    report = StudyReport(tables, ("a note",)).signed("arc", options)
    assert StudyReport.from_json(report.to_json()) == report
    content = json.loads(report.to_json())
    assert ("tables" in content) is (len(tables) > 1)
    assert content["arguments"] == {"kernels": ["b.bsp"], "trials": 3}
    assert content["version"] == catalog.__version__
    assert content["date"] == datetime.now(UTC).date().isoformat()
    assert content["commit"] == checkout_commit()


@pytest.mark.parametrize(
    "text", ["", "[]", '{"study": "arc"}', '{"tables": [], "notes": [], "x": 1}']
)
def test_other_files_are_no_stored_figures(text: str) -> None:
    with pytest.raises(DataError, match="not the stored figures"):
        StudyReport.from_json(text)


@pytest.mark.parametrize("study", STUDIES, ids=lambda study: study.name)
def test_a_study_s_module_takes_the_options_of_its_command(study: Study) -> None:
    taken = inspect.signature(study.function("run")).parameters
    assert {"progress", *(option.name for option in study.options)} == set(taken)
    assert callable(study.function("report"))
    if study.draws:
        assert callable(study.function("picture"))
    if study.prints:
        assert callable(study.function(study.prints))


def test_a_study_prints_and_stores_the_same_rows_every_time(tmp_path: Path) -> None:
    command = ["resection", "--trials", "10"]
    stored = []
    for name in ("a.json", "b.json"):
        done = CliRunner().invoke(studies, [*command, "--json", str(tmp_path / name)])
        assert done.exit_code == 0
        stored.append((tmp_path / name).read_text(encoding="utf-8"))
        report = StudyReport.from_json(stored[-1])
        assert done.stdout == report.to_text() + "\n"
        assert report.arguments == {"trials": 10, "seed": 1}
    assert stored[0] == stored[1]


def test_a_study_draws_its_plot(tmp_path: Path) -> None:
    plot = tmp_path / "arc.svg"
    done = CliRunner().invoke(studies, ["arc", "--trials", "5", "-o", str(plot)])
    assert done.exit_code == 0
    assert re.search(r"<svg\b", plot.read_text(encoding="utf-8"))


def test_the_registry_makes_commands() -> None:
    names = {study.name for study in STUDIES}
    assert studies.list_commands(click.Context(studies)) == sorted(names | {"show"})


def test_show_lists_the_stored_results() -> None:
    done = CliRunner().invoke(studies, ["show"])
    assert done.exit_code == 0
    lines = [line.split() for line in done.stdout.splitlines()]
    assert [line[0] for line in lines] == list_stored()
    assert ["navigation_real", "navigation"] in [line[:2] for line in lines]


def test_show_prints_the_tables_and_their_run_as_markdown() -> None:
    done = CliRunner().invoke(studies, ["show", "comet"])
    report = read_stored("comet")
    assert done.exit_code == 0
    assert f"*{report.tables[0].title}*\n\n{report.tables[0].to_markdown()}\n" in done.stdout
    origin = f"From the run of `python -m tests.studies comet data` at commit {report.commit}"
    assert done.stdout.rstrip().endswith(f"{origin}, {report.date}.")


def test_show_names_the_stored_results_for_an_unknown_name(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(["show", "nowhere"], studies) == 2
    message = capsys.readouterr().err
    assert "there is no 'nowhere'; there are acceptance, " in message
    assert all(name in message for name in list_stored())


def test_a_study_replaces_no_foreign_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "new.json"
    path.write_text('{"a": "letter"}')
    line = ["resection", "--trials", "10", "--json", str(path)]
    assert run(line, studies) == 3
    assert "was not made by optnav" in capsys.readouterr().err
    assert path.read_text() == '{"a": "letter"}'
    path.unlink()
    assert [run(line, studies), run(line, studies)] == [0, 0]
