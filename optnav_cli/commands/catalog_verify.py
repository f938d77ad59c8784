"""`optnav catalog verify`: read everything and check every checksum."""

from pathlib import Path

import click

from catalog.errors import DataError
from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress
from optnav_cli.options import path_argument

SHOWN = 50


@click.command(short_help="Read everything and check every checksum.")
@path_argument("catalog")
@pass_progress
def command(progress: ConsoleProgress, catalog: Path) -> None:
    """Read all of CATALOG, check every checksum and compute its content digest anew.

    Prints what is damaged, by table, point and level, and ends with exit code 3 if anything is. A
    catalog that a GIS program wrote its styles to is whole as long as its own content is.

    \b
    Example:
      optnav catalog verify tycho.gpkg
    """
    from catalog.store.verify import verify

    announce_compilation()
    found = verify(catalog, progress)
    for problem in found.problems[:SHOWN]:
        click.echo(f"damaged: {problem}")
    if len(found.problems) > SHOWN:
        click.echo(f"damaged: and {len(found.problems) - SHOWN} more")
    click.echo(f"points: {found.points}")
    click.echo(f"patches: {found.patches}")
    click.echo(f"digest: {found.computed or 'unknown'}")
    if found.seal is not None:
        click.echo(f"file: {found.seal.value}")
    if not found.sound:
        raise DataError(
            f"{catalog}: is damaged ({len(found.problems)} findings); restore it or build it again"
        )
