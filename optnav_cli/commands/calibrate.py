"""`optnav calibrate`: a camera by the pictures of a route, or its lens by a grid of dots."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from optnav_cli.console import ConsoleProgress, pass_progress, report_compilation, report_lines
from optnav_cli.options import PATH, Number, OptnavCommand, output_option, workers_option

SOLVED = ("focal", "centre", "distortion", "mounting", "clock")
OF_A_LENS = SOLVED[:3]
IN_FLIGHT, OF_A_GRID = (
    ("catalogs", "config", "workers"),
    ("grid", "pattern", "name", "distance_mm", "error_mm"),
)


def _parse_solve(context: click.Context, option: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in value.split(","))
    for name in names:
        if name not in SOLVED:
            raise click.BadParameter(f"{name!r} is none of {', '.join(SOLVED)}", context, option)
    return names


def _parse_size(
    context: click.Context, option: click.Parameter, value: str | None
) -> tuple[int, int] | None:
    if value is None:
        return None
    match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", value.strip().lower())
    if match is None or min(int(match[1]), int(match[2])) < 3:
        raise click.BadParameter(
            f"{value!r} is not COLUMNSxROWS of at least 3x3 dots, such as 9x7", context, option
        )
    return int(match[1]), int(match[2])


@click.command("calibrate", cls=OptnavCommand)
@click.argument("paths", nargs=-1, required=True, type=PATH, metavar="FOLDER|PICTURE...")
@click.option(
    "--catalog",
    "catalogs",
    type=PATH,
    multiple=True,
    help="A control-point catalog; of several, the first has priority where it has points.",
)
@click.option(
    "--solve",
    callback=_parse_solve,
    default=",".join(SOLVED),
    show_default=True,
    metavar="WHAT,...",
    help="What to solve for: focal length, principal point (centre), distortion (k1; of grids k1 "
    "and k2), the mounting's three angles, and by how much pictures are taken later than they say "
    "(clock). Mounting and clock in flight only.",
)
@click.option(
    "--config", type=PATH, help="Settings; `optnav config template calibrate` prints the defaults."
)
@click.option(
    "--grid-spacing-mm",
    "spacing_mm",
    type=Number(1e-3, 1e6),
    help="Pictures show a plane grid of dots or corners that are so far apart; of OpenCV's "
    "asymmetric grid its rows.",
)
@click.option(
    "--grid",
    callback=_parse_size,
    metavar="COLUMNSxROWS",
    help="Its dots, found if left out; a chessboard's inner corners, 4x11 for OpenCV's acircles.",
)
@click.option(
    "--pattern",
    type=click.Choice(["circles", "acircles", "chessboard"]),
    help="By OpenCV's names; dots of either kind are found if left out.",
)
@click.option("--name", metavar="NAME", help="Of the camera that grids give; `grid` if left out.")
@click.option(
    "--distance-mm",
    type=Number(1e-3, 1e9),
    help="From the lens to the middle of the grid in the first picture, as measured.",
)
@click.option(
    "--distance-error-mm", "error_mm", type=Number(1e-6, 1e9), help="Its 1 sigma; 5 if left out."
)
@output_option("Folder for the calibration; an earlier one in it is replaced.")
@workers_option
@pass_progress
def command(
    progress: ConsoleProgress,
    /,
    paths: tuple[Path, ...],
    output: Path,
    solve: tuple[str, ...],
    spacing_mm: float | None,
    **more: Any,
) -> None:
    """Calibrate a camera by the pictures of a route, or by pictures of a grid of dots.

    In flight: the cameras of FOLDER, by its pictures over known ground. Positions and attitudes of
    frames.csv (by satellite navigation and star sensors) are measurements with their sigmas.

    With --grid-spacing-mm: one lens, by one or several pictures of a plane grid of round dots, in
    rows or as OpenCV's asymmetric grid, or of a chessboard (--pattern). Tilted by 20 to 40 deg, or
    at a measured distance, a single picture will do.

    OUTPUT gets cameras/ as found, calibration.json (values, sigmas, correlations, and what is not
    told apart), residuals.csv from before and after, and manifest.json. The cameras go into a
    picture folder in place of the old ones.

    Ends with exit code 4 where frames show too few control points, or all on a line, and where
    pictures show no grid or leave the focal length open.

    \b
    Example:
      optnav calibrate pictures --catalog moon.gpkg -o calibration
      optnav calibrate pictures --catalog moon.gpkg --solve focal,mounting -o calibration
      optnav calibrate grid.png --grid-spacing-mm 10 -o calibration
      optnav report calibration -o calibration.html
    """
    _check_words(click.get_current_context(), spacing_mm, solve)
    if spacing_mm is not None:
        result = _calibrate_by_grids(progress, paths, output, solve, spacing_mm, more)
    else:
        result = _calibrate_in_flight(progress, paths[0], output, solve, **more)
    report_lines(result)
    click.echo(output)


def _check_words(context: click.Context, spacing_mm: float | None, solve: tuple[str, ...]) -> None:
    """Raise UsageError for options of the one kind of calibration with the other."""
    given, by_grid = context.params, spacing_mm is not None
    for name in IN_FLIGHT if by_grid else OF_A_GRID:
        if given[name] not in (None, ()):
            option = next(p for p in context.command.params if p.name == name).opts[0]
            other = "goes without" if by_grid else "wants"
            raise click.UsageError(f"{option} {other} --grid-spacing-mm", context)
    if by_grid:
        source = context.get_parameter_source("solve")
        if source is not click.core.ParameterSource.DEFAULT and (
            "focal" not in solve or not set(solve) <= set(OF_A_LENS)
        ):
            raise click.UsageError(
                "--solve of a grid takes focal, and with it centre and distortion", context
            )
        if given["error_mm"] is not None and given["distance_mm"] is None:
            raise click.UsageError("--distance-error-mm wants --distance-mm", context)
    elif not given["catalogs"]:
        raise click.UsageError("say --catalog of a route, or --grid-spacing-mm of a grid", context)
    elif len(given["paths"]) > 1:
        raise click.UsageError("one FOLDER is calibrated in flight, not several", context)


def _calibrate_by_grids(
    progress: ConsoleProgress,
    pictures: tuple[Path, ...],
    output: Path,
    solve: tuple[str, ...],
    spacing_mm: float,
    given: Mapping[str, Any],
) -> list[str]:
    """Calibrate by grids of dots; `given` are the other options, OF_A_GRID among them."""
    from optnav_cli.calibration.grid_calibration import GridDistance
    from optnav_cli.calibration.grid_job import GridInputs, calibrate_grid
    from optnav_cli.camera.camera_file import is_plain_name
    from optnav_cli.estimation.models.common import Common

    name, distance_mm, error_mm = given["name"], given["distance_mm"], given["error_mm"]
    if name is not None and not is_plain_name(name):
        raise click.UsageError(f"--name is {name!r}; wanted a plain word, the name of a file")
    kinds = [kind for kind in Common if kind.value in solve and kind.value in OF_A_LENS]
    distance = None if distance_mm is None else GridDistance(distance_mm, error_mm or 5.0)
    if given["pattern"] == "chessboard" and given["grid"] is None:
        raise click.UsageError("--pattern chessboard wants --grid, its inner corners: 9x6")
    inputs = GridInputs(
        pictures, spacing_mm, given["grid"], name or "grid", distance, given["pattern"]
    )
    return calibrate_grid(inputs, output, kinds, progress).lines()


def _calibrate_in_flight(
    progress: ConsoleProgress,
    folder: Path,
    output: Path,
    solve: tuple[str, ...],
    *,
    catalogs: tuple[Path, ...],
    config: Path | None,
    workers: int | None,
    **_: Any,
) -> list[str]:
    from optnav_cli.calibration.job import calibrate_folder
    from optnav_cli.calibration.model import CalibrateSettings, load_calibrate_settings
    from optnav_cli.estimation.models.common import Common
    from optnav_cli.navigate.worker import RunInputs

    settings = load_calibrate_settings(config) if config else CalibrateSettings()
    report_compilation()
    kinds = [kind for kind in Common if kind.value in solve]
    inputs = RunInputs(folder, list(catalogs))
    return calibrate_folder(inputs, output, kinds, settings, progress, workers).lines()
