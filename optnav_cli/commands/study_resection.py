"""`optnav study resection`: position errors against number and intersection angle of points."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, pass_progress
from optnav_cli.options import output_option


@click.command(short_help="Position errors against number and angle of control points.")
@click.option(
    "--trials",
    type=click.IntRange(min=10),
    default=300,
    show_default=True,
    help="Resections of each geometry.",
)
@click.option("--seed", type=int, default=1, show_default=True, help="Of the noise.")
@output_option("Draw the curves into this file (SVG).", required=False)
@pass_progress
def command(progress: ConsoleProgress, trials: int, seed: int, output: Path | None) -> None:
    """Solve thousands of resections with noisy points and tabulate the errors.

    Shows how the horizontal error falls with the number of points, how the height error grows
    below 20 degrees of intersection angle, and what solving the attitude too costs.

    \b
    Example:
      optnav study resection --trials 1000 -o resection.svg
    """
    from optnav_cli.report.sheet import write_sheet
    from optnav_cli.studies.resection import format_table, picture, run

    rows = run(progress, trials, seed)
    click.echo(format_table(rows))
    if output is not None:
        write_sheet(picture(rows), output)
