"""`optnav study arc`: errors of a horizon against the arc of limb in view."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress
from optnav_cli.options import output_option


@click.command(short_help="Errors of a horizon against the arc of limb in view.")
@click.option(
    "--trials",
    type=click.IntRange(min=5),
    default=100,
    show_default=True,
    help="Limbs of each interval.",
)
@click.option(
    "--height-km",
    type=click.FloatRange(min=1.0, max=1e6),
    default=200.0,
    show_default=True,
    help="From which the Moon is seen.",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of errors.")
@output_option("Draw the curves into this file (SVG).", required=False)
@pass_progress
def command(
    progress: ConsoleProgress, trials: int, height_km: float, seed: int, output: Path | None
) -> None:
    """Fit limbs with correlated errors and tabulate the errors of direction and angular radius.

    Shows why less than 100 degrees of limb make no good horizon, and how relief, whose errors are
    alike over degrees of limb, costs more than noise.

    \b
    Example:
      optnav study arc -o arc.svg
    """
    from optnav_cli.report.sheet import write_sheet
    from optnav_cli.studies.arc import format_table, picture, run

    announce_compilation()
    rows = run(progress, trials, height_km, seed)
    click.echo(format_table(rows))
    if output is not None:
        write_sheet(picture(rows), output)
