"""The reference ellipsoid and the plane that touches it."""

import numpy as np
import pyproj
import pytest

from catalog.geometry.ellipsoid import (
    compute_normals,
    find_foot,
    geodetic_from_xyz,
    measure_height_above,
    project_to_surface,
)
from catalog.geometry.projection import TangentPlane

PHOBOS = np.array([13.0e3, 11.4e3, 9.1e3])


def directions(count: int, seed: int = 1) -> np.ndarray:
    found = np.random.default_rng(seed).standard_normal((count, 3))
    found[0], found[1], found[2] = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)
    return found / np.linalg.norm(found, axis=1)[:, None]


@pytest.mark.parametrize("height", [0.0, 3000.0, -1500.0, 1e9])
def test_a_foot_is_found_again_from_any_height_over_it(height: float) -> None:
    foot = project_to_surface(directions(500), PHOBOS)
    found = find_foot(foot + height * compute_normals(foot, PHOBOS), PHOBOS)
    assert np.abs(found - foot).max() < 1e-7 * max(1.0, height / 1e6)


def test_heights_along_a_planes_normal_lead_to_the_near_side() -> None:
    plane = TangentPlane.make_below([6.0e3, 7.0e3, 3.0e3], PHOBOS)
    x, y = np.meshgrid(np.linspace(-6e3, 6e3, 9), np.linspace(-5e3, 5e3, 9))
    up = plane.body_from_local[:, 2]
    height = measure_height_above(plane.points(x, y, 0.0), up, PHOBOS)
    found = plane.points(x, y, height)
    assert np.square(found / PHOBOS).sum(axis=-1) == pytest.approx(np.ones((9, 9)), abs=1e-12)
    assert (compute_normals(found, PHOBOS) @ up > 0.0).all()
    assert height[4, 4] == pytest.approx(0.0, abs=1e-8)
    assert np.isnan(measure_height_above(plane.points(2e4, 0.0, 0.0), up, PHOBOS))


def test_surface_points_satisfy_the_ellipsoids_equation() -> None:
    foot = project_to_surface(directions(100), PHOBOS)
    assert np.square(foot / PHOBOS).sum(axis=1) == pytest.approx(np.ones(100), abs=1e-14)


def test_normals_are_those_of_the_slope_between_near_points() -> None:
    middle = directions(50)
    aside = np.cross(middle, directions(53, seed=2)[3:])
    near = [project_to_surface(middle + sign * 1e-5 * aside, PHOBOS) for sign in (1.0, -1.0)]
    along = (near[0] - near[1]) / np.linalg.norm(near[0] - near[1], axis=1)[:, None]
    cosine = np.einsum(
        "ij,ij->i", along, compute_normals(project_to_surface(middle, PHOBOS), PHOBOS)
    )
    assert np.abs(cosine).max() < 1e-8


def test_the_foot_agrees_with_proj_on_an_oblate_spheroid() -> None:
    from pyproj import Transformer

    radii = (6378137.0, 6378137.0, 6356752.314245179)
    points = directions(200) * 6.38e6  # so low PROJ's own formula is good to 4e-6 m
    to_geodetic = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    lon, lat, height = to_geodetic.transform(*points.T)
    foot = find_foot(points, radii)
    assert np.linalg.norm(points - foot, axis=1) == pytest.approx(height, abs=1e-5)
    normal = compute_normals(foot, radii)
    assert np.degrees(np.arcsin(normal[:, 2])) == pytest.approx(lat, abs=1e-9)
    assert np.abs(np.degrees(np.arctan2(normal[3:, 1], normal[3:, 0])) - lon[3:]).max() < 1e-9


def test_the_centre_has_no_foot() -> None:
    with pytest.raises(ValueError, match="no one foot"):
        find_foot([0.0, 0.0, 0.0], PHOBOS)


def test_a_tangent_plane_goes_through_its_point_and_comes_back() -> None:
    for direction in directions(20):
        point = 1.05 * project_to_surface(direction, PHOBOS)
        plane = TangentPlane.make_below(point, PHOBOS)
        x, y = plane.xy_from_xyz(point)
        assert (float(x), float(y)) == pytest.approx((0.0, 0.0), abs=1e-6)
        assert plane.points(0.0, 0.0, plane.height_of(point)) == pytest.approx(point, abs=1e-6)
        east, north = plane.body_from_local[:, 0], plane.body_from_local[:, 1]
        there = plane.points(300.0, -200.0, 50.0)
        assert there == pytest.approx(
            np.array(plane.foot_m)
            + 300.0 * east
            - 200.0 * north
            + 50.0 * plane.body_from_local[:, 2]
        )
        x, y = plane.xy_from_xyz(there)
        assert (float(x), float(y), float(plane.height_of(there))) == pytest.approx(
            (300.0, -200.0, 50.0)
        )


def test_a_tangent_planes_axes_point_east_and_north() -> None:
    plane = TangentPlane.make_below(1.02 * project_to_surface([0.5, 0.4, 0.6], PHOBOS), PHOBOS)
    lat, lon = plane.latlon(np.array([0.0, 100.0, 0.0]), np.array([0.0, 0.0, 100.0]), 200.0)
    assert lon[1] > lon[0]
    assert lat[2] > lat[0]
    assert abs(plane.body_from_local[2, 0]) < 1e-12  # east is level with the equator


@pytest.mark.parametrize(
    "radii", [(6378137.0, 6378137.0, 6356752.314245), (71492e3, 71492e3, 66854e3)]
)
def test_geodetic_coordinates_are_those_of_pyproj(radii):
    rng = np.random.default_rng(3)
    lat, lon = rng.uniform(-90.0, 90.0, 200), rng.uniform(-180.0, 180.0, 200)
    height = rng.uniform(-1e4, 1e6, 200)
    lat[:3], height[3:6] = (90.0, -90.0, 0.0), (0.0, 4e7, 4e8)
    wanted = lat, lon, height
    a, _, c = radii
    ellipsoid = {"a": a, "b": c, "type": "crs"}
    there = pyproj.Transformer.from_crs(
        {"proj": "longlat", **ellipsoid}, {"proj": "geocent", **ellipsoid}, always_xy=True
    )
    xyz = np.column_stack(there.transform(lon, lat, height))
    found_lat, found_lon, found_height = geodetic_from_xyz(xyz, radii)
    np.testing.assert_allclose(np.degrees(found_lat), wanted[0], atol=1e-10)
    np.testing.assert_allclose(np.degrees(found_lon[2:]), wanted[1][2:], atol=1e-10)
    np.testing.assert_allclose(found_height, wanted[2], atol=1e-5)


def test_geodetic_coordinates_near_the_centre_are_unknown():
    found = geodetic_from_xyz([(1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (7e6, 0.0, 0.0)], (6e6, 6e6, 5e6))
    assert np.isnan(found[0]).tolist() == [True, True, False]
    assert found[2][2] == pytest.approx(1e6)
