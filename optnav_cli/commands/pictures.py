"""`optnav import | simulate | navigate | adjust | evaluate | export | report`: work on pictures."""

from pathlib import Path
from typing import Any

import click

from optnav_cli.console import ConsoleProgress, pass_progress, report_compilation, report_lines
from optnav_cli.options import (
    PATH,
    Number,
    OptnavCommand,
    OutputOption,
    SolvedLimit,
    json_option,
    matcher_option,
    output_option,
    path_argument,
    scheduler_option,
    threads_option,
    workers_option,
)

LIMIT = Number(0.0, 1e9, min_open=True)
SOLVABLE = ("body_rotation", "origin", "scale", "boresight", "focal")

MEASURED_KINDS = ("stars", "cylinder")  # runs of single measurements, without a position


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
    "--orbit",
    type=PATH,
    help="Folder of `optnav orbit fit`: the prior of frames that have none.",
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
    "evaluate", cls=OptnavCommand, short_help="Compare a run's positions with the truth."
)
@path_argument("run")
@click.option(
    "--truth",
    type=PATH,
    required=True,
    help="The truth.csv beside the simulated pictures; of a hazard folder a terrain model.",
)
@click.option("--max-horizontal-m", type=LIMIT, help="Limit of the rms along and across.")
@click.option("--max-height-m", type=LIMIT, help="Limit of the rms of the height.")
@click.option(
    "--min-solved",
    type=SolvedLimit(),
    help="Least number of solved frames (as 10), or share of all frames (as 0.9 or 90%).",
)
@click.option(
    "--max-nees",
    type=LIMIT,
    help="Limit of the mean normalised error squared, a degree of freedom: 1 is expected of an "
    "honest covariance.",
)
@click.option(
    "--max-wrong",
    type=click.IntRange(0, 10**9),
    help="Most solved frames whose error is beyond 5 stated sigmas.",
)
@click.option(
    "--max-dangerous-share",
    type=Number(0.0, 1.0),
    help="Of a hazard folder: limit of the mean share of its pads above 7 deg, as 0.07.",
)
@json_option
def evaluate(
    run: Path, truth: Path, as_json: bool, max_dangerous_share: float | None, **limits: Any
) -> None:
    """Compare the positions of RUN with the truth, or the pads of a hazard folder.

    Prints a table of errors along the radius (R), the motion (N) and across (B), and writes
    evaluation.json and evaluation.csv into RUN. Ends with exit code 5 when a limit is passed, and
    with 4 when no frame is solved and --min-solved does not say that this passes a limit.

    RUN may be what `optnav hazard` made: its pads are judged by the slopes of a terrain model. Or
    an orbit by `optnav orbit fit`: its places at the fixes, its velocity, and its predictions.

    \b
    Example:
      optnav evaluate run --truth pictures/truth.csv --max-horizontal-m 30
      optnav evaluate run --truth pictures/truth.csv --min-solved 90% --max-wrong 0
      optnav evaluate orbit --truth pictures/truth.csv
      optnav evaluate sky-run --truth sky/truth.csv
      optnav evaluate hazard --truth site.tif --max-dangerous-share 0.07
    """
    from catalog.errors import UsageError
    from catalog.files import is_made_by_optnav
    from optnav_cli.evaluation.figures import Limits, check_limits, list_limit_checks
    from optnav_cli.evaluation.files import evaluate_run, format_table, summarise, write_evaluation
    from optnav_cli.output.wording import format_json

    if is_made_by_optnav(run, "hazard"):
        if any(limit is not None for limit in limits.values()):
            raise UsageError(f"{run}: is a hazard folder; its limit is --max-dangerous-share")
        _evaluate_pads(run, truth, as_json, max_dangerous_share)
        return
    if max_dangerous_share is not None:
        raise UsageError(f"{run}: is no hazard folder, whose limit --max-dangerous-share is")
    if is_made_by_optnav(run, "orbit"):
        _evaluate_orbit(run, truth, as_json, limits)
        return
    for kind in MEASURED_KINDS:
        if is_made_by_optnav(run, kind):
            if any(limit is not None for limit in limits.values()):
                raise UsageError(f"{run}: is a {kind} folder, which the limits are not for")
            _evaluate_measured(run, truth, kind, as_json)
            return
    evaluation, wanted = evaluate_run(run, truth), Limits(**limits)
    figures = evaluation.figures_if_any()
    if as_json:
        checks = [check._asdict() for check in list_limit_checks(figures, wanted)]
        document = {"run": run, "truth": truth} | summarise(evaluation) | {"limits": checks}
        click.echo(format_json(document))
    else:
        click.echo(format_table(evaluation))
    if not evaluation.any_solved:  # a limit that this passes is what was asked for
        check_limits(figures, wanted)
    write_evaluation(evaluation, run)
    check_limits(figures, wanted)


def _evaluate_measured(folder: Path, truth: Path, kind: str, as_json: bool) -> None:
    from optnav_cli.evaluation.measured import evaluate_cylinder, evaluate_stars, write_measured
    from optnav_cli.output.wording import format_json

    evaluation = (evaluate_stars if kind == "stars" else evaluate_cylinder)(folder, truth)
    document = {"run": folder, "truth": truth} | evaluation.summary()
    click.echo(format_json(document) if as_json else evaluation.to_text())
    write_measured(evaluation, folder)


def _evaluate_orbit(folder: Path, truth: Path, as_json: bool, given: dict[str, Any]) -> None:
    from optnav_cli.evaluation.figures import Limits, check_limits, list_limit_checks
    from optnav_cli.orbit.fit.evaluate import evaluate_orbit, write_orbit_evaluation
    from optnav_cli.output.wording import format_json

    evaluation, wanted = evaluate_orbit(folder, truth), Limits(**given)
    if as_json:
        checks = [check._asdict() for check in list_limit_checks(evaluation.figures, wanted)]
        document = {"run": folder, "truth": truth} | evaluation.summary() | {"limits": checks}
        click.echo(format_json(document))
    else:
        click.echo(evaluation.to_text())
    write_orbit_evaluation(evaluation, folder)
    check_limits(evaluation.figures, wanted)


def _evaluate_pads(folder: Path, truth: Path, as_json: bool, limit: float | None) -> None:
    from dataclasses import asdict

    from optnav_cli.hazard.evaluate import evaluate_pads, write_pad_evaluation
    from optnav_cli.output.wording import format_json

    figures, pads = evaluate_pads(folder, truth)
    if as_json:
        limits = {"max_dangerous_share": limit}  # null for none
        click.echo(format_json({"run": folder, "truth": truth} | asdict(figures) | limits))
    else:
        click.echo(figures.to_text())
    write_pad_evaluation(folder, figures, pads)
    figures.check(limit)


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


@click.command("export", cls=OptnavCommand)
@path_argument("run")
@output_option("The layers, a GeoPackage (.gpkg); an earlier export is replaced.", (".gpkg", ""))
def export(run: Path, output: Path) -> None:
    """Write RUN as layers on the body's own coordinate system, which QGIS and GDAL open.

    camera_track is a line below each camera; camera_positions has a point for each frame, with its
    sigma, method and reason; footprints the ground in each solved frame, up to the limb;
    matched_points the control points that were tried. Of a run of `stars` the boresights on the
    sky, of `cylinder` the camera's places about its axis.

    \b
    Example:
      optnav export run -o run.gpkg
    """
    from catalog.files import is_made_by_optnav
    from optnav_cli.navigate.gis_layers import export_run
    from optnav_cli.output.run_folder import read_run
    from optnav_cli.report.measured_layers import export_cylinder, export_stars

    if is_made_by_optnav(run, "stars"):
        counts = export_stars(run, output)
    elif is_made_by_optnav(run, "cylinder"):
        counts = export_cylinder(run, output)
    else:
        counts = export_run(read_run(run), output)
    click.echo(f"{output}: {', '.join(f'{name} {count}' for name, count in counts.items())}")


@click.command("report", cls=OptnavCommand)
@path_argument("source")
@output_option(
    "The page, one HTML file with its pictures inside; or .svg, a run's errors alone.",
    (".html", ".svg", ""),
    required=False,
)
@click.option(
    "--foxglove-layout",
    "layout",
    cls=OutputOption,
    endings=(".json",),
    help="A layout in which Foxglove shows run.mcap of a run: import it there.",
)
def report(source: Path, output: Path | None, layout: Path | None) -> None:
    """Make a page about SOURCE, a run or hazard folder or a catalog.

    Of a run that was compared with the truth it shows the errors against time and height, by
    method and camera; of another one what its solutions state.

    \b
    Example:
      optnav report run -o report.html
      optnav report run -o errors.svg
      optnav report moon.gpkg -o catalog.html
      optnav report hazard -o hazard.html
      optnav report orbit -o orbit.html
      optnav report run --foxglove-layout run.json
    """
    from optnav_cli.pages import write_report
    from optnav_cli.report.foxglove_layout import write_layout

    if output is None and layout is None:
        raise click.UsageError("nothing to make; name a page (-o) or a --foxglove-layout")
    for path, write in ((output, write_report), (layout, write_layout)):
        if path is not None:
            write(source, path)
            click.echo(path)


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
