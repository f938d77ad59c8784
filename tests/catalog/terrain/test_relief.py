"""The relief of a whole body against numpy's own means and maxima of the same raster."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from rasterio.warp import Resampling, reproject

from catalog.config import resource
from catalog.errors import DataError
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.error_model import StatedError
from catalog.terrain.relief import sums
from catalog.terrain.relief.sums import build_relief, count_rows, load_relief

MOON = "+proj=longlat +R=1737400 +no_defs"
NODATA = -32768


def raster(path: Path, counts, west=0.0, north=90.0, step=None, crs=MOON) -> Path:
    rows, cols = counts.shape
    step = step or 360.0 / cols
    with rasterio.open(
        path, "w", driver="GTiff", height=rows, width=cols, count=1, dtype="int16",
        nodata=NODATA, crs=rasterio.CRS.from_user_input(crs),
        transform=Affine(step, 0.0, west, 0.0, -step, north),
    ) as file:  # fmt: skip
        file.write(counts, 1)
    return path


def relief_of(path: Path, moon, rows=None, **settings):
    source = DemSource.open(DemSettings(path=str(path), **settings), Path(), moon)
    return build_relief(source, rows)


@pytest.fixture(scope="module")
def counts():
    return np.random.default_rng(4).integers(-3000, 3000, (180, 360)).astype(np.int16)


@pytest.mark.parametrize("west", [0.0, -180.0])
def test_blocks_of_pixels_become_means_and_maxima(tmp_path, monkeypatch, moon, counts, west):
    monkeypatch.setattr(sums, "WINDOW", 50)  # windows end within cells
    relief = relief_of(raster(tmp_path / "a.tif", counts, west), moon, rows=60)
    blocks = np.roll(counts, 180 if west == 0.0 else 0, axis=1).reshape(60, 3, 120, 3)
    np.testing.assert_allclose(relief.heights, blocks.mean(axis=(1, 3)), atol=1e-3)
    np.testing.assert_array_equal(relief.max_heights, blocks.max(axis=(1, 3)))


def test_pixels_across_cell_borders_count_by_their_share(tmp_path, moon, counts):
    """Repeating pixels and cells up to the common multiple makes both grids one."""
    relief = relief_of(raster(tmp_path / "a.tif", counts, -180.0), moon, rows=72)
    fine = np.kron(counts, np.ones((2, 2)))  # 360 rows: 2 a pixel, 5 a cell
    blocks = fine.reshape(72, 5, 144, 5)
    np.testing.assert_allclose(relief.heights, blocks.mean(axis=(1, 3)), atol=1e-3)
    np.testing.assert_array_equal(relief.max_heights, blocks.max(axis=(1, 3)))


def test_a_coarse_model_keeps_its_own_grid(moon):
    relief = load_relief("bundled:moon_gld100_4ppd.tif", moon)
    with rasterio.open(resource("data/moon_gld100_4ppd.tif")) as dataset:
        raw = np.roll(dataset.read(1), 720, axis=1)
    np.testing.assert_array_equal(relief.heights, raw)
    np.testing.assert_array_equal(relief.max_heights, raw)
    assert load_relief("bundled:moon_gld100_4ppd.tif", moon) is relief
    assert relief.error_m is None
    assert load_relief("bundled:moon_gld100_4ppd.tif", moon, StatedError("gld100")).error_m == 28.0
    assert count_rows(np.radians(1.0 / 32.0)) == 2880


def test_the_real_moon_at_16_a_degree_is_the_mean_of_its_32(shared_data, moon):
    path = shared_data("moon/moon_gld100_32ppd.tif")
    relief = load_relief(str(path), moon)
    with rasterio.open(path) as dataset:
        raw = np.roll(dataset.read(1), 5760, axis=1).astype(np.float32)
    four = raw[::2, ::2], raw[1::2, ::2], raw[::2, 1::2], raw[1::2, 1::2]
    assert np.abs(relief.heights - sum(four) / 4.0).max() < 1e-3
    assert (relief.max_heights == np.maximum.reduce(four)).all()


def test_a_pixel_on_each_pole_counts_by_the_half_that_is_there(tmp_path, moon):
    """Grid-registered: 181 rows from pole to pole, so that the outer ones reach beyond."""
    rows = np.arange(181, dtype=np.int16)[:, None] * np.ones(360, np.int16)
    path = raster(tmp_path / "a.tif", rows.astype(np.int16), -180.5, 90.5)
    relief = relief_of(path, moon, rows=180)
    np.testing.assert_allclose(relief.heights[:, 7], np.arange(180) + 0.5, atol=1e-4)
    np.testing.assert_array_equal(relief.max_heights[:, 7], np.arange(1, 181))


def test_heights_go_on_across_the_seam_and_the_poles(tmp_path, moon):
    """A plane's heights, z = 1000 m times the direction along a fixed axis, have no seam."""
    axis = np.array([0.48, 0.6, 0.64])
    lat = np.radians(89.5 - np.arange(180.0))[:, None]
    lon = np.radians(np.arange(360.0) + 0.5)
    parts = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat) + 0.0 * lon
    field = 1000.0 * sum(a * p for a, p in zip(axis, parts))
    relief = relief_of(raster(tmp_path / "a.tif", np.rint(field).astype(np.int16)), moon)
    rng = np.random.default_rng(5)
    lat = np.concatenate(
        [np.radians([90.0, 89.9, -89.9, -90.0, 10.0, 10.0]), rng.uniform(-1, 1, 50)]
    )
    lon = np.concatenate(
        [np.radians([0.0, 40.0, 200.0, 10.0, 180.0, -179.9]), rng.uniform(-4, 4, 50)]
    )
    true = 1000.0 * (
        axis[0] * np.cos(lat) * np.cos(lon) + axis[1] * np.cos(lat) * np.sin(lon)
        + axis[2] * np.sin(lat)
    )  # fmt: skip
    assert np.abs(relief.heights_at(lat, lon) - true).max() < 0.8  # rounding, and the chord's sag


def test_holes_take_the_heights_around_them(tmp_path, moon):
    flat = np.full((180, 360), 700, np.int16)
    flat[:, 180:] = 300
    flat[40:43, 350:] = NODATA
    flat[40:43, :10] = NODATA  # over the seam of the raster, between 300 and 700
    flat[0, :] = NODATA  # a pole
    relief = relief_of(raster(tmp_path / "a.tif", flat), moon)
    assert np.isfinite(relief.heights).all()
    hole = np.roll(relief.heights, 180, axis=1)[41]
    assert (hole[349], hole[10]) == (300.0, 700.0)
    assert (hole[350:] == 300.0).sum() + (hole[:10] == 700.0).sum() >= 12
    assert 300.0 < hole[0] < 700.0
    assert (relief.max_heights >= relief.heights).all()


def test_an_average_of_part_of_a_cell_is_of_what_is_known(tmp_path, moon):
    flat = np.full((180, 360), 500, np.int16)
    flat[100, 100] = NODATA
    flat[101, 101] = 560
    relief = relief_of(raster(tmp_path / "a.tif", flat, -180.0), moon, rows=90)
    assert relief.heights[50, 50] == pytest.approx(520.0)
    assert relief.max_heights[50, 50] == 560.0


def test_a_model_of_a_part_is_refused_with_its_share(tmp_path, moon, counts):
    with pytest.raises(DataError, match=r"a\.tif: 25 % of moon is shown; a relief wants 99 %"):
        relief_of(raster(tmp_path / "a.tif", counts[:90, :180], step=1.0), moon)
    holes = counts.copy()
    holes[80:84] = NODATA
    with pytest.raises(DataError, match=r"96\.5 % of moon is shown"):
        relief_of(raster(tmp_path / "b.tif", holes), moon)
    with pytest.raises(DataError, match="whole body"):
        load_relief("bundled:tycho_gld100_256ppd.tif", moon)


def test_a_file_by_itself_is_refused_with_a_remedy_that_it_has(tmp_path, moon):
    with pytest.raises(DataError, match=r"none\.tif: there is no such file; check the path$"):
        load_relief(str(tmp_path / "none.tif"), moon)
    path = raster(tmp_path / "a.tif", np.random.default_rng(1).integers(-9, 9, (90, 180), np.int16))
    with pytest.raises(DataError, match=r'set units = "km" in \[relief\] dem of a build config'):
        load_relief(str(path), moon)


def test_wrong_units_and_another_body_are_refused(tmp_path, moon, counts):
    path = raster(tmp_path / "a.tif", counts)
    with pytest.raises(DataError, match=r"heights run from .*are these m\?"):
        relief_of(path, moon, units="km")
    mars = raster(tmp_path / "mars.tif", counts, crs="+proj=longlat +R=3396190 +no_defs")
    with pytest.raises(DataError, match=r"is for a body of 3396\.2 km radius, moon has 1737\.4"):
        relief_of(mars, moon)


def test_a_map_that_is_not_cylindrical_gives_its_pixels_middles(tmp_path, moon):
    """GDAL's own warp to a Mollweide map and our cells: a smooth field comes back."""
    lat = np.radians(89.5 - np.arange(180.0))[:, None]
    lon = np.radians(np.arange(360.0) - 179.5)
    field = 3000.0 * np.cos(lat) * np.cos(lon) * np.ones((180, 360))
    plain = Affine(1.0, 0.0, -180.0, 0.0, -1.0, 90.0)
    crs = rasterio.CRS.from_user_input("+proj=moll +R=1737400 +no_defs")
    step, width, height = 15000.0, 656, 328  # its ellipse is 4 sqrt(2) by 2 sqrt(2) radii
    place = Affine(step, 0.0, -step * width / 2.0, 0.0, -step, step * height / 2.0)
    warped = np.full((height, width), NODATA, np.float32)
    reproject(
        field.astype(np.float32), warped, src_transform=plain, src_crs=MOON, dst_transform=place,
        dst_crs=crs, dst_nodata=NODATA, resampling=Resampling.bilinear,
    )  # fmt: skip
    path = tmp_path / "moll.tif"
    with rasterio.open(
        path, "w", driver="GTiff", height=height, width=width, count=1, dtype="float32",
        nodata=NODATA, crs=crs, transform=place,
    ) as file:  # fmt: skip
        file.write(warped, 1)
    relief = relief_of(path, moon, rows=90)
    true = field.reshape(90, 2, 180, 2).mean(axis=(1, 3))
    inner = np.abs(relief.heights - true)[2:-2, 2:-2]
    assert inner.max() < 60.0  # half a cell of the steepest slope, 105 m a cell
