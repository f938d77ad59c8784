"""The patches' projection against PROJ."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyproj import CRS, Transformer

from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.projection import (
    Stereographic,
    TangentPlane,
    make_node_grid,
    make_node_offsets,
)

RADIUS_M = 1737400.0
CENTRES = [(0.0, 0.0), (-43.3, -11.2), (60.0, 180.0), (-5.0, -180.0), (90.0, 0.0), (-90.0, 30.0)]


def transformers(lat_deg, lon_deg):
    plane = CRS.from_proj4(
        f"+proj=stere +lat_0={lat_deg} +lon_0={lon_deg} +k=1 +R={RADIUS_M} +units=m +no_defs"
    )
    sphere = CRS.from_proj4(f"+proj=longlat +R={RADIUS_M} +no_defs")
    forward = Transformer.from_crs(sphere, plane, always_xy=True)
    return forward, Transformer.from_crs(plane, sphere, always_xy=True)


@pytest.mark.parametrize(("lat_deg", "lon_deg"), CENTRES)
def test_map_points_have_the_latitudes_and_longitudes_of_proj(lat_deg, lon_deg):
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-150e3, 150e3, (2, 400))
    projection = Stereographic(np.radians(lat_deg), np.radians(lon_deg), RADIUS_M)
    lat, lon = projection.latlon(x, y)
    proj_lon, proj_lat = transformers(lat_deg, lon_deg)[1].transform(x, y)
    ours = xyz_from_latlon(lat, lon, RADIUS_M)
    theirs = xyz_from_latlon(np.radians(proj_lat), np.radians(proj_lon), RADIUS_M)
    # a tenth of a millimetre
    assert np.abs(ours - theirs).max() < 1e-4


@pytest.mark.parametrize(("lat_deg", "lon_deg"), CENTRES)
def test_latitudes_and_longitudes_have_the_map_points_of_proj(lat_deg, lon_deg):
    rng = np.random.default_rng(4)
    projection = Stereographic(np.radians(lat_deg), np.radians(lon_deg), RADIUS_M)
    # anywhere within a third of the sphere, the antimeridian and the poles among it
    away = rng.uniform(-1.5, 1.5, (400, 2)) * RADIUS_M
    lat, lon = projection.latlon(away[:, 0], away[:, 1])
    x, y = projection.xy_from_latlon(lat, lon)
    forward = transformers(lat_deg, lon_deg)[0]
    proj_x, proj_y = forward.transform(np.degrees(lon), np.degrees(lat))
    assert_allclose(x, proj_x, atol=1e-3)
    assert_allclose(y, proj_y, atol=1e-3)
    assert_allclose(np.stack([x, y], axis=-1), away, atol=1e-5)


@pytest.mark.parametrize(("lat_deg", "lon_deg"), CENTRES)
def test_points_with_heights_come_back_to_their_place(lat_deg, lon_deg):
    rng = np.random.default_rng(5)
    projection = Stereographic(np.radians(lat_deg), np.radians(lon_deg), RADIUS_M)
    x, y = rng.uniform(-80e3, 80e3, (2, 300))
    height = rng.uniform(-9e3, 9e3, 300)
    xyz = projection.points(x, y, height)
    assert_allclose(np.linalg.norm(xyz, axis=-1), RADIUS_M + height, rtol=1e-14)
    back_x, back_y = projection.xy_from_xyz(xyz)
    assert_allclose(back_x, x, atol=1e-6)
    assert_allclose(back_y, y, atol=1e-6)


def test_the_map_keeps_angles_and_grows_by_the_stated_scale():
    projection = Stereographic(-0.7, 0.4, RADIUS_M)
    x, y, step = 90e3, -60e3, 1.0
    middle = projection.points(x, y, 0.0)
    along_x = projection.points(x + step, y, 0.0) - middle
    along_y = projection.points(x, y + step, 0.0) - middle
    assert_allclose(along_x @ along_y, 0.0, atol=1e-5)
    scale = 1.0 + (x * x + y * y) / (2.0 * RADIUS_M) ** 2
    assert_allclose(np.linalg.norm(along_x), step / scale, rtol=1e-6)
    assert_allclose(np.linalg.norm(along_y), step / scale, rtol=1e-6)


def test_the_antipode_has_no_finite_place_and_warns_nobody():
    projection = Stereographic(0.0, 0.0, RADIUS_M)
    x, y = projection.xy_from_xyz(np.array([-1.0, 0.0, 0.0]))
    assert not (np.isfinite(x) and np.isfinite(y))


@pytest.mark.parametrize("size", [1, 2, 5, 80])
def test_nodes_are_centred_with_north_up_and_west_left(size):
    x, y = make_node_grid(size, 118.0)
    assert x.shape == y.shape == (size, size)
    assert_allclose([x.mean(), y.mean()], 0.0, atol=1e-9)
    assert_allclose(x[0], make_node_offsets(size, 118.0))
    assert_allclose(np.diff(x, axis=1), 118.0)
    assert_allclose(np.diff(y, axis=0), -118.0)


@pytest.mark.parametrize(
    "projection", [Stereographic(0.4, -2.0, RADIUS_M), TangentPlane(0.4, -2.0, (5e3, 1e3, -2e3))]
)
def test_nodes_with_heights_are_the_points_of_their_places(projection):
    heights = np.random.default_rng(6).uniform(-3e3, 3e3, (7, 7)).astype(np.float32)
    points = projection.points(*make_node_grid(7, 118.0), heights)
    assert_allclose(projection.nodes(heights, 118.0), points, rtol=1e-15)
