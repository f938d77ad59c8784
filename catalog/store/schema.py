"""The tables of the catalog file, which is a GeoPackage 1.3 (OGC 12-128r17).

control_points   feature layer, one row a point: what GIS programs show
optnav_records   the same points packed, 4096 a row, so that a program opens them at once
optnav_patches   one compressed grid a row
optnav_meta      the manifest
optnav_relief    tiles of the relief of the whole body; only in a catalog that carries one
"""

import sqlite3
from collections.abc import Sequence

from catalog.store.manifest import CatalogMeta

APPLICATION_ID = 0x47504B47  # "GPKG"
USER_VERSION = 10300
# A row of 3-9 kB lies whole within a page of 64 kB, nine to a page; with 4 kB pages each row
# would chain pages of its own and leave half of its last one empty: a third more file.
PAGE_SIZE = 65536

POINTS = "control_points"
GEOMETRY = "geom"
RECORDS = "optnav_records"
PATCHES = "optnav_patches"
META = "optnav_meta"
RELIEF = "optnav_relief"
RTREE = f"rtree_{POINTS}_{GEOMETRY}"

RECORDS_A_ROW = 4096
HEIGHT_LAYER = 0  # an albedo layer would be another number in the same table

MOON_SRS_ID = 30100  # IAU_2015:30100, Moon, sphere, planetocentric latitude
MOON_RADIUS_M = 1737400.0
CUSTOM_SRS_ID = 100001  # a number that no registry uses


_SERVICE_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '',
  last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
  CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
CREATE TABLE gpkg_extensions (
  table_name TEXT, column_name TEXT, extension_name TEXT NOT NULL, definition TEXT NOT NULL,
  scope TEXT NOT NULL, CONSTRAINT ge_tce UNIQUE (table_name, column_name, extension_name));
"""

# columns of these tables are read from the statements: no part of them holds a comma
_PATCH_TABLE = f"""
CREATE TABLE {PATCHES} (
  id INTEGER PRIMARY KEY NOT NULL, point_id INTEGER NOT NULL, layer INTEGER NOT NULL,
  level INTEGER NOT NULL, posting_m DOUBLE NOT NULL, size INTEGER NOT NULL, step DOUBLE NOT NULL,
  value_offset DOUBLE NOT NULL, checksum INTEGER NOT NULL, data BLOB NOT NULL);
"""

_POINT_TABLE = f"""
CREATE TABLE {POINTS} (
  id INTEGER PRIMARY KEY NOT NULL, {GEOMETRY} POINT NOT NULL,
  lat_deg DOUBLE NOT NULL, lon_deg DOUBLE NOT NULL, radius_m DOUBLE,
  usable BOOLEAN NOT NULL, flags INTEGER NOT NULL, reasons TEXT NOT NULL,
  localisation_nodes DOUBLE, hessian_eigenvalue DOUBLE, recognition_rate DOUBLE,
  trials INTEGER NOT NULL, uniqueness_min DOUBLE, uniqueness TEXT NOT NULL,
  shadow_limit_max_deg DOUBLE, shadow_limit_deg TEXT NOT NULL,
  source TEXT NOT NULL, levels INTEGER NOT NULL, checksum INTEGER NOT NULL);
"""

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


def _columns(statement: str) -> tuple[str, ...]:
    """Names of the columns of a CREATE TABLE statement."""
    return tuple(part.split()[0] for part in statement.partition("(")[2].split(","))


POINT_COLUMNS, PATCH_COLUMNS = _columns(_POINT_TABLE), _columns(_PATCH_TABLE)
RELIEF_COLUMNS = _columns(RELIEF_TABLE)
# Up to format 3 the error, in nodes as now, stood under the name of another unit.
FORMER_POINT_COLUMNS = tuple(
    "localisation_px" if name == "localisation_nodes" else name for name in POINT_COLUMNS
)


def select_points(meta: CatalogMeta) -> str:
    """The start of a query for the feature layer: rows in the order of POINT_COLUMNS."""
    columns = POINT_COLUMNS if meta.format_version > 3 else FORMER_POINT_COLUMNS
    return f"SELECT {', '.join(columns)} FROM {POINTS}"


# The triggers that the extension gpkg_rtree_index wants, so that programs which edit a copy of
# the layer keep its index; they call functions that only GIS programs have.
_T, _C, _I = POINTS, GEOMETRY, "id"
_RTREE_ROW = (
    f"INSERT OR REPLACE INTO {RTREE} VALUES (NEW.{_I}, ST_MinX(NEW.{_C}), ST_MaxX(NEW.{_C}), "
    f"ST_MinY(NEW.{_C}), ST_MaxY(NEW.{_C}));"
)
_FULL = f"(NEW.{_C} NOTNULL AND NOT ST_IsEmpty(NEW.{_C}))"
_EMPTY = f"(NEW.{_C} ISNULL OR ST_IsEmpty(NEW.{_C}))"
_DROP_OLD = f"DELETE FROM {RTREE} WHERE id = OLD.{_I};"
RTREE_TRIGGERS = f"""
CREATE TRIGGER {RTREE}_insert AFTER INSERT ON {_T} WHEN {_FULL} BEGIN {_RTREE_ROW} END;
CREATE TRIGGER {RTREE}_update1 AFTER UPDATE OF {_C} ON {_T}
  WHEN OLD.{_I} = NEW.{_I} AND {_FULL} BEGIN {_RTREE_ROW} END;
CREATE TRIGGER {RTREE}_update2 AFTER UPDATE OF {_C} ON {_T}
  WHEN OLD.{_I} = NEW.{_I} AND {_EMPTY} BEGIN {_DROP_OLD} END;
CREATE TRIGGER {RTREE}_update3 AFTER UPDATE ON {_T}
  WHEN OLD.{_I} != NEW.{_I} AND {_FULL} BEGIN {_DROP_OLD} {_RTREE_ROW} END;
CREATE TRIGGER {RTREE}_update4 AFTER UPDATE ON {_T}
  WHEN OLD.{_I} != NEW.{_I} AND {_EMPTY}
  BEGIN DELETE FROM {RTREE} WHERE id IN (OLD.{_I}, NEW.{_I}); END;
CREATE TRIGGER {RTREE}_delete AFTER DELETE ON {_T}
  WHEN OLD.{_C} NOT NULL BEGIN {_DROP_OLD} END;
"""


def patch_key(point_id: int, layer: int, level: int) -> int:
    """Primary key of a patch: the patches of a point lie side by side in the file."""
    return point_id * 256 + layer * 16 + level


def srs_of(body: str, radius_m: float) -> tuple[int, str, str, int, str]:
    """srs_id, name, organization, its code and WKT of planetocentric degrees on a body's sphere."""
    radius = f"{radius_m:.12g}"
    if body == "moon" and radius_m == MOON_RADIUS_M:
        name, datum = "Moon (2015) - Sphere / Ocentric", "Moon (2015) - Sphere"
        srs_id, organization, code = MOON_SRS_ID, "IAU_2015", MOON_SRS_ID
    else:
        datum = f"{body.capitalize()} - Sphere of {radius} m"
        name = f"{datum} / Ocentric"
        srs_id, organization, code = CUSTOM_SRS_ID, "NONE", CUSTOM_SRS_ID
    wkt = (
        f'GEOGCS["{name}",DATUM["{datum}",SPHEROID["{datum}",{radius},0]],'
        'PRIMEM["Reference Meridian",0],UNIT["degree",0.0174532925199433,'
        'AUTHORITY["EPSG","9122"]],AXIS["Longitude",EAST],AXIS["Latitude",NORTH]]'
    )
    return srs_id, name, organization, code, wkt


def service_rows(meta: CatalogMeta) -> dict[str, list[tuple[object, ...]]]:
    """Rows of the GeoPackage's service tables that do not depend on the points, by table."""
    srs_id, name, organization, code, wkt = srs_of(meta.body, meta.radius_m)
    wgs84 = (
        'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
        'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]'
    )
    # the specification wants the first three in every GeoPackage
    systems: list[tuple[object, ...]] = [
        ("Undefined Cartesian", -1, "NONE", -1, "undefined", "undefined Cartesian system"),
        ("Undefined geographic", 0, "NONE", 0, "undefined", "undefined geographic system"),
        ("WGS 84 geodetic", 4326, "EPSG", 4326, wgs84, "Earth"),
        (name, srs_id, organization, code, wkt, "planetocentric latitude, east longitude"),
    ]
    rtree = "gpkg_rtree_index", "http://www.geopackage.org/spec120/#extension_rtree", "write-only"
    return {
        "gpkg_spatial_ref_sys": systems,
        "gpkg_geometry_columns": [(POINTS, GEOMETRY, "POINT", srs_id, 0, 0)],
        "gpkg_extensions": [(POINTS, GEOMETRY, *rtree)],
    }


def create_tables(db: sqlite3.Connection, with_patches: bool = True) -> None:
    """Make the empty tables in a new file; without patches it is a plain layer of points."""
    db.execute(f"PRAGMA page_size = {PAGE_SIZE if with_patches else 4096}")
    db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    db.execute(f"PRAGMA user_version = {USER_VERSION}")
    tables = (
        _SERVICE_TABLES + (_CATALOG_TABLES + _PATCH_TABLE if with_patches else "") + _POINT_TABLE
    )
    for statement in filter(str.strip, tables.split(";\n")):
        db.execute(statement)
    db.execute(f"CREATE VIRTUAL TABLE {RTREE} USING rtree(id, minx, maxx, miny, maxy)")


def create_triggers(db: sqlite3.Connection) -> None:
    """Add the R-tree triggers, once all points are in."""
    for statement in filter(str.strip, RTREE_TRIGGERS.split("END;\n")):
        db.execute(statement + " END")


def insert_service_rows(
    db: sqlite3.Connection,
    meta: CatalogMeta,
    extent: Sequence[float] | None,
    with_patches: bool = True,
) -> None:
    """Fill the service tables. extent: west, south, east, north (deg) of the points, if any."""
    for table, rows in service_rows(meta).items():
        db.executemany(f"INSERT INTO {table} VALUES ({', '.join('?' * len(rows[0]))})", rows)
    srs_id = srs_of(meta.body, meta.radius_m)[0]
    box = tuple(extent) if extent is not None else (None,) * 4
    tables: list[tuple[object, ...]] = [
        (POINTS, "features", "Control points with their certificates", *box, srs_id)
    ]
    if with_patches:
        nowhere = (None,) * 5
        tables += [
            (PATCHES, "attributes", "Height grids of the control points", *nowhere),
            (RECORDS, "attributes", "The control points, packed", *nowhere),
            (META, "attributes", "Manifest", *nowhere),
        ]
        if meta.relief is not None:
            tables.append((RELIEF, "attributes", "Relief of the whole body", *nowhere))
    for name, kind, description, *where in tables:
        row = name, kind, name, description, meta.created_utc or "1970-01-01T00:00:00Z", *where
        db.execute("INSERT INTO gpkg_contents VALUES (?,?,?,?,?,?,?,?,?,?)", row)
