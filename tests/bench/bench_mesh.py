"""Pictures of a small body with cast shadows, of as many triangles as published figures."""

import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from catalog.bodies.body import load_body
from catalog.rendering.mesh_scene import MeshScene
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.mesh.shape import load_shape
from tests.bench.timing import result, sized, within

pytestmark = pytest.mark.bench

PIXELS, SUBDIVISIONS = sized((1024, 2), (128, 1))
PICTURE_S = 1.0  # what the figures ask for, on one core


@pytest.fixture(scope="module")
def triangles() -> NDArray[np.float64]:
    """Phobos with each triangle cut into 16, small into 4; 20 m rms of relief on corners."""
    settings = MeshSettings("bundled:phobos_thomas.tab", "km", "west")
    shape = load_shape(settings, Path(), load_body("phobos"))
    vertices, faces = shape.vertices, shape.faces
    for _ in range(SUBDIVISIONS):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    rough = 20.0 * np.random.default_rng(1).standard_normal(len(vertices))
    vertices = vertices * (1.0 + rough / np.linalg.norm(vertices, axis=1))[:, None]
    return np.asarray(vertices[faces])


def corner_rays(position: NDArray[np.float64], half: float) -> NDArray[np.float64]:
    ahead = -position / np.linalg.norm(position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    offsets = np.linspace(-half, half, PIXELS + 1)
    x, y = np.meshgrid(offsets, offsets)
    rays = ahead + x[..., None] * right - y[..., None] * np.cross(right, ahead)
    return np.asarray(rays / np.linalg.norm(rays, axis=2)[..., None])


def test_a_picture_of_half_a_million_triangles(triangles) -> None:
    start = time.process_time()
    mesh = MeshRays(triangles)
    mesh.find_first_hits(np.array([[1e5, 0.0, 0.0]]), np.array([[-1.0, 0.0, 0.0]]))
    index = time.process_time() - start
    position = np.array([6e4, 3e4, 2e4])
    corners = corner_rays(position, 0.2)
    for name, sun in (("phase 45 deg", [0.3, 1.0, 0.2]), ("full phase", position)):
        scene = MeshScene(mesh, sun)
        scene.picture(position, corners, samples=1)
        for samples in (1, 3):
            start = time.process_time()
            picture = scene.picture(position, corners, samples)
            seconds = time.process_time() - start
            result(
                f"picture of a mesh of half a million triangles, 1024², with shadows, {name}, "
                f"{samples}² rays at edges",
                f"{seconds:.2f} s, {(picture > 0.0).mean():.0%} lit (its index {index:.2f} s)",
                f"limit {PICTURE_S:g} s; NASA's GIANT 512² in 1.2 s (index 13 s)"
                if samples == 1
                else "",
            )
            if samples == 1:
                assert within(seconds, PICTURE_S)
