"""`optnav catalog export`: the points as a layer for GIS programs."""

from pathlib import Path

import click

from optnav_cli.options import output_option, path_argument


@click.command(short_help="Write the points as a layer for GIS programs.")
@path_argument("catalog")
@output_option("The layer: a name ending in .geojson, .csv or .gpkg.")
def command(catalog: Path, output: Path) -> None:
    """Write the points of CATALOG with their attributes as a layer, on the body's own sphere.

    A CSV gets a .prj and a .csvt file beside it, so that GIS programs know places and types.

    \b
    Example:
      optnav catalog export tycho.gpkg -o points.geojson
    """
    from catalog.store.export import export
    from catalog.store.reader import Catalog

    with Catalog.open(catalog) as opened:
        number = export(opened, output)
    click.echo(f"{output}: {number} points")
