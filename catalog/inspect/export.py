"""A catalog for other programs: points as a map layer, a patch as a solid or, as relief, a GeoTIFF.

A layer is GeoJSON, CSV or a plain GeoPackage. All three carry the body's coordinate system in the
way that GDAL and QGIS read it back: GeoJSON in its (pre-RFC 7946) crs member, CSV in a .prj file
beside it (and column types in a .csvt file), the GeoPackage in its own table.

The top of a patch's solid is the ground, its sides go down the map's verticals, its bottom lies a
fifth of its width below the lowest ground. Lengths are metres from the control point: OBJ has east,
north, up as x, y, z, GLB as x, -z, y, as its standard wants.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
import rasterio
import trimesh
from rasterio.transform import Affine

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Patch
from catalog.errors import DataError, OutputError
from catalog.files import check_file, make_prefix_test, replace_file, write_output
from catalog.geometry.projection import make_node_grid
from catalog.inspect.summary import shift_document
from catalog.rasters import DESCRIPTION, encode_geotiff, is_described
from catalog.store.connection import SIDECARS, is_points_file
from catalog.store.geopackage import (
    MAP_AXES,
    define_srs,
    format_stereographic_wkt,
    open_new_geopackage,
)
from catalog.store.manifest import CatalogMeta
from catalog.store.reader import Catalog
from catalog.store.records import insert_shifts, replace_unknown
from catalog.store.schema import POINT_LAYER, insert_service_rows
from catalog.store.writer import insert_features
from catalog.tables import CsvColumn, CsvTable

# what begins a file that we wrote, and may therefore write again
GEOJSON_START = '{"type":"FeatureCollection","name":"control_points","optnav":"catalog layer"'
PATCH_NAME = "optnav patch"  # what stands near the beginning of a file that we wrote
PATCH_ENDINGS = (".obj", ".glb")
HEAD_BYTES = 4096
BASE_SHARE = 0.2
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])

AZIMUTHS = [i * 360 // SHADOW_AZIMUTHS for i in range(SHADOW_AZIMUTHS)]
SHADOW_COLUMNS = [(f"shadow_limit_{azimuth:03d}_deg", azimuth) for azimuth in AZIMUTHS]

Properties = dict[str, object]
RASTER_ENDINGS = (".tif", ".tiff")
RELIEF_NAME = "optnav relief"  # begins the description of a file of ours, as PATCH_NAME does


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
            ".tif, .obj or .glb; choose one of these endings"
        )
    if path.exists() and path.samefile(catalog.path):
        raise OutputError(f"{path}: is the catalog itself; name another file for the layer")
    writer(catalog, path)
    return len(catalog)


def collect_properties(catalog: Catalog, point: ControlPoint) -> Properties:
    """Attributes of a point under the names that the feature layer uses, lists spread out.

    With where the comparison model has it, in a catalog with one.
    """
    properties: Properties = {
        "id": point.id,
        "lon_deg": point.lon_deg,
        "lat_deg": point.lat_deg,
        "radius_m": replace_unknown(point.radius_m),
        "usable": int(point.usable),
        "reasons": point.flags.label,
        "flags": int(point.flags),
        "localisation_nodes": replace_unknown(point.localisation_nodes),
        "hessian_eigenvalue": replace_unknown(point.hessian_eigenvalue),
        "recognition_rate": replace_unknown(point.recognition_rate),
        "trials": point.trials,
        "source": point.source,
    }
    for level, margin in enumerate(point.uniqueness):
        properties[f"uniqueness_{level}"] = replace_unknown(margin)
    for (name, _), limit in zip(SHADOW_COLUMNS, point.shadow_limit_deg):
        properties[name] = replace_unknown(limit)
    if catalog.meta.comparison is not None:
        properties |= shift_document(catalog.shifts.get(point.id))
    return properties


def _format_geojson(catalog: Catalog) -> Iterator[str]:
    _, _, organization, code, wkt = define_srs(catalog.meta.body, catalog.meta.radius_m)
    name = f"urn:ogc:def:crs:IAU:2015:{code}" if organization == "IAU_2015" else wkt
    crs = {"type": "name", "properties": {"name": name}}
    yield f'{GEOJSON_START},"crs":{json.dumps(crs)},"features":['
    for number, point in enumerate(catalog.points()):
        feature = {
            "type": "Feature",
            "id": point.id,
            "geometry": {"type": "Point", "coordinates": [point.lon_deg, point.lat_deg]},
            "properties": collect_properties(catalog, point),
        }
        yield (",\n" if number else "\n") + json.dumps(feature, separators=(",", ":"))
    yield "\n]}\n"


def _write_geojson(catalog: Catalog, path: Path) -> None:
    ours = make_prefix_test(GEOJSON_START.encode())
    with replace_file(path, ours) as new, new.open("w", encoding="utf-8") as file:
        file.writelines(_format_geojson(catalog))


def make_points_table(levels: int, compared: bool) -> CsvTable:
    """The columns of the CSV layer of a catalog whose points have so many levels.

    compared  whether a second terrain model has been compared
    """

    def number(name: str, meaning: str, unit: str = "") -> CsvColumn:
        return CsvColumn(name, meaning, unit=unit, empty=True)

    shadow, shift = "Sun elevation without shadow", "from here to its place in the comparison model"
    shifts = (
        number("comparison_e_m", f"eastward {shift}", "m"),
        number("comparison_n_m", f"northward {shift}", "m"),
        number("comparison_score", "correlation with the comparison model"),
    )
    return CsvTable(
        (
            CsvColumn("id", "the control point's id", "count"),
            CsvColumn("lon_deg", "longitude, -180 to 180, east positive", unit="deg"),
            CsvColumn("lat_deg", "latitude, planetocentric", unit="deg"),
            number("radius_m", "distance from the body's centre", "m"),
            CsvColumn("usable", "whether navigation uses it", "flag"),
            CsvColumn("reasons", "why not", "text", empty=True),
            CsvColumn("flags", "the reasons as a sum of bits", "count"),
            number("localisation_nodes", "predicted match error, 1 sigma", "nodes"),
            number("hessian_eigenvalue", "least eigenvalue of the correlation's curvature"),
            number("recognition_rate", "share of the recognition trials run that succeeded"),
            CsvColumn("trials", "recognition trials that were run", "count"),
            CsvColumn("source", "terrain models of its finest patch", "text", empty=True),
            *(number(f"uniqueness_{k}", f"uniqueness margin, level {k}") for k in range(levels)),
            *(number(name, f"{shadow}, azimuth {a}", "deg") for name, a in SHADOW_COLUMNS),
            *(shifts if compared else ()),
        )
    )


def _write_csv(catalog: Catalog, path: Path) -> None:
    table = make_points_table(catalog.meta.levels, catalog.meta.comparison is not None)
    kinds = {"lon_deg": "CoordX", "lat_deg": "CoordY", "text": "String", "number": "Real"}
    columns = ((column.name, kinds.get(column.kind, "Integer64")) for column in table.columns)
    types = ",".join(kinds.get(name, kind) for name, kind in columns)
    wkt = define_srs(catalog.meta.body, catalog.meta.radius_m)[4]
    sides = {path.with_suffix(".csvt"): types, path.with_suffix(".prj"): wkt}
    with replace_file(path, make_prefix_test(",".join(table.names[:6]).encode())) as new:
        # those beside a layer of ours are ours; a lone .prj may belong to another layer
        again = path.is_file() and path.stat().st_size > 0
        ours = (lambda _: True) if again else make_prefix_test(wkt.encode(), types.encode())
        for side in sides:
            check_file(side, ours)
        table.write(new, (collect_properties(catalog, point) for point in catalog.points()))
        for side, text in sides.items():
            write_output(side, f"{text}\n".encode(), ours)


def _write_geopackage(catalog: Catalog, path: Path) -> None:
    with (
        replace_file(path, is_points_file, SIDECARS) as partial,
        open_new_geopackage(partial) as db,
    ):
        POINT_LAYER.create(db)
        extent = insert_features(db, catalog.meta, zip(catalog.points(), catalog.records))
        if catalog.meta.comparison is not None:
            insert_shifts(db, catalog.shifts)
        insert_service_rows(db, catalog.meta, extent, with_patches=False)


def export_patch(catalog: Catalog, point_id: int, level: int, path: Path) -> int:
    """Write a point's patch as a solid to a .obj or .glb file; returns its number of triangles.

    Raises DataError for a point or level that is not there or a patch with holes, OutputError for
    a place that cannot be written or an existing file that is no such export.
    """
    vertices, faces = make_patch_solid(catalog, point_id, level)
    name = f"{PATCH_NAME} {point_id} level {level}"
    data: bytes
    if path.suffix.lower() == ".glb":
        scene: Any = trimesh.Scene()
        scene.add_geometry(trimesh.Trimesh(vertices @ Y_UP.T, faces, process=False), geom_name=name)
        data = scene.export(file_type="glb")
    else:
        solid: Any = trimesh.Trimesh(vertices, faces, process=False)
        data = solid.export(file_type="obj", header=name, digits=4).encode()
    write_output(path, data, _is_our_patch)
    return len(faces)


def find_patch(catalog: Catalog, point_id: int, level: int) -> tuple[ControlPoint, Patch]:
    """A point and its patch of a level. Raises DataError for one that is not there."""
    point, patches = catalog.point(point_id), catalog.patches(point_id)
    if not 0 <= level < len(patches):
        raise DataError(
            f"{catalog.path}: control point {point_id} has {len(patches)} levels, from 0 on; "
            f"there is no level {level}"
        )
    return point, patches[level]


def make_patch_solid(catalog: Catalog, point_id: int, level: int) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3), m, east, north, up from the point, and outward triangles (m, 3)."""
    point, patch = find_patch(catalog, point_id, level)
    holes = int(np.isnan(patch.heights_m).sum())
    if holes:
        raise DataError(
            f"{catalog.path}: level {level} of control point {point_id} has {holes} nodes without "
            "ground; a solid wants whole ground: choose another level or point"
        )
    size = patch.size
    x, y = make_node_grid(size, patch.posting_m)
    heights = patch.heights_m.astype(np.float64)
    base = np.full_like(heights, heights.min() - BASE_SHARE * size * patch.posting_m)
    projection = catalog.meta.projection(point)
    placed = np.stack([projection.points(x, y, h) for h in (heights, base)])
    vertices = (placed.reshape(-1, 3) - point.xyz_m) @ projection.body_from_local
    faces = _make_faces(size)
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(vert_properties=vertices, tri_verts=faces.astype(np.uint64))
    )
    if solid.status() != manifold3d.Error.NoError or not solid.volume() > 0.0:
        raise DataError(
            f"{catalog.path}: level {level} of control point {point_id} makes no solid "
            f"({solid.status().name}); run `optnav catalog verify`"
        )
    return vertices, faces


def _make_faces(size: int) -> IntArray:
    """Triangles of two square grids of nodes, the ground's first, and of the sides between."""
    top = np.arange(size * size).reshape(size, size)  # row 0 north
    a, b = top[1:, :-1].ravel(), top[1:, 1:].ravel()  # south-west, south-east
    c, d = top[:-1, 1:].ravel(), top[:-1, :-1].ravel()
    ground = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    bottom = ground[:, ::-1] + size * size
    # once round the ground, eastward along the south
    rim = np.concatenate([top[-1, :-1], top[:0:-1, -1], top[0, :0:-1], top[:-1, 0]])
    after, below = np.roll(rim, -1), rim + size * size
    side = np.stack([below, np.roll(below, -1), after], axis=1)
    return np.concatenate([ground, bottom, side, np.stack([below, after, rim], axis=1)])


def _is_our_patch(path: Path) -> bool:
    with path.open("rb") as file:
        return PATCH_NAME.encode() in file.read(HEAD_BYTES)


def export_relief(catalog: Catalog, path: Path) -> int:
    """Write means and tops as the bands of a GeoTIFF on the body's sphere; returns its rows.

    Raises DataError for a catalog without a relief or with a damaged one, OutputError for a place
    that cannot be written or an existing file that is no such export.
    """
    relief = catalog.relief()
    if relief is None:
        raise DataError(
            f"{catalog.path}: carries no relief; name a terrain model of the whole body as "
            "[relief] dem of its build config and build it again, or name a point with --point to "
            "write its patch"
        )
    rows = len(relief.heights)
    step = 180.0 / rows
    georeference = {
        "crs": rasterio.CRS.from_wkt(define_srs(catalog.meta.body, catalog.meta.radius_m)[4]),
        "transform": Affine(step, 0.0, -180.0, 0.0, -step, 90.0),
        "tiled": True,
    }
    bands = {"mean height, m": relief.heights, "highest place, m": relief.max_heights}
    _write_raster(path, bands, georeference, {DESCRIPTION: f"{RELIEF_NAME}: {relief.source}"})
    return rows


def export_patch_heights(catalog: Catalog, point_id: int, level: int, path: Path) -> int:
    """Write the heights of a point's patch, a pixel a node, as a GeoTIFF; returns nodes a side.

    Its system is the stereographic projection of the body's sphere that is centred on the point, or
    the plane that touches the body below it. Nodes without ground are NaN, which is its nodata.
    Raises DataError for a point or level that is not there, OutputError as `export_relief`.
    """
    point, patch = find_patch(catalog, point_id, level)
    half = patch.posting_m * patch.size / 2.0
    georeference = {
        "crs": rasterio.CRS.from_wkt(_format_patch_system(catalog.meta, point)),
        "transform": Affine(patch.posting_m, 0.0, -half, 0.0, -patch.posting_m, half),
        "nodata": np.nan,
    }
    words = f"{PATCH_NAME} {point_id} level {level}: {point.source}"
    above = "sphere" if catalog.meta.planes is None else "plane"
    bands = {f"height above the {above}, m": patch.heights_m}
    _write_raster(path, bands, georeference, {DESCRIPTION: words, "AREA_OR_POINT": "Point"})
    return patch.size


def _format_patch_system(meta: CatalogMeta, point: ControlPoint) -> str:
    """The map projection of a point's patches, as WKT."""
    if meta.planes is None:
        return format_stereographic_wkt(
            meta.body, f"control point {point.id}", meta.radius_m, (point.lat_deg, point.lon_deg)
        )
    # no projection of a sphere: heights move a point across the plane
    name = f"Plane that touches the ellipsoid of {meta.body} below control point {point.id}"
    if point.vertical_deg is not None:
        name = f"Plane of the ground of {meta.body} at control point {point.id}"
    return f'LOCAL_CS["{name}",{MAP_AXES}'


def _write_raster(
    path: Path, bands: Mapping[str, Float32Array], place: Mapping[str, Any], tags: Mapping[str, str]
) -> None:
    """Write grids as bands, with their descriptions; all of them are metres."""
    with replace_file(path, _is_our_raster) as partial:
        partial.write_bytes(encode_geotiff(bands, place, tags, unit="m"))


def _is_our_raster(path: Path) -> bool:
    return is_described(path, RELIEF_NAME, PATCH_NAME)
