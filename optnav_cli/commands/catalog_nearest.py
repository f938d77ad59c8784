"""`optnav catalog nearest`: the control point nearest to a place."""

from pathlib import Path

import click

from optnav_cli.options import NumberArguments, latitude, longitude, path_argument


@click.command(cls=NumberArguments, short_help="The control point nearest to a place.")
@path_argument("catalog")
@click.argument("lat", type=float, callback=latitude)
@click.argument("lon", type=float, callback=longitude)
def command(catalog: Path, lat: float, lon: float) -> None:
    """Print the control point of CATALOG nearest to LAT LON (degrees, east positive).

    \b
    Example:
      optnav catalog nearest tycho.gpkg -43.3 -11.2
    """
    from catalog.store.reader import Catalog
    from catalog.store.summary import describe_point, distance_km

    with Catalog.open(catalog) as opened:
        point = opened.point(opened.nearest(lat, lon))
        for key, value in describe_point(point).items():
            click.echo(f"{key}: {value}")
        click.echo(f"distance_km: {distance_km(opened, point, lat, lon):.3f}")
