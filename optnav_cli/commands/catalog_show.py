"""`optnav catalog show`: a control point and a picture of its levels, or all points of a body."""

from pathlib import Path

import click

from optnav_cli.console import announce_compilation
from optnav_cli.options import NumberArguments, output_option, path_argument


@click.command(cls=NumberArguments, short_help="A picture of a control point, or of a small body.")
@path_argument("catalog")
@click.argument("point_id", metavar="[ID]", type=int, required=False)
@output_option(
    "The picture (PNG); CATALOG-ID.png or CATALOG.png in this folder by default.", required=False
)
def command(catalog: Path, point_id: int | None, output: Path | None) -> None:
    """Print what CATALOG says about control point ID and draw its levels.

    In the picture: heights by colour with relief shading, and below them the brightness by Hapke
    with cast shadows, finest level left.

    Without an ID a small body whose shape the catalog carries is drawn from its six sides, with
    all points, usable or why not.

    \b
    Example:
      optnav catalog show tycho.gpkg 6420 -o point.png
      optnav catalog show phobos.gpkg -o phobos.png
    """
    from catalog.store.drawing import check_png_place, draw_pyramid, write_png
    from catalog.store.reader import Catalog
    from catalog.store.summary import describe_point

    announce_compilation()
    place = output or Path(f"{catalog.stem}{'' if point_id is None else f'-{point_id}'}.png")
    check_png_place(place)
    with Catalog.open(catalog) as opened:
        if point_id is None:
            from optnav_cli.output.report.body_figure import sides_picture

            write_png(sides_picture(opened), place)
        else:
            pyramid = opened.pyramid(point_id)
            for key, value in describe_point(pyramid.point).items():
                click.echo(f"{key}: {value}")
            write_png(draw_pyramid(pyramid, opened.meta.map_radius_m), place)
    click.echo(f"picture: {place}")
