"""Latitudes, longitudes and local axes: round trips, the poles, ±180°."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from catalog.geometry.latlon import (
    angular_distance,
    body_from_local,
    latlon_from_xyz,
    wrap_longitude,
    wrap_longitude_deg,
    xyz_from_latlon,
)


def test_vectors_go_to_angles_and_back():
    rng = np.random.default_rng(1)
    xyz = rng.normal(size=(2000, 3)) * 1e6
    back = xyz_from_latlon(*latlon_from_xyz(xyz))
    assert_allclose(back, xyz, atol=1e-8)


def test_angles_go_to_vectors_and_back_at_the_poles_and_across_the_antimeridian():
    lat = np.radians([90.0, -90.0, 89.999999, 0.0, 0.0, -30.0])
    lon = np.radians([0.0, 0.0, 170.0, -180.0, 179.999999, -179.999999])
    got_lat, got_lon, radius = latlon_from_xyz(xyz_from_latlon(lat, lon, 1737.4))
    assert_allclose(got_lat, lat, atol=1e-9)
    # the longitude of a point 1e-6 degrees from a pole keeps 8 of its digits
    assert_allclose(got_lon[2:], lon[2:], atol=1e-7)
    assert_allclose(radius, 1737.4, rtol=1e-14)


def test_known_directions_have_their_known_vectors():
    assert_allclose(xyz_from_latlon(0.0, 0.0, 2.0), [2.0, 0.0, 0.0])
    assert_allclose(xyz_from_latlon(0.0, np.pi / 2, 2.0), [0.0, 2.0, 0.0], atol=1e-15)
    assert_allclose(xyz_from_latlon(np.pi / 2, 1.0, 2.0), [0.0, 0.0, 2.0], atol=1e-15)


@pytest.mark.parametrize(
    ("given", "wrapped"),
    [(180.0, -180.0), (-180.0, -180.0), (359.0, -1.0), (540.0, -180.0), (-181.0, 179.0)],
)
def test_longitudes_are_written_from_minus_180_up_to_but_not_180(given, wrapped):
    assert wrap_longitude_deg(given) == wrapped
    assert_allclose(wrap_longitude(np.radians(given)), np.radians(wrapped), atol=1e-12)


def test_a_longitude_a_hair_below_minus_180_never_becomes_plus_180():
    for tiny in (1e-20, 1e-17, 1e-15, 1e-13):
        assert -180.0 <= float(wrap_longitude_deg(-180.0 - tiny)) < 180.0
        assert -np.pi <= float(wrap_longitude(-np.pi - tiny)) < np.pi


@pytest.mark.parametrize("lat_deg", [-90.0, -43.0, 0.0, 89.0, 90.0])
@pytest.mark.parametrize("lon_deg", [-180.0, -11.0, 0.0, 179.9])
def test_local_axes_are_right_handed_and_point_east_north_and_up(lat_deg, lon_deg):
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    axes = body_from_local(lat, lon)
    assert_allclose(axes.T @ axes, np.eye(3), atol=1e-14)
    assert_allclose(np.linalg.det(axes), 1.0, atol=1e-14)
    assert_allclose(axes[:, 2], xyz_from_latlon(lat, lon, 1.0), atol=1e-14)
    # a step in longitude goes east, a step in latitude north; on a pole east is still defined
    step = 1e-6
    east = xyz_from_latlon(0.0, lon + step, 1.0) - xyz_from_latlon(0.0, lon - step, 1.0)
    assert_allclose(axes[:, 0], east / (2.0 * step), atol=1e-9)
    north = xyz_from_latlon(lat + step, lon, 1.0) - xyz_from_latlon(lat - step, lon, 1.0)
    assert_allclose(axes[:, 1], north / (2.0 * step), atol=1e-9)


def test_angular_distances_hold_from_a_microdegree_to_the_antipode():
    micro = np.radians(1e-6)
    assert_allclose(angular_distance(0.3, 1.0, 0.3 + micro, 1.0), micro, rtol=1e-8)
    assert_allclose(angular_distance(0.3, 1.0, -0.3, 1.0 - np.pi), np.pi, atol=1e-12)
    assert_allclose(angular_distance(np.pi / 2, 0.0, np.pi / 2, 2.0), 0.0, atol=1e-15)
    across = angular_distance(0.0, np.radians(179.5), 0.0, np.radians(-179.5))
    assert_allclose(across, np.radians(1.0), rtol=1e-12)


def test_angular_distances_agree_with_the_angle_between_vectors():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 500, 3))
    cosine = np.sum(a * b, axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    lat1, lon1, _ = latlon_from_xyz(a)
    lat2, lon2, _ = latlon_from_xyz(b)
    assert_allclose(angular_distance(lat1, lon1, lat2, lon2), np.arccos(cosine), atol=1e-7)
