"""Pixels without a value, as files state them: masks of all kinds, alpha, special values."""

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import Affine

from catalog.special_values import ISIS
from catalog.terrain.dem.file import Conversion, find_nodata_range
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.pyramid.pyramid import HeightPyramid
from catalog.terrain.slopes import summarise_slopes
from tests.catalog.terrain.maps import isis_cube

SIZE = 64
HOLE = np.s_[10:20, 30:45]


def with_holes(path, values, affine, how):
    """A GeoTIFF of heights with other values in its hole, and what says that it is one."""
    values = values.copy()
    values[HOLE] = 0 if values.dtype.kind == "u" else -9999
    valid = np.ones(values.shape, bool)
    valid[HOLE] = False
    profile = {"driver": "GTiff", "height": SIZE, "width": SIZE, "transform": affine}
    profile |= {"crs": "+proj=longlat +R=1737400 +no_defs", "dtype": str(values.dtype), "count": 1}
    if how.startswith("alpha"):
        profile["count"] = 3 if how == "alpha of three" else 2
    inner = how == "internal mask"
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=inner),
        rasterio.open(path, "w", **profile) as file,
    ):
        file.write(values, 1)
        if how == "alpha":
            file.write(valid.astype(values.dtype) * 255, 2)
            file.colorinterp = ColorInterp.gray, ColorInterp.alpha
        elif how == "alpha of three":  # GDAL takes none of three bands for a mask
            file.write(values, 2)
            file.write(valid.astype(values.dtype), 3)
            file.colorinterp = ColorInterp.gray, ColorInterp.undefined, ColorInterp.alpha
        else:
            file.write_mask(valid)
    return path


@pytest.mark.parametrize("dtype", ["float32", "int16", "int32", "uint16"])
@pytest.mark.parametrize("how", ["internal mask", "msk beside", "alpha", "alpha of three"])
def test_what_a_mask_hides_is_no_ground(tmp_path, dems, moon, how, dtype):
    """All readers go through the source: windows, places, overviews, slopes."""
    rough, affine = dems.rough_region(SIZE)
    values = np.rint(rough + (4000.0 if dtype == "uint16" else 0.0)).astype(dtype)
    path = with_holes(tmp_path / "masked.tif", values, affine, how)
    expected = values.astype(np.float32)
    expected[HOLE] = np.nan
    source = DemSource.open(DemSettings(path.name), tmp_path, moon)
    np.testing.assert_array_equal(source.read_window(0, 0, SIZE, SIZE), expected)
    lat, lon = source.georeference.latlon_from_pixel([37.0, 5.0], [15.0, 40.0])
    assert np.isfinite(source.heights_at(lat, lon)).tolist() == [False, True]

    right = dems.write(tmp_path / "right.tif", expected, affine=affine)
    truth = DemSource.open(DemSettings(right.name), tmp_path, moon)
    base_m = 3.0 * source.posting_m
    assert summarise_slopes(source, base_m)[0].rms_deg == summarise_slopes(truth, base_m)[0].rms_deg

    made = HeightPyramid.build(source, tmp_path / "masked")
    other = HeightPyramid.build(truth, tmp_path / "right")
    assert made.record.valid_share == other.record.valid_share < 1.0
    for level in range(made.levels):
        shape = made.shape(level)
        np.testing.assert_array_equal(
            made.read(level, 0, 0, *shape), other.read(level, 0, 0, *shape)
        )


def test_a_file_of_long_strips_is_copied_with_its_mask(tmp_path, dems, moon):
    values = np.rint(dems.smooth_grid(40)).astype(np.int16)
    values = np.repeat(values, 60, axis=1)  # 4800 columns
    affine = Affine(360.0 / 4800, 0.0, -180.0, 0.0, -180.0 / 40, 90.0)
    path = tmp_path / "strips.tif"
    valid = np.ones(values.shape, bool)
    valid[5:9, 1000:2000] = False
    profile = {"driver": "GTiff", "height": 40, "width": 4800, "count": 1, "dtype": "int16"}
    crs = "+proj=longlat +R=1737400 +no_defs"
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(path, "w", crs=crs, transform=affine, blockysize=1, **profile) as file,
    ):
        file.write(values, 1)
        file.write_mask(valid)
    made = HeightPyramid.build(
        DemSource.open(DemSettings(path.name), tmp_path, moon), tmp_path / "levels"
    )
    assert made.record.tiled_copy
    assert (np.isfinite(made.read(0, 0, 0, 40, 4800)) == valid).all()


def test_a_file_without_a_mask_is_read_as_it_is_stored(tmp_path, dems, moon):
    values, affine = dems.rough_region(SIZE)
    path = dems.write(tmp_path / "plain.tif", np.rint(values).astype(np.int16), affine=affine)
    source = DemSource.open(DemSettings(path.name), tmp_path, moon)
    assert source.validity.is_plain
    assert source.read_raw(0, 0, 4, 4).dtype == np.int16


def test_a_second_band_that_is_no_mask_is_reported(tmp_path, dems, moon, caplog):
    values, affine = dems.rough_region(SIZE)
    profile = {"driver": "GTiff", "height": SIZE, "width": SIZE, "count": 2, "dtype": "float32"}
    crs = "+proj=longlat +R=1737400 +no_defs"
    with rasterio.open(tmp_path / "two.tif", "w", crs=crs, transform=affine, **profile) as file:
        file.write(values, 1)
        file.write(np.ones_like(values), 2)
        file.set_band_description(2, "sigma")
    DemSource.open(DemSettings("two.tif"), tmp_path, moon)
    (record,) = caplog.records
    assert "2 bands, the first taken as heights; not used: band 2 ('sigma')" in record.message


@pytest.mark.parametrize(
    ("stated", "stored", "dtype", "missing"),
    [
        (-3.40282e38, -3.4028234663852886e38, "float32", True),
        (-3.40282e38, -3.4028226550889045e38, "float32", True),  # NULL of ISIS
        (-3.4e38, -3.4028234663852886e38, "float32", True),
        (-3.4028234663852886e38, -3.4028234663852886e38, "float32", True),
        (-1.79769e308, -1.7976931348623157e308, "float64", True),
        (1.70141e38, 1.7014118346046923e38, "float32", True),  # of Surfer
        (-9999.0, -9999.0, "float32", True),
        (-9999.0, -9999.25, "float32", False),
        (-9999.9, -9999.9, "float32", True),
        (-32768.0, -32768.0, "int16", True),
        (-32768.0, -32767.0, "int16", False),
        (-2147483647.0, -2147483646.0, "int32", False),
        (None, 0.0, "float32", False),
        (float("nan"), 0.0, "float32", False),
    ],
)
def test_a_no_data_value_with_too_few_digits_means_what_it_is_short_for(
    stated, stored, dtype, missing
):
    convert = Conversion(1.0, 0.0, *find_nodata_range(stated, dtype))
    raw = np.array([[stored, 17.0]], dtype)
    assert np.isnan(convert(raw)).tolist() == [[missing, False]]


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "float32"])
@pytest.mark.parametrize(("base", "multiplier"), [(0.0, 1.0), (1000.0, 0.5)])
def test_special_pixels_of_isis_cubes_are_no_heights(tmp_path, moon, dtype, base, multiplier):
    special = ISIS[dtype]
    values = np.full((SIZE, SIZE), 100, dtype)
    values += np.arange(SIZE, dtype=dtype)
    marked = (*special.missing, *special.saturated)
    values[3, : len(marked)] = np.array(marked, dtype)
    source = DemSource.open(
        DemSettings(isis_cube(tmp_path / "map.cub", values, base, multiplier).name), tmp_path, moon
    )
    heights = source.read_window(0, 0, SIZE, SIZE)
    expected = values * multiplier + base
    assert np.isnan(heights[3, : len(marked)]).all()
    heights[3], expected[3] = 0.0, 0.0
    np.testing.assert_array_equal(heights, expected)
