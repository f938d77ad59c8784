"""`optnav orbit`: orbits through fixes and what follows from them; a module for each subcommand."""

import click

from optnav_cli.options import Entry, LazyGroup

_HERE = "optnav_cli.commands"
COMMANDS: dict[str, Entry] = {  # by name, in the order of the help
    "fit": Entry(f"{_HERE}.orbit_fit", "Fit an orbit through the fixes of runs."),
    "predict": Entry(f"{_HERE}.orbit_predict", "Where an orbit leads, ahead or before.", "predict"),
    "export": Entry(
        f"{_HERE}.orbit_predict", "Write an orbit as OEM, SPICE kernel, CSV.", "export"
    ),
    "time": Entry(f"{_HERE}.orbit_time", "When pictures were taken, from a known orbit."),
    "qso": Entry(f"{_HERE}.orbit_qso", "Quasi-satellite orbits of a moon such as Phobos."),
    "landing": Entry(f"{_HERE}.orbit_landing", "Landings: impulse, navigation, touchdown."),
    "delivery": Entry(f"{_HERE}.orbit_delivery", "How accurately corrections lead to a target."),
}


@click.group(cls=LazyGroup, table=lambda: COMMANDS, short_help="Orbits through fixes, and more.")
def command() -> None:
    """Orbits: through the fixes of runs, ahead of them, about small moons, to the ground.

    \b
    Example:
      optnav orbit fit run -o orbit
    """
