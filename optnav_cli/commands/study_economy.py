"""`optnav study economy`: what the build's economies cost in recognised points."""

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress


@click.command(short_help="The build's settings against slower and quicker ones.")
@click.option(
    "--trials",
    type=click.IntRange(min=4),
    default=24,
    show_default=True,
    help="New recognition trials of each place, at least.",
)
@click.option(
    "--cell-deg",
    "cells_deg",
    type=click.FloatRange(min=0.2, max=2.0),
    multiple=True,
    default=(1.0, 0.5),
    show_default=True,
    help="Side of the cells; may be given several times.",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of trials.")
@pass_progress
def command(
    progress: ConsoleProgress, trials: int, cells_deg: tuple[float, ...], seed: int
) -> None:
    """Choose points on the bundled Tycho terrain by several policies and try to recognise them.

    Prints what the build's few candidates, Suns and trials cost in recognition and gain in time,
    against all candidates under 32 Suns, against trials of them all, and against fewer candidates.

    \b
    Example:
      optnav study economy --cell-deg 0.5 --trials 40
    """
    from optnav_cli.studies.economy import format_table, run

    announce_compilation()
    click.echo(format_table(run(progress, cells_deg, trials, seed)))
