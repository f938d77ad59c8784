"""`optnav orbit delivery`: how accurately corrections bring a craft to a target, at what cost."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, pass_progress, tell
from optnav_cli.options import OptnavCommand, output_option, path_argument


@click.command("delivery", cls=OptnavCommand)
@path_argument("settings")
@output_option("Folder for the tables; earlier ones in it are replaced.")
@pass_progress
def command(progress: ConsoleProgress, settings: Path, output: Path) -> None:
    """Bound the errors of an arrival and the corrections of a schedule, and draw them in trials.

    SETTINGS is a TOML file, or `bundled:NAME` for one that ships with optnav: target and aim, start
    of the reference path, errors of injection and burns, times of corrections, measurements.
    `optnav config template delivery` shows them all.

    OUTPUT gets stages.csv (a row a correction and the arrival: errors and velocity change by boxes
    that hold all bounded errors, and by trials), boxes.csv and arrivals.csv. Exit code 4 when the
    start does not lead to the target or nothing is measured.

    \b
    Example:
      optnav orbit delivery bundled:delivery_moon -o delivery
      optnav report delivery -o delivery.html
    """
    from optnav_cli.runs.delivery_folder import delivery_folder, delivery_lines

    tell(delivery_lines(delivery_folder(settings, output, progress)))
    click.echo(output)
