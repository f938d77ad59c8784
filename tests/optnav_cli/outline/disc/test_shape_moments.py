"""Light of small discs of bodies that are no sphere, against formulas and traced pictures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from catalog.bodies.body import load_body
from catalog.rendering.mesh_scene import MeshScene
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.mesh.shape import load_shape
from catalog.terrain.mesh.terrain import MeshTerrain, make_mesh_relief
from optnav_cli.outline.disc.moments import compute_light_moments, compute_sphere_moments, is_round

PHOBOS = load_body("phobos")
MEAN_M = float(np.mean(PHOBOS.radii_m))


def axes_for(up: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """x toward the Sun, y beside it, and the direction to the camera."""
    along = sun - (sun @ up) * up
    along /= np.linalg.norm(along)
    return np.stack([along, np.cross(-up, along), up])


def traced(mesh: MeshRays, axes: np.ndarray, sun: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle of light and second moments of a picture from very far, in mean half axes."""
    side = np.linspace(-1.3, 1.3, 201)
    x, y = np.meshgrid(side, side)
    far = 1e4
    goals = (x[..., None] * axes[0] + y[..., None] * axes[1]).reshape(-1, 3)
    rays = goals - far * axes[2]
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    light, _ = MeshScene(mesh, sun).radiance(far * MEAN_M * axes[2], rays)
    weight = light / light.sum(dtype=np.float64)
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    middle = weight @ places
    away = places - middle
    return middle, (weight[:, None] * away).T @ away


def unit(vector: list[float]) -> np.ndarray:
    return np.array(vector) / np.linalg.norm(vector)


def test_a_sphere_is_a_sphere_and_a_body_nearly_round_is_nearly_one() -> None:
    up, sun = unit([0.3, -0.5, 0.6]), unit([-0.2, -0.7, 0.5])
    phase = float(np.arccos(up @ sun))
    moon = load_body("moon")
    assert is_round(moon)
    assert not is_round(PHOBOS)
    oval = replace(moon, radii_m=(1.012e6, 1.0e6, 1.0e6))
    assert not is_round(oval)
    for body, close in ((moon, 1e-12), (oval, 5e-3)):
        found = compute_light_moments(body, None, axes_for(up, sun), sun, phase)
        for light, sphere in zip(found, compute_sphere_moments(phase), strict=True):
            np.testing.assert_allclose(light.offset, sphere.offset, atol=close)
            np.testing.assert_allclose(light.second, sphere.second, atol=close)


def test_a_full_ellipsoid_is_an_even_ellipse_under_lommel_seeliger() -> None:
    """Its light is even over the outline, whose second moments are a quarter of a^2 and b^2."""
    up = np.array([0.0, 0.0, 1.0])
    light = compute_light_moments(PHOBOS, None, np.eye(3), up, 0.0)[1]
    wanted = 0.25 * np.square(np.array(PHOBOS.radii_m[:2]) / MEAN_M)
    np.testing.assert_allclose(light.offset, 0.0, atol=1e-9)
    np.testing.assert_allclose(light.second, np.diag(wanted), atol=1e-3)


@pytest.mark.parametrize("phase_deg", [20.0, 45.0, 70.0])
def test_an_ellipsoid_s_light_is_that_of_its_picture(phase_deg: float) -> None:
    ball = trimesh.creation.icosphere(5)
    mesh = MeshRays((ball.vertices * np.array(PHOBOS.radii_m))[ball.faces])
    up = unit([0.5, 0.4, -0.7])
    aside = unit(list(np.cross(up, [0.1, 0.9, 0.2])))
    phase = float(np.radians(phase_deg))
    sun = np.cos(phase) * up + np.sin(phase) * aside
    axes = axes_for(up, sun)
    light = compute_light_moments(PHOBOS, None, axes, sun, phase)[0]
    middle, second = traced(mesh, axes, sun)
    np.testing.assert_allclose(light.offset, middle, atol=2e-3)
    np.testing.assert_allclose(light.second, second, atol=2e-3)


def test_phobos_light_is_known_better_from_its_relief_than_from_its_ellipsoid(
    tmp_path: Path,
) -> None:
    """Shadows are left out: a hundredth of the radius in place, some hundredths in width."""
    shape = load_shape(MeshSettings("bundled:phobos_thomas.tab", "km", "west"), Path(), PHOBOS)
    mesh = MeshRays(shape.vertices[shape.faces])
    np.save(tmp_path / "corners.npy", mesh.corners)
    # as coarse as a posting of 1 km asks for
    relief = make_mesh_relief(MeshTerrain(PHOBOS, tmp_path / "corners.npy", "phobos", 1000.0))
    missed: dict[bool, list[float]] = {False: [], True: []}
    for up in (unit([1.0, 0.2, 0.1]), unit([-0.3, 1.0, 0.4]), unit([0.2, -0.3, 1.0])):
        sun = np.cos(0.7) * up + np.sin(0.7) * unit(list(np.cross(up, [0.4, 0.1, 0.8])))
        axes = axes_for(up, sun)
        middle, second = traced(mesh, axes, sun)
        for known in (False, True):
            light = compute_light_moments(PHOBOS, relief if known else None, axes, sun, 0.7)[0]
            widths = np.diag(light.second) / np.diag(second) - 1.0
            missed[known] += [*(light.offset - middle), *(0.5 * widths)]
    rms = {known: float(np.sqrt(np.mean(np.square(m)))) for known, m in missed.items()}
    assert rms[True] < 0.015
    assert rms[False] < 0.07
    assert rms[True] < 0.5 * rms[False]
