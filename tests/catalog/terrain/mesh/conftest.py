"""Small bodies for the tests."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from catalog.bodies.body import Body, load_body
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.shape import Shape, load_shape


@pytest.fixture(scope="session")
def phobos() -> Body:
    return load_body("phobos")


@pytest.fixture(scope="session")
def phobos_shape(phobos: Body) -> Shape:
    settings = MeshSettings("bundled:phobos_thomas.tab", "km", "west")
    return load_shape(settings, Path(), phobos)


@pytest.fixture
def ellipsoid_km(phobos: Body) -> trimesh.Trimesh:
    """The body's ellipsoid in 1280 triangles, km."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    return trimesh.Trimesh(ball.vertices * np.array(phobos.radii_m) / 1e3, ball.faces)
