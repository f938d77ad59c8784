"""[[image]]: what is read of an orthoimage, and what is refused."""

import numpy as np
import pyproj
import pytest
import rasterio

from catalog.bodies.body import load_body
from catalog.control_point import Flag
from catalog.errors import ConfigError, DataError
from catalog.geometry.latlon import latlon_from_xyz
from catalog.pipeline.build import run
from catalog.pipeline.config import load_build_config
from catalog.store.reader import Catalog
from catalog.store.verify import verify
from catalog.terrain.dem.image import ImageSource
from catalog.terrain.dem.source import DemSettings

EARTH, MOON = load_body("earth"), load_body("moon")
UTM = ("EPSG:32637", rasterio.Affine(1000.0, 0.0, 400e3, 0.0, -1000.0, 5_640e3))
DEGREES = ("EPSG:4326", rasterio.Affine(0.01, 0.0, 38.0, 0.0, -0.01, 51.0))
LUNAR = ("IAU_2015:30100", rasterio.Affine(0.01, 0.0, 10.0, 0.0, -0.01, 5.0))
BUILD = (
    '[body]\nname = "{body}"\n[[image]]\npath = "image.tif"\n{more}\n[grid]\ncell_deg = {cell}\n'
    "[pyramid]\nlevels = 2\nsize = 32\n[render]\nwindow_nodes = 24\ncandidates = 2\n"
    "[check]\nplaces = 1\ntrials = 1\n"
)


def fields(shape=(160, 200), seed=1):
    """Brightness of random squares with some noise, 1 to 255."""
    rng = np.random.default_rng(seed)
    squares = rng.uniform(40.0, 220.0, (shape[0] // 5 + 1, shape[1] // 5 + 1)).repeat(5, 0)
    squares = squares.repeat(5, 1)[: shape[0], : shape[1]] + rng.normal(0.0, 3.0, shape)
    return np.clip(np.rint(squares), 1, 255).astype(np.uint8)


def write(folder, values, place, **more):
    path = folder / "image.tif"
    crs, affine = place
    profile = {"driver": "GTiff", "count": 1, "dtype": values.dtype, "crs": crs, **more}
    rows, cols = values.shape
    with rasterio.open(path, "w", width=cols, height=rows, transform=affine, **profile) as file:
        file.write(values, 1)
    return path


def build_image(folder, body="earth", cell=0.3, more="", bbox=None):
    config = folder / "build.toml"
    config.write_text(BUILD.format(body=body, cell=cell, more=more))
    return run(config, output=folder / "image.gpkg", workers=1, bbox=bbox)


@pytest.mark.parametrize("place", [UTM, DEGREES])
def test_a_place_on_the_ellipsoid_has_the_pixel_that_proj_gives(place, tmp_path):
    """To a thousandth of a pixel: latitudes of the files are geodetic, ours planetocentric."""
    write(tmp_path, fields(), place)
    source = ImageSource.open(DemSettings("image.tif"), tmp_path, EARTH)
    cols, rows = np.meshgrid([10.0, 100.0, 180.0], [5.0, 80.0, 150.0])
    affine = place[1]
    x, y = affine.c + affine.a * (cols + 0.5), affine.f + affine.e * (rows + 0.5)
    body = pyproj.Transformer.from_crs(place[0], "EPSG:4978", always_xy=True)
    lat, lon, _ = latlon_from_xyz(np.stack(body.transform(x, y, np.zeros_like(x)), axis=-1))
    col, row = source.pixel_from_latlon(lat, lon)
    np.testing.assert_allclose(col, cols, atol=1e-3)
    np.testing.assert_allclose(row, rows, atol=1e-3)
    again_lat, again_lon = source.georeference.latlon_from_pixel(cols, rows)
    np.testing.assert_allclose([again_lat, again_lon], [lat, lon], atol=1e-9)


@pytest.mark.parametrize(
    ("body", "place", "box"),
    [("earth", DEGREES, (38.8, 50.0, 39.6, 50.6)), ("moon", LUNAR, (10.6, 3.9, 11.4, 4.5))],
)
def test_points_have_the_brightness_of_the_image_at_their_places(body, place, box, tmp_path):
    values = fields()
    write(tmp_path, values, place)
    report = build_image(tmp_path, body, bbox=box)
    assert report.usable > 0
    assert verify(report.output).sound
    catalog = Catalog.open(report.output)
    assert catalog.meta.image.name == "image.tif"
    assert catalog.meta.format_version == 6
    for point in (p for p in catalog.points() if p.usable):
        patch = catalog.patches(point.id)[0]
        inner = patch.brightness[12:20, 12:20]
        lat, lon = np.radians([point.lat_deg, point.lon_deg])
        source = ImageSource.open(DemSettings("image.tif"), tmp_path, load_body(body))
        col, row = source.pixel_from_latlon(lat, lon)
        r, c = int(row), int(col)
        near = values[r - 3 : r + 5, c - 3 : c + 5]
        assert float(inner.mean()) == pytest.approx(near.mean() * source.convert.scale_m, rel=0.12)
        radii = load_body(body).radii_m
        xyz = point.xyz_m / np.array(radii)
        assert np.linalg.norm(xyz) == pytest.approx(1.0, abs=1e-7)  # on the ellipsoid


def test_points_beside_masked_holes_are_not_usable(tmp_path):
    values = fields()
    values[60:100, 60:140] = 0
    write(tmp_path, values, DEGREES, nodata=0)
    report = build_image(tmp_path, bbox=(38.3, 49.6, 39.8, 50.9))
    flags = [p.flags for p in Catalog.open(report.output).points()]
    assert any(Flag.NO_DATA & flag for flag in flags)
    assert report.usable > 0


def test_holes_without_a_mask_are_refused_until_they_are_stated(tmp_path):
    values = fields()
    values[60:100, 60:140] = 0
    values[values == 1] = 40
    write(tmp_path, values, DEGREES)
    box = (38.3, 49.6, 38.9, 50.9)
    with pytest.raises(DataError, match=r"share one brightness, 0, .*state nodata = 0"):
        build_image(tmp_path, bbox=box)
    assert build_image(tmp_path, more="nodata = 0", bbox=box).points > 0


def test_an_image_without_a_coordinate_system_is_refused(tmp_path):
    write(tmp_path, fields(), (None, DEGREES[1]))
    with pytest.raises(DataError, match=r"has no coordinate system; set `crs` in its .*image"):
        build_image(tmp_path)


def test_an_image_of_another_body_is_refused(tmp_path):
    write(tmp_path, fields(), LUNAR)
    with pytest.raises(DataError, match=r"for a body of 1737.4 km radius, earth has 6371.0 km"):
        build_image(tmp_path)
    write(tmp_path, fields(), DEGREES)
    with pytest.raises(DataError, match=r"for a body of 6378.1 km radius, moon has"):
        build_image(tmp_path, "moon")


def test_an_image_without_light_or_contrast_is_refused(tmp_path):
    write(tmp_path, np.zeros((160, 200), np.uint8), DEGREES)
    with pytest.raises(DataError, match="brightness is 0 and less"):
        build_image(tmp_path)
    write(tmp_path, np.full((160, 200), 9, np.uint8), DEGREES)
    with pytest.raises(DataError, match="equally bright"):
        build_image(tmp_path)


def test_a_palette_is_refused(tmp_path):
    path = write(tmp_path, fields(), DEGREES, photometric="palette")
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {1: (255, 0, 0, 255)})
    with pytest.raises(DataError, match="palette; wanted brightness"):
        build_image(tmp_path)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ('[[image]]\npath = "b.tif"', "2 sections.*gdalbuildvrt"),
        ('[[mesh]]\npath = "a.obj"\nunits = "km"', "beside .*mesh"),
        ('[[dem]]\npath = ""', "path is empty"),
    ],
)
def test_impossible_combinations_are_refused(more, message, tmp_path):
    path = tmp_path / "build.toml"
    path.write_text(f'[body]\nname = "earth"\n[[image]]\npath = "image.tif"\n{more}\n')
    with pytest.raises(ConfigError, match=message):
        load_build_config(path)
