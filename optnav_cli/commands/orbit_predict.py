"""`optnav orbit predict | export`: where a fitted orbit leads, and its files for others."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress, tell
from optnav_cli.options import OptnavCommand, output_option, path_argument
from optnav_cli.parameters import Number

CRAFT = click.option(
    "--craft",
    type=click.IntRange(-(10**9), -2),  # -1 is Geotail
    default=-999,
    show_default=True,
    help="NAIF number of the craft in a .bsp, a negative one.",
)


@click.command("predict", cls=OptnavCommand)
@path_argument("orbit")
@click.option("--to", "to_utc", required=True, metavar="UTC", help="When the prediction ends.")
@click.option(
    "--step",
    "step_s",
    type=Number(1e-3, 1e7),
    default=60.0,
    show_default=True,
    help="Seconds between its states.",
)
@output_option(
    "File for the states: .csv with the columns of orbit.csv, or a CCSDS .oem. Without it a table "
    "is printed.",
    (".csv", ".oem"),
    required=False,
)
@pass_progress
def predict(
    progress: ConsoleProgress, orbit: Path, to_utc: str, step_s: float, output: Path | None
) -> None:
    """Predict ORBIT, a folder of `optnav orbit fit`, to a time ahead of its arc or before it.

    The covariance grows by that of the parameters, of arcs of thrust and of what the forces leave
    out. A path that meets the body's surface ends there, and the time is said; exit code 4 where it
    does before the first state.

    \b
    Example:
      optnav orbit predict orbit --to 2026-01-01T12:00:00Z --step 600
      optnav orbit predict orbit --to 2026-01-01T12:00:00Z -o ahead.oem
    """
    from optnav_cli.runs.orbit_files import predict_orbit, prediction_lines, write_orbit

    announce_compilation()
    path, prediction = predict_orbit(orbit, to_utc, step_s, progress)
    lines = prediction_lines(path, prediction)
    if output is None:
        click.echo("\n".join(lines))
        return
    write_orbit(path, prediction.rows, output, -999)
    tell([*lines[:2], lines[-1]])
    click.echo(output)


@click.command("export", cls=OptnavCommand)
@path_argument("orbit")
@CRAFT
@output_option(
    "File: .oem (CCSDS OEM 2.0 with covariances), .bsp (SPICE, type 13) or .csv.",
    (".oem", ".bsp", ".csv"),
)
def export(orbit: Path, craft: int, output: Path) -> None:
    """Write the states of ORBIT, a folder of `optnav orbit fit`, for other programs.

    A .bsp needs the extra spice: pip install 'optnav[spice]'.

    \b
    Example:
      optnav orbit export orbit -o orbit.bsp
      optnav orbit export orbit -o orbit.oem
    """
    from optnav_cli.runs.orbit_files import export_orbit

    export_orbit(orbit, output, craft)
    click.echo(output)
