"""`optnav study rotation`: fit what a body's rotation series lacks against SPICE kernels."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, pass_progress


@click.command(short_help="Fit what a body's rotation series lacks against SPICE kernels.")
@click.argument("kernels", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--body", default="moon", show_default=True, help="Whose rotation.")
@click.option(
    "--years",
    type=(float, float),
    default=(1900.0, 2051.0),
    show_default=True,
    help="First and last year of the fit.",
)
@click.option(
    "--terms",
    type=click.IntRange(min=1, max=400),
    default=120,
    show_default=True,
    help="How many trigonometric terms.",
)
@pass_progress
def command(
    progress: ConsoleProgress,
    kernels: tuple[Path, ...],
    body: str,
    years: tuple[float, float],
    terms: int,
) -> None:
    """Fit the small turn between the published rotation of a body and that of SPICE KERNELS.

    Prints the section [rotation_correction] for the body's file, and on stderr what the fit leaves
    at times that it has not seen. Takes two minutes.

    \b
    Example:
      optnav study rotation moon_080317.tf moon_pa_de421_1900-2050.bpc
    """
    from catalog.bodies.body import load_body
    from optnav_cli.studies.rotation import format_table, format_toml, run

    fit = run(progress, load_body(body), kernels, years, terms)
    click.echo(format_toml(fit))
    click.echo(format_table(fit), err=True)
