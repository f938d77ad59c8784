"""Runs of stars and cylinders for GIS programs: boresights on the sky, places of the camera."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from catalog.errors import DataError, OutputError
from catalog.files import replace_file
from catalog.geometry.rotations import rotation_from_quaternion
from catalog.store.connection import SIDECARS
from catalog.store.geopackage import (
    BLUE,
    MOON_RADIUS_M,
    UNDATED,
    Feature,
    FeatureLayer,
    Rule,
    describe_geopackage,
    encode_point,
    format_style,
    list_columns,
    open_new_geopackage,
)
from optnav_cli.frames.tables import ATTITUDES, CYLINDER, QUATERNION
from optnav_cli.output.manifest import read_manifest

ENDING = ".gpkg"
# Of the GeoPackage standard: numbers of an undefined Cartesian and an undefined geographic system.
CARTESIAN, GEOGRAPHIC = -1, 0
_ROW = ("file TEXT NOT NULL", "utc TEXT NOT NULL", "status TEXT NOT NULL", "reason TEXT NOT NULL")
BORESIGHTS = FeatureLayer(
    "boresights",
    "POINT",
    "Where the camera's axis points, right ascension (-180 to 180) and declination, ICRS, deg",
    (
        *(*_ROW, "ra_deg DOUBLE", "dec_deg DOUBLE", "sigma_across_arcsec DOUBLE"),
        *("sigma_about_arcsec DOUBLE", "n_used INTEGER", "residual_rms_px DOUBLE"),
    ),
    format_style(Rule("boresight", "", "circle", BLUE, 2.4)),
)
PLACES = FeatureLayer(
    "camera_places",
    "POINT",
    "The camera from the cylinder's axis, m: y towards the light, x to where theta grows",
    (
        *(*_ROW, "zone TEXT NOT NULL", "d_m DOUBLE", "d_sigma_m DOUBLE", "theta_deg DOUBLE"),
        *("theta_sigma_deg DOUBLE", "bearing_deg DOUBLE", "vx_m_s DOUBLE", "vy_m_s DOUBLE"),
    ),
    format_style(Rule("camera", "", "circle", BLUE, 2.4)),
)


def export_stars(run: Path, path: Path) -> dict[str, int]:
    """Write the boresights of a run of `stars` to a .gpkg file; return how many rows there are.

    Raises DataError for a damaged run, OutputError for another ending or a file of other contents.
    """
    return _write_layer(path, BORESIGHTS, GEOGRAPHIC, lambda: _list_boresights(run))


def export_cylinder(run: Path, path: Path) -> dict[str, int]:
    """Write the camera's places of a run of `cylinder`; as `export_stars`."""
    return _write_layer(path, PLACES, CARTESIAN, lambda: _list_places(run))


def _write_layer(
    path: Path, layer: FeatureLayer, srs_id: int, make: Callable[[], Iterator[Feature]]
) -> dict[str, int]:
    if path.suffix.lower() != ENDING:
        raise OutputError(f"{path}: a run is written as {ENDING}; choose a name that ends so")
    features = list(make())

    def is_ours(place: Path) -> bool:
        return list_columns(place, layer.name) == layer.names

    with replace_file(path, is_ours, SIDECARS) as partial, open_new_geopackage(partial) as db:
        describe_geopackage(db, "moon", MOON_RADIUS_M, UNDATED)
        layer.create(db)
        layer.register(db, srs_id, layer.fill(db, iter(features)), UNDATED)
    return {layer.name: len(features)}


def _list_boresights(run: Path) -> Iterator[Feature]:
    for number, row in enumerate(ATTITUDES.rows(run / "attitudes.csv"), start=1):
        head = tuple(row[name] for name in ("file", "utc", "status", "reason"))
        quaternion = row.vector(QUATERNION)
        if quaternion is None:
            yield (number, None, *head, *(None,) * 6), None
            continue
        x, y, z = rotation_from_quaternion(*quaternion).inv().apply((0.0, 0.0, 1.0))
        ra, dec = (
            float(np.degrees(np.arctan2(y, x))),
            float(np.degrees(np.arcsin(np.clip(z, -1, 1)))),
        )
        across = [row.number(f"sigma_{axis}_arcsec") for axis in "xy"]
        worst = None if None in across else max(value for value in across if value is not None)
        cells = (ra, dec, worst, row.number("sigma_z_arcsec"), row.count("n_used"))
        geometry = encode_point(ra, dec, GEOGRAPHIC)
        yield (number, geometry, *head, *cells, row.number("residual_rms_px")), (ra, dec, ra, dec)


def _list_places(run: Path) -> Iterator[Feature]:
    inputs = read_manifest(run).get("inputs")
    radius = inputs.get("radius_m") if isinstance(inputs, dict) else None
    if not isinstance(radius, int | float):
        raise DataError(f"{run}: its manifest.json has no radius_m of the cylinder; run it again")
    names = ("d_m", "d_sigma_m", "theta_deg", "theta_sigma_deg", "bearing_deg", "vx_m_s", "vy_m_s")
    for number, row in enumerate(CYLINDER.rows(run / "cylinder.csv"), start=1):
        head = tuple(row[name] for name in ("file", "utc", "status", "reason", "zone"))
        cells = tuple(row.number(name) for name in names)
        distance, theta = cells[0], cells[2]
        if distance is None or theta is None:
            yield (number, None, *head, *cells), None
            continue
        turn, from_axis = np.radians(theta), radius + distance
        x, y = float(from_axis * np.sin(turn)), float(from_axis * np.cos(turn))
        yield (number, encode_point(x, y, CARTESIAN), *head, *cells), (x, y, x, y)
