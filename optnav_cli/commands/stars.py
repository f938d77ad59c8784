"""`optnav stars`: attitudes from the stars in pictures."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, pass_progress, report_lines
from optnav_cli.options import PATH, Number, OptnavCommand, output_option, path_argument


@click.command("stars", cls=OptnavCommand)
@path_argument("folder")
@output_option("Folder for the results; earlier attitudes in it are replaced.")
@click.option(
    "--catalogue",
    type=PATH,
    help="Stars of your own: a CSV of ra_deg, dec_deg, pm_ra_mas_yr, pm_dec_mas_yr, mag.",
)
@click.option(
    "--epoch",
    type=Number(1800.0, 2200.0),
    help="Year that the places of --catalogue hold for: 2016.0 for Gaia DR3.",
)
@pass_progress
def command(
    progress: ConsoleProgress,
    folder: Path,
    output: Path,
    catalogue: Path | None,
    epoch: float | None,
) -> None:
    """Find how the camera is turned against the stars, for each picture of FOLDER.

    FOLDER is a picture folder whose frames.csv needs file, camera and a time alone; the time is for
    the stars' own motion and aberration, and may be empty. run.toml may be left out: the craft then
    flies at the Earth. No attitude is needed to begin with, and a lit body may be in view.

    OUTPUT gets attitudes.csv (camera_from_inertial, its sigmas about the camera's axes, how many
    spots are stars, the focal length that they ask for, the odds of chance) and overlays that name
    the stars. A picture without an attitude has a row with the reason.

    The stars that ship reach V 6.5, for fields from 8 deg on. Narrower ones need --catalogue: to
    magnitude 9 for 2 deg. It states its epoch by --epoch or a column 'epoch'.

    Ends with exit code 4 when no picture gives an attitude.

    \b
    Example:
      optnav stars pictures -o attitudes
    """
    from optnav_cli.stars.job import list_result_lines, solve_star_folder

    if epoch is not None and catalogue is None:
        raise click.UsageError("--epoch is that of --catalogue, which is not given")
    report_lines(list_result_lines(solve_star_folder(folder, output, progress, catalogue, epoch)))
    click.echo(output)
