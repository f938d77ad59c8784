"""Smooth surfaces through shape models: nearer to what the vertices were taken from."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from catalog.terrain.dem.file import resolve_path
from catalog.terrain.mesh.file import RadiiGrid
from catalog.terrain.mesh.refine import refine_grid, smooth_corners, split_by_butterfly
from catalog.terrain.mesh.shape import Shape, compute_volume, find_edges


def test_the_butterfly_leaves_a_ball_by_a_tenth_of_what_flat_faces_do() -> None:
    """Twelve vertices of the icosphere have five neighbours, the others six."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices, faces = split_by_butterfly(np.asarray(ball.vertices), np.asarray(ball.faces))
    assert (vertices[: len(ball.vertices)] == ball.vertices).all()
    assert len(faces) == 4 * len(ball.faces)
    edges = find_edges(faces)
    assert not edges.open.size
    assert not edges.crowded.size
    assert not edges.same.any()
    new = np.linalg.norm(vertices[len(ball.vertices) :], axis=1)
    plain = np.linalg.norm(ball.vertices[ball.edges_unique].mean(axis=1), axis=1)
    assert np.abs(new - 1.0).mean() < np.abs(plain - 1.0).mean() / 10.0
    assert np.abs(new - 1.0).max() < np.abs(plain - 1.0).max() / 4.0


def test_faces_about_needles_do_not_fold_over() -> None:
    rng = np.random.default_rng(4)
    ball = trimesh.creation.icosphere(subdivisions=3)
    rough = np.asarray(ball.vertices) * rng.uniform(0.7, 1.3, (len(ball.vertices), 1))
    faces = np.asarray(ball.faces)
    finer, quarter = split_by_butterfly(rough, faces)
    parents = np.repeat(_normals(rough[faces]), 4, axis=0)
    assert (np.einsum("ij,ij->i", _normals(finer[quarter]), parents) > 0.0).all()


def _normals(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def lumpy(lats: np.ndarray, lons: np.ndarray) -> np.ndarray:
    """Radii of a smooth body that knows no pole and no seam: a polynomial of directions."""
    lat, lon = np.radians(lats)[:, None], np.radians(lons)[None, :]
    x, y = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon)
    z = np.sin(lat) + 0.0 * lon
    return 10.0 + x * y - 0.5 * z**2 * x + 0.3 * (x + 2.0 * z) ** 4 / 9.0


@pytest.mark.parametrize("first", [0.0, -180.0])
def test_grids_are_smooth_over_poles_and_seam(first: float) -> None:
    lats, lons = np.linspace(-90.0, 90.0, 46), first + np.linspace(0.0, 360.0, 91)
    fine = refine_grid(RadiiGrid(lats, lons, lumpy(lats, lons)), 4)
    assert fine.radii.shape == (181, 361)
    assert fine.radii[::4, ::4] == pytest.approx(lumpy(lats, lons), abs=1e-9)
    # chords of 4 deg leave this body by up to 4e-3
    assert np.abs(fine.radii - lumpy(fine.lats, fine.lons)).max() < 2e-5


def test_a_table_of_west_longitudes_looks_outward(phobos_shape: Shape) -> None:
    path = resolve_path("bundled:phobos_thomas.tab", Path())
    corners = smooth_corners(path, "west", 1e3, phobos_shape.vertices, phobos_shape.faces, 1)
    volume = compute_volume(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    # faces cut off what is round: half the edges' length, a quarter of the loss of 4 km3
    assert volume / 1e9 == pytest.approx(5752.5, abs=1.5)
    assert volume > phobos_shape.volume_m3
    far, _ = cKDTree(corners.reshape(-1, 3)).query(phobos_shape.vertices)
    # the table ends 15 parallels up to 23 m from where they begin
    assert far.max() < 11.4
    assert np.count_nonzero(far > 1e-6) == 30
