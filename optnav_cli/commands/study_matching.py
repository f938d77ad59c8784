"""`optnav study matching`: what matching bears of noise, scale, slant and roll."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress
from optnav_cli.options import output_option


@click.command(short_help="What matching bears of noise, scale, slant and roll.")
@click.option(
    "--scenes",
    type=click.IntRange(min=1, max=24),
    default=2,
    show_default=True,
    help="Grounds and Suns that the pictures are made of.",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of trials.")
@output_option("Draw the curves into this file (SVG).", required=False)
@pass_progress
def command(progress: ConsoleProgress, scenes: int, seed: int, output: Path | None) -> None:
    """Look for control points of the bundled Tycho terrain by correlation and by SURF-64.

    Prints how many are recognised, and how well, as the picture's noise or the believed scale,
    slant or roll gets worse: first with nothing but the place searched, then with what the
    navigator does about it.

    \b
    Example:
      optnav study matching -o matching.svg
    """
    from optnav_cli.report.sheet import write_sheet
    from optnav_cli.studies.matching import format_table, picture, run

    announce_compilation()
    rows = run(progress, scenes, seed)
    click.echo(format_table(rows))
    if output is not None:
        write_sheet(picture(rows), output)
