"""`optnav study navigation`: the accuracy table, from simulated flights over richer ground."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress


@click.command(short_help="The accuracy table, from simulated flights over richer ground.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default="optnav-navigation",
    show_default=True,
    help="Folder for catalogs, pictures and runs; pictures in it are used again.",
)
@click.option("--frames", type=click.IntRange(min=1), help="Pictures of each flight; all if left.")
@click.option("--rows", default="", help="Only rows whose name contains this, such as 'unk 200'.")
@pass_progress
def command(progress: ConsoleProgress, output: Path, frames: int | None, rows: str) -> None:
    """Fly, navigate and evaluate every row of the accuracy table.

    All pictures take one to two hours on two cores; --frames 10 gives a first look.

    \b
    Example:
      optnav study navigation --frames 10 --rows "unk 200"
    """
    from optnav_cli.studies.navigation import format_results, run

    announce_compilation()
    click.echo(format_results(run(output, progress, frames, rows)))
