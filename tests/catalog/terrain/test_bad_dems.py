"""What is wrong with a terrain model is said with the file's name and a remedy."""

import shutil
import struct

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine

from catalog.bodies.body import load_body
from catalog.errors import DataError
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.pyramid.pyramid import HeightPyramid


def ingest(path, moon, **settings):
    one = DemSettings(path=path.name, **settings)
    return HeightPyramid.load_or_build(one, path.parent, moon, path.parent / "overviews")


def refused(path, moon, *words, **settings):
    with pytest.raises(DataError) as caught:
        ingest(path, moon, **settings)
    message = str(caught.value)
    for word in (str(path), *words):
        assert word in message
    assert not (path.parent / "overviews").exists()
    assert not list(path.parent.glob("*.partial"))


def test_a_missing_file(tmp_path, moon):
    refused(tmp_path / "none.tif", moon, "no such file", "path")


def test_a_folder(tmp_path, moon):
    (tmp_path / "folder.tif").mkdir()
    refused(tmp_path / "folder.tif", moon, "is a folder")


def test_an_empty_file(tmp_path, moon):
    (tmp_path / "empty.tif").touch()
    refused(tmp_path / "empty.tif", moon, "is empty")


def test_a_file_that_is_no_raster(tmp_path, moon):
    (tmp_path / "text.tif").write_text("not a raster at all")
    refused(tmp_path / "text.tif", moon, "cannot be opened", "GeoTIFF")


def test_a_fits_file(tmp_path, moon):
    card = b"SIMPLE  =                    T".ljust(80) + b"END".ljust(80)
    (tmp_path / "map.fits").write_bytes(card.ljust(2880) + bytes(2880))
    refused(tmp_path / "map.fits", moon, "FITS is not read as a map", "GeoTIFF")


def test_an_image_without_its_label(tmp_path, moon):
    (tmp_path / "LDEM.IMG").write_bytes(bytes(1000))
    refused(tmp_path / "LDEM.IMG", moon, "LDEM.LBL")


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_truncated_file(tmp_path, dems, moon, share):
    path = dems.write(tmp_path / "cut.tif", dems.smooth_grid(400).astype(np.float32))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * share)])
    refused(path, moon, "damaged or cut short")


def test_damage_far_from_any_probe_is_found_before_anything_is_built(tmp_path, dems, moon):
    path = dems.write(
        tmp_path / "bitten.tif",
        dems.smooth_grid(600).astype(np.float32),
        tiled=True,
        blockxsize=64,
        blockysize=64,
        # deflate would not do: libtiff lets a broken stream pass, its check sum unread
        compress="lzw",
    )
    data = bytearray(path.read_bytes())
    middle = len(data) * 3 // 5
    data[middle : middle + 600] = bytes(600)
    path.write_bytes(data)
    refused(path, moon, "cannot be read", "damaged")


def test_a_pds3_image_cut_short(shared_data, tmp_path, moon):
    for name in ("LDEM_4.LBL", "LDEM_4.IMG"):
        shutil.copyfile(shared_data(f"moon/{name}"), tmp_path / name)
    image = tmp_path / "LDEM_4.IMG"
    image.write_bytes(image.read_bytes()[:1_500_000])
    refused(tmp_path / "LDEM_4.LBL", moon, "damaged or cut short")


def test_no_coordinate_system(tmp_path, dems, moon):
    path = dems.write(tmp_path / "bare.tif", dems.smooth_grid(64).astype(np.float32), crs=None)
    refused(path, moon, "no coordinate system", "crs = ")


@pytest.mark.parametrize("when", ["opened", "asked later"])
def test_a_coordinate_system_of_damaged_numbers(tmp_path, dems, moon, when):
    """GDAL raises errors of its own for these, which rasterio hands on as they are."""
    path = dems.write(tmp_path / "bad.tif", dems.smooth_grid(64).astype(np.float32))
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, start)
    entries = [start + 2 + 12 * number for number in range(count)]
    scale, keys, numbers = (
        next(at for at in entries if struct.unpack_from("<H", data, at)[0] == tag)
        for tag in (33550, 34735, 34736)
    )
    if when == "opened":
        (place,) = struct.unpack_from("<I", data, numbers + 8)
        struct.pack_into("<d", data, place + 8 * 2, float("nan"))  # the prime meridian
    else:
        (place,) = struct.unpack_from("<I", data, keys + 8)
        struct.pack_into("<H", data, place + 2 * 43, 5)  # its number, of three
        struct.pack_into("<I", data, scale + 4, 1)  # a number too few
    path.write_bytes(data)
    refused(path, moon, *(["cannot be opened", "broken"] if when == "opened" else ["damaged"]))


def test_a_crs_in_the_config_stands_in(tmp_path, dems, moon):
    path = dems.write(tmp_path / "bare.tif", dems.smooth_grid(64).astype(np.float32), crs=None)
    made = ingest(path, moon, crs="IAU_2015:30100")
    assert made.source.wraps


def test_a_crs_that_proj_does_not_know(tmp_path, dems, moon):
    path = dems.write(tmp_path / "bare.tif", dems.smooth_grid(64).astype(np.float32), crs=None)
    refused(path, moon, "EPSG:moon", crs="EPSG:moon")


def test_no_place_on_the_map(tmp_path, dems, moon):
    with pytest.warns(NotGeoreferencedWarning):
        path = dems.write(
            tmp_path / "floating.tif",
            dems.smooth_grid(64).astype(np.float32),
            affine=Affine.identity(),
        )
    refused(path, moon, "no geotransform")


def test_a_map_of_the_earth_is_not_one_of_the_moon(tmp_path, dems, moon):
    path = dems.write(
        tmp_path / "earth.tif", dems.smooth_grid(64).astype(np.float32), crs="EPSG:4326"
    )
    refused(path, moon, "6378.1 km", "moon has 1737.4 km")


@pytest.mark.parametrize(
    ("name", "crs", "axes"),
    [
        ("earth", "EPSG:4326", (6378137.0, 6356752.314245)),
        ("earth", "EPSG:32633", (6378137.0, 6356752.314245)),
        ("mars", "+proj=longlat +a=3396190 +rf=169.894447 +no_defs", (3396190.0, 3376200.0)),
    ],
)
def test_a_map_on_an_ellipsoid_is_refused_with_the_way_to_the_body_s_sphere(
    tmp_path, dems, name, crs, axes
):
    """The pipeline in the message is exact: geodetic latitudes by their formula in x, y, z."""
    body = load_body(name)
    degrees, metres = (0.01, 0.0, 12.0, 0.0, -0.01, 49.0), (1e2, 0.0, 4e5, 0.0, -1e2, 5.4e6)
    affine = Affine(*(metres if crs == "EPSG:32633" else degrees))
    heights = dems.smooth_grid(64).astype(np.float32)
    path = dems.write(tmp_path / "flat.tif", heights, crs=crs, affine=affine)
    with pytest.raises(
        DataError, match=r"on a flattened ellipsoid.*latitudes are geodetic"
    ) as error:
        DemSource.open_alone(path, body)
    pipeline = str(error.value).partition("+proj=pipeline")
    lon, lat, height = pyproj.Transformer.from_pipeline("".join(pipeline[1:])).transform(
        12.5, 48.7, 500.0
    )
    a, b = axes
    phi, square = np.radians(48.7), (b / a) ** 2
    normal = a / np.sqrt(1.0 - (1.0 - square) * np.sin(phi) ** 2)
    across, up = (normal + 500.0) * np.cos(phi), (normal * square + 500.0) * np.sin(phi)
    assert lon == pytest.approx(12.5, abs=1e-12)
    assert lat == pytest.approx(np.degrees(np.arctan2(up, across)), abs=1e-9)
    assert height == pytest.approx(np.hypot(across, up) - body.radius_m, abs=1e-3)


def test_nothing_but_no_data(tmp_path, dems, moon):
    path = dems.write(tmp_path / "void.tif", np.full((64, 128), -32768, np.int16), nodata=-32768)
    refused(path, moon, "no data at all")


def test_nothing_but_nan(tmp_path, dems, moon):
    path = dems.write(tmp_path / "nan.tif", np.full((64, 128), np.nan, np.float32))
    refused(path, moon, "no data at all")


def test_kilometres_taken_for_metres(tmp_path, dems, moon):
    path = dems.write(tmp_path / "km.tif", (dems.smooth_grid(64) / 1e3).astype(np.float32))
    refused(path, moon, "are these km?", 'units = "km"')
    assert ingest(path, moon, units="km").record.highest_m > 2000.0


def test_metres_taken_for_kilometres(tmp_path, dems, moon):
    path = dems.write(tmp_path / "m.tif", dems.smooth_grid(64).astype(np.float32))
    refused(path, moon, 'units = "m"', units="km")


def test_radii_stated_to_be_heights(tmp_path, dems, moon):
    path = dems.write(tmp_path / "r.tif", dems.smooth_grid(64) + moon.radius_m)
    refused(path, moon, 'heights = "radius"', heights="height")


def test_one_absurd_value_is_told_with_the_ranges(tmp_path, dems, moon):
    values = dems.smooth_grid(64).astype(np.float32)
    values[17, 90] = 1e6
    path = dems.write(tmp_path / "spike.tif", values)
    refused(path, moon, "1e+06", "nodata")


def test_values_in_feet_are_not_taken_for_metres(tmp_path, dems, moon):
    path = dems.write(tmp_path / "ft.tif", dems.smooth_grid(64).astype(np.float32))
    with rasterio.open(path, "r+") as file:
        file.units = ["ft"]
    refused(path, moon, "'ft'", "`units`")
    assert ingest(path, moon, units="m").record.highest_m > 2000.0


def test_a_colour_picture_is_no_terrain(tmp_path, dems, moon):
    path = dems.write(tmp_path / "c.tif", dems.smooth_grid(64).astype(np.uint8))
    with rasterio.open(path, "r+") as file:
        file.colorinterp = [ColorInterp.red]
    refused(path, moon, "colour picture")


def test_holes_are_no_error(tmp_path, dems, moon):
    values = dems.smooth_grid(64).astype(np.float32)
    values[:20] = np.nan
    made = ingest(dems.write(tmp_path / "holes.tif", values), moon)
    assert made.record.valid_share == pytest.approx(44 / 64)


def test_a_map_of_many_turns_is_refused_before_it_is_read(tmp_path, dems, moon):
    affine = Affine(10.0, 0.0, 0.0, 0.0, -0.5, 45.0)
    path = dems.write(tmp_path / "wide.tif", np.zeros((8, 100), np.float32), affine=affine)
    refused(path, moon, "spans 1e+03 x 4 deg", "wanted up to 720")
