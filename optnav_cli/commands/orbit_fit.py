"""`optnav orbit fit`: an orbit through the fixes of runs."""

from pathlib import Path

import click

from optnav_cli.console import announce_compilation, tell
from optnav_cli.options import OptnavCommand, output_option
from optnav_cli.parameters import PATH

SOLVED = ("clock", "focal", "map_offset", "acceleration", "srp")


def _solved(context: click.Context, option: click.Parameter, value: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in value.split(",") if name.strip())
    for name in names:
        if name not in SOLVED:
            raise click.BadParameter(f"{name!r} is none of {', '.join(SOLVED)}", context, option)
    return names


@click.command("fit", cls=OptnavCommand)
@click.argument("runs", nargs=-1, required=True, type=PATH)
@click.option(
    "--config", type=PATH, help="Settings; `optnav config template orbit` prints the defaults."
)
@click.option(
    "--solve",
    callback=_solved,
    default="",
    metavar="WHAT,...",
    help="What to solve for besides the orbit: clock of a camera or run against the first one, "
    "focal length, origin of the map (map_offset), a constant acceleration, sunlight (srp).",
)
@output_option("Folder for the orbit; an earlier one in it is replaced.")
def command(
    runs: tuple[Path, ...], config: Path | None, solve: tuple[str, ...], output: Path
) -> None:
    """Fit an orbit through the solved frames of RUNS, which `optnav navigate` made.

    Forces, noise, parameters with their priors, and prior orbits stand in the settings. OUTPUT gets
    orbit.toml, orbit.csv, residuals.csv, disturbances.csv, smoothed.csv, orbit.oem, run.mcap and
    manifest.json. Ends with exit code 4, and the test that failed, where the fit does not converge
    or the residuals refute it.

    \b
    Example:
      optnav orbit fit run -o orbit
      optnav orbit fit run-1 run-2 --solve clock,focal -o orbit
      optnav orbit fit run --config orbit.toml -o orbit
    """
    from optnav_cli.orbit.settings import OrbitFitSettings, load_orbit_settings
    from optnav_cli.runs.orbit_folder import fit_runs

    settings = load_orbit_settings(config) if config else OrbitFitSettings()
    announce_compilation()
    tell(fit_runs(runs, output, settings, solve, config.parent if config else Path()))
    click.echo(output)
