"""`optnav import | simulate | navigate | adjust`: work on pictures."""

from pathlib import Path
from typing import Any

import click

from optnav_cli.console import ConsoleProgress, pass_progress, report_compilation, report_lines
from optnav_cli.options import (
    PATH,
    Number,
    OptnavCommand,
    matcher_option,
    output_option,
    path_argument,
    scheduler_option,
    threads_option,
    workers_option,
)

SOLVABLE = ("body_rotation", "origin", "scale", "boresight", "focal")


@click.command(
    "simulate", cls=OptnavCommand, short_help="Make a folder of pictures with known positions."
)
@path_argument("scenario")
@output_option("Folder for the pictures; an earlier simulation in it is replaced.")
@threads_option
@scheduler_option("the scenario's terrain models and kernels")
@pass_progress
def simulate(
    progress: ConsoleProgress,
    scenario: Path,
    output: Path,
    workers: int | None,
    scheduler: str | None,
) -> None:
    """Make a folder of pictures as a camera over the terrain of SCENARIO takes them.

    The folder is what `optnav navigate` reads, with the truth in truth.csv beside it. SCENARIO is a
    file, or `bundled:NAME` for one that `optnav config list scenarios` shows.

    A stopped simulation goes on where it was when the same command is given again; what is done
    lies in OUTPUT.work until then. Pictures of the same scenario are left as they are.

    \b
    Example:
      optnav config template scenario > flight.toml
      optnav simulate flight.toml -o pictures
      optnav simulate bundled:demo -o pictures
    """
    from catalog.config import resolve_config
    from optnav_cli.simulation.job import simulate_folder

    report_compilation()
    named = resolve_config(scenario, "scenarios")
    simulate_folder(named, output, progress, workers, scheduler)
    click.echo(output)


@click.command(
    "navigate", cls=OptnavCommand, short_help="Find the camera's position for each picture."
)
@path_argument("folder")
@click.option(
    "--catalog",
    "catalogs",
    type=PATH,
    multiple=True,
    help="A control-point catalog to navigate with. Of several, the first has priority where it "
    "has points. Without any the limb alone gives positions.",
)
@click.option(
    "--config", type=PATH, help="Settings; `optnav config template navigate` prints the defaults."
)
@matcher_option
@click.option(
    "--relief",
    type=PATH,
    help="A terrain model of the whole body for the horizon; by default the relief that a catalog "
    "carries.",
)
@click.option(
    "--orbit", type=PATH, help="Folder of `optnav orbit fit`: the prior of frames that have none."
)
@output_option("Folder for the results; an earlier run in it is replaced.")
@workers_option
@scheduler_option("pictures, catalogs, --relief and --orbit")
@pass_progress
def navigate(
    progress: ConsoleProgress,
    /,
    folder: Path,
    config: Path | None,
    output: Path,
    workers: int | None,
    scheduler: str | None,
    **given: Any,
) -> None:
    """Find the camera's position for each picture of FOLDER.

    FOLDER holds run.toml, cameras/, frames.csv and the pictures. The run folder gets solution.csv
    (a row a frame), matches.csv (a row a control point), run.mcap, overlays and manifest.json.

    Without a catalog each frame is solved by the limb of the body: of its relief where --relief
    gives one, else of its smooth ellipsoid, whose unknown relief the sigmas then hold.

    A frame without a prior position in frames.csv is solved by itself: by the limb of the body,
    then by control points; earlier frames and other cameras at the same time serve where it shows
    no limb.

    A folder with points.csv, places that a person found in its pictures, needs neither catalog nor
    prior nor the pictures themselves.

    A stopped run goes on where it was when the same command is given again; what is done lies in
    OUTPUT.work until then. A run that is there already, from the same inputs, is left as it is.

    With --orbit, where the orbit leads is the prior of a frame that states none, with the orbit's
    covariance: for a second pass over the pictures that it was fitted to, or for others near them.

    Ends with exit code 4 when no frame could be solved.

    \b
    Example:
      optnav navigate pictures --catalog tycho.gpkg --catalog moon.gpkg -o run
      optnav navigate pictures --catalog moon.gpkg --orbit orbit -o run-2
      optnav navigate pictures --catalog moon.gpkg -o run --workers 4
      optnav navigate pictures --relief bundled:moon_gld100_4ppd.tif -o run
    """
    from optnav_cli.control_points.settings import NavigateSettings, load_settings
    from optnav_cli.navigate.job import navigate_folder
    from optnav_cli.navigate.worker import RunInputs
    from optnav_cli.output.run_folder import summarise_run

    settings = load_settings(config) if config else NavigateSettings()
    report_compilation()
    inputs = RunInputs(folder, settings=settings, **given)
    solutions = navigate_folder(inputs, output, progress, workers=workers, scheduler=scheduler)
    report_lines(summarise_run(solutions))
    click.echo(output)


@click.command(
    "import", cls=OptnavCommand, short_help="Make a picture folder of an archive's pictures."
)
@click.argument("files", type=PATH, nargs=-1, required=True)
@output_option("Picture folder to make; an earlier import in it is replaced.")
@click.option("--table", metavar="NAME", help="Table of keywords: a shipped one's name or a path.")
@click.option("--camera", metavar="NAME", help="The camera, where the table names none or another.")
@click.option("--body", metavar="NAME", help="The body, where the labels name none or another.")
@click.option(
    "--picture",
    "pictures",
    type=PATH,
    multiple=True,
    help="The picture, in place of that of the label; once for each of FILES.",
)
@click.option(
    "--kernel",
    "kernels",
    type=PATH,
    multiple=True,
    help="A SPICE kernel, for how the body turns; of a list of times where the camera is, too.",
)
def import_pictures(files: tuple[Path, ...], output: Path, **given: Any) -> None:
    """Make a picture folder of FILES: pictures of an archive with the geometry of their labels.

    FILES are ISIS cubes with the tables of spiceinit, PDS3 or PDS4 labels, FITS files, lists of
    settings, or a .csv with the columns file and utc, whose geometry SPICE kernels have. What their
    keywords mean says a table of the mission's camera; one that ships is taken where it fits.

    The geometry becomes priors with the errors that such labels have. What is not known is said, a
    line each; a file that cannot be used is left out, with the reason.

    \b
    Example:
      optnav import m0126865998f4_2p_iof.fit -o eros
      optnav import *.lbl -o comet
      optnav import AS15-M-0297.cub --picture AS15-M-0297.png -o apollo
      optnav import times.csv --table my.toml --kernel craft.bsp --kernel craft.bc -o pictures
    """
    from optnav_cli.archives.job import ImportOptions, import_folder

    report_lines(import_folder(files, output, ImportOptions(**given)).remarks)
    click.echo(output)


class SolveOption(click.ParamType):  # type: ignore[type-arg] # generic since 8.4 only
    """Names of what is common to frames, with commas between them; "none" for nothing."""

    name = "WHAT,..."

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        if isinstance(value, tuple):
            return value
        names = tuple(name.strip() for name in str(value).split(","))
        if names == ("none",):
            return ()
        for name in names:
            if name not in SOLVABLE:
                self.fail(f"{name!r} is none of {', '.join(SOLVABLE)}, or 'none'", param, ctx)
        return names


@click.command(
    "adjust",
    cls=OptnavCommand,
    short_help="Adjust the frames of runs together, and what is common.",
)
@click.argument("runs", nargs=-1, required=True, type=PATH)
@click.option(
    "--solve",
    type=SolveOption(),
    default="body_rotation,origin,scale,boresight",
    show_default=True,
    help="What is common to the frames: rotation of the body frame, origin and scale of the "
    "catalog, boresight and focal length (focal) of each camera; or none.",
)
@click.option(
    "--position-sigma-m",
    type=Number(0.001, 1e9),
    help="What stated positions scatter by, a component, where frames.csv states more: sigmas for "
    "a search hold what all frames have in common, too.",
)
@click.option(
    "--attitude-sigma-arcsec",
    type=Number(1e-3, 648_000.0),
    help="The same of stated attitudes, an axis.",
)
@output_option("Folder for the adjusted run; an earlier one in it is replaced.")
def adjust(
    runs: tuple[Path, ...], solve: tuple[str, ...], output: Path, **scatter: float | None
) -> None:
    """Adjust all frames of RUNS, which `optnav navigate` solved, in one least squares.

    The positions and attitudes of frames.csv count with their sigmas, matches with what the runs
    state of their positions. Prints what is common to the frames with its sigmas, and names what
    they do not tell apart. OUTPUT gets solution.csv and matches.csv of the adjusted poses,
    common.json and common.csv, and run.toml, the body's file and cameras/ as found: in a picture
    folder they make `optnav navigate` use them.

    \b
    Example:
      optnav adjust run -o adjusted
      optnav adjust run --position-sigma-m 60 --attitude-sigma-arcsec 60 -o adjusted
      optnav adjust run-1 run-2 --solve body_rotation,boresight -o adjusted
    """
    from optnav_cli.calibration.adjust_job import LabelScatter, adjust_runs
    from optnav_cli.estimation.models.common import Common

    kinds = [kind for kind in Common if kind.value in solve]
    result = adjust_runs(runs, output, kinds, LabelScatter(**scatter))
    report_lines(result.lines())
    click.echo(output)
