"""`optnav calibrate`: a camera's lens, mounting and clock by the pictures of a route."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress, tell
from optnav_cli.options import OptnavCommand, output_option, path_argument, workers_option
from optnav_cli.parameters import PATH

SOLVED = ("focal", "centre", "distortion", "mounting", "clock")


def _solved(context: click.Context, option: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in value.split(","))
    for name in names:
        if name not in SOLVED:
            raise click.BadParameter(f"{name!r} is none of {', '.join(SOLVED)}", context, option)
    return names


@click.command("calibrate", cls=OptnavCommand)
@path_argument("folder")
@click.option(
    "--catalog",
    "catalogs",
    type=PATH,
    multiple=True,
    required=True,
    help="A control-point catalog; of several, the first has priority where it has points.",
)
@click.option(
    "--solve",
    callback=_solved,
    default=",".join(SOLVED),
    show_default=True,
    metavar="WHAT,...",
    help="What to solve for: focal length, principal point (centre), distortion (k1), the "
    "mounting's three angles, and by how much pictures are taken later than they say (clock).",
)
@click.option(
    "--config", type=PATH, help="Settings; `optnav config template calibrate` prints the defaults."
)
@output_option("Folder for the calibration; an earlier one in it is replaced.")
@workers_option
@pass_progress
def command(
    progress: ConsoleProgress,
    folder: Path,
    catalogs: tuple[Path, ...],
    solve: tuple[str, ...],
    config: Path | None,
    output: Path,
    workers: int | None,
) -> None:
    """Calibrate the cameras of FOLDER in flight, by its pictures over known ground.

    Positions and attitudes of frames.csv (by satellite navigation and star sensors) are
    measurements with their sigmas. OUTPUT gets cameras/ as found, calibration.json (values, sigmas,
    correlations, and what the frames do not tell apart), residuals.csv from before and after, and
    manifest.json. The cameras go into a picture folder in place of the old ones.

    Ends with exit code 4 where the frames show too few control points, or all on a line.

    \b
    Example:
      optnav calibrate pictures --catalog moon.gpkg -o calibration
      optnav calibrate pictures --catalog moon.gpkg --solve focal,mounting -o calibration
      optnav report calibration -o calibration.html
    """
    from optnav_cli.calibration.settings import CalibrateSettings, load_calibrate_settings
    from optnav_cli.estimation.models.common import Common
    from optnav_cli.runs.calibrate_folder import calibrate_folder
    from optnav_cli.runs.frame_worker import RunInputs

    settings = load_calibrate_settings(config) if config else CalibrateSettings()
    announce_compilation()
    kinds = [kind for kind in Common if kind.value in solve]
    inputs = RunInputs(folder, list(catalogs))
    result = calibrate_folder(inputs, output, kinds, settings, progress, workers)
    tell(result.lines())
    click.echo(output)
