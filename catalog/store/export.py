"""The points of a catalog as a map layer for other programs: GeoJSON, CSV or a plain GeoPackage.

All three carry the body's coordinate system in the way that GDAL and QGIS read it back: GeoJSON in
its (pre-RFC 7946) crs member, CSV in a .prj file beside it (and column types in a .csvt file), the
GeoPackage in its own table.
"""

import csv
import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint
from catalog.errors import OutputError
from catalog.store.features import reasons_text
from catalog.store.partial import is_points_file, replacing
from catalog.store.reader import Catalog
from catalog.store.records import unknown_as_none
from catalog.store.schema import create_tables, insert_service_rows, srs_of
from catalog.store.writer import insert_features

# what begins a file that we wrote, and may therefore write again
GEOJSON_START = '{"type":"FeatureCollection","name":"control_points","optnav":"catalog layer"'
FIRST_COLUMNS = ("id", "lon_deg", "lat_deg", "radius_m", "usable", "reasons")

Properties = dict[str, object]


def export(catalog: Catalog, path: str | Path) -> int:
    """Write all points to a .geojson/.json, .csv or .gpkg file; returns their number.

    Raises OutputError for another ending, a place that cannot be written, or an existing file that
    is no such export.
    """
    path = Path(path)
    writers: dict[str, Callable[[Catalog, Path], None]] = {
        ".geojson": _write_geojson,
        ".json": _write_geojson,
        ".csv": _write_csv,
        ".gpkg": _write_geopackage,
    }
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise OutputError(
            f"{path}: a layer is written as {', '.join(writers)}, the relief as .tif, a patch as "
            ".obj or .glb; choose one of these endings"
        )
    if path.exists() and path.samefile(catalog.path):
        raise OutputError(f"{path}: is the catalog itself; name another file for the layer")
    writer(catalog, path)
    return len(catalog)


def point_properties(point: ControlPoint) -> Properties:
    """Attributes of a point under the names that the feature layer uses, lists spread out."""
    properties: Properties = {
        "id": point.id,
        "lon_deg": point.lon_deg,
        "lat_deg": point.lat_deg,
        "radius_m": unknown_as_none(point.radius_m),
        "usable": int(point.usable),
        "reasons": reasons_text(point.flags),
        "flags": int(point.flags),
        "localisation_px": unknown_as_none(point.localisation_px),
        "hessian_eigenvalue": unknown_as_none(point.hessian_eigenvalue),
        "recognition_rate": unknown_as_none(point.recognition_rate),
        "trials": point.trials,
        "source": point.source,
    }
    for level, margin in enumerate(point.uniqueness):
        properties[f"uniqueness_{level}"] = unknown_as_none(margin)
    for i, limit in enumerate(point.shadow_limit_deg):
        azimuth = i * 360 // SHADOW_AZIMUTHS
        properties[f"shadow_limit_{azimuth:03d}_deg"] = unknown_as_none(limit)
    return properties


def _geojson_lines(catalog: Catalog) -> Iterator[str]:
    _, _, organization, code, wkt = srs_of(catalog.meta.body, catalog.meta.radius_m)
    name = f"urn:ogc:def:crs:IAU:2015:{code}" if organization == "IAU_2015" else wkt
    crs = {"type": "name", "properties": {"name": name}}
    yield f'{GEOJSON_START},"crs":{json.dumps(crs)},"features":['
    for number, point in enumerate(catalog.points()):
        feature = {
            "type": "Feature",
            "id": point.id,
            "geometry": {"type": "Point", "coordinates": [point.lon_deg, point.lat_deg]},
            "properties": point_properties(point),
        }
        yield (",\n" if number else "\n") + json.dumps(feature, separators=(",", ":"))
    yield "\n]}\n"


def _starts_as_ours(start: str) -> Callable[[Path], bool]:
    def check(path: Path) -> bool:
        with path.open("rb") as file:
            return file.read(len(start)) == start.encode()

    return check


def _write_geojson(catalog: Catalog, path: Path) -> None:
    with replacing(path, _starts_as_ours(GEOJSON_START)) as partial:
        _write_text(path, partial, _geojson_lines(catalog))


def _csv_type(value: object) -> str:
    return {int: "Integer64", str: "String"}.get(type(value), "Real")


def _write_csv(catalog: Catalog, path: Path) -> None:
    # the columns of an empty catalog are those of the point that it does not have
    blank = ControlPoint(
        0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, (0.0,) * catalog.meta.levels,
        (0.0,) * SHADOW_AZIMUTHS, False,
    )  # fmt: skip
    columns = point_properties(blank)
    places = {"lon_deg": "CoordX", "lat_deg": "CoordY"}
    types = ",".join(places.get(name, _csv_type(value)) for name, value in columns.items())
    ours = _starts_as_ours(",".join(FIRST_COLUMNS))
    wkt = srs_of(catalog.meta.body, catalog.meta.radius_m)[4]
    with replacing(path, ours) as partial:
        try:
            with partial.open("w", encoding="utf-8", newline="") as file:
                rows = csv.DictWriter(file, list(columns), lineterminator="\n")
                rows.writeheader()
                for point in catalog.points():
                    rows.writerow(point_properties(point))
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
        for suffix, text in ((".csvt", types + "\n"), (".prj", wkt + "\n")):
            beside = path.with_suffix(suffix)
            with replacing(beside, lambda _: True) as partial_beside:
                _write_text(beside, partial_beside, iter([text]))


def _write_text(path: Path, partial: Path, parts: Iterator[str]) -> None:
    try:
        with partial.open("w", encoding="utf-8") as file:
            file.writelines(parts)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _write_geopackage(catalog: Catalog, path: Path) -> None:
    with (
        replacing(path, is_points_file) as partial,
        closing(sqlite3.connect(partial, isolation_level=None)) as db,
    ):
        db.execute("PRAGMA journal_mode = OFF")
        db.execute("PRAGMA synchronous = OFF")
        create_tables(db, with_patches=False)
        db.execute("BEGIN")
        extent = insert_features(db, catalog.meta, zip(catalog.points(), catalog.records))
        insert_service_rows(db, catalog.meta, extent, with_patches=False)
        db.execute("COMMIT")
