"""`optnav orbit landing`: departure, navigation and touchdown of landings on a moon."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress, tell
from optnav_cli.options import OptnavCommand, output_option, path_argument


@click.command("landing", cls=OptnavCommand)
@path_argument("settings")
@output_option("Folder for the landing; an earlier one in it is replaced.")
@pass_progress
def command(progress: ConsoleProgress, settings: Path, output: Path) -> None:
    """Find a departure impulse and fly landings on a moon with drawn errors.

    SETTINGS is a TOML file, or `bundled:NAME` for one that ships with optnav: target, departure,
    transfer, beams, errors, surface, trials. `optnav config template landing` shows them all.

    OUTPUT gets landing.csv (a row a trial: errors of the navigation at the arrival and at the end
    of the descent, where and how fast the craft touches down), impulse.csv, path.csv and
    transfer.oem. A trial that no fit leads down has a row with the reason. Exit code 4 when there
    is no departure impulse, as to a target on the far side, or no trial lands.

    \b
    Example:
      optnav orbit landing bundled:landing_phobos -o landing
      optnav report landing -o landing.html
    """
    from optnav_cli.runs.landing_folder import landing_folder, landing_lines

    announce_compilation()
    tell(landing_lines(landing_folder(settings, output, progress)))
    click.echo(output)
