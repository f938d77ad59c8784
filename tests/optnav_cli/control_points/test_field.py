"""Points of several catalogs in one field: which are there and near, and their names."""

from dataclasses import replace

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import xyz_from_latlon
from optnav_cli.control_points.field import ControlPointField, PointLayer

RADIUS_M = 1_737_400.0


def layer(name, cell_deg, box=None, seed=0, posting_m=118.0):
    """A point at a random place of every cell, without patches."""
    rng = np.random.default_rng(seed)
    grid = CellGrid(cell_deg)
    cells = np.arange(grid.total) if box is None else grid.find_cells_in_bbox(*box)
    west, south, east, north = grid.compute_bounds_deg(cells)
    lat = south + (north - south) * rng.uniform(size=len(cells))
    lon = west + (east - west) * rng.uniform(size=len(cells))
    radius = RADIUS_M + rng.uniform(-9e3, 9e3, len(cells))
    place = xyz_from_latlon(np.radians(lat), np.radians(lon), 1.0) * radius[:, None]
    skyline = np.zeros((len(cells), 36), dtype=np.float32)
    postings = posting_m * 2.0 ** np.arange(5)
    return PointLayer(name, None, grid, cells, place, skyline, postings, RADIUS_M)


@pytest.fixture(scope="module")
def globe():
    return layer("moon.gpkg", 2.0, posting_m=948.0)


def seen_at_less_than(place, position, emission_deg):
    to_camera = position - place
    up = place / np.linalg.norm(place, axis=1, keepdims=True)
    cosine = np.einsum("ni,ni->n", up, to_camera) / np.linalg.norm(to_camera, axis=1)
    return np.flatnonzero(cosine > np.cos(np.radians(emission_deg)))


@pytest.mark.parametrize(("lat", "lon"), [(-43, -11), (90, 0), (-89.9, 77), (3, 180), (-1, -179.9)])
@pytest.mark.parametrize("height_km", [20.0, 200.0, 10_000.0, 380_000.0])
def test_no_point_that_a_camera_sees_is_missed(globe, lat, lon, height_km):
    position = xyz_from_latlon(np.radians(lat), np.radians(lon), RADIUS_M + 1e3 * height_km)
    found = ControlPointField([globe]).near(position, 70.0)
    assert len(np.unique(found)) == len(found)
    wanted = seen_at_less_than(globe.xyz_m, position, 70.0)
    assert set(wanted) <= set(found)
    assert len(found) < 0.5 * len(globe.ids)


def test_an_earlier_catalog_has_priority_where_it_has_points(globe):
    tycho = layer("tycho.gpkg", 0.5, (-17.0, -48.0, -5.0, -38.0), seed=1)
    field = ControlPointField([tycho, globe])
    first, second = field.layers
    assert len(first.ids) == len(tycho.ids)
    gap = np.linalg.norm(second.xyz_m[:, None] - first.xyz_m[None], axis=2).min(axis=1)
    assert gap.min() > np.radians(0.5) * RADIUS_M
    # what is left out lies in the box, and all else is there
    assert 20 <= len(globe.ids) - len(second.ids) <= 60
    other_way = ControlPointField([globe, tycho])
    assert len(other_way.layers[0].ids) == len(globe.ids)
    assert len(other_way.layers[1].ids) == 0


def test_a_point_is_found_by_catalog_and_id_and_knows_its_postings(globe):
    tycho = layer("tycho.gpkg", 2.0, (-17.0, -48.0, -5.0, -38.0), seed=1)
    field = ControlPointField([tycho, globe])
    for index in (0, len(tycho.ids) - 1, len(tycho.ids), len(field) - 1):
        assert field.index_of(*field.name(index)) == index
    last = len(field) - 1
    assert field.postings_m(0)[0] == 118.0
    assert field.postings_m(last)[0] == 948.0
    assert list(field.finest_postings_m(np.array([last, 0]))) == [948.0, 118.0]
    covered = set(globe.ids) - set(field.layers[1].ids)
    with pytest.raises(KeyError):
        field.index_of("moon.gpkg", covered.pop())


def test_of_two_catalogs_the_points_of_both_are_near(globe):
    tycho = layer("tycho.gpkg", 0.5, (-17.0, -48.0, -5.0, -38.0), seed=1)
    field = ControlPointField([tycho, globe])
    position = xyz_from_latlon(np.radians(-43.0), np.radians(-11.0), RADIUS_M + 400e3)
    found = field.near(position, 70.0)
    assert {field.name(int(k))[0] for k in found} == {"tycho.gpkg", "moon.gpkg"}
    assert set(seen_at_less_than(field.xyz_m, position, 70.0)) <= set(found)


@pytest.mark.parametrize(("zenith_deg", "moved_m"), [(0.0, 0.0), (10.0, 0.4), (45.0, 4.6)])
def test_points_of_the_earth_are_seen_through_its_air(globe, zenith_deg, moved_m):
    """Shifts as tracing of rays through an exponential atmosphere has them (design of 001)."""
    earth, place = load_body("earth"), np.array([[6378137.0, 0.0, 0.0]])
    tilt = np.radians(zenith_deg)
    camera = place[0] + 832e3 * np.array([np.cos(tilt), np.sin(tilt), 0.0])
    moved = ControlPointField([replace(globe, body=earth)]).correct_refraction(place, camera)
    np.testing.assert_allclose(moved - place, [[0.0, -moved_m, 0.0]], atol=0.06)
    same = ControlPointField([globe]).correct_refraction(place, camera)
    np.testing.assert_array_equal(same, place)
