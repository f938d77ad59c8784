"""Real and made terrain files against values read by rasterio alone."""

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from catalog.config import resource
from catalog.errors import ConfigError, DataError
from catalog.terrain.dem.file import resolve_path
from catalog.terrain.dem.source import DemSettings, DemSource

# file, scale and offset that its label or documentation gives, whether the sum is a radius
REAL = [
    ("moon/moon_gld100_4ppd.tif", 1.0, 0.0),
    ("moon/LDEM_4.LBL", 0.5, 0.0),
    ("moon/gld100_lola_reduced.cub", 0.5, 0.0),
    ("moon/lola_2.8ppd_lon180.tif", 0.5, 0.0),
    ("moon/tycho_gld100_64ppd.tif", 1.0, 0.0),
    ("moon/boguslawsky_gld100_64ppd.tif", 1.0, 0.0),
]


def source_of(path: Path, moon, **settings) -> DemSource:
    return DemSource.open(DemSettings(path=path.name, **settings), path.parent, moon)


@pytest.mark.parametrize(("name", "scale", "offset"), REAL)
def test_heights_of_real_files_are_scaled_counts_above_the_sphere(
    shared_data, moon, name, scale, offset
):
    path = shared_data(name)
    source = source_of(path, moon)
    with rasterio.open(path) as dataset:
        raw = dataset.read(1)
    np.testing.assert_allclose(
        source.read_window(0, 0, *source.shape), raw * scale + offset, atol=1e-3
    )


@pytest.mark.parametrize(("name", "scale", "offset"), REAL)
def test_real_files_put_each_pixel_where_gdal_puts_it(shared_data, moon, name, scale, offset):
    path = shared_data(name)
    source = source_of(path, moon)
    rng = np.random.default_rng(1)
    row = rng.integers(0, source.shape[0], 200)
    col = rng.integers(0, source.shape[1], 200)
    lat, lon = source.georeference.latlon_from_pixel(col, row)
    found_col, found_row = source.pixel_from_latlon(lat, lon)
    # the ISIS cube's last column begins again at its first: whole turns do not count
    period = source.georeference.period
    off = np.mod(found_col - col + period / 2.0, period) - period / 2.0
    assert np.abs(off).max() < 1e-6
    assert np.abs(found_row - row).max() < 1e-6
    with rasterio.open(path) as dataset:
        x, y = dataset.xy(row, col)
    a, _, c, _, e, f = source.georeference.affine
    np.testing.assert_allclose(x, c + a * (col + 0.5), rtol=1e-12, atol=1e-6)
    np.testing.assert_allclose(y, f + e * (row + 0.5), rtol=1e-12, atol=1e-6)


def test_heights_at_places_are_those_of_pixels_across_the_seam_and_nan_beyond_the_edge(moon):
    whole = source_of(resource("data/moon_gld100_4ppd.tif"), moon)
    rows, cols = np.array([300, 300, 301, 360]), np.array([0, whole.shape[1] - 1, 1, 700])
    stored = whole.read_window(0, 0, *whole.shape)
    lat, lon = whole.georeference.latlon_from_pixel(cols, rows)
    np.testing.assert_allclose(whole.heights_at(lat, lon), stored[rows, cols], atol=1e-2)
    # half a pixel beyond the last column lies the middle between the last and the first
    lat, lon = whole.georeference.latlon_from_pixel(np.array([cols[1] + 0.5]), np.array([300.0]))
    between = stored[300, [-2, -1, 0, 1]] @ np.array([-1.0, 9.0, 9.0, -1.0]) / 16.0
    assert whole.heights_at(lat, lon)[0] == pytest.approx(between, abs=0.1)

    part = source_of(resource("data/tycho_gld100_256ppd.tif"), moon)
    west, south, _, _ = part.latlon_bounds()
    assert np.isnan(part.heights_at(south - 0.01, west - 0.01))


def test_a_pds3_image_finds_its_label_and_its_radii_become_heights(shared_data, moon):
    shared_data("moon/LDEM_4.LBL")
    source = source_of(shared_data("moon/LDEM_4.IMG"), moon)
    assert source.path.name == "LDEM_4.LBL"
    assert source.heights == "radius"
    # LDEM_4.LBL: MINIMUM = -17757, MAXIMUM = 21008 counts of half a metre
    heights = source.read_window(0, 0, *source.shape)
    assert (heights.min(), heights.max()) == (-8878.5, 10504.0)


def test_four_real_lunar_models_agree_on_the_ground(shared_data, moon):
    """Registration: models shifted by half a pixel (3.8 km) would differ by hundreds of metres.

    All are LOLA or tied to it; the median difference is what is left of their resolutions.
    """
    rng = np.random.default_rng(2)
    lat, lon = np.arcsin(rng.uniform(-0.85, 0.85, 4000)), rng.uniform(-np.pi, np.pi, 4000)
    values = {}
    for name in ("moon_gld100_4ppd.tif", "LDEM_4.LBL", "lola_2.8ppd_lon180.tif"):
        source = source_of(shared_data(f"moon/{name}"), moon)
        col, row = source.pixel_from_latlon(lat, lon)
        grid = np.pad(source.read_window(0, 0, *source.shape), ((0, 0), (1, 1)), mode="wrap")
        values[name] = _bilinear(grid, row, col + 1.0)
    reference = values.pop("moon_gld100_4ppd.tif")
    for name, other in values.items():
        assert np.median(np.abs(other - reference)) < 60.0, name
        assert abs(np.mean(other - reference)) < 10.0, name


@pytest.mark.parametrize(
    "name", ["LDEM_4.LBL", "gld100_lola_reduced.cub", "lola_2.8ppd_lon180.tif"]
)
def test_registration_is_right_to_a_tenth_of_a_pixel(shared_data, moon, name):
    """The shift that fits GLD100 best is far below the half pixel that a mistake would make."""
    source = source_of(shared_data(f"moon/{name}"), moon)
    truth = source_of(shared_data("moon/moon_gld100_4ppd.tif"), moon)
    fine = np.pad(truth.read_window(0, 0, *truth.shape), ((0, 0), (2, 2)), mode="wrap")
    rng = np.random.default_rng(3)
    row = rng.integers(source.shape[0] // 6, 5 * source.shape[0] // 6, 6000)
    col = rng.integers(1, source.shape[1] - 2, 6000)
    heights = source.read_window(0, 0, *source.shape)[row, col]
    lat, lon = source.georeference.latlon_from_pixel(col, row)
    t_col, t_row = truth.pixel_from_latlon(lat, lon)
    ratio = source.posting_m / truth.posting_m
    # least squares for a shift (dx, dy) from the slopes of GLD100 itself
    value = _bilinear(fine, t_row, t_col + 2.0)
    slope_x = _bilinear(fine, t_row, t_col + 2.5) - _bilinear(fine, t_row, t_col + 1.5)
    slope_y = _bilinear(fine, t_row + 0.5, t_col + 2.0) - _bilinear(fine, t_row - 0.5, t_col + 2.0)
    design = np.stack([slope_x, slope_y], axis=1)
    shift = np.linalg.lstsq(design, heights - value, rcond=None)[0] / ratio
    assert np.abs(shift).max() < 0.1, shift


def _bilinear(grid, row, col):
    r, c = np.floor(row).astype(int), np.floor(col).astype(int)
    r = np.clip(r, 0, grid.shape[0] - 2)
    dr, dc = row - r, col - c
    top = grid[r, c] * (1 - dc) + grid[r, c + 1] * dc
    below = grid[r + 1, c] * (1 - dc) + grid[r + 1, c + 1] * dc
    return top * (1 - dr) + below * dr


def test_scale_offset_units_and_nodata_of_the_config_win(tmp_path, dems, moon):
    counts = np.round(dems.smooth_grid(64) * 2.0).astype(np.int16)
    counts[3, 4] = 30000
    path = dems.write(tmp_path / "halves.tif", counts)
    heights = source_of(path, moon, scale=0.5, nodata=30000).read_window(0, 0, 64, 128)
    assert np.isnan(heights[3, 4])
    known = np.isfinite(heights)
    np.testing.assert_array_equal(heights[known], counts[known] * np.float32(0.5))
    kilometres = source_of(path, moon, scale=0.0005, units="km", offset=1.0, nodata=30000)
    np.testing.assert_allclose(
        kilometres.read_window(0, 0, 64, 128)[known], counts[known] * 0.5 + 1000.0, atol=1e-2
    )


def test_tags_of_the_file_are_applied(tmp_path, dems, moon):
    counts = np.round(dems.smooth_grid(32)).astype(np.int16)
    path = dems.write(tmp_path / "tagged.tif", counts, nodata=-32768)
    with rasterio.open(path, "r+") as dataset:
        dataset.scales, dataset.offsets = (0.25,), (100.0,)
    heights = source_of(path, moon).read_window(0, 0, 32, 64)
    np.testing.assert_allclose(heights, counts * 0.25 + 100.0, atol=1e-3)


@pytest.mark.parametrize("stated", [None, "radius"])
def test_radii_become_heights(tmp_path, dems, moon, stated):
    values = dems.smooth_grid(32)
    path = dems.write(tmp_path / "radii.tif", values + moon.radius_m)  # float64
    source = source_of(path, moon, heights=stated)
    assert source.heights == "radius"
    # float64 in the file, float32 out: the subtraction comes first
    np.testing.assert_allclose(source.read_window(0, 0, 32, 64), values, atol=1e-3)


def test_windows_wrap_round_the_body_and_end_at_its_edges(tmp_path, dems, moon):
    values = dems.smooth_grid(32).astype(np.float32)
    source = source_of(dems.write(tmp_path / "globe.tif", values), moon)
    window = source.read_window(-2, -5, 6, 140)
    assert np.isnan(window[:2]).all()
    columns = np.arange(-5, 135) % 64
    np.testing.assert_array_equal(window[2:], values[:4][:, columns])


def test_windows_of_a_region_are_empty_beyond_it(tmp_path, dems, moon):
    values, affine = dems.rough_region(64)
    source = source_of(dems.write(tmp_path / "region.tif", values, affine=affine), moon)
    window = source.read_window(60, -3, 8, 70)
    inside = np.zeros(window.shape, dtype=bool)
    inside[:4, 3:67] = True
    assert (np.isfinite(window) == inside).all()
    np.testing.assert_array_equal(window[:4, 3:67], values[60:])


def test_bounds_are_those_of_the_outer_edges(tmp_path, dems, moon):
    values, affine = dems.rough_region(64)
    source = source_of(dems.write(tmp_path / "region.tif", values, affine=affine), moon)
    np.testing.assert_allclose(
        np.degrees(source.latlon_bounds()), (19.36, 9.36, 20.64, 10.64), atol=1e-9
    )


def test_bounds_of_a_polar_tile_hold_the_pole(tmp_path, dems, moon):
    values = np.full((40, 40), 50.0, dtype=np.float32)
    values[::2] = -50.0
    path = dems.write(
        tmp_path / "pole.tif",
        values,
        crs=f"+proj=stere +lat_0=-90 +lon_0=0 {dems.sphere}",
        affine=Affine(5000.0, 0.0, -100e3, 0.0, -5000.0, 100e3),
    )
    west, south, east, north = np.degrees(source_of(path, moon).latlon_bounds())
    assert (west, east) == (-180.0, 180.0)
    assert south == -90.0
    # the corner: 141.4 km from the pole on the map
    corner = -90.0 + 2.0 * np.degrees(np.arctan(np.hypot(100e3, 100e3) / (2.0 * moon.radius_m)))
    assert north == pytest.approx(corner, abs=1e-6)


def test_a_map_with_westward_longitudes_is_read_eastward(tmp_path, dems, moon):
    values = dems.smooth_grid(64).astype(np.float32)
    path = dems.write(tmp_path / "west.tif", values[:, ::-1].copy())
    source = source_of(path, moon, longitude="west")
    lat, lon = np.radians([12.0, -40.0]), np.radians([100.0, -35.0])
    col, row = source.pixel_from_latlon(lat, lon)
    read = [
        float(source.read_window(int(r), int(c), 1, 1)[0, 0])
        for r, c in zip(np.rint(row), np.rint(col), strict=True)
    ]
    np.testing.assert_allclose(read, dems.smooth_heights(lat, lon), atol=250.0)


def test_a_name_with_a_nul_is_no_path(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is no path of a file"):
        resolve_path("nul\0", tmp_path)


def test_heights_beyond_the_body_name_the_place_of_the_settings(tmp_path, dems, moon):
    """A file that a command line names has no [[dem]] section to mend."""
    path = dems.write(tmp_path / "far.tif", np.full((8, 16), 3e7, np.float32))
    for source, place in (
        (DemSource.open_alone(path, moon), "in the file itself"),
        (source_of(path, moon), r"in its \[\[dem\]\] section"),
    ):
        with pytest.raises(DataError, match=place):
            source.check_range(3e7, 3e7)
