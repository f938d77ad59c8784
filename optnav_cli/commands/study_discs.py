"""`optnav study discs`: direction and range of discs of 2 to 40 pixels, and their covariance."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, pass_progress


@click.command(short_help="Direction and range of discs of 2 to 40 px, and their covariance.")
@click.option(
    "--discs",
    type=click.IntRange(min=1),
    default=30,
    show_default=True,
    help="Discs of each size and body.",
)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="JSON file for every disc's errors."
)
@pass_progress
def command(progress: ConsoleProgress, discs: int, output: Path | None) -> None:
    """Draw small discs of the Moon and of Phobos, solve them, and compare with the truth.

    Needs nothing but what is bundled; 30 discs of each size take a quarter of an hour.

    \b
    Example:
      optnav study discs --discs 5
    """
    from optnav_cli.studies.discs import format_table, run

    click.echo(format_table(run(progress, discs, output)))
