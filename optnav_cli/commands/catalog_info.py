"""`optnav catalog info`: what a catalog holds."""

from pathlib import Path

import click

from optnav_cli.options import path_argument


@click.command(short_help="What a catalog holds.")
@path_argument("catalog")
def command(catalog: Path) -> None:
    """Print what CATALOG holds, a `key: value` a line, its content digest among them.

    The digest is the one that the catalog states; `optnav catalog verify` tells whether it is true.

    \b
    Example:
      optnav catalog info tycho.gpkg
    """
    from catalog.store.reader import Catalog
    from catalog.store.summary import describe

    with Catalog.open(catalog) as opened:
        for key, value in describe(opened).items():
            click.echo(f"{key}: {value}")
