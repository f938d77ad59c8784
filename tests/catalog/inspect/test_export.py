"""Exported layers, read back through GDAL."""

import csv
import shutil
import sqlite3
import subprocess
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest

from catalog.errors import OutputError
from catalog.geometry.cells import CellGrid
from catalog.inspect.export import export
from catalog.store.reader import Catalog
from catalog.store.writer import Written

pyogrio = pytest.importorskip("pyogrio", reason="needs pyogrio to read vector layers")


@pytest.fixture(scope="module")
def catalog(written: Written) -> Any:
    with Catalog.open(written.path) as opened:
        yield opened


@pytest.mark.parametrize("ending", [".geojson", ".csv", ".gpkg"])
def test_a_layer_reads_back_on_the_moon(catalog: Catalog, tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"points{ending}"
    assert export(catalog, path) == len(catalog)
    layer = "control_points" if ending == ".gpkg" else None  # beside its styles
    info = pyogrio.read_info(path, layer=layer)
    crs = pyproj.CRS.from_user_input(info["crs"])
    assert crs.ellipsoid is not None
    assert crs.ellipsoid.semi_major_metre == crs.ellipsoid.semi_minor_metre == 1737400.0
    assert (info["geometry_type"], info["features"]) == ("Point", len(catalog))
    meta, _, geometry, fields = pyogrio.raw.read(path, layer=layer)
    columns = dict(zip(meta["fields"].tolist(), fields))
    places = np.array([np.frombuffer(wkb[5:21], dtype="<f8") for wkb in geometry])
    assert np.array_equal(places, np.column_stack([catalog.lon_deg, catalog.lat_deg]))
    assert columns["usable"].astype(bool).tolist() == catalog.usable.tolist()
    points = list(catalog.points())
    assert columns["radius_m"].tolist() == [point.radius_m for point in points]
    assert columns["source"].tolist() == [point.source for point in points]
    if ending != ".gpkg":
        assert columns["id"].tolist() == catalog.ids.tolist()
        assert columns["shadow_limit_350_deg"].tolist() == [p.shadow_limit_deg[35] for p in points]
        assert columns["uniqueness_2"].tolist() == [p.uniqueness[2] for p in points]


EDGES = ((-90.0, -180.0), (-90.0, 77.0), (0.0, -180.0), (0.05, 179.9999999), (90.0, -13.0))


@pytest.mark.parametrize("ending", [".geojson", ".csv", ".gpkg"])
def test_gdal_s_own_programs_read_points_at_the_poles_and_180_degrees(
    world: Any, tmp_path: Path, ending: str
) -> None:
    """Another GDAL than that within pyogrio, as users have it; RFC 7946 alone would mean Earth."""
    ogr2ogr, ogrinfo = shutil.which("ogr2ogr"), shutil.which("ogrinfo")
    if ogr2ogr is None or ogrinfo is None:
        pytest.skip("needs GDAL's ogr2ogr and ogrinfo")
    grid = CellGrid(world.meta.cell_deg)
    cells = [int(grid.find_cells(*place)) for place in EDGES]
    assert sorted(set(cells)) == cells
    pairs = [
        (replace(point, id=cell, lat_deg=place[0], lon_deg=place[1]), patches)
        for cell, place, (point, patches) in zip(cells, EDGES, world.points)
    ]
    written = type(world)(world.meta, pairs).write(tmp_path / "edges.gpkg")
    path = tmp_path / f"layer{ending}"
    with Catalog.open(written.path) as catalog:
        export(catalog, path)
        radii = [point.radius_m for point in catalog.points()]
    told = subprocess.run(
        [ogrinfo, "-ro", "-so", "-al", str(path)], capture_output=True, text=True, check=True
    )
    layer = ["control_points"] if ending == ".gpkg" else []  # beside its styles
    assert told.stderr == ""
    assert 'ELLIPSOID["Moon (2015) - Sphere",1737400,0,' in told.stdout
    assert "6378137" not in told.stdout
    table = subprocess.run(
        [ogr2ogr, "-f", "CSV", "/vsistdout/", str(path), "-lco", "GEOMETRY=AS_XY", *layer],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    rows = list(csv.DictReader(table.splitlines()))
    assert [(float(row["Y"]), float(row["X"])) for row in rows] == list(EDGES)
    assert [float(row["radius_m"]) for row in rows] == radii


def test_a_layer_of_a_former_version_is_replaced(catalog: Catalog, tmp_path: Path) -> None:
    path = tmp_path / "points.gpkg"
    export(catalog, path)
    first = path.read_bytes()
    with closing(sqlite3.connect(path)) as db:
        db.execute("ALTER TABLE control_points RENAME localisation_nodes TO localisation_px")
    export(catalog, path)
    assert path.read_bytes() == first


def test_geojson_of_another_body_has_its_sphere(world: Any, tmp_path: Path) -> None:
    meta = replace(world.meta, body="phobos", radius_m=11080.0)
    written = type(world)(meta, world.points).write(tmp_path / "phobos.gpkg")
    for ending in (".geojson", ".csv", ".gpkg"):
        with Catalog.open(written.path) as catalog:
            export(catalog, tmp_path / f"layer{ending}")
        layer = "control_points" if ending == ".gpkg" else None
        info = pyogrio.read_info(tmp_path / f"layer{ending}", layer=layer)
        crs = pyproj.CRS.from_user_input(info["crs"])
        assert crs.ellipsoid is not None
        assert crs.ellipsoid.semi_major_metre == 11080.0, ending


@pytest.mark.parametrize("ending", [".geojson", ".csv", ".gpkg"])
def test_an_older_layer_is_replaced_and_anything_else_left_alone(
    catalog: Catalog, tmp_path: Path, ending: str
) -> None:
    path = tmp_path / f"points{ending}"
    export(catalog, path)
    first = path.read_bytes()
    export(catalog, path)
    assert path.read_bytes() == first
    path.write_text("somebody's notes")
    with pytest.raises(OutputError, match="not made by optnav"):
        export(catalog, path)
    assert path.read_text() == "somebody's notes"


def test_unknown_endings_and_the_catalog_itself_are_refused(
    catalog: Catalog, tmp_path: Path
) -> None:
    with pytest.raises(OutputError, match="endings"):
        export(catalog, tmp_path / "points.shp")
    with pytest.raises(OutputError, match="itself"):
        export(catalog, catalog.path)
