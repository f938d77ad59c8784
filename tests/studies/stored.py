"""Read the stored figures of studies and format them as Markdown.

The command `show` and the parts of documents made from stored figures print the same text.
"""

import shlex
from pathlib import Path

import click

from tests.studies.registry import STUDIES
from tests.studies.tables import StudyReport

FIGURES = Path(__file__).with_name("figures")


def list_stored() -> list[str]:
    """List the names of the stored results; a study may have several."""
    return sorted(path.stem for path in FIGURES.glob("*.json"))


def read_stored(name: str) -> StudyReport:
    """Read the stored result of this name."""
    return read_report(FIGURES / f"{name}.json")


def read_report(path: Path) -> StudyReport:
    """Read a file of stored figures. Raises DataError for any other file."""
    return StudyReport.from_json(path.read_text(encoding="utf-8"))


def format_report(report: StudyReport, command: str = "python -m tests.studies {}") -> str:
    """Format all tables and notes of a report as Markdown, with its command, commit and date.

    command  that makes the report; {} stands for the study's name
    """
    words = [command.format(report.study)]
    options = [
        option for study in STUDIES if study.name == report.study for option in study.options
    ]
    bare = {option.name for option in options if isinstance(option, click.Argument)}
    for name, value in report.arguments.items():
        if value is True:
            words.append(f"--{name}")
        elif value not in (None, "", False):
            words.append(("" if name in bare else f"--{name} ") + shlex.quote(str(value)))
    origin = f"From the run of `{' '.join(words)}` at commit {report.commit}, {report.date}."
    titles = [f"*{table.title}*\n\n" if table.title else "" for table in report.tables]
    tables = [f"{t}{table.to_markdown()}" for t, table in zip(titles, report.tables, strict=True)]
    return "\n\n".join([*tables, *report.notes, origin])
