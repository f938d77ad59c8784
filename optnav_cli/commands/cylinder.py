"""`optnav cylinder`: distance and light angle by pictures of a lit cylinder."""

from pathlib import Path
from typing import Literal, cast

import click

from optnav_cli.console import ConsoleProgress, pass_progress, report_compilation, report_lines
from optnav_cli.options import OptnavCommand, RenamedChoice, output_option, path_argument


@click.command("cylinder", cls=OptnavCommand)
@path_argument("folder")
@click.option(
    "--formula",
    type=RenamedChoice(["fit", "printed"], {"seed": "printed"}),
    default="fit",
    show_default=True,
    help="Fit the whole profile, or compute the formulas of the source as printed.",
)
@output_option("Folder for the result; an earlier one in it is replaced.")
@pass_progress
def command(progress: ConsoleProgress, folder: Path, formula: str, output: Path) -> None:
    """Measure distance and angle of the light by pictures of a lit upright cylinder.

    FOLDER is a picture folder whose run.toml says target = "cylinder", radius_m and height_m. Of
    frames.csv the columns file, utc and camera count. The camera stands level.

    OUTPUT gets cylinder.csv (a row a picture: zone, distance d to the surface, angle theta of the
    light, bearing, velocity), plots of d, theta and the path (cylinder.svg), overlays and
    manifest.json. Ends with exit code 4 when no picture gives a distance.

    \b
    Example:
      optnav simulate bundled:cylinder_circle -o pictures
      optnav cylinder pictures -o run
      optnav cylinder pictures --formula printed -o printed
      optnav report run -o run.html
    """
    from optnav_cli.cylinder.job import list_result_lines, measure_cylinder_folder

    report_compilation()
    chosen = cast(Literal["fit", "printed"], formula)
    rows = measure_cylinder_folder(folder, output, chosen, progress)
    report_lines(list_result_lines(rows))
    click.echo(output)
