"""`optnav study phobos`: navigation at Phobos from 20 000 km to 20 km, by a catalog of its mesh."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress


@click.command(short_help="Navigation at Phobos, by disc, limb and control points.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default="optnav-phobos",
    show_default=True,
    help="Folder for catalog, pictures and runs; what is in it is used again.",
)
@click.option("--frames", type=click.IntRange(min=1), help="Pictures of each case; all if left.")
@click.option("--rows", default="", help="Only rows whose name contains this, such as 'limb'.")
@pass_progress
def command(progress: ConsoleProgress, output: Path, frames: int | None, rows: str) -> None:
    """Build the catalog of Phobos, fly to it, navigate, and compare with the truth.

    Needs nothing but what is bundled. All pictures take half an hour on two cores; --frames 4 gives
    a first look.

    \b
    Example:
      optnav study phobos --frames 4 --rows limb
    """
    from optnav_cli.studies.phobos import format_results, run

    announce_compilation()
    click.echo(format_results(run(output, progress, frames, rows)))
