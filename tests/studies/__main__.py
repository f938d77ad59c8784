"""`make study-NAME`: the experiments behind the figures, a command each from their registry.

python -m tests.studies NAME [OPTIONS]
python -m tests.studies show [NAME]
"""

import inspect
from pathlib import Path
from typing import Any

import click

from optnav_cli.console import ConsoleProgress, pass_progress, report_compilation
from optnav_cli.main import cli, main
from optnav_cli.options import LazyGroup, OptnavCommand, OutputOption
from tests.studies.registry import STUDIES
from tests.studies.study import Study

PROGRAM = "python -m tests.studies"


@click.group(cls=LazyGroup, context_settings=cli.context_settings)
def studies() -> None:
    """Run one of the experiments behind the figures of the documents.

    Studies repeat trials with fixed seeds and take minutes to hours.

    \b
    Example:
      python -m tests.studies resection
    """


def _command(study: Study) -> click.Command:
    """The command of one study: its own options, and what all of them have."""

    @pass_progress
    def call(
        progress: ConsoleProgress,
        /,
        json_file: Path | None,
        plot: Path | None = None,
        **options: Any,
    ) -> None:
        from catalog.files import check_file, make_prefix_test
        from optnav_cli.report import sheet
        from tests.studies import tables

        for place, beginning in ((plot, sheet.BEGINNING.encode()), (json_file, tables.BEGINNING)):
            if place is not None:
                check_file(place, make_prefix_test(beginning))  # before hours of work
        if study.compiles:
            report_compilation()
        result = study.function("run")(progress=progress, **options)
        report = study.function("report")(result)
        click.echo(report.to_text(), err=bool(study.prints))
        if study.prints:
            click.echo(study.function(study.prints)(result))
        if plot is not None:
            sheet.write_sheet(study.function("picture")(result), plot)
        if json_file is not None:
            report.signed(study.name, options).write(json_file)

    parameters = [*study.options]
    if study.draws:
        plot = ("-o", "--output", "plot")
        text = "Draw the curves into this file (SVG)."
        parameters.append(OutputOption(plot, endings=(".svg", ""), help=text))
    text = "Also write the tables into this file (JSON)."
    parameters.append(OutputOption(("--json", "json_file"), endings=(".json", ""), help=text))
    return OptnavCommand(
        study.name,
        callback=call,
        params=parameters,
        short_help=study.question,
        help=f"{inspect.cleandoc(study.text)}\n\n\b\nExample:\n"
        f"  python -m tests.studies {study.name} {study.example}".rstrip(),
    )


@studies.command("show", cls=OptnavCommand, short_help="Print the stored tables of a study.")
@click.argument("name", default="")
def show(name: str) -> None:
    """Print the stored tables of a study as Markdown.

    Without NAME, list the stored results with their study, date and commit.

    \b
    Example:
      python -m tests.studies show navigation_real
    """
    from tests.studies.stored import format_report, list_stored, read_stored

    names = list_stored()
    if name and name not in names:
        raise click.BadParameter(f"there is no {name!r}; there are {', '.join(names)}")
    if name:
        click.echo(format_report(read_stored(name)))
        return
    for stored in names:
        report = read_stored(stored)
        click.echo(f"{stored:<22}{report.study:<14}{report.date}  {report.commit}")


for _study in STUDIES:
    studies.add_command(_command(_study))

if __name__ == "__main__":
    main(studies, PROGRAM)
