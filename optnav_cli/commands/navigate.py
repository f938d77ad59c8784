"""`optnav navigate`: the camera's position for each picture."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress
from optnav_cli.options import output_option, path_argument


@click.command(short_help="Find the camera's position for each picture.")
@path_argument("folder")
@click.option(
    "--catalog",
    "catalogs",
    type=click.Path(path_type=Path),
    required=True,
    multiple=True,
    help="A control-point catalog to navigate with. Of several, the first has priority where it "
    "has points.",
)
@click.option(
    "--config",
    type=click.Path(path_type=Path),
    help="Settings; `optnav config template navigate` prints the defaults.",
)
@click.option(
    "--matcher",
    type=click.Choice(["ncc", "surf"]),
    default="ncc",
    show_default=True,
    help="How a control point is recognised.",
)
@click.option(
    "--relief",
    type=click.Path(path_type=Path),
    help="A terrain model of the whole body for the horizon; by default the relief that a catalog "
    "carries.",
)
@output_option("Folder for the results; an earlier run in it is replaced.")
@pass_progress
def command(
    progress: ConsoleProgress,
    folder: Path,
    catalogs: tuple[Path, ...],
    config: Path | None,
    matcher: str,
    relief: Path | None,
    output: Path,
) -> None:
    """Find the camera's position for each picture of FOLDER.

    FOLDER holds run.toml, cameras/, frames.csv and the pictures. The run folder gets solution.csv
    (a row a frame), matches.csv (a row a control point), run.mcap, overlays and manifest.json.

    A frame without a prior position in frames.csv is solved by itself: by the limb of the body,
    then by control points; earlier frames and other cameras at the same time serve where it shows
    no limb.

    Ends with exit code 4 when no frame could be solved.

    \b
    Example:
      optnav navigate pictures --catalog tycho.gpkg --catalog moon.gpkg -o run
    """
    from optnav_cli.navigation.settings import NavigateSettings, load_settings
    from optnav_cli.runs.navigate_folder import navigate_folder

    settings = load_settings(config) if config else NavigateSettings()
    announce_compilation()
    navigate_folder(folder, catalogs, settings, matcher, output, progress, relief)
    click.echo(output)
