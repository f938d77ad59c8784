"""`optnav orbit`: orbits through fixes, and what follows from them."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, pass_progress, report_compilation, report_lines
from optnav_cli.options import PATH, LazyGroup, Number, output_option, path_argument

SOLVED = (
    "clock",
    "focal",
    "map_offset",
    "acceleration",
    "srp",
    "vertical",
    "range_bias",
    "range_rate_bias",
    "station_clock",
)
CRAFT = click.option(
    "--craft",
    type=click.IntRange(-(10**9), -2),  # -1 is Geotail
    default=-999,
    show_default=True,
    help="NAIF number of the craft in a .bsp, a negative one.",
)


@click.group(cls=LazyGroup, short_help="Orbits through fixes, and more.")
def command() -> None:
    """Orbits: through the fixes of runs, ahead of them, about small moons, to the ground.

    \b
    Example:
      optnav orbit fit run -o orbit
    """


def _parse_solve(context: click.Context, option: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in value.split(",") if name.strip())
    for name in names:
        if name not in SOLVED:
            raise click.BadParameter(f"{name!r} is none of {', '.join(SOLVED)}", context, option)
    return names


@command.command("fit", short_help="Fit an orbit through the fixes of runs.")
@click.argument("runs", nargs=-1, type=PATH)
@click.option(
    "--config", type=PATH, help="Settings; `optnav config template orbit` prints the defaults."
)
@click.option(
    "--solve",
    callback=_parse_solve,
    default="",
    metavar="WHAT,...",
    help="What to solve for besides the orbit: clock of a camera or run against the first one, "
    "focal length, origin of the map (map_offset), a constant acceleration, sunlight (srp); of "
    "zenith distances the vertical; of signals range_bias, range_rate_bias, station_clock.",
)
@click.option(
    "--measurements",
    type=PATH,
    help="CSV of ranges, Doppler, angles and altimeter heights, fitted together with RUNS.",
)
@click.option("--stations", type=PATH, help="TOML with the stations of its signals.")
@output_option("Folder for the orbit; an earlier one in it is replaced.")
def fit(
    runs: tuple[Path, ...],
    config: Path | None,
    solve: tuple[str, ...],
    measurements: Path | None,
    stations: Path | None,
    output: Path,
) -> None:
    """Fit an orbit through the solved frames of RUNS, which `optnav navigate` made.

    Forces, noise, parameters with their priors, and prior orbits stand in the settings. OUTPUT gets
    orbit.toml, orbit.csv, residuals.csv, disturbances.csv, smoothed.csv, orbit.oem, run.mcap and
    manifest.json. Ends with exit code 4, and the test that failed, where the fit does not converge
    or the residuals refute it.

    A zenith.csv among RUNS, or a folder that has one and no solution.csv, gives zenith distances of
    stars, --measurements other kinds. All are fitted together, whichever there are; OUTPUT gets
    zenith_residuals.csv and measurement_residuals.csv. Without three fixes or zenith distances of
    two stars the settings state a [[prior]].

    \b
    Example:
      optnav orbit fit run -o orbit
      optnav orbit fit run/zenith.csv --solve srp -o orbit
      optnav orbit fit run-1 run-2 --solve clock,focal -o orbit
      optnav orbit fit run --measurements measurements.csv --stations stations.toml -o orbit
      optnav orbit fit run --config orbit.toml -o orbit
    """
    from catalog.inputs import check_input
    from optnav_cli.orbit.fit.job import TrackingFiles, fit_runs
    from optnav_cli.orbit.fit.settings import OrbitFitSettings, load_orbit_settings

    settings = load_orbit_settings(config) if config else OrbitFitSettings()
    report_compilation()
    if stations is not None:
        check_input(stations, "stations")
    if not runs and measurements is None:
        raise click.UsageError("name RUNS, --measurements, or both")
    if stations is not None and measurements is None:
        raise click.UsageError("--stations are those of --measurements; name both or neither")
    beside = config.parent if config else Path()
    tracking = TrackingFiles(measurements, stations) if measurements else None
    report_lines(fit_runs(runs, output, settings, solve, beside, tracking))
    click.echo(output)


@command.command("predict", short_help="Where an orbit leads, ahead or before.")
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
    from optnav_cli.orbit.fit.files import predict_orbit, prediction_lines, write_orbit

    report_compilation()
    path, prediction = predict_orbit(orbit, to_utc, step_s, progress)
    lines = prediction_lines(path, prediction)
    if output is None:
        click.echo("\n".join(lines))
        return
    write_orbit(path.orbit, prediction.rows, output, -999)
    report_lines([*lines[:2], lines[-1]])
    click.echo(output)


@command.command("export", short_help="Write an orbit as OEM, SPICE kernel, CSV.")
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
    from optnav_cli.orbit.fit.files import export_orbit

    export_orbit(orbit, output, craft)
    click.echo(output)


@command.command("time", short_help="When pictures were taken, from a known orbit.")
@path_argument("run")
@click.option(
    "--orbit",
    type=PATH,
    required=True,
    help="The known orbit: a folder of `optnav orbit fit`, a CCSDS OEM, a SPICE .bsp, or a file "
    "with the two lines of a TLE.",
)
@CRAFT
@click.option(
    "--margin",
    "margin_s",
    type=Number(0.0, 1e7),
    default=600.0,
    show_default=True,
    help="Seconds before and after the orbit's arc and the stamps that are searched as well.",
)
@output_option("CSV file for the times.", (".csv",))
def time(run: Path, orbit: Path, craft: int, margin_s: float, output: Path) -> None:
    """Tell when the solved pictures of RUN were taken, from where they were and a known orbit.

    OUTPUT gets a row a picture: its stamp, the time at which the orbit passes its position nearest
    to the stamp, the sigma of that, and all passes within 3 sigmas. Sigmas take the orbit for one
    that these pictures had no part in. A .bsp needs the extra spice, a TLE the extra tle; a picture
    without a time is sought over all of the orbit. Ends with exit code 4 when the orbit passes no
    position.

    \b
    Example:
      optnav orbit time run --orbit orbit -o times.csv
      optnav orbit time run --orbit craft.oem -o times.csv
    """
    from optnav_cli.orbit.fit.files import time_pictures

    report_compilation()
    report_lines(time_pictures(run, orbit, output, margin_s, craft))
    click.echo(output)


@command.command("qso", short_help="Quasi-satellite orbits of a moon such as Phobos.")
@path_argument("settings")
@output_option("Folder for the orbits; earlier ones in it are replaced.")
@pass_progress
def find_qso(progress: ConsoleProgress, settings: Path, output: Path) -> None:
    """Find quasi-satellite orbits: about a moon too light to have satellites of its own.

    SETTINGS is a TOML file, or `bundled:NAME` for one that ships with optnav: distances from the
    surface, the longitude that is to be passed always at the same distance, times, days, forces.
    `optnav config template qso` shows them all.

    OUTPUT gets qso.csv (a row an orbit: its state, how far its passes differ, how much quicker than
    the moon it goes round, and the averaged theory's figures), passes.csv and an OEM of each orbit.
    A start without an orbit has a row with the reason; exit code 4 when none has one.

    \b
    Example:
      optnav orbit qso bundled:qso_55km -o qso
      optnav report qso -o qso.html
    """
    from optnav_cli.orbit.qso.job import qso_folder, qso_lines

    report_compilation()
    rows, mean_motion = qso_folder(settings, output, progress)
    report_lines(qso_lines(rows, mean_motion))
    click.echo(output)


@command.command("landing", short_help="Landings: impulse, navigation, touchdown.")
@path_argument("settings")
@output_option("Folder for the landing; an earlier one in it is replaced.")
@pass_progress
def simulate_landing(progress: ConsoleProgress, settings: Path, output: Path) -> None:
    """Find a departure impulse and fly landings on a moon with drawn errors.

    SETTINGS is a TOML file, or `bundled:NAME` for one that ships with optnav: target, departure,
    transfer, beams, errors, surface, trials. `optnav config template landing` shows them all.

    OUTPUT gets landing.csv (a row a trial: errors of the navigation at the arrival and at the end
    of the descent, where and how fast the craft touches down), impulse.csv, path.csv and
    transfer.oem. A trial that no fit leads down has a row with the reason. Exit code 4 when there
    is no departure impulse, as to a target on the far side, or no trial lands.

    \b
    Example:
      optnav orbit landing bundled:landing_phobos -o landing
      optnav report landing -o landing.html
    """
    from optnav_cli.orbit.landing.job import landing_folder, landing_lines

    report_compilation()
    report_lines(landing_lines(landing_folder(settings, output, progress)))
    click.echo(output)


@command.command("delivery", short_help="How accurately corrections lead to a target.")
@path_argument("settings")
@output_option("Folder for the tables; earlier ones in it are replaced.")
@pass_progress
def evaluate_delivery(progress: ConsoleProgress, settings: Path, output: Path) -> None:
    """Bound the errors of an arrival and the corrections of a schedule, and draw them in trials.

    SETTINGS is a TOML file, or `bundled:NAME` for one that ships with optnav: target and aim, start
    of the reference path, errors of injection and burns, times of corrections, measurements.
    `optnav config template delivery` shows them all.

    OUTPUT gets stages.csv (a row a correction and the arrival: errors and velocity change by boxes
    that hold all bounded errors, and by trials), boxes.csv and arrivals.csv. Exit code 4 when the
    start does not lead to the target or nothing is measured.

    \b
    Example:
      optnav orbit delivery bundled:delivery_moon -o delivery
      optnav report delivery -o delivery.html
    """
    from optnav_cli.orbit.delivery.job import delivery_folder, delivery_lines

    report_lines(delivery_lines(delivery_folder(settings, output, progress)))
    click.echo(output)
