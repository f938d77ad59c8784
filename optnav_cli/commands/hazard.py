"""`optnav slopes | hazard`: slopes of terrain models, the risk of landing by pictures."""

from pathlib import Path
from typing import Any

import click

from optnav_cli.console import ConsoleProgress, pass_progress, report_compilation, report_lines
from optnav_cli.options import (
    PATH,
    Number,
    OptnavCommand,
    json_option,
    output_option,
    path_argument,
)

METRES = Number(0.1, 1e5)
nodata_option = click.option(
    "--nodata",
    type=Number(-1e300, 1e300),
    help="Stored value of the terrain model's pixels without data; one that is not there: all are "
    "ground.",
)


@click.command("slopes", cls=OptnavCommand, short_help="How steep a terrain model is.")
@path_argument("dem")
@click.option(
    "--base-m",
    type=Number(1e-3, 1e6),
    default=3.0,
    show_default=True,
    help="Distance over which the ground rises; at least two postings are taken.",
)
@click.option("--body", default="moon", show_default=True, help="Whose ground it is.")
@nodata_option
@output_option(
    "The slopes: .tif (degrees, on the model's coordinate system) or .png (map and histogram).",
    (".tif", ".png"),
    required=False,
)
@click.option("--pads", type=PATH, help="A CSV file for the flattest pad of each square.")
@click.option("--pad-m", type=METRES, default=20.0, show_default=True, help="Side of a pad.")
@click.option("--square-m", type=METRES, default=200.0, show_default=True, help="Side of a square.")
@json_option
def slopes(
    dem: Path,
    base_m: float,
    body: str,
    nodata: float | None,
    output: Path | None,
    as_json: bool,
    **places: Any,
) -> None:
    """Print the shares of the terrain model DEM above 7 deg and above 15 deg, and its rms slope.

    DEM is a raster of heights, or `bundled:NAME` for one that ships with optnav. Shares are of the
    area that has slopes: holes and their borders have none.

    \b
    Example:
      optnav slopes bundled:tycho_gld100_256ppd.tif --base-m 240
      optnav slopes site.tif -o slopes.tif --pads pads.csv
    """
    from optnav_cli.hazard.slopes import PadSearch, measure_slopes
    from optnav_cli.output.wording import format_json

    report_compilation()
    pads: Path | None = places["pads"]
    search = None if pads is None else PadSearch(pads, places["pad_m"], places["square_m"])
    measured = measure_slopes(dem, base_m, body, output, nodata, search)
    if as_json:
        click.echo(format_json(measured.figures()))
    else:
        click.echo(measured.to_text())
        for path in (output, pads):
            if path is not None:
                click.echo(path)


@click.command("hazard", cls=OptnavCommand, short_help="Map the risk of landing, choose pads.")
@path_argument("pictures")
@output_option("Folder for the maps and pads; earlier ones in it are replaced.")
@click.option("--catalog", type=PATH, help="Heights of the ground: a control-point catalog.")
@click.option("--dem", type=PATH, help="Heights of the ground: a terrain model.")
@nodata_option
@click.option(
    "--slopes",
    type=PATH,
    help="A slope map from orbit, as `optnav slopes -o` writes it: brightness does not tell the "
    "tilt of all that a picture shows.",
)
@click.option(
    "--pictures",
    "pictures_folder",
    type=PATH,
    help="Of a run: the folder of its pictures, where they have moved since.",
)
@click.option("--camera", type=PATH, help="The camera of a single picture, a TOML file.")
@click.option("--height-m", type=Number(0.1, 1e7), help="Of the camera over the ground.")
@click.option(
    "--sun-elevation-deg", type=Number(0.0, 90.0), help="Of a single picture: the Sun's height."
)
@click.option(
    "--sun-azimuth-deg",
    type=Number(0.0, 360.0),
    help="Of a single picture: direction to the Sun, clockwise from its upper edge.",
)
@click.option(
    "--method",
    type=click.Choice(["shading", "variance"]),
    help="Slopes from brightness (default), or variance of brightness.",
)
@click.option("--pad-m", type=METRES, help="Side of a pad; 20 by default.")
@click.option("--square-m", type=METRES, help="Side of the squares of one pad each; 200.")
@click.option(
    "--config", type=PATH, help="Settings; `optnav config template hazard` prints the defaults."
)
@pass_progress
def hazard(
    progress: ConsoleProgress,
    /,
    pictures: Path,
    output: Path,
    config: Path | None,
    camera: Path | None,
    **given: Any,
) -> None:
    """Map how risky landing is on the ground that PICTURES show, and choose a pad in each square.

    PICTURES is a picture folder whose frames.csv states positions and attitudes; or one picture of
    a camera that looks straight down, with --camera, --height-m and where the Sun stands; or a run
    of `optnav navigate`, whose solved poses are refined by windows of --dem and of the frame
    before. Its pads are carried from frame to frame into carried_pads.csv and .gpkg.

    OUTPUT gets risk.tif (254 x the expected share of slopes above 7 deg on a pad, 255 refused),
    slopes.tif, risk.png, hazard.png, pads.csv, hazard.mcap and manifest.json; of several frames,
    each in a folder of its own. Ends with exit code 4 when no square has a pad.

    \b
    Example:
      optnav hazard pictures --dem site.tif --slopes slopes.tif -o hazard
      optnav hazard run --dem site.tif -o hazard
      optnav hazard site.png --camera tsnn2_narrow.toml --height-m 500 --sun-elevation-deg 5
        --sun-azimuth-deg 120 -o hazard
    """
    from optnav_cli.hazard.job import map_pictures

    report_compilation()
    given["pictures"] = given.pop("pictures_folder")
    report_lines(map_pictures(pictures, output, config, camera, given, progress))
    click.echo(output)
