"""Closed forms of map projections against PROJ."""

import numpy as np
import pyproj
import pytest

from catalog.terrain.dem.georeference import (
    CYLINDRICAL,
    OTHER,
    POLAR,
    make_georeference,
    make_proj_georeference,
)

RADIUS_M = 1_737_400.0
GRIDS = {
    "geographic": (
        "+proj=longlat",
        (0.25, 0.0, -180.0, 0.0, -0.25, 90.0),
        (720, 1440),
        CYLINDRICAL,
    ),
    "equirectangular": (
        "+proj=eqc +lat_ts=0 +lon_0=180",
        (7580.84, 0.0, -5458204.8, 0.0, -7580.84, 2729102.4),
        (720, 1440),
        CYLINDRICAL,
    ),
    "equirectangular with a standard parallel and false origin": (
        "+proj=eqc +lat_ts=-43 +lat_0=-40 +lon_0=349 +x_0=2000 +y_0=-3000",
        (118.0, 0.0, -150000.0, 0.0, -119.0, 120000.0),
        (2000, 2500),
        CYLINDRICAL,
    ),
    "equirectangular in kilometres": (
        "+proj=eqc +lat_ts=0 +lon_0=0 +units=km",
        (7.58, 0.0, -1000.0, 0.0, -7.58, 900.0),
        (200, 300),
        CYLINDRICAL,
    ),
    "north polar stereographic": (
        "+proj=stere +lat_0=90 +lon_0=30 +k=0.97 +x_0=500 +y_0=100",
        (1000.0, 0.0, -300000.0, 0.0, -1000.0, 310000.0),
        (600, 640),
        POLAR,
    ),
    "south polar stereographic by true latitude": (
        "+proj=stere +lat_0=-90 +lat_ts=-80 +lon_0=-70",
        (500.0, 0.0, -200000.0, 0.0, -500.0, 210000.0),
        (800, 900),
        POLAR,
    ),
    # no closed form of ours
    "orthographic": (
        "+proj=ortho +lat_0=20 +lon_0=10",
        (500.0, 0.0, -100000.0, 0.0, -500.0, 90000.0),
        (300, 400),
        OTHER,
    ),
}


def place(name):
    text, affine, shape, kind = GRIDS[name]
    wkt = pyproj.CRS.from_user_input(f"{text} +R={RADIUS_M:.0f} +no_defs +type=crs").to_wkt()
    return make_georeference(wkt, affine, shape, 1.0, RADIUS_M), kind


@pytest.mark.parametrize("name", list(GRIDS))
def test_pixels_agree_with_proj_over_the_whole_raster(name):
    made, kind = place(name)
    assert made.kind == kind
    rng = np.random.default_rng(5)
    col = rng.uniform(-0.5, made.shape[1] - 0.5, 2000)
    row = rng.uniform(-0.5, made.shape[0] - 0.5, 2000)
    lat, lon = made.latlon_from_pixel(col, row)  # through PROJ
    back_col, back_row = made.pixel_from_latlon(lat, lon)
    turn = made.period or np.inf
    off = np.mod(back_col - col + turn / 2, turn) - turn / 2 if made.period else back_col - col
    # a hundredth of a millimetre of a pixel: only rounding is left
    assert np.abs(off).max() < 1e-6
    assert np.abs(back_row - row).max() < 1e-6


@pytest.mark.parametrize("name", list(GRIDS))
def test_the_proj_route_gives_the_same_pixels(name):
    made, _ = place(name)
    slow = make_proj_georeference(made)
    middle_lat, middle_lon = made.latlon_from_pixel(made.shape[1] / 2.0, made.shape[0] / 2.0)
    rng = np.random.default_rng(6)
    lat = np.clip(middle_lat + rng.uniform(-0.02, 0.02, 100), -np.pi / 2, np.pi / 2)
    lon = middle_lon + rng.uniform(-0.02, 0.02, 100)
    np.testing.assert_allclose(
        made.pixel_from_latlon(lat, lon), slow.pixel_from_latlon(lat, lon), atol=1e-6
    )


def test_any_turn_of_longitude_gives_the_same_column():
    made, _ = place("geographic")
    lon = np.radians([-190.0, 170.0, 530.0])
    col, _ = made.pixel_from_latlon(np.zeros(3), lon)
    np.testing.assert_allclose(col, col[0], atol=1e-9)
    assert made.wraps


def test_a_westward_map_mirrors_longitude():
    text, affine, shape, _ = GRIDS["geographic"]
    wkt = pyproj.CRS.from_user_input(f"{text} +R={RADIUS_M:.0f} +no_defs +type=crs").to_wkt()
    west = make_georeference(wkt, affine, shape, -1.0, RADIUS_M)
    east = make_georeference(wkt, affine, shape, 1.0, RADIUS_M)
    lat, lon = np.radians([10.0, -20.0]), np.radians([33.0, -120.0])
    np.testing.assert_allclose(
        west.pixel_from_latlon(lat, lon), east.pixel_from_latlon(lat, -lon), atol=1e-9
    )


def test_the_middle_of_the_first_pixel_is_zero():
    made, _ = place("geographic")
    col, row = made.pixel_from_latlon(np.radians(89.875), np.radians(-179.875))
    assert (float(col), float(row)) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_a_rotated_raster_goes_through_proj():
    text, affine, shape, _ = GRIDS["equirectangular"]
    a, _, c, _, e, f = affine
    wkt = pyproj.CRS.from_user_input(f"{text} +R={RADIUS_M:.0f} +no_defs +type=crs").to_wkt()
    made = make_georeference(wkt, (a, 100.0, c, -100.0, e, f), shape, 1.0, RADIUS_M)
    assert made.kind == OTHER
    lat, lon = made.latlon_from_pixel(700.25, 300.75)
    col, row = made.pixel_from_latlon(lat, lon)
    assert (float(col), float(row)) == pytest.approx((700.25, 300.75), abs=1e-6)


def test_points_that_a_projection_cannot_show_have_no_pixel():
    made, _ = place("orthographic")
    col, row = made.pixel_from_latlon(np.radians([20.0, -20.0]), np.radians([10.0, 190.0]))
    assert np.isfinite(col[0])
    assert np.isnan(col[1])
    assert np.isnan(row[1])


@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_a_rotated_raster_that_lies_turns_away_shows_the_same_places(turns):
    """A map at 349 E may begin at x of 349 deg or of -11: PROJ gives the second."""
    crs = pyproj.CRS.from_proj4(f"+proj=eqc +R={RADIUS_M} +no_defs")
    x0 = RADIUS_M * np.radians(-11.0 + 360.0 * turns)
    steps = (400.0, 150.0, x0, 150.0, -400.0, -1.3e6)
    made = make_georeference(crs.to_wkt(), steps, (300, 300), 1.0, RADIUS_M)
    assert made.kind == OTHER
    x, y = steps[0] * 40.5 + steps[1] * 70.5, steps[3] * 40.5 + steps[4] * 70.5 - 1.3e6
    lon = np.radians(-11.0) + x / RADIUS_M
    for turn in (0.0, 2.0 * np.pi):
        col, row = made.pixel_from_latlon(y / RADIUS_M, lon + turn)
        assert (col, row) == (pytest.approx(40.0, abs=1e-6), pytest.approx(70.0, abs=1e-6))
