"""`optnav stars`: attitudes from the stars in pictures."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, pass_progress, tell
from optnav_cli.options import OptnavCommand, output_option, path_argument


@click.command("stars", cls=OptnavCommand)
@path_argument("folder")
@output_option("Folder for the results; earlier attitudes in it are replaced.")
@pass_progress
def command(progress: ConsoleProgress, folder: Path, output: Path) -> None:
    """Find how the camera is turned against the stars, for each picture of FOLDER.

    FOLDER is a picture folder whose frames.csv needs file, camera and a time alone; the time is for
    the stars' own motion and aberration, and may be empty. run.toml may be left out: the craft then
    flies at the Earth. No attitude is needed to begin with, and a lit body may be in view.

    OUTPUT gets attitudes.csv (camera_from_inertial, its sigmas about the camera's axes, how many
    spots are stars, the focal length that they ask for, the odds of chance) and overlays that name
    the stars. A picture without an attitude has a row with the reason.

    Ends with exit code 4 when no picture gives an attitude.

    \b
    Example:
      optnav stars pictures -o attitudes
    """
    from optnav_cli.runs.stars_folder import star_lines, stars_folder

    tell(star_lines(stars_folder(folder, output, progress)))
    click.echo(output)
