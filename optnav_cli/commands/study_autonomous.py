"""`optnav study autonomous`: flights without any prior, and how many of their frames are solved."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress


@click.command(short_help="Flights without any prior: accuracy and share of frames solved.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default="optnav-autonomous",
    show_default=True,
    help="Folder for catalogs, pictures and runs; pictures in it are used again.",
)
@click.option("--frames", type=click.IntRange(min=1), help="Pictures of each flight; all if left.")
@click.option("--rows", default="", help="Only rows whose name contains this, such as 'wide'.")
@pass_progress
def command(progress: ConsoleProgress, output: Path, frames: int | None, rows: str) -> None:
    """Fly without priors over Tycho and all over the Moon, navigate, and compare with the truth.

    Needs the 948 m model of the whole Moon in the folder that OPTNAV_SHARED_DATA names. All
    pictures take some two hours on two cores; --frames 4 gives a first look.

    \b
    Example:
      optnav study autonomous --frames 4 --rows wide
    """
    from optnav_cli.studies.autonomous import run
    from optnav_cli.studies.autonomous_table import format_results

    announce_compilation()
    click.echo(format_results(run(output, progress, frames, rows)))
