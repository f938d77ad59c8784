"""`optnav simulate`: pictures with known positions."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress
from optnav_cli.options import output_option, path_argument


@click.command(short_help="Make a folder of pictures with known positions.")
@path_argument("scenario")
@output_option("Folder for the pictures; an earlier simulation in it is replaced.")
@pass_progress
def command(progress: ConsoleProgress, scenario: Path, output: Path) -> None:
    """Make a folder of pictures as a camera over the terrain of SCENARIO takes them.

    The folder is what `optnav navigate` reads, with the truth in truth.csv beside it.

    \b
    Example:
      optnav config template scenario > flight.toml
      optnav simulate flight.toml -o pictures
    """
    from optnav_cli.runs.simulate_folder import simulate_folder

    announce_compilation()
    simulate_folder(scenario, output, progress)
    click.echo(output)
