"""A GeoPackage 1.3 (OGC 12-128r17): its own tables, and feature layers on a body's sphere.

A layer has an R-tree, as the extension gpkg_rtree_index wants it, and a style in the table
`layer_styles`, from which QGIS takes how a layer is drawn: QML with a symbol for each of some
rules.
"""

import os
import sqlite3
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple
from urllib.parse import quote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from catalog.arrays import FloatArray
from catalog.errors import DATABASE_ERRORS

APPLICATION_ID = 0x47504B47  # "GPKG"
USER_VERSION = 10300
UNDATED = "1970-01-01T00:00:00Z"

MOON_SRS_ID = 30100  # IAU_2015:30100, Moon, sphere, planetocentric latitude
MOON_RADIUS_M = 1737400.0
MAP_AXES = 'UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'  # end of a map's WKT
CUSTOM_SRS_ID, SPHEROID_SRS_ID = 100001, 100002  # numbers that no registry uses
WGS84 = (6378137.0, 298.257224)  # semi-major axis, m, and inverse flattening
WGS84_WKT = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]'
)

Box = tuple[float, float, float, float]  # west, south, east, north, deg
Feature = tuple[tuple[object, ...], Box | None]  # a row of a layer, and what its geometry spans
Kind = Literal["POINT", "MULTILINESTRING", "MULTIPOLYGON"]

_POINT = struct.Struct("<2sBBiBIdd")
_HEADER = struct.Struct("<2sBBiBII")  # of a collection: how many parts
_LINE, _POLYGON = struct.Struct("<BII"), struct.Struct("<BIII")
_PART_CODES = {"MULTILINESTRING": 2, "MULTIPOLYGON": 3}  # of well-known binary; a collection's + 3

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
CREATE TABLE layer_styles (
  id INTEGER PRIMARY KEY NOT NULL, f_table_catalog TEXT(256), f_table_schema TEXT(256),
  f_table_name TEXT(256), f_geometry_column TEXT(256), styleName TEXT(30), styleQML TEXT,
  styleSLD TEXT, useAsDefault BOOLEAN, description TEXT, owner TEXT(30), ui TEXT(30),
  update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')));
"""

# So that programs which edit a copy of a layer keep its index; the functions are those that GIS
# programs have.
_TRIGGERS = """
CREATE TRIGGER {tree}_insert AFTER INSERT ON {table} WHEN {full} BEGIN {row} END;
CREATE TRIGGER {tree}_update1 AFTER UPDATE OF geom ON {table}
  WHEN OLD.id = NEW.id AND {full} BEGIN {row} END;
CREATE TRIGGER {tree}_update2 AFTER UPDATE OF geom ON {table}
  WHEN OLD.id = NEW.id AND {empty} BEGIN {drop} END;
CREATE TRIGGER {tree}_update3 AFTER UPDATE ON {table}
  WHEN OLD.id != NEW.id AND {full} BEGIN {drop} {row} END;
CREATE TRIGGER {tree}_update4 AFTER UPDATE ON {table}
  WHEN OLD.id != NEW.id AND {empty}
  BEGIN DELETE FROM {tree} WHERE id IN (OLD.id, NEW.id); END;
CREATE TRIGGER {tree}_delete AFTER DELETE ON {table}
  WHEN OLD.geom NOT NULL BEGIN {drop} END;
"""
Colour = tuple[int, int, int]
Shape = Literal["circle", "cross2", "triangle", "line", "fill"]

GREEN, RED, BLUE, GRAY = (46, 125, 50), (198, 40, 40), (21, 101, 192), (97, 97, 97)
_SYMBOLS = {"line": ("line", "SimpleLine"), "fill": ("fill", "SimpleFill")}
_MARKER = ("marker", "SimpleMarker")


@dataclass(frozen=True)
class FeatureLayer:
    """A feature layer; its first columns are `id` and `geom`.

    columns  the others, as SQL declares them
    style    how QGIS draws it (QML)
    """

    name: str
    kind: Kind
    description: str
    columns: tuple[str, ...]
    style: str

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all columns."""
        return ("id", "geom", *(column.split()[0] for column in self.columns))

    @property
    def rtree(self) -> str:
        """The table of its index."""
        return f"rtree_{self.name}_geom"

    def create(self, db: sqlite3.Connection) -> None:
        """Make the empty table and its index."""
        columns = ", ".join((f"geom {self.kind}", *self.columns))
        db.execute(f"CREATE TABLE {self.name} (id INTEGER PRIMARY KEY NOT NULL, {columns})")
        db.execute(f"CREATE VIRTUAL TABLE {self.rtree} USING rtree(id, minx, maxx, miny, maxy)")

    def fill(self, db: sqlite3.Connection, features: Iterable[Feature]) -> Box | None:
        """Insert features, in the order of their ids, and index them; returns what they span."""
        insert = f"INSERT INTO {self.name} VALUES ({', '.join('?' * len(self.names))})"
        boxes: list[Box] = []
        places: list[tuple[object, ...]] = []
        for row, box in features:
            db.execute(insert, row)
            if box is not None:
                west, south, east, north = box
                boxes.append(box)
                places.append((row[0], west, east, south, north))
        db.executemany(f"INSERT INTO {self.rtree} VALUES (?,?,?,?,?)", places)
        for statement in filter(str.strip, self._format_triggers().split("END;\n")):
            db.execute(statement + " END")
        if not boxes:
            return None
        wests, souths, easts, norths = zip(*boxes)
        return min(wests), min(souths), max(easts), max(norths)

    def register(
        self, db: sqlite3.Connection, srs_id: int, extent: Box | None, changed: str
    ) -> None:
        """Name the layer, and its style, in the GeoPackage's own tables."""
        _insert(db, "gpkg_contents", [self._make_contents_row(srs_id, extent, changed)])
        for table, rows in self.service_rows(srs_id).items():
            _insert(db, table, rows)
        named = "", "", self.name, "geom", self.name, self.style, "", 1, self.description, "", None
        columns = "f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName, "
        columns += "styleQML, styleSLD, useAsDefault, description, owner, ui, update_time"
        values = ", ".join("?" * (len(named) + 1))
        db.execute(f"INSERT INTO layer_styles ({columns}) VALUES ({values})", (*named, changed))

    def service_rows(self, srs_id: int) -> dict[str, list[tuple[object, ...]]]:
        """Rows of the GeoPackage's own tables that do not depend on the features, by table."""
        link = "http://www.geopackage.org/spec120/#extension_rtree"
        return {
            "gpkg_geometry_columns": [(self.name, "geom", self.kind, srs_id, 0, 0)],
            "gpkg_extensions": [(self.name, "geom", "gpkg_rtree_index", link, "write-only")],
        }

    def _make_contents_row(
        self, srs_id: int, extent: Box | None, changed: str
    ) -> tuple[object, ...]:
        box = extent or (None,) * 4
        return self.name, "features", self.name, self.description, changed, *box, srs_id

    def _format_triggers(self) -> str:
        return _TRIGGERS.format(
            tree=self.rtree,
            table=self.name,
            row=f"INSERT OR REPLACE INTO {self.rtree} VALUES (NEW.id, ST_MinX(NEW.geom), "
            "ST_MaxX(NEW.geom), ST_MinY(NEW.geom), ST_MaxY(NEW.geom));",
            full="(NEW.geom NOTNULL AND NOT ST_IsEmpty(NEW.geom))",
            empty="(NEW.geom ISNULL OR ST_IsEmpty(NEW.geom))",
            drop=f"DELETE FROM {self.rtree} WHERE id = OLD.id;",
        )


@contextmanager
def open_new_geopackage(path: Path) -> Iterator[sqlite3.Connection]:
    """A new file with a GeoPackage's own tables, to be filled; nobody else reads it yet."""
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.executescript("PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF;")
        create_geopackage(db)
        db.execute("BEGIN")
        yield db
        db.execute("COMMIT")


def create_geopackage(db: sqlite3.Connection, page_size: int = 4096) -> None:
    """Make a new file a GeoPackage without layers."""
    db.execute(f"PRAGMA page_size = {page_size}")
    db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    db.execute(f"PRAGMA user_version = {USER_VERSION}")
    for statement in filter(str.strip, _SERVICE_TABLES.split(";\n")):
        db.execute(statement)


def describe_geopackage(
    db: sqlite3.Connection, body: str, radius_m: float, changed: str, tables: Sequence[str] = ()
) -> None:
    """Fill in the coordinate systems and the tables without features, with their descriptions.

    tables  "NAME: description"
    """
    _insert(db, "gpkg_spatial_ref_sys", list_systems(body, radius_m))
    plain = [("layer_styles", "Styles of the layers, for QGIS")]
    plain += [(name, text.strip()) for name, _, text in (table.partition(":") for table in tables)]
    nowhere = (None,) * 5
    rows = [(name, "attributes", name, text, changed, *nowhere) for name, text in plain]
    _insert(db, "gpkg_contents", rows)


def list_columns(path: Path, table: str) -> tuple[str, ...]:
    """Columns of a table of a file; none where it has no such table, or is no SQLite database."""
    uri = f"file:{quote(os.fsencode(path.absolute()))}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as db:
            rows = db.execute("SELECT name FROM pragma_table_info(?)", (table,)).fetchall()
    except DATABASE_ERRORS:
        return ()
    return tuple(column for (column,) in rows)


def define_srs(body: str, radius_m: float) -> tuple[int, str, str, int, str]:
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


def define_spheroid_srs(
    body: str, radii_m: tuple[float, float, float]
) -> tuple[int, str, str, int, str]:
    """Return what `define_srs` does, of geodetic degrees on a spheroid; EPSG:4326 for WGS 84."""
    a, _, c = radii_m
    inverse = a / (a - c)
    if body == "earth" and (a, round(inverse, 6)) == WGS84:
        return 4326, "WGS 84 geodetic", "EPSG", 4326, WGS84_WKT
    name = f"{body.capitalize()} - Spheroid of {a:.12g} and {c:.12g} m"
    wkt = (
        f'GEOGCS["{name}",DATUM["{name}",SPHEROID["{name}",{a:.12g},{inverse:.15g}]],'
        'PRIMEM["Reference Meridian",0],UNIT["degree",0.0174532925199433,'
        'AUTHORITY["EPSG","9122"]],AXIS["Longitude",EAST],AXIS["Latitude",NORTH]]'
    )
    return SPHEROID_SRS_ID, name, "NONE", SPHEROID_SRS_ID, wkt


def add_system(db: sqlite3.Connection, system: tuple[int, str, str, int, str]) -> None:
    """Add a coordinate system of `define_spheroid_srs` that the file does not have yet."""
    srs_id, name, organization, code, wkt = system
    row = name, srs_id, organization, code, wkt, "geodetic latitude, east longitude"
    db.execute("INSERT OR IGNORE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", row)


def format_stereographic_wkt(
    body: str, centre: str, radius_m: float, centre_deg: tuple[float, float]
) -> str:
    """WKT of the stereographic projection of a body's sphere, metres east and north.

    centre      what is at its centre, for the name
    centre_deg  latitude and longitude
    """
    lat, lon = centre_deg
    wkt = define_srs(body, radius_m)[4]
    return (
        f'PROJCS["{body.capitalize()}, stereographic about {centre}",{wkt},'
        f'PROJECTION["Stereographic"],PARAMETER["latitude_of_origin",{lat!r}],'
        f'PARAMETER["central_meridian",{lon!r}],PARAMETER["scale_factor",1],'
        f'PARAMETER["false_easting",0],PARAMETER["false_northing",0],{MAP_AXES}'
    )


def list_systems(body: str, radius_m: float) -> list[tuple[object, ...]]:
    """Rows of gpkg_spatial_ref_sys: what every GeoPackage has, and the body's own."""
    srs_id, name, organization, code, wkt = define_srs(body, radius_m)
    # the specification wants the first three in every GeoPackage
    return [
        ("Undefined Cartesian", -1, "NONE", -1, "undefined", "undefined Cartesian system"),
        ("Undefined geographic", 0, "NONE", 0, "undefined", "undefined geographic system"),
        ("WGS 84 geodetic", 4326, "EPSG", 4326, WGS84_WKT, "Earth"),
        (name, srs_id, organization, code, wkt, "planetocentric latitude, east longitude"),
    ]


def encode_point(lon_deg: float, lat_deg: float, srs_id: int) -> bytes:
    """GeoPackage geometry of a point: header without envelope, then little-endian WKB."""
    return _POINT.pack(b"GP", 0, 1, srs_id, 1, 1, lon_deg, lat_deg)


def encode_parts(kind: Kind, parts: Sequence[FloatArray], srs_id: int) -> bytes | None:
    """Geometry of lines or of polygons without holes from their (n, 2) lon, lat; None for none.

    The rings of polygons are closed: their last point is the first.
    """
    if not parts:
        return None
    code = _PART_CODES[kind]
    data = [_HEADER.pack(b"GP", 0, 1, srs_id, 1, code + 3, len(parts))]
    for part in parts:
        fields = (1, code, len(part)) if code == 2 else (1, code, 1, len(part))
        data += [(_LINE if code == 2 else _POLYGON).pack(*fields), part.astype("<f8").tobytes()]
    return b"".join(data)


def _insert(db: sqlite3.Connection, table: str, rows: Sequence[tuple[object, ...]]) -> None:
    db.executemany(f"INSERT INTO {table} VALUES ({', '.join('?' * len(rows[0]))})", rows)


class Rule(NamedTuple):
    """Which features are drawn how.

    label   for the legend
    filter  an expression of QGIS; "ELSE": those that no other rule takes; "": all
    shape   of a point; or a line, or an area that shows what lies below
    size    of a point, or width of a line, mm
    """

    label: str
    filter: str
    shape: Shape
    colour: Colour
    size: float


def format_style(*rules: Rule) -> str:
    """The style of a layer whose features are drawn by the first rule that they fit."""
    root = Element("qgis", version="3.22.0", styleCategories="Symbology")
    renderer = SubElement(root, "renderer-v2", type="RuleRenderer", symbollevels="0")
    listed = SubElement(renderer, "rules", key="root")
    symbols = SubElement(renderer, "symbols")
    for number, rule in enumerate(rules):
        which = {"filter": rule.filter} if rule.filter else {}
        names = {"key": f"rule{number}", "symbol": str(number), "label": rule.label}
        SubElement(listed, "rule", names | which)
        kind, drawn_by = _SYMBOLS.get(rule.shape, _MARKER)
        symbol = SubElement(symbols, "symbol", name=str(number), type=kind, alpha="1")
        layer = SubElement(symbol, "layer", {"class": drawn_by, "enabled": "1", "pass": "0"})
        options = SubElement(layer, "Option", type="Map")
        for name, value in _list_options(rule).items():
            SubElement(options, "Option", name=name, type="QString", value=value)
            SubElement(layer, "prop", k=name, v=value)  # what QGIS read before 3.26
    ElementTree.indent(root)
    return f"<!DOCTYPE qgis>\n{ElementTree.tostring(root, encoding='unicode')}\n"


def _list_options(rule: Rule) -> dict[str, str]:
    """The settings of a symbol's layer as QGIS names them."""
    colour, size = ",".join(map(str, (*rule.colour, 255))), f"{rule.size:g}"
    if rule.shape == "line":
        return {"line_color": colour, "line_width": size, "line_width_unit": "MM"}
    if rule.shape == "fill":
        inside = ",".join(map(str, (*rule.colour, 40)))
        edge = {"outline_color": colour, "outline_width": size, "outline_width_unit": "MM"}
        return {"color": inside, "style": "solid", "outline_style": "solid"} | edge
    edge = {"outline_color": colour, "outline_style": "solid", "outline_width": "0.4"}
    return {"name": rule.shape, "color": colour, "size": size, "size_unit": "MM"} | edge
