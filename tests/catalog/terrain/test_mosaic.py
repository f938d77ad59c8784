"""Sampled surfaces against other readers of the same files and against known surfaces."""

import pickle
import time

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from rasterio.warp import Resampling, reproject
from rasterio.warp import transform as transform_places
from scipy.ndimage import map_coordinates

from catalog.geometry.projection import Stereographic, make_node_grid
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import DemSettings


def mosaic_of(moon, folder, *paths, **settings) -> Mosaic:
    named = [
        DemSettings(path=str(path), priority=i + 1, **settings) for i, path in enumerate(paths)
    ]
    return Mosaic.from_files(named, folder, moon, folder / "overviews")


def on_the_sphere(rng, n, south=-90.0, north=90.0):
    z = rng.uniform(np.sin(np.radians(south)), np.sin(np.radians(north)), n)
    return np.arcsin(z), rng.uniform(-np.pi, np.pi, n)


REAL = [
    "moon_gld100_4ppd.tif",
    "LDEM_4.LBL",
    "gld100_lola_reduced.cub",
    "lola_2.8ppd_lon180.tif",
    "tycho_gld100_256ppd.tif",
    "tycho_gld100_64ppd.tif",
    "boguslawsky_gld100_64ppd.tif",
    "moon_gld100_32ppd.tif",
]


@pytest.mark.parametrize("name", REAL)
def test_heights_of_real_files_agree_with_gdal_between_pixels(shared_data, tmp_path, moon, name):
    """GDAL's cubic convolution on a grid shifted by parts of a pixel, its places through PROJ.

    The same interpolation by another program, so only rounding (of single precision here and of
    weights there) is left: 1 m where neighbouring pixels differ by up to 5 km.
    """
    path = shared_data(f"moon/{name}")
    mosaic = mosaic_of(moon, tmp_path, path)
    source = mosaic.pyramids[0].source
    rows, cols = source.shape
    height, width = min(150, rows // 2), min(200, cols // 2)
    row0, col0 = rows // 2 - height // 2 + 0.37, cols // 3 + 0.71
    with rasterio.open(path) as dataset:
        a, _, c, _, e, f = dataset.transform[:6]
        shifted = Affine(a, 0.0, c + a * col0, 0.0, e, f + e * row0)
        read = np.full((height, width), np.nan)
        reproject(
            dataset.read(1).astype(np.float64),
            read,
            src_transform=dataset.transform,
            src_crs=dataset.crs,
            dst_transform=shifted,
            dst_crs=dataset.crs,
            resampling=Resampling.cubic,
        )
        row, col = np.mgrid[0:height, 0:width] + 0.5
        x, y = shifted.c + a * col, shifted.f + e * row
        lon, lat = transform_places(
            dataset.crs, f"+proj=longlat +R={moon.radius_m}", x.ravel(), y.ravel()
        )
    # footprints below 1.5 columns wherever the file lies: single cubic samples
    posting = source.posting_m * np.cos(np.radians(np.abs(lat).max()))
    ours = mosaic.heights(np.radians(lat), np.radians(lon), posting)
    # this product's radii: GDAL was given counts
    expected = read.ravel() * source.convert.scale_m + source.convert.offset_m
    assert np.isfinite(expected).all()
    assert np.abs(ours - expected).max() < 1.0
    # half a pixel would not pass: the ground is rough
    assert np.abs(np.diff(expected)).max() > 20.0


def test_real_heights_follow_a_cubic_spline_everywhere(shared_data, tmp_path, moon):
    """The whole Tycho file, rough ground included: cubic convolution is within a few metres rms."""
    path = shared_data("moon/tycho_gld100_256ppd.tif")
    mosaic = mosaic_of(moon, tmp_path, path)
    with rasterio.open(path) as dataset:
        raw = dataset.read(1).astype(np.float64)
    rng = np.random.default_rng(5)
    row, col = rng.uniform(5, 2554, 20_000), rng.uniform(5, 3066, 20_000)
    lat, lon = mosaic.pyramids[0].source.georeference.latlon_from_pixel(col, row)
    ours = mosaic.heights(lat, lon, mosaic.posting_m * 0.7)
    spline = map_coordinates(raw, [row, col], order=3)
    assert np.std(ours - spline) < 1.0
    assert abs(np.mean(ours - spline)) < 0.02


@pytest.mark.parametrize("lat_deg", [0.0, 60.0, 85.0, 89.7, 90.0, -90.0])
@pytest.mark.parametrize("lon_deg", [0.0, 180.0, -97.0])
def test_patches_of_a_known_surface_are_right_everywhere(tmp_path, dems, moon, lat_deg, lon_deg):
    """Poles and ±180° included; the surface bends little within a pixel of 0.25°."""
    path = dems.write(tmp_path / "globe.tif", dems.smooth_grid(720).astype(np.float32))
    mosaic = mosaic_of(moon, tmp_path, path)
    projection = Stereographic(np.radians(lat_deg), np.radians(lon_deg), moon.radius_m)
    for factor in (1.0, 2.0, 4.0):
        posting = mosaic.posting_m * factor
        grid = mosaic.local_grid(projection, posting, 40)
        lat, lon = projection.latlon(*make_node_grid(40, posting))
        truth = dems.smooth_heights(lat, lon)
        # what a mean over a footprint takes off a curved surface grows with its square
        assert np.abs(grid - truth).max() < 3.0 * factor**2, factor


@pytest.mark.parametrize("pole", [90.0, -90.0])
def test_the_real_moon_goes_on_across_its_poles(shared_data, tmp_path, moon, pole):
    """Second differences across the pole are no larger than those of the ground about it."""
    mosaic = mosaic_of(moon, tmp_path, shared_data("moon/moon_gld100_32ppd.tif"))
    for lon_deg in (0.0, 61.0):
        projection = Stereographic(np.radians(pole), np.radians(lon_deg), moon.radius_m)
        grid = mosaic.local_grid(projection, mosaic.posting_m, 121).astype(np.float64)
        assert np.isfinite(grid).all()
        bend = np.abs(np.diff(grid, 2, axis=0))
        near, about = bend[55:64, 56:65], bend[:50]
        assert near.mean() < 1.5 * about.mean()
        assert near.max() < about.max()


def test_the_pole_does_not_depend_on_the_longitude_it_is_asked_by(shared_data, tmp_path, moon):
    mosaic = mosaic_of(moon, tmp_path, shared_data("moon/moon_gld100_4ppd.tif"))
    lon = np.linspace(-np.pi, np.pi, 50)
    for pole in (-np.pi / 2.0, np.pi / 2.0):
        heights = mosaic.heights(np.full(50, pole), lon, mosaic.posting_m)
        assert np.ptp(heights) < 1.0


def test_crowded_columns_are_averaged_not_picked(tmp_path, dems, moon):
    """White noise at 80 N: a node is as wide as 5.8 columns, so its variance falls accordingly."""
    rng = np.random.default_rng(6)
    values = rng.normal(0.0, 1000.0, (720, 1440)).astype(np.float32)
    mosaic = mosaic_of(moon, tmp_path, dems.write(tmp_path / "noise.tif", values))
    at = {
        lat_deg: np.std(mosaic.heights(np.full(3000, np.radians(lat_deg)), lon, mosaic.posting_m))
        for lon in [rng.uniform(-np.pi, np.pi, 3000)]
        for lat_deg in (0.125, 80.125)
    }
    assert at[80.125] / at[0.125] == pytest.approx(np.sqrt(np.cos(np.radians(80.125))), rel=0.15)


def test_a_coarse_posting_reads_means_not_single_pixels(tmp_path, dems, moon):
    rng = np.random.default_rng(7)
    values = rng.normal(0.0, 1000.0, (720, 1440)).astype(np.float32)
    mosaic = mosaic_of(moon, tmp_path, dems.write(tmp_path / "noise.tif", values))
    lat, lon = on_the_sphere(rng, 3000, -20.0, 20.0)
    fine = np.std(mosaic.heights(lat, lon, mosaic.posting_m))
    for factor in (1.6, 2.0, 3.3, 8.0):
        coarse = np.std(mosaic.heights(lat, lon, mosaic.posting_m * factor))
        # interpolation between means smooths by a factor of its own, the same at every level
        assert coarse < 1.4 * fine / factor, factor


def polar_tile(path, source_path, dems, posting=2000.0, size=400):
    """A north polar stereographic tile that GDAL makes from a global model."""
    affine = Affine(posting, 0.0, -posting * size / 2, 0.0, -posting, posting * size / 2)
    crs = f"+proj=stere +lat_0=90 +lon_0=0 +k=1 {dems.sphere}"
    out = np.full((size, size), np.nan, np.float32)
    with rasterio.open(source_path) as dataset:
        # from -180°: GDAL looks for places west of 0 nowhere else
        a, _, _, _, e, f = dataset.transform[:6]
        half = dataset.width // 2
        reproject(
            np.roll(dataset.read(1), half, axis=1).astype(np.float32),
            out,
            src_transform=Affine(a, 0.0, -a * half, 0.0, e, f),
            src_crs=dataset.crs,
            dst_transform=affine,
            dst_crs=crs,
            dst_nodata=np.nan,
            resampling=Resampling.cubic,
        )
    return dems.write(path, out, crs=crs, affine=affine)


def test_a_polar_stereographic_tile_gives_the_heights_it_was_made_from(
    shared_data, tmp_path, dems, moon
):
    """GDAL's reprojection, read back through our closed form, against the model itself.

    Differences are two interpolations of rough ground; they have no trend, so a shift of the tile
    by a tenth of a pixel would show as a slope against the ground's own.
    """
    globe = shared_data("moon/moon_gld100_32ppd.tif")
    tile = polar_tile(tmp_path / "pole.tif", globe, dems)
    ours = mosaic_of(moon, tmp_path / "a", tile)
    model = mosaic_of(moon, tmp_path / "b", globe)
    rng = np.random.default_rng(8)
    lat, lon = on_the_sphere(rng, 20_000, 78.0, 85.0)
    heights = ours.heights(lat, lon, ours.posting_m)
    truth = model.heights(lat, lon, ours.posting_m)
    known = np.isfinite(heights)
    assert known.mean() > 0.9
    step = np.radians(0.01)
    east = model.heights(lat, lon + step / np.cos(lat), ours.posting_m) - truth
    north = model.heights(lat + step, lon, ours.posting_m) - truth
    design = np.stack([east, north], axis=1)[known] / (step * moon.radius_m)
    shift_m = np.linalg.lstsq(design, (heights - truth)[known], rcond=None)[0]
    assert np.abs(shift_m).max() < 0.1 * ours.posting_m
    assert abs(np.mean((heights - truth)[known])) < 2.0
    assert np.std((heights - truth)[known]) < 0.15 * np.std(truth)


def test_a_better_source_comes_first_and_a_lower_one_fills_its_holes(tmp_path, dems, moon):
    base = dems.write(tmp_path / "base.tif", dems.smooth_grid(360).astype(np.float32))
    rows = 200
    lat_deg = 12.0 - 0.02 * (np.arange(rows) + 0.5)
    lon_deg = 30.0 + 0.02 * (np.arange(rows) + 0.5)
    lat, lon = np.radians(lat_deg)[:, None], np.radians(lon_deg)[None, :]
    better = (dems.smooth_heights(lat, lon) + 500.0).astype(np.float32)
    better[80:120, 80:120] = np.nan
    top = dems.write(tmp_path / "top.tif", better, affine=Affine(0.02, 0.0, 30.0, 0.0, -0.02, 12.0))
    mosaic = mosaic_of(moon, tmp_path, top, base)
    places = np.radians([[10.5, 30.5], [10.0, 32.0], [10.0, 36.0]])  # on top, in its hole, beside
    heights = mosaic.heights(places[:, 0], places[:, 1], mosaic.posting_m)
    truth = dems.smooth_heights(places[:, 0], places[:, 1])
    np.testing.assert_allclose(heights - truth, [500.0, 0.0, 0.0], atol=3.0)
    assert mosaic.source_index(places[:, 0], places[:, 1]).tolist() == [0, 1, 1]
    assert mosaic.names == ("top.tif", "base.tif")
    projection = Stereographic(*np.radians([10.0, 32.0]), moon.radius_m)
    assert np.isfinite(mosaic.local_grid(projection, mosaic.posting_m, 120)).all()


def test_priorities_decide_not_the_order_in_the_config(tmp_path, dems, moon):
    low = dems.write(tmp_path / "low.tif", dems.smooth_grid(90).astype(np.float32))
    high = dems.write(tmp_path / "high.tif", dems.smooth_grid(90).astype(np.float32) + 700.0)
    mosaic = Mosaic.from_files(
        [DemSettings(path=low.name, priority=2), DemSettings(path=high.name, priority=1)],
        tmp_path,
        moon,
        tmp_path / "overviews",
    )
    height = float(mosaic.heights(0.3, 0.4, mosaic.posting_m))
    assert height == pytest.approx(dems.smooth_heights(0.3, 0.4) + 700.0, abs=20.0)


def test_outside_a_region_there_is_nothing(tmp_path, dems, moon):
    values, affine = dems.rough_region(200)
    mosaic = mosaic_of(moon, tmp_path, dems.write(tmp_path / "r.tif", values, affine=affine))
    lat = np.radians([10.0, 11.99, 12.05, 10.0, -10.0, 90.0])
    lon = np.radians([20.0, 20.0, 20.0, 22.05, -160.0, 0.0])
    assert mosaic.covers(lat, lon).tolist() == [True, True, False, False, False, False]
    assert mosaic.source_index(lat, lon).tolist() == [0, 0, -1, -1, -1, -1]
    assert mosaic.heights(np.empty(0), np.empty(0), 100.0).shape == (0,)


def test_a_region_across_180_degrees_is_one_piece(tmp_path, dems, moon):
    """Eastings go on beyond the half turn, as in the Tycho file."""
    values, _ = dems.rough_region(200)
    per_degree = np.radians(1.0) * moon.radius_m
    affine = Affine(
        0.02 * per_degree, 0.0, 178.0 * per_degree, 0.0, -0.02 * per_degree, 12.0 * per_degree
    )
    path = dems.write(tmp_path / "r.tif", values, crs=f"+proj=eqc {dems.sphere}", affine=affine)
    mosaic = mosaic_of(moon, tmp_path, path)
    projection = Stereographic(np.radians(10.0), np.pi, moon.radius_m)
    grid = mosaic.local_grid(projection, mosaic.posting_m, 100)
    assert np.isfinite(grid).all()
    lat, lon = projection.latlon(*make_node_grid(100, mosaic.posting_m))
    row, col = (12.0 - np.degrees(lat)) / 0.02 - 0.5, np.mod(np.degrees(lon), 360) - 178.0
    linear = map_coordinates(values, [row, col / 0.02 - 0.5], order=1)
    assert np.std(grid - linear) < 0.05 * np.std(linear)


def test_scattered_points_do_not_pull_the_whole_raster_into_memory(
    shared_data, tmp_path, moon, monkeypatch
):
    mosaic = mosaic_of(moon, tmp_path, shared_data("moon/moon_gld100_4ppd.tif"))
    rng = np.random.default_rng(9)
    lat, lon = on_the_sphere(rng, 500)
    at_once = mosaic.heights(lat, lon, mosaic.posting_m)
    monkeypatch.setattr("catalog.terrain.sampling.footprint.MAX_WINDOW", 1000)
    in_pieces = mosaic.heights(lat, lon, mosaic.posting_m)
    # the offset inside a window takes the last bits of the coordinates
    np.testing.assert_allclose(at_once, in_pieces, atol=0.01)


def test_a_pickled_mosaic_reads_the_same(tmp_path, dems, moon):
    path = dems.write(tmp_path / "globe.tif", dems.smooth_grid(90).astype(np.float32))
    mosaic = mosaic_of(moon, tmp_path, path)
    lat, lon = on_the_sphere(np.random.default_rng(10), 50)
    before = mosaic.heights(lat, lon, mosaic.posting_m)
    blob = pickle.dumps(mosaic)
    # no heights travel; the Moon itself does, with a rotation of over a hundred terms
    assert len(blob) < len(pickle.dumps(moon)) + 5_000
    np.testing.assert_array_equal(pickle.loads(blob).heights(lat, lon, mosaic.posting_m), before)


def test_the_tile_cache_stays_within_its_bound(tmp_path, dems, moon, monkeypatch):
    path = dems.write(tmp_path / "globe.tif", dems.smooth_grid(1024).astype(np.float32))
    monkeypatch.setattr("catalog.terrain.pyramid.pyramid.CACHE_BYTES", 1 << 20)
    mosaic = mosaic_of(moon, tmp_path, path)
    lat, lon = on_the_sphere(np.random.default_rng(11), 300)
    monkeypatch.setattr("catalog.terrain.sampling.footprint.MAX_WINDOW", 1 << 16)
    whole = mosaic.heights(lat, lon, mosaic.posting_m)
    assert mosaic._cache.held <= 1 << 20
    np.testing.assert_allclose(whole, dems.smooth_heights(lat, lon), atol=2.0)


@pytest.mark.bench
def test_a_patch_is_cut_in_less_than_a_millisecond(shared_data, tmp_path, moon):
    mosaic = mosaic_of(moon, tmp_path, shared_data("moon/moon_gld100_32ppd.tif"))
    projection = Stereographic(np.radians(-43.0), np.radians(-11.0), moon.radius_m)
    for level in range(5):
        posting = mosaic.posting_m * 2**level
        mosaic.local_grid(projection, posting, 80)
        started = time.process_time()
        for _ in range(20):
            mosaic.local_grid(projection, posting, 80)
        assert (time.process_time() - started) / 20 < 1.0e-3
