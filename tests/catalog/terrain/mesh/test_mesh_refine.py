"""Finer meshes: rounder than the model, closed, with relief of the wanted size."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from catalog.bodies.body import load_body
from catalog.geometry.latlon import latlon_from_xyz
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.refine import add_detail, refine_shape
from catalog.terrain.mesh.shape import Shape, load_shape
from catalog.terrain.synthetic.relief import SyntheticRelief


@pytest.fixture(scope="module")
def ball() -> Shape:
    mesh = trimesh.creation.icosphere(2, radius=1000.0)
    return Shape(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64))


def test_a_refined_ball_is_rounder_than_its_flat_faces(ball: Shape) -> None:
    fine = refine_shape(ball, 2)
    flat = trimesh.remesh.subdivide(*trimesh.remesh.subdivide(ball.vertices, ball.faces))
    sag = 1000.0 - np.linalg.norm(flat[0], axis=1).min()
    assert sag > 10.0
    # what is left comes of normals that are means of flat faces
    assert np.abs(np.linalg.norm(fine.vertices, axis=1) - 1000.0).max() < 0.15 * sag


def test_a_refined_mesh_keeps_the_vertices_and_stays_closed(ball: Shape) -> None:
    fine = refine_shape(ball, 2)
    np.testing.assert_array_equal(fine.vertices[: len(ball.vertices)], ball.vertices)
    mesh = trimesh.Trimesh(fine.vertices, fine.faces, process=False)
    assert len(mesh.faces) == 16 * len(ball.faces)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    # 1 - 2 pi^2 / (sqrt(3) n) of the ball for n such faces, inscribed
    assert mesh.volume == pytest.approx(4.0 / 3.0 * np.pi * 1e9, rel=3e-3)


def test_relief_goes_along_the_normals(ball: Shape) -> None:
    detail = SyntheticRelief(7, 60.0, 1000.0, smallest_m=30.0, rms_slope_deg=10.0, saturation=0.1)
    rough = add_detail(ball, detail)
    lat, lon, _ = latlon_from_xyz(ball.vertices)
    heights = np.linalg.norm(rough.vertices, axis=1) - 1000.0
    # the ball's normals are radii, those of its flat faces' means nearly so
    np.testing.assert_allclose(heights, detail.heights(lat, lon), atol=0.02)
    assert heights.std() > 1.0
    np.testing.assert_array_equal(rough.vertices, add_detail(ball, detail).vertices)


def test_relief_of_the_phobos_scenarios_is_20_m_rms() -> None:
    body = load_body("phobos")
    shape = load_shape(MeshSettings("bundled:phobos_thomas.tab", "km", "west"), Path(), body)
    detail = SyntheticRelief(
        501, shape.posting_m, body.radius_m, smallest_m=160.0, rms_slope_deg=15.0, saturation=0.1
    )
    offset = np.linalg.norm(add_detail(shape, detail).vertices - shape.vertices, axis=1)
    # latitude rings near the poles stand close: every vertex counts by the ground about it
    weight = np.cos(latlon_from_xyz(shape.vertices)[0])
    assert np.sqrt(np.average(offset**2, weights=weight)) == pytest.approx(20.0, abs=1.5)
