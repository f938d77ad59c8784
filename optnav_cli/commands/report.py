"""`optnav report`: a page about a run or a catalog."""

from pathlib import Path

import click

from optnav_cli.options import output_option, path_argument


@click.command(short_help="Make a page about a run or a catalog.")
@path_argument("source")
@output_option("The page, one HTML file with its pictures inside; or .svg, a run's errors alone.")
def command(source: Path, output: Path) -> None:
    """Make a page about SOURCE, a run folder or a catalog.

    Of a run that was compared with the truth it shows the errors against time and height, by
    method and camera; of another one what its solutions state.

    \b
    Example:
      optnav report run -o report.html
      optnav report run -o errors.svg
      optnav report moon.gpkg -o catalog.html
    """
    from optnav_cli.report import write_report

    write_report(source, output)
    click.echo(output)
