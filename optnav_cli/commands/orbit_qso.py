"""`optnav orbit qso`: quasi-satellite orbits about a moon."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress, tell
from optnav_cli.options import OptnavCommand, output_option, path_argument


@click.command("qso", cls=OptnavCommand)
@path_argument("settings")
@output_option("Folder for the orbits; earlier ones in it are replaced.")
@pass_progress
def command(progress: ConsoleProgress, settings: Path, output: Path) -> None:
    """Find quasi-satellite orbits: about a moon too light to have satellites of its own.

    SETTINGS is a TOML file, or `bundled:NAME` for one that ships with optnav: distances from the
    surface, the longitude that is to be passed always at the same distance, times, days, forces.
    `optnav config template qso` shows them all.

    OUTPUT gets qso.csv (a row an orbit: its state, how far its passes differ, how much quicker than
    the moon it goes round, and the averaged theory's figures), passes.csv and an OEM of each orbit.
    A start without an orbit has a row with the reason; exit code 4 when none has one.

    \b
    Example:
      optnav orbit qso bundled:qso_55km -o qso
      optnav report qso -o qso.html
    """
    from optnav_cli.runs.qso_folder import qso_folder, qso_lines

    announce_compilation()
    rows, mean_motion = qso_folder(settings, output, progress)
    tell(qso_lines(rows, mean_motion))
    click.echo(output)
