"""`optnav orbit time`: when pictures were taken, from a known orbit."""

from pathlib import Path

import click

from optnav_cli.console import announce_compilation, tell
from optnav_cli.options import OptnavCommand, output_option, path_argument
from optnav_cli.parameters import PATH, Number


@click.command("time", cls=OptnavCommand)
@path_argument("run")
@click.option(
    "--orbit", type=PATH, required=True, help="Folder of `optnav orbit fit` with the known orbit."
)
@click.option(
    "--margin",
    "margin_s",
    type=Number(0.0, 1e7),
    default=600.0,
    show_default=True,
    help="Seconds before and after the orbit's arc and the stamps that are searched as well.",
)
@output_option("CSV file for the times.", (".csv",))
def command(run: Path, orbit: Path, margin_s: float, output: Path) -> None:
    """Tell when the solved pictures of RUN were taken, from where they were and a known orbit.

    OUTPUT gets a row a picture: its stamp, the time at which the orbit passes its position nearest
    to the stamp, the sigma of that, and all passes within 3 sigmas. Sigmas take the orbit for one
    that these pictures had no part in. Ends with exit code 4 when the orbit passes no position.

    \b
    Example:
      optnav orbit time run --orbit orbit -o times.csv
    """
    from optnav_cli.runs.orbit_files import time_pictures

    announce_compilation()
    tell(time_pictures(run, orbit, output, margin_s))
    click.echo(output)
