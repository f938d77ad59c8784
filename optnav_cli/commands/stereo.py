"""`optnav stereo`: height and side velocity from two cameras on a base."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, pass_progress, report_lines
from optnav_cli.options import OptnavCommand, output_option, path_argument


@click.command("stereo", cls=OptnavCommand)
@path_argument("folder")
@output_option("Folder for the results; earlier heights in it are replaced.")
@pass_progress
def command(progress: ConsoleProgress, folder: Path, output: Path) -> None:
    """Measure the height over the ground, and the side velocity, from pairs of pictures.

    FOLDER is a picture folder whose run.toml says in two [[mount]] sections where the cameras stand
    in the ship; pictures of one time are a pair. OUTPUT gets heights.csv: the height over the mean
    ground below with its sigma and what the mounting's error adds to it, and the velocity against
    the pair before. A pair that gives no height has a row with the reason.

    Ends with exit code 4 when no pair gives a height.

    \b
    Example:
      optnav simulate bundled:stereo_100m -o pairs
      optnav stereo pairs -o heights
    """
    from optnav_cli.stereo.job import list_result_lines, measure_stereo_folder

    report_lines(list_result_lines(measure_stereo_folder(folder, output, progress)))
    click.echo(output)
