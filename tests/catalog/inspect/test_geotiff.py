"""A patch as a GeoTIFF: where GDAL and PROJ put its nodes, and what stands there."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio

from catalog.errors import DataError, OutputError
from catalog.geometry.cells import CellGrid
from catalog.geometry.projection import make_node_grid
from catalog.inspect.export import export_patch_heights
from catalog.store.manifest import PlanesMeta
from catalog.store.reader import Catalog

PLACES = ((-90.0, -180.0), (-43.1234567, -11.7654321), (0.05, 179.9999999), (89.9999999, -13.0))


def moved(world: Any, place: tuple[float, float], path: Path) -> Path:
    """A catalog of one point, with a hole in its ground, at a place."""
    cell = int(CellGrid(world.meta.cell_deg).find_cells(*place))
    point, patches = next(pair for pair in world.points if pair[0].id % 3 == 0)
    pair = replace(point, id=cell, lat_deg=place[0], lon_deg=place[1]), patches
    written: Path = type(world)(world.meta, [pair]).write(path).path
    return written


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("level", [0, 2])
def test_proj_puts_every_node_where_the_catalog_has_it(
    world: Any, tmp_path: Path, place: tuple[float, float], level: int
) -> None:
    with Catalog.open(moved(world, place, tmp_path / "one.gpkg")) as catalog:
        number = int(catalog.ids[0])
        size = export_patch_heights(catalog, number, level, tmp_path / "patch.tif")
        patch, point = catalog.patches(number)[level], catalog.point(number)
        projection = catalog.meta.projection(point)
    with rasterio.open(tmp_path / "patch.tif") as file:
        heights, crs = file.read(1), pyproj.CRS.from_wkt(file.crs.to_wkt())
        assert (file.dtypes, file.units, file.count) == (("float32",), ("m",), 1)
        assert np.isnan(file.nodata)
        rows, columns = np.mgrid[:size, :size]
        x, y = rasterio.transform.xy(file.transform, rows.ravel(), columns.ravel())
    np.testing.assert_array_equal(heights, patch.heights_m)
    assert np.isnan(heights).any()
    assert crs.ellipsoid is not None
    assert crs.ellipsoid.semi_major_metre == catalog.meta.radius_m
    to_places = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
    lon, lat = np.radians(to_places.transform(x, y))
    wanted = make_node_grid(size, patch.posting_m)
    found = projection.xy_from_latlon(lat, lon)
    off = np.hypot(*(theirs - ours.ravel() for theirs, ours in zip(found, wanted)))
    assert off.max() < 1e-3 * patch.posting_m  # a tenth of a node is wanted
    centre = to_places.transform(0.0, 0.0)
    assert centre[1] == pytest.approx(place[0], abs=1e-7)


def test_patches_in_planes_are_on_no_sphere(world: Any, tmp_path: Path) -> None:
    planes = PlanesMeta((1737400.0, 1737400.0, 1737000.0), 500.0)
    world = type(world)(replace(world.meta, body="phobos", planes=planes), world.points)
    with Catalog.open(world.write(tmp_path / "planes.gpkg").path) as catalog:
        export_patch_heights(catalog, int(catalog.ids[0]), 0, tmp_path / "patch.tif")
    with rasterio.open(tmp_path / "patch.tif") as file:
        assert not file.crs.is_geographic
        assert not file.crs.is_projected
        assert "Plane that touches the ellipsoid of phobos" in file.crs.to_wkt()
        assert file.descriptions == ("height above the plane, m",)


def test_the_same_patch_gives_the_same_bytes_and_nothing_else_is_replaced(
    catalog_copy: Path, tmp_path: Path
) -> None:
    path = tmp_path / "patch.tif"
    with Catalog.open(catalog_copy) as catalog:
        number = int(catalog.ids[0])
        export_patch_heights(catalog, number, 0, path)
        first = path.read_bytes()
        export_patch_heights(catalog, number, 0, path)
        assert path.read_bytes() == first
        with pytest.raises(DataError, match="there is no level 9"):
            export_patch_heights(catalog, number, 9, path)
        path.write_bytes(b"II*\x00 somebody's own picture")
        with pytest.raises(OutputError, match="not made by optnav"):
            export_patch_heights(catalog, number, 0, path)


def test_a_name_that_is_no_utf_8_is_refused(world: Any, tmp_path: Path) -> None:
    place = tmp_path / os.fsdecode(b"n\xff\xe9.tif")
    one = moved(world, PLACES[1], tmp_path / "one.gpkg")
    with Catalog.open(one) as catalog, pytest.raises(OutputError, match="not UTF-8"):
        export_patch_heights(catalog, int(catalog.ids[0]), 0, place)
    assert not place.exists()
