"""A catalog as GIS programs see it: read through GDAL, not through our own code."""

import json
import shutil
import sqlite3
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest

from catalog.store.reader import Catalog
from catalog.store.verify import verify
from catalog.store.writer import Written

pyogrio = pytest.importorskip("pyogrio", reason="needs pyogrio to read vector layers")


def assert_lunar(wkt: str) -> None:
    """The Moon's sphere with longitudes in degrees."""
    crs = pyproj.CRS.from_user_input(wkt)
    assert crs.is_geographic
    assert crs.ellipsoid is not None
    assert crs.ellipsoid.semi_major_metre == crs.ellipsoid.semi_minor_metre == 1737400.0
    assert "Moon" in crs.name


def test_gdal_lists_the_points_as_a_layer_on_the_moon(world: Any, written: Written) -> None:
    layers = dict(pyogrio.list_layers(written.path).tolist())
    assert layers["control_points"] == "Point"
    info = pyogrio.read_info(written.path, layer="control_points")
    assert info["features"] == len(world.points)
    assert info["fid_column"] == "id"
    assert_lunar(info["crs"])


def test_the_coordinate_system_is_the_one_of_the_iau(written: Written) -> None:
    info = pyogrio.read_info(written.path, layer="control_points")
    iau = pyproj.CRS.from_user_input("IAU_2015:30100")
    assert pyproj.CRS.from_user_input(info["crs"]).equals(iau, ignore_axis_order=True)


def test_gdal_reads_places_and_attributes(written: Written) -> None:
    meta, fids, geometry, fields = pyogrio.raw.read(
        written.path, layer="control_points", return_fids=True
    )
    columns = dict(zip(meta["fields"].tolist(), fields))
    with Catalog.open(written.path) as catalog:
        assert fids.tolist() == catalog.ids.tolist()
        for row, point in enumerate(catalog.points()):
            x, y = np.frombuffer(geometry[row][5:21], dtype="<f8")
            assert (x, y) == (point.lon_deg, point.lat_deg)
            assert columns["usable"][row] == point.usable
            assert columns["hessian_eigenvalue"][row] == point.hessian_eigenvalue
            assert columns["source"][row] == point.source
            assert json.loads(columns["uniqueness"][row]) == list(point.uniqueness)
            assert len(json.loads(columns["shadow_limit_deg"][row])) == 36


def test_gdal_finds_points_in_a_box_through_the_r_tree(written: Written) -> None:
    box = (-100.0, -60.0, 60.0, 50.0)
    _, fids, _, _ = pyogrio.raw.read(
        written.path, layer="control_points", bbox=box, return_fids=True
    )
    with Catalog.open(written.path) as catalog:
        inside = (
            (catalog.lon_deg >= box[0])
            & (catalog.lat_deg >= box[1])
            & (catalog.lon_deg <= box[2])
            & (catalog.lat_deg <= box[3])
        )
        assert 0 < inside.sum() < len(catalog)
        assert sorted(fids.tolist()) == catalog.ids[inside].tolist()


def test_another_body_gets_its_own_sphere(world: Any, tmp_path: Path) -> None:
    from dataclasses import replace

    meta = replace(world.meta, body="phobos", radius_m=11080.0)
    points = [(replace(point, radius_m=11000.0), patches) for point, patches in world.points]
    written = type(world)(meta, points).write(tmp_path / "phobos.gpkg")
    crs = pyproj.CRS.from_user_input(pyogrio.read_info(written.path, layer="control_points")["crs"])
    assert crs.ellipsoid is not None
    assert crs.ellipsoid.semi_major_metre == 11080.0
    assert "Phobos" in crs.name
    assert verify(written.path).sound


def test_an_edit_with_gdal_keeps_the_r_tree_and_is_noticed(catalog_copy: Path) -> None:
    """The triggers of the R-tree are those of the GeoPackage extension: GDAL's SQL runs them."""
    ogrinfo = shutil.which("ogrinfo")
    if ogrinfo is None:
        pytest.skip("needs GDAL's ogrinfo")
    with Catalog.open(catalog_copy) as catalog:
        moved, removed = int(catalog.ids[1]), int(catalog.ids[2])
    for statement in (
        "UPDATE control_points SET geom = SetSRID(MakePoint(12.5, 33.25), 30100) "
        f"WHERE id = {moved}",
        f"DELETE FROM control_points WHERE id = {removed}",
    ):
        done = subprocess.run(
            [ogrinfo, str(catalog_copy), "-sql", statement], capture_output=True, text=True
        )
        if "no such function" in done.stderr:
            pytest.skip("this GDAL has no Spatialite functions")
        assert done.returncode == 0, done.stderr
    db = sqlite3.connect(catalog_copy)
    boxes = db.execute("SELECT * FROM rtree_control_points_geom").fetchall()
    tree = {row[0]: row[1:] for row in boxes}
    db.close()
    assert removed not in tree
    assert tree[moved] == pytest.approx((12.5, 12.5, 33.25, 33.25))
    places = [problem.where for problem in verify(catalog_copy).problems]
    assert f"control_points {moved}" in places
    assert f"control_points {removed}" in places
