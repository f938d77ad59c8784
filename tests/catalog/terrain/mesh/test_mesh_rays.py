"""Rays meet a mesh where 64-bit arithmetic over all triangles says."""

import numpy as np
import pytest

from catalog.terrain.mesh.rays import MeshRays, intersect_all
from catalog.terrain.mesh.shape import count_turns


@pytest.fixture(scope="module")
def rays(phobos_shape) -> MeshRays:
    return MeshRays(phobos_shape.vertices[phobos_shape.faces])


def some_rays(count: int, distance_m: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return rng.uniform(-12e3, 12e3, (count, 3)) - distance_m * directions, directions


@pytest.mark.parametrize("distance_m", [4e4, 1e6, 2e9])
def test_first_hits_are_those_of_all_triangles_tried(rays, distance_m) -> None:
    origins, directions = some_rays(1500, distance_m)
    face, distance = rays.find_first_hits(origins, directions)
    tried = [
        intersect_all(rays.corners, o, d, 0.0) for o, d in zip(origins, directions, strict=True)
    ]
    exact = np.array([at for _, at in tried])
    met = face >= 0
    assert met.sum() > 500
    assert (met == np.isfinite(exact)).all()
    # 64 bits of 2e9 m end at 5e-7 m, and a ray that grazes a face has 20 times that
    assert np.abs(distance[met] - exact[met]).max() < 1e-6 + 1e-14 * distance_m


def test_rays_at_vertices_do_not_slip_through(rays, phobos_shape) -> None:
    """Where six triangles meet 32 bits are at their worst; the seam's walls lie along the rays."""
    vertices = phobos_shape.vertices
    radii = np.linalg.norm(vertices, axis=1)
    face, distance = rays.find_first_hits(3.0 * vertices, -vertices / radii[:, None])
    off = np.abs(distance - 2.0 * radii)
    assert (face >= 0).all()
    assert off.max() < 23.0  # the step of the model's own seam
    assert np.sort(off)[-30] < 1e-6


def test_a_ray_that_slips_in_is_traced_again(rays, monkeypatch) -> None:
    origin, direction = np.array([[4e4, 10.0, 20.0]]), np.array([[-1.0, 0.0, 0.0]])
    face, distance = rays.find_first_hits(origin, direction)
    far, _ = rays.find_next_hits(origin, direction, distance + 1.0)
    monkeypatch.setattr(rays, "_run", lambda *_: far)
    again, at = rays.find_first_hits(origin, direction)
    assert (again, at) == (face, pytest.approx(distance, abs=1e-9))


def test_the_far_side_is_met_next_and_nothing_after_it(rays) -> None:
    origin, direction = np.array([[0.0, 0.0, 5e4]]), np.array([[0.0, 0.0, -1.0]])
    _, first = rays.find_first_hits(origin, direction)
    face, second = rays.find_next_hits(origin, direction, first + 1.0)
    assert 5e4 - second[0] == pytest.approx(-8372.6, abs=0.1)  # the table's south pole
    assert face[0] >= 0
    assert rays.find_next_hits(origin, direction, second + 1.0)[0] == [-1]


def test_a_body_hides_the_sun_from_its_far_side(rays, phobos_shape) -> None:
    sun = np.array([1.0, 0.0, 0.0])
    outward = phobos_shape.vertices * 1.0001
    away = outward[:, 0] < -0.7 * np.linalg.norm(outward, axis=1)
    assert rays.are_blocked(outward[away], sun).all()
    clear = np.array([[2e4, 0.0, 0.0], [-2e4, 2e4, 0.0]])
    assert not rays.are_blocked(clear, sun).any()


def test_the_surface_goes_once_round_what_it_holds(phobos_shape) -> None:
    vertices, faces = phobos_shape.vertices, phobos_shape.faces
    inside, outside = np.array([3e3, -2e3, 1e3]), np.array([0.0, 2e4, 0.0])
    assert count_turns(inside, vertices, faces) == pytest.approx(1.0, abs=1e-9)
    assert count_turns(outside, vertices, faces) == pytest.approx(0.0, abs=1e-9)
