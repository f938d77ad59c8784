"""The tables of the catalog file, which is a GeoPackage 1.3 (OGC 12-128r17).

control_points   feature layer, one row a point: what GIS programs show
optnav_records   the same points packed, 4096 a row, so that a program opens them at once
optnav_patches   one compressed grid a row
optnav_meta      the manifest
optnav_relief    tiles of the relief of the whole body; only in a catalog that carries one
optnav_comparison  where a second terrain model has the points; only in a catalog with one
"""

import sqlite3

from catalog.store.geopackage import (
    GREEN,
    RED,
    UNDATED,
    Box,
    FeatureLayer,
    Rule,
    create_geopackage,
    define_srs,
    describe_geopackage,
    format_style,
    list_systems,
)
from catalog.store.manifest import CatalogMeta

# A row of 3-9 kB lies whole within a page of 64 kB, nine to a page; with 4 kB pages each row
# would chain pages of its own and leave half of its last one empty: a third more file.
PAGE_SIZE = 65536

POINTS = "control_points"
RECORDS = "optnav_records"
PATCHES = "optnav_patches"
META = "optnav_meta"
RELIEF = "optnav_relief"
COMPARISON = "optnav_comparison"

RECORDS_A_ROW = 4096
NO_DATA_COUNT = -32768  # of a patch: no height
HEIGHT_LAYER, IMAGE_LAYER = 0, 1  # of patches: heights, and brightness of an image

# columns of these tables are read from the statements: no part of them holds a comma
_PATCH_TABLE = f"""
CREATE TABLE {PATCHES} (
  id INTEGER PRIMARY KEY NOT NULL, point_id INTEGER NOT NULL, layer INTEGER NOT NULL,
  level INTEGER NOT NULL, posting_m DOUBLE NOT NULL, size INTEGER NOT NULL, step DOUBLE NOT NULL,
  value_offset DOUBLE NOT NULL, checksum INTEGER NOT NULL, data BLOB NOT NULL);
"""

POINT_LAYER = FeatureLayer(
    POINTS,
    "POINT",
    "Control points with their certificates",
    (
        "lat_deg DOUBLE NOT NULL",
        "lon_deg DOUBLE NOT NULL",
        "radius_m DOUBLE",
        "usable BOOLEAN NOT NULL",
        "flags INTEGER NOT NULL",
        "reasons TEXT NOT NULL",
        "localisation_nodes DOUBLE",
        "hessian_eigenvalue DOUBLE",
        "recognition_rate DOUBLE",
        "trials INTEGER NOT NULL",
        "uniqueness_min DOUBLE",
        "uniqueness TEXT NOT NULL",
        "shadow_limit_max_deg DOUBLE",
        "shadow_limit_deg TEXT NOT NULL",
        "source TEXT NOT NULL",
        "levels INTEGER NOT NULL",
        "checksum INTEGER NOT NULL",
    ),
    format_style(
        Rule("usable", '"usable"', "circle", GREEN, 2.0),
        Rule("not usable", "ELSE", "cross2", RED, 2.0),
    ),
)

_CATALOG_TABLES = f"""
CREATE TABLE {META} (id INTEGER PRIMARY KEY NOT NULL, key TEXT NOT NULL, value TEXT NOT NULL);
CREATE TABLE {RECORDS} (
  id INTEGER PRIMARY KEY NOT NULL, count INTEGER NOT NULL, checksum INTEGER NOT NULL,
  data BLOB NOT NULL);
"""

RELIEF_TABLE = f"""
CREATE TABLE {RELIEF} (
  id INTEGER PRIMARY KEY NOT NULL, layer INTEGER NOT NULL, tile_row INTEGER NOT NULL,
  tile_col INTEGER NOT NULL, size INTEGER NOT NULL, step DOUBLE NOT NULL,
  value_offset DOUBLE NOT NULL, checksum INTEGER NOT NULL, data BLOB NOT NULL);
"""

COMPARISON_TABLE = f"""
CREATE TABLE {COMPARISON} (
  id INTEGER PRIMARY KEY NOT NULL, comparison_e_m DOUBLE, comparison_n_m DOUBLE,
  level INTEGER NOT NULL, score DOUBLE NOT NULL);
"""


def _parse_columns(statement: str) -> tuple[str, ...]:
    """Names of the columns of a CREATE TABLE statement."""
    return tuple(part.split()[0] for part in statement.partition("(")[2].split(","))


POINT_COLUMNS, PATCH_COLUMNS = POINT_LAYER.names, _parse_columns(_PATCH_TABLE)
RELIEF_COLUMNS = _parse_columns(RELIEF_TABLE)
# Up to format 3 the error, in nodes as now, stood under the name of another unit.
FORMER_POINT_COLUMNS = tuple(
    "localisation_px" if name == "localisation_nodes" else name for name in POINT_COLUMNS
)


def select_points(meta: CatalogMeta) -> str:
    """The start of a query for the feature layer: rows in the order of POINT_COLUMNS."""
    columns = POINT_COLUMNS if meta.format_version > 3 else FORMER_POINT_COLUMNS
    return f"SELECT {', '.join(columns)} FROM {POINTS}"


def compute_patch_key(point_id: int, layer: int, level: int) -> int:
    """Primary key of a patch: the patches of a point lie side by side in the file."""
    return point_id * 256 + layer * 16 + level


def list_service_rows(meta: CatalogMeta) -> dict[str, list[tuple[object, ...]]]:
    """Rows of the GeoPackage's own tables that do not depend on the points, by table."""
    systems = list_systems(meta.body, meta.radius_m)
    srs_id = define_srs(meta.body, meta.radius_m)[0]
    return {"gpkg_spatial_ref_sys": systems} | POINT_LAYER.service_rows(srs_id)


def create_tables(db: sqlite3.Connection) -> None:
    """Make the empty tables in a new file."""
    create_geopackage(db, PAGE_SIZE)
    for statement in (_CATALOG_TABLES + _PATCH_TABLE).split(";\n"):
        db.execute(statement)
    POINT_LAYER.create(db)


def insert_service_rows(
    db: sqlite3.Connection, meta: CatalogMeta, extent: Box | None, with_patches: bool = True
) -> None:
    """Fill the GeoPackage's own tables, once all points are in and span the extent."""
    tables = []
    if with_patches:
        tables = [
            f"{PATCHES}: Height grids of the control points",
            f"{RECORDS}: The control points, packed",
            f"{META}: Manifest",
        ]
        if meta.relief is not None:
            tables.append(f"{RELIEF}: Relief of the whole body")
    if meta.comparison is not None:
        tables.append(f"{COMPARISON}: Shifts of the points in a second terrain model")
    changed = meta.created_utc or UNDATED
    describe_geopackage(db, meta.body, meta.radius_m, changed, tables)
    POINT_LAYER.register(db, define_srs(meta.body, meta.radius_m)[0], extent, changed)
