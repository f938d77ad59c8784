"""`optnav catalog`: look at, compare, verify and export a catalog."""

import click

from optnav_cli.lazy_group import Entry, LazyGroup

_HERE = "optnav_cli.commands"
COMMANDS = {
    "info": Entry(f"{_HERE}.catalog_info", "What a catalog holds, a `key: value` a line."),
    "nearest": Entry(f"{_HERE}.catalog_nearest", "The control point nearest to a place."),
    "show": Entry(f"{_HERE}.catalog_show", "A control point's attributes and a picture of it."),
    "compare": Entry(f"{_HERE}.catalog_compare", "What differs between two catalogs."),
    "verify": Entry(f"{_HERE}.catalog_verify", "Read everything and check every checksum."),
    "export": Entry(f"{_HERE}.catalog_export", "Write the points as a layer for GIS programs."),
}


@click.group(cls=LazyGroup, table=lambda: COMMANDS, short_help="Look at, compare, verify, export.")
def command() -> None:
    """Look at, compare, verify and export a catalog.

    \b
    Examples:
      optnav catalog info tycho.gpkg
      optnav catalog nearest tycho.gpkg -43.3 -11.2
    """
