"""`optnav catalog export`: the points, or the relief, as a layer for GIS programs."""

from pathlib import Path

import click

from optnav_cli.options import output_option, path_argument


@click.command(short_help="Write the points, or the relief, as a layer for GIS programs.")
@path_argument("catalog")
@output_option("The layer: a name ending in .geojson, .csv or .gpkg; .tif for the relief.")
def command(catalog: Path, output: Path) -> None:
    """Write the points of CATALOG with their attributes as a layer, on the body's own sphere.

    A CSV gets a .prj and a .csvt file beside it, so that GIS programs know places and types.
    A .tif gets the relief of the whole body that CATALOG carries: its mean heights and its tops.

    \b
    Example:
      optnav catalog export tycho.gpkg -o points.geojson
      optnav catalog export tycho.gpkg -o relief.tif
    """
    from catalog.store.export import export
    from catalog.store.export_relief import ENDINGS, export_relief
    from catalog.store.reader import Catalog

    with Catalog.open(catalog) as opened:
        if output.suffix.lower() in ENDINGS:
            rows = export_relief(opened, output)
            click.echo(f"{output}: {rows} x {2 * rows} cells")
        else:
            click.echo(f"{output}: {export(opened, output)} points")
