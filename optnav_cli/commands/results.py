"""`optnav evaluate | export | report`: what was found, against the truth, on maps, on pages."""

from pathlib import Path
from typing import Any

import click

from optnav_cli.console import ConsoleProgress, pass_progress
from optnav_cli.options import (
    PATH,
    Number,
    OptnavCommand,
    OutputOption,
    SolvedLimit,
    json_option,
    output_option,
    path_argument,
)

LIMIT = Number(0.0, 1e9, min_open=True)
MEASURED_KINDS = ("stars", "cylinder")  # runs of single measurements, without a position


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


@click.command("export", cls=OptnavCommand)
@path_argument("run")
@output_option(
    "The layers, a GeoPackage (.gpkg), or with --ortho a folder; an earlier one is replaced.",
    (".gpkg", ""),
)
@click.option("--ortho", is_flag=True, help="Lay the solved pictures on the ground of --dem.")
@click.option("--dem", type=PATH, help="Heights for --ortho: a terrain model of the ground.")
@click.option(
    "--dem-sigma-m", type=LIMIT, help="1 sigma of these heights, m; counts where a view is oblique."
)
@click.option("--posting-m", type=LIMIT, help="Pixel of the maps, m; as fine as the pictures.")
@click.option("--pictures", type=PATH, help="The picture folder, where it is not in its old place.")
@pass_progress
def export(progress: ConsoleProgress, /, run: Path, output: Path, **given: Any) -> None:
    """Write RUN as layers on the body's own coordinate system, which QGIS and GDAL open.

    camera_track is a line below each camera; camera_positions has a point for each frame, with its
    sigma, method and reason; footprints the ground in each solved frame, up to the limb;
    matched_points the control points that were tried. Of a run of `stars` the boresights on the
    sky, of `cylinder` the camera's places about its axis.

    With --ortho a folder of GeoTIFFs, one a solved frame: its counts on a map, and how far off each
    place is, 1 sigma in m; ortho.csv lists them.

    \b
    Example:
      optnav export run -o run.gpkg
      optnav export run --ortho --dem moon.tif -o maps
    """
    if given.pop("ortho"):
        _export_ortho(run, output, given, progress)
        return
    if named := [f"--{name.replace('_', '-')}" for name, value in given.items() if value]:
        raise click.UsageError(f"{', '.join(named)}: for --ortho, which is not there")
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


def _export_ortho(
    run: Path, output: Path, given: dict[str, Any], progress: ConsoleProgress
) -> None:
    from optnav_cli.navigate.orthophoto import OrthoSettings, export_orthophotos
    from optnav_cli.output.run_folder import read_run

    if given["dem"] is None:
        raise click.UsageError("--ortho: wants --dem, the terrain model of the ground")
    if output.suffix:
        raise click.UsageError(f"--ortho: makes a folder; '{output.name}' is the name of a file")
    settings = OrthoSettings(
        given["dem"], given["dem_sigma_m"] or 0.0, given["posting_m"], given["pictures"]
    )
    rows = export_orthophotos(read_run(run), settings, output, progress)
    made = [row for row in rows if row["status"] == "solved"]
    click.echo(f"{output}: {len(made)} of {len(rows)} frames laid out")
    for row in rows:
        if row["status"] != "solved":
            click.echo(f"{row['file']}: {row['reason']}")


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
