"""Rays against a sphere: by stepping along them, and where digits are scarce."""

import numpy as np
from numpy.testing import assert_allclose

from catalog.geometry.ellipsoid import distance_to_sphere

RADIUS = 1.7


def first_crossing(origin, direction, radius):
    """Distance by a fine walk and bisection; None for a miss."""
    steps = np.linspace(0.0, 12.0, 24001)
    inside = np.linalg.norm(origin + steps[:, None] * direction, axis=1) < radius
    if not inside.any():
        return None
    k = int(np.argmax(inside))
    low, high = steps[k - 1], steps[k]
    for _ in range(50):
        middle = (low + high) / 2.0
        if np.linalg.norm(origin + middle * direction) < radius:
            high = middle
        else:
            low = middle
    return high


def test_crossings_and_misses_agree_with_a_walk_along_the_ray():
    rng = np.random.default_rng(17)
    origin = np.array([3.0, -1.0, 2.0])
    directions = rng.normal(size=(60, 3)) - 0.7 * origin
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = distance_to_sphere(origin, directions, RADIUS)
    wanted = [first_crossing(origin, d, RADIUS) for d in directions]
    assert sum(w is None for w in wanted) > 5
    assert sum(w is not None for w in wanted) > 20
    for got, want in zip(found, wanted, strict=True):
        if want is None:
            assert np.isnan(got)
        else:
            assert abs(got - want) < 1e-9


def test_a_sphere_behind_the_origin_is_a_miss():
    assert np.isnan(distance_to_sphere([3.0, 0, 0], np.array([1.0, 0, 0]), RADIUS))


def test_ten_metres_above_the_moon_the_distance_keeps_its_millimetres():
    origin = [0.0, 0.0, 1737400.0 + 10.0]
    assert_allclose(distance_to_sphere(origin, np.array([0, 0, -1.0]), 1737400.0), 10.0, atol=1e-6)


def test_a_ray_that_grazes_touches_where_the_tangent_does():
    angle = np.arcsin(RADIUS / 5.0) - 1e-9
    graze = distance_to_sphere([5.0, 0, 0], np.array([-np.cos(angle), np.sin(angle), 0]), RADIUS)
    assert_allclose(graze, np.sqrt(25.0 - RADIUS**2), atol=1e-3)


def test_the_shape_of_the_directions_is_kept():
    rays = np.broadcast_to([-1.0, 0.0, 0.0], (4, 5, 3))
    assert distance_to_sphere([3.0, 0, 0], rays, RADIUS).shape == (4, 5)
