"""`optnav study horizon`: positions from the limb alone, sphere against terrain-aware."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress


@click.command(short_help="Positions from the limb alone, sphere against terrain-aware.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default="optnav-horizon",
    show_default=True,
    help="Folder for pictures and figures.json; pictures in it are used again.",
)
@click.option("--frames", type=click.IntRange(min=1), help="Pictures of each case; all if left.")
@click.option("--rows", default="", help="Only rows whose name contains this, such as 'far'.")
@pass_progress
def command(progress: ConsoleProgress, output: Path, frames: int | None, rows: str) -> None:
    """Solve single pictures from 50 to 100 000 km by their limb, and compare with the truth.

    Needs the 948 m model of the whole Moon in the folder that OPTNAV_SHARED_DATA names. All
    pictures take some three hours on two cores, solving them two minutes; --frames 6 gives a
    first look.

    \b
    Example:
      optnav study horizon --frames 6 --rows nadir
    """
    from optnav_cli.studies.horizon import run
    from optnav_cli.studies.horizon_table import format_results

    announce_compilation()
    click.echo(format_results(run(output, progress, frames, rows)))
