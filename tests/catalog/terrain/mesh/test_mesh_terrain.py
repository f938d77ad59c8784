"""Map grids of a mesh: heights as exact rays give them, overhangs told, the body's shadows."""

import pickle
from dataclasses import replace

import manifold3d
import numpy as np
import pytest

from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.projection import Stereographic, TangentPlane, make_node_grid
from catalog.rendering.shadow import make_lit_mask
from catalog.terrain.mesh.rays import intersect_all
from catalog.terrain.mesh.terrain import MeshTerrain

PLACES = [(0.2, 0.3), (-1.2, 2.0), (1.5707, 0.0), (0.0, -3.1415), (0.7, -1.0)]


@pytest.fixture(scope="module")
def terrain(phobos, phobos_shape, tmp_path_factory) -> MeshTerrain:
    place = tmp_path_factory.mktemp("mesh") / "corners.npy"
    np.save(place, phobos_shape.vertices[phobos_shape.faces])
    return MeshTerrain(phobos, place, "phobos_thomas.tab", phobos_shape.posting_m)


@pytest.fixture(scope="module")
def binary(phobos, tmp_path_factory) -> MeshTerrain:
    """Two balls that touch along x, 4 km and 2.4 km, as one surface."""
    ball = manifold3d.Manifold.sphere(4.0e3, 96)
    both = ball.translate([3.6e3, 0.0, 0.0]) + ball.scale([0.6] * 3).translate([-2.4e3, 0.0, 0.0])
    mesh = both.to_mesh64()
    place = tmp_path_factory.mktemp("binary") / "corners.npy"
    np.save(place, np.asarray(mesh.vert_properties)[np.asarray(mesh.tri_verts)])
    body = replace(phobos, radius_m=4.5e3, radii_m=(6.2e3, 4.0e3, 4.0e3))
    return MeshTerrain(body, place, "binary.obj", 200.0)


@pytest.mark.parametrize(("lat", "lon"), PLACES)
def test_heights_are_where_exact_rays_meet_all_triangles(terrain, lat, lon) -> None:
    plane = terrain.projection(lat, lon)
    assert isinstance(plane, TangentPlane)
    grid = terrain.local_grid(plane, 60.0, 40)
    x, y = make_node_grid(40, 60.0)
    for row, col in ((0, 0), (3, 30), (20, 19), (39, 39), (11, 2)):
        start = plane.points(x[row, col], y[row, col], 3e4)
        _, at = intersect_all(terrain.rays.corners, start, -plane.body_from_local[:, 2], 0.0)
        assert grid[row, col] == pytest.approx(3e4 - at, abs=1e-3)


@pytest.mark.parametrize(("lat", "lon"), PLACES)
def test_a_patch_goes_through_its_point(terrain, lat, lon) -> None:
    point = terrain.points(lat, lon)
    plane = terrain.projection(lat, lon)
    near = terrain.local_grid(plane, 0.5, 2)
    assert near == pytest.approx(np.full((2, 2), plane.height_of(point)), abs=1.0)
    radius = terrain.body.radius_m + float(terrain.heights(lat, lon, 50.0))
    assert point == pytest.approx(xyz_from_latlon(lat, lon, radius), abs=2e-3)


def test_coarse_nodes_are_means_of_rays_no_wider_than_the_mesh(terrain) -> None:
    plane = terrain.projection(0.4, 1.0)
    coarse = terrain.local_grid(plane, 4.0 * terrain.posting_m, 8)
    fine = terrain.local_grid(plane, terrain.posting_m, 32)
    assert coarse == pytest.approx(fine.reshape(8, 4, 8, 4).mean(axis=(1, 3)), abs=0.01)


def test_a_large_body_has_radial_heights_on_its_sphere(terrain, tmp_path) -> None:
    large = replace(terrain.body, radius_m=1.108e6, radii_m=(1.3e6, 1.14e6, 0.91e6))
    np.save(tmp_path / "corners.npy", 100.0 * terrain.rays.corners)
    body = MeshTerrain(large, tmp_path / "corners.npy", "large.obj", 3.2e4)
    place = body.projection(0.3, -0.7)
    assert isinstance(place, Stereographic)
    grid = body.local_grid(place, 5e3, 16)
    lat, lon = place.latlon(*make_node_grid(16, 5e3))
    assert grid == pytest.approx(100.0 * (
        terrain.heights(lat, lon, 50.0) + 11.08e3) - 1.108e6, abs=0.3)  # fmt: skip
    assert body.make_outer_grids(place, 5e3, 16) == ()


def test_a_plane_of_the_ground_leaves_out_the_lobe_that_stands_over_it(binary) -> None:
    """On the small ball's side towards the large one lines along the normal end in the latter."""
    own = MeshTerrain(binary.body, binary.corners_file, "binary.obj", 200.0, normals_m=300.0)
    lat, lon = 0.55, 2.95  # on the small ball, towards the neck
    plane = own.projection(lat, lon)
    point = own.points(lat, lon)
    ball = np.array([-2.4e3, 0.0, 0.0])
    assert plane.body_from_local[:, 2] @ (point - ball) / 2.4e3 > 0.95
    grid = own.local_grid(plane, 20.0, 40)
    x, y = make_node_grid(40, 20.0)
    placed = plane.points(x, y, grid)
    away = np.linalg.norm(placed - ball, axis=-1)
    assert np.isfinite(grid).all()
    assert away == pytest.approx(2.4e3, abs=20.0)
    assert not own.overhangs(plane, 20.0, 40)
    assert plane.height_of(point) == pytest.approx(0.0, abs=1e-6)


def test_ground_under_an_overhang_has_no_height_and_is_told(binary) -> None:
    neck = binary.projection(0.0, 0.72 * np.pi)  # lines past the small ball meet the large one
    assert binary.overhangs(neck, 100.0, 64)
    holes = np.isnan(binary.local_grid(neck, 100.0, 64))
    assert 0.005 < holes.mean() < 0.5
    tip = binary.projection(0.0, 0.0)
    assert not binary.overhangs(tip, 50.0, 64)
    assert np.isfinite(binary.local_grid(tip, 50.0, 64)).all()
    assert not binary.overhangs(binary.projection(0.0, np.pi), 30.0, 32)


def test_beside_the_body_there_is_no_ground(terrain) -> None:
    plane = terrain.projection(0.0, 0.0)
    wide = terrain.local_grid(plane, 1000.0, 40)
    assert np.isnan(wide[0]).all()
    assert np.isfinite(wide[20, 20])


def sun_of(elevation_deg: float, azimuth_deg: float) -> np.ndarray:
    elevation, azimuth = np.radians([elevation_deg, azimuth_deg])
    across = np.cos(elevation)
    return np.array([across * np.sin(azimuth), across * np.cos(azimuth), np.sin(elevation)])


@pytest.mark.parametrize("elevation", [45.0, 20.0, 8.0, 2.0, -5.0, -15.0])
def test_shadows_on_patches_are_those_of_the_whole_body(terrain, elevation) -> None:
    """Against rays from each node to the Sun: 32 patches and azimuths, whatever the Sun's height.

    Nodes nearer to a shadow's edge than the coarse grids tell may differ: 2 % on average, 3 % of
    the nodes where all is grazing light.
    """
    differing, dark = [], []
    for number, (lat, lon) in enumerate([*PLACES, (0.5, 0.9), (-0.4, -2.2), (-0.9, 0.1)]):
        plane = terrain.projection(lat, lon)
        posting, size = 48.0, 80
        grid = terrain.local_grid(plane, posting, size)
        beyond = terrain.make_outer_grids(plane, posting, size)
        points = plane.points(*make_node_grid(size, posting), grid.astype(np.float64) + 0.5)
        for azimuth in (10.0 + 11.0 * number, 100.0, 190.0, 280.0):
            sun = sun_of(elevation, azimuth)
            lit = make_lit_mask(grid, posting, sun, plane.radius_m, beyond)
            ray = plane.body_from_local @ sun
            blocked = terrain.rays.are_blocked(points.reshape(-1, 3), ray).reshape(lit.shape)
            differing.append((lit == blocked).mean())
            dark.append(blocked.mean())
    assert np.mean(differing) < 0.02 if elevation > 5.0 else np.mean(differing) < 0.03
    if elevation < 20.0:
        assert np.mean(dark) > 0.02


def test_a_mesh_travels_to_workers_by_its_path(terrain) -> None:
    sent = pickle.loads(pickle.dumps(terrain))
    assert len(pickle.dumps(terrain)) < 20_000
    assert sent.points(0.1, 0.2) == pytest.approx(terrain.points(0.1, 0.2))
