"""`optnav catalog export`: the points or the relief as a layer, a patch as a solid."""

from pathlib import Path

import click

from optnav_cli.options import output_option, path_argument


@click.command(short_help="Write the points or the relief as a layer, a patch as a solid.")
@path_argument("catalog")
@output_option(
    "The layer: a name ending in .geojson, .csv or .gpkg; .tif for the relief; .obj or .glb for a "
    "patch."
)
@click.option("--point", "point_id", type=int, metavar="ID", help="The point of the patch.")
@click.option(
    "--level", type=int, default=0, show_default=True, help="The patch's level, 0 the finest."
)
def command(catalog: Path, output: Path, point_id: int | None, level: int) -> None:
    """Write the points of CATALOG with their attributes as a layer, on the body's own sphere.

    A CSV gets a .prj and a .csvt file beside it, so that GIS programs know places and types.
    A .tif gets the relief of the whole body that CATALOG carries: its mean heights and its tops.
    A .obj or .glb gets the ground of a patch of --point as a closed solid, metres from the point.

    \b
    Example:
      optnav catalog export tycho.gpkg -o points.geojson
      optnav catalog export tycho.gpkg -o relief.tif
      optnav catalog export tycho.gpkg --point 6420 -o patch.glb
    """
    from catalog.errors import UsageError
    from catalog.store import export_patch
    from catalog.store.export import export
    from catalog.store.export_relief import ENDINGS, export_relief
    from catalog.store.reader import Catalog

    with Catalog.open(catalog) as opened:
        if output.suffix.lower() in ENDINGS:
            rows = export_relief(opened, output)
            click.echo(f"{output}: {rows} x {2 * rows} cells")
        elif output.suffix.lower() in export_patch.ENDINGS:
            if point_id is None:
                raise UsageError(f"{output}: a solid is of one patch; name its point with --point")
            triangles = export_patch.export_patch(opened, point_id, level, output)
            click.echo(f"{output}: {triangles} triangles")
        else:
            click.echo(f"{output}: {export(opened, output)} points")
