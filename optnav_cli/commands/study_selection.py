"""`optnav study selection`: chosen control points against random and one-Sun Harris points."""

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress


@click.command(short_help="Chosen control points against random and one-Sun Harris points.")
@click.option(
    "--trials",
    type=click.IntRange(min=100),
    default=1000,
    show_default=True,
    help="Recognition trials of each strategy at each posting, at least.",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Of trials.")
@pass_progress
def command(progress: ConsoleProgress, trials: int, seed: int) -> None:
    """Try to recognise chosen, random and one-Sun Harris points on the bundled Tycho terrain.

    Prints recognition rates and errors with 95 % intervals, at the DEM's posting and at twice it.

    \b
    Example:
      optnav study selection --trials 2000
    """
    from optnav_cli.studies.selection import format_table, run

    announce_compilation()
    click.echo(format_table(run(progress, trials, seed)))
