"""Ray casting against spheres, planes and a march in steps too small to miss anything."""

import math

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from catalog.geometry.projection import Stereographic
from catalog.geometry.sphere import distance_to_sphere
from catalog.terrain.raycast import cast_rays, node_points, sees

MOON_M = 1_737_400.0


def bumps(size, seed, scale):
    rng = np.random.default_rng(seed)
    spectrum = np.fft.rfft2(rng.normal(size=(size, size)))
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)) + 1 / size
    field = np.fft.irfft2(spectrum / frequency**2)
    return (field / field.std() * scale).astype(np.float32)


def test_rays_meet_a_bare_sphere_where_geometry_says():
    rng = np.random.default_rng(5)
    radius = 50e3
    origins = rng.uniform(-3e3, 3e3, (200, 3)) + [0.0, 0.0, 8e3]
    directions = rng.normal(size=(200, 3)) * 0.3 + [0.0, 0.0, -1.0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    got = cast_rays(np.zeros((401, 401), np.float32), 50.0, origins, directions, radius)
    for origin, direction, distance in zip(origins, directions, got, strict=True):
        expected = distance_to_sphere(origin + [0.0, 0.0, radius], direction, radius)
        # a bilinear cell between nodes of a sphere sags by posting^2 / 8R, here 6 mm (twice: x, y)
        if not math.isnan(distance):
            assert distance == pytest.approx(float(expected), abs=0.05)
    assert np.isfinite(got).sum() > 150


def test_hits_agree_with_a_march_in_small_steps():
    heights = bumps(64, seed=6, scale=300.0)
    posting = 100.0
    rng = np.random.default_rng(7)
    origins = rng.uniform(-2e3, 2e3, (60, 3))
    origins[:, 2] = heights.max() + 100.0
    directions = rng.normal(size=(60, 3)) + [0.0, 0.0, -0.8]
    directions[:, 2] = -np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    got = cast_rays(heights, posting, origins, directions, MOON_M)
    place = Stereographic(0.0, 0.0, MOON_M)
    steps = np.arange(0.0, 14e3, 0.5)
    hits = 0
    for origin, direction, distance in zip(origins, directions, got, strict=True):
        points = origin + steps[:, None] * direction + [0.0, 0.0, MOON_M]
        x, y = place.xy_from_xyz(points @ place.body_from_local.T)
        ground = map_coordinates(
            heights.astype(float), [31.5 - y / posting, x / posting + 31.5], order=1, cval=np.nan
        )
        under = np.linalg.norm(points, axis=1) - MOON_M < ground
        if under.any():
            hits += 1
            assert distance == pytest.approx(steps[np.argmax(under)], abs=0.6)
        else:
            assert math.isnan(distance)
    assert hits > 20


def test_nodes_stand_where_the_projection_puts_them():
    heights = bumps(16, seed=8, scale=200.0)
    place = Stereographic(-0.7, 2.0, MOON_M)
    offsets = (np.arange(16) - 7.5) * 500.0
    x, y = np.meshgrid(offsets, -offsets)
    expected = place.points(x, y, heights.astype(np.float64)) @ place.body_from_local - [
        0.0,
        0.0,
        MOON_M,
    ]
    np.testing.assert_allclose(node_points(heights, 500.0, MOON_M), expected, atol=1e-6)


def test_flat_ground_sees_the_sun_and_a_pit_does_not():
    heights = np.zeros((41, 41), np.float32)
    heights[18:23, 18:23] = -400.0
    seen = sees(heights, 100.0, [0.0, -1.0, 0.3], MOON_M)
    assert seen[5, 5]
    assert seen[23:, :].all()
    assert not seen[20, 20]


def test_rays_that_look_away_meet_nothing():
    heights = np.zeros((9, 9), np.float32)
    assert np.isnan(cast_rays(heights, 100.0, [[0, 0, 50.0]], [[0, 0, 1.0]], MOON_M)).all()
    assert cast_rays(heights, 100.0, [[0, 0, 50.0]], [[0, 0, -2.0]], MOON_M)[0] == pytest.approx(
        50, abs=2e-3
    )
    with pytest.raises(ValueError, match="no length"):
        cast_rays(heights, 100.0, [[0, 0, 1.0]], [[0, 0, 0.0]], MOON_M)
