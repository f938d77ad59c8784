"""Pictures of meshes against spheres known in closed form and triangles tried one by one."""

import manifold3d
import numpy as np
import pytest
import trimesh

from catalog.photometry.hapke import reflectance_scalar
from catalog.photometry.sets import LUNAR
from catalog.rendering.mesh_scene import MeshScene
from catalog.terrain.mesh.rays import MeshRays, intersect_all

RADIUS_M = 5000.0


@pytest.fixture(scope="module")
def ball() -> MeshRays:
    mesh = trimesh.creation.icosphere(subdivisions=6, radius=RADIUS_M)
    return MeshRays(np.asarray(mesh.triangles))


@pytest.fixture(scope="module")
def binary() -> MeshRays:
    """Two balls that touch, as one closed surface: a contact binary about its neck."""
    ball = manifold3d.Manifold.sphere(1.0, 128)
    both = ball.translate([0.9, 0.0, 0.0]) + ball.scale([0.6] * 3).translate([-0.6, 0.0, 0.0])
    mesh = both.to_mesh64()
    return MeshRays(np.asarray(mesh.vert_properties)[np.asarray(mesh.tri_verts)] * 1000.0)


def corner_rays(position: np.ndarray, half: float, pixels: int) -> np.ndarray:
    """Rays of a pinhole camera that looks at the origin, z of the body up."""
    ahead = -position / np.linalg.norm(position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    offsets = np.linspace(-half, half, pixels + 1)
    x, y = np.meshgrid(offsets, offsets)
    rays = ahead + x[..., None] * right - y[..., None] * np.cross(right, ahead)
    return rays / np.linalg.norm(rays, axis=2)[..., None]


def sphere_radiance(position: np.ndarray, rays: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Hapke's radiance factor of the ball along rays (n, 3), in closed form."""
    along = rays @ position
    inside = along**2 - position @ position + RADIUS_M**2
    out = np.zeros(len(rays))
    for n in np.flatnonzero(inside > 0.0):
        up = (position + (-along[n] - np.sqrt(inside[n])) * rays[n]) / RADIUS_M
        out[n] = reflectance_scalar(up @ sun, -up @ rays[n], -rays[n] @ sun, LUNAR)
    return out


@pytest.mark.parametrize("distance_m", [2e4, 1e8])
def test_a_ball_shines_as_in_closed_form(ball, distance_m) -> None:
    """Facets of 80 m stand 0.8 % of a radian from the sphere: so much of the slope of the law."""
    sun = np.array([0.8, 0.6, 0.0])
    position = np.array([distance_m, 0.0, 0.0])
    corners = corner_rays(position, 1.1 * RADIUS_M / distance_m, 64)
    middles = corners[:-1, :-1] + corners[1:, 1:] + corners[:-1, 1:] + corners[1:, :-1]
    rays = (middles / np.linalg.norm(middles, axis=2)[..., None]).reshape(-1, 3)
    found, faces = MeshScene(ball, sun).radiance(position, rays)
    wanted = sphere_radiance(position, rays, sun)
    assert ((faces >= 0) != (np.linalg.norm(np.cross(position, rays), axis=1) < RADIUS_M)).sum() < 9
    assert np.abs(found - wanted).mean() < 0.004 * wanted.max()
    assert found[wanted == 0.0].max() < 0.03 * wanted.max()  # facets beside limb and terminator


def test_pictures_of_a_ball_hold_its_light_to_a_thousandth(ball) -> None:
    """Where the limb crosses pixels they are averaged: the whole disc is as bright as it is."""
    sun, position = np.array([1.0, 0.0, 0.0]), np.array([1e6, 0.0, 0.0])
    half = 1.1 * RADIUS_M / 1e6
    total = MeshScene(ball, sun).picture(position, corner_rays(position, half, 40)).sum()
    fine = MeshScene(ball, sun).picture(position, corner_rays(position, half, 400)).sum() / 100.0
    assert total == pytest.approx(fine, rel=1e-3)


def test_shadows_are_those_of_all_triangles_tried(binary) -> None:
    sun = np.array([-1.0, 0.2, 0.1]) / np.linalg.norm([-1.0, 0.2, 0.1])
    position = np.array([-2e3, 7e3, 1e3])
    corners = corner_rays(position, 0.25, 50)
    rays = corners[:-1, :-1].reshape(-1, 3)
    scene = MeshScene(binary, sun)
    found, faces = scene.radiance(position, rays)
    _, distances = binary.find_first_hits(position, rays)
    normals = np.cross(*(binary.corners[:, k] - binary.corners[:, 0] for k in (1, 2)))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    shaded = differing = 0
    for n in np.flatnonzero(faces >= 0):
        up = normals[faces[n]]
        place = position + distances[n] * rays[n] + 0.02 * up
        blocked = intersect_all(binary.corners, place, sun, 0.0)[0] >= 0
        shaded += blocked and up @ sun > 0.0
        differing += (found[n] > 0.0) != (up @ sun > 0.0 and up @ rays[n] < 0.0 and not blocked)
    assert shaded > 20  # the small ball darkens the neck and the large one
    assert differing == 0


def test_the_small_ball_throws_its_round_shadow_on_the_large_one(binary) -> None:
    sun = np.array([-1.0, 0.0, 0.0])
    position = np.array([-8e3, 0.0, 0.0])  # along the Sun: the shadow hides behind the ball itself
    picture = MeshScene(binary, sun).picture(position, corner_rays(position, 0.2, 64), samples=1)
    assert (picture > 0.0).sum() / 64**2 == pytest.approx(
        np.pi * (1.0 / (2 * 0.2 * np.sqrt(8.9**2 - 1.0))) ** 2, rel=0.03
    )
    aside = np.array([-8e3, 5e3, 0.0])
    turned = MeshScene(binary, sun).picture(aside, corner_rays(aside, 0.2, 64), samples=1)
    dark = MeshScene(binary, [1.0, 0.0, 0.0]).picture(aside, corner_rays(aside, 0.2, 64), samples=1)
    assert not ((turned > 0.0) & (dark > 0.0)).any()  # what one Sun lights the other cannot


def test_a_camera_that_sees_nothing_there_sees_sky(ball) -> None:
    position = np.array([2e4, 0.0, 0.0])
    corners = corner_rays(position, 0.2, 16)
    corners[:4] = np.nan
    picture = MeshScene(ball, [1.0, 0.0, 0.0]).picture(position, corners)
    assert (picture[:4] == 0.0).all()
    assert (picture[8] > 0.0).any()
    away = MeshScene(ball, [1.0, 0.0, 0.0]).picture(position, -corner_rays(position, 0.2, 16))
    assert (away == 0.0).all()
