"""Skylines against bodies whose limb is known, and against sampling everything."""

import numpy as np
import pytest

from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.skyline.limb import LimbRelief, make_nadir_axes

RADIUS = 1737400.0
AZIMUTHS = np.linspace(0.0, 2.0 * np.pi, 90, endpoint=False)


def relief_of(heights, max_heights=None, radius=RADIUS):
    heights = np.asarray(heights, np.float32)
    return GlobalRelief(heights, heights if max_heights is None else max_heights, radius, "made up")


def grid(rows):
    """Unit directions (rows, 2 rows, 3) of the middles of the cells."""
    lat = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    lon = np.pi * ((np.arange(2 * rows) + 0.5) / rows - 1.0)[None, :]
    return np.stack(
        np.broadcast_arrays(np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)), -1
    )


def rough(rows, seed=1):
    """Hills of kilometres on several scales."""
    rng = np.random.default_rng(seed)
    directions, heights = grid(rows), np.zeros((rows, 2 * rows))
    for wave in (4.0, 15.0, 60.0, 150.0):
        for _ in range(4):
            axis = rng.normal(size=3)
            axis /= np.linalg.norm(axis)
            heights += 6000.0 / wave**0.6 * np.sin(wave * directions @ axis + rng.uniform(0.0, 6.0))
    return heights


def place(height, seed=3):
    direction = np.random.default_rng(seed).normal(size=3)
    return (RADIUS + height) * direction / np.linalg.norm(direction)


@pytest.mark.parametrize("height", [3e3, 5e4, 1e6, 1e8])
@pytest.mark.parametrize("level", [-2000.0, 0.0, 5000.0])
def test_an_even_sphere_has_its_tangent_cone_as_skyline(height, level):
    position = place(height + max(level, 0.0))
    ground = LimbRelief(relief_of(np.full((180, 360), level)), 0.0)
    line = ground.skyline(position, make_nadir_axes(position), AZIMUTHS)
    distance = np.linalg.norm(position)
    # within the finest step of the search a sphere falls by less than 2 m
    size = distance * np.sin(line.off_nadir)
    assert size == pytest.approx(np.full(len(AZIMUTHS), RADIUS + level), abs=2.0)


def test_an_ellipsoid_written_as_relief_has_the_ellipsoids_limb():
    """The tangent cone of a quadric: (d.A.p)^2 = (d.A.d) (p.A.p - 1) for rays d from p."""
    radii = np.array([13000.0, 11400.0, 9100.0])
    quadric = np.diag(1.0 / radii**2)
    directions = grid(720)
    surface = 1.0 / np.sqrt(np.einsum("...i,ij,...j", directions, quadric, directions))
    ground = LimbRelief(relief_of(surface - 11000.0, radius=11000.0), 0.0)
    position = np.array([9000.0, -14000.0, 12000.0])
    axes = make_nadir_axes(position)
    line = ground.skyline(position, axes, AZIMUTHS)
    across = np.cos(AZIMUTHS)[:, None] * axes[0] + np.sin(AZIMUTHS)[:, None] * axes[1]
    rays = np.sin(line.off_nadir)[:, None] * across - np.cos(line.off_nadir)[:, None] * axes[2]
    inner = np.einsum("ni,ij,j->n", rays, quadric, position)
    closest = position - inner[:, None] / np.einsum("ni,ij,nj->n", rays, quadric, rays)[:, None] * (
        rays
    )
    level = np.einsum("ni,ij,nj->n", closest, quadric, closest)
    # where the ray passes closest it is on the surface, to some metres of the bilinear cells
    assert np.sqrt(level) == pytest.approx(np.ones(len(AZIMUTHS)), abs=3e-4)


@pytest.mark.parametrize("height", [2e4, 1e5, 8e5, 2e7])
def test_no_sample_of_the_ground_stands_above_the_skyline(height):
    """The jumps over ground that cannot matter leave nothing out: poles and +-180 deg included."""
    relief = relief_of(rough(360))
    ground = LimbRelief(relief, 0.0)
    for position in (place(height), np.array([0.02, 0.01, 1.0]) * (RADIUS + height)):
        axes = make_nadir_axes(position)
        distance = np.linalg.norm(position)
        line = ground.skyline(position, axes, AZIMUTHS)
        limb = np.arccos(RADIUS / distance)
        angles = np.linspace(max(limb - 0.3, 1e-4), min(limb + 0.3, np.pi - 1e-4), 3000)
        across = np.cos(AZIMUTHS)[:, None] * axes[0] + np.sin(AZIMUTHS)[:, None] * axes[1]
        points = (
            np.cos(angles)[None, :, None] * axes[2]
            + np.sin(angles)[None, :, None] * across[:, None, :]
        )
        lat, lon = np.arcsin(points[..., 2]), np.arctan2(points[..., 1], points[..., 0])
        radius = RADIUS + relief.heights_at(lat, lon)
        seen = np.arctan2(radius * np.sin(angles), distance - radius * np.cos(angles)).max(axis=1)
        away = distance * np.cos(limb)
        below = (line.off_nadir - seen) * max(away, 3e5)
        assert below.min() > -15.0  # m: two searches with different steps over hills of km
        assert below.max() < 60.0


@pytest.mark.parametrize("height", [2e4, 2e7])
def test_a_crest_is_the_same_whichever_azimuth_was_searched_before(height):
    ground, position = LimbRelief(relief_of(rough(360)), 0.0), place(height)
    axes = make_nadir_axes(position)
    together = ground.skyline(position, axes, AZIMUTHS)
    alone = [ground.skyline(position, axes, AZIMUTHS[k : k + 1]) for k in range(len(AZIMUTHS))]
    for name in ("off_nadir", "range", "radius_m"):
        each = [getattr(line, name)[0] for line in alone]
        assert getattr(together, name).tolist() == each


def test_tops_raise_the_skyline_by_their_share():
    heights = np.full((180, 360), 100.0, np.float32)
    position = place(1e5)
    axes = make_nadir_axes(position)
    relief = relief_of(heights, heights + np.float32(300.0))
    line = LimbRelief(relief, 0.5).skyline(position, axes, AZIMUTHS)
    size = np.linalg.norm(position) * np.sin(line.off_nadir)
    assert size == pytest.approx(np.full(len(AZIMUTHS), RADIUS + 250.0), abs=2.0)


def test_a_wall_shades_what_lies_behind_it():
    heights = np.zeros((720, 1440), np.float32)
    heights[:, 760:764] = 4000.0  # a wall along the meridian of 10.5 deg E
    ground = LimbRelief(relief_of(heights), 0.0)
    lon = np.radians([9.5, 11.5, 14.0])
    points = (RADIUS + 20.0) * np.stack([np.cos(lon), np.sin(lon), np.zeros(3)], axis=1)
    # the Sun 5 deg high in the west of 11.5 deg E; the wall is 23 km away and 9.5 deg high
    west = np.radians(11.5 - 85.0)
    sun = np.array([np.cos(west), np.sin(west), 0.0])
    assert ground.mark_sunlit(points, sun).tolist() == [True, False, True]
    assert ground.mark_sunlit(points, np.array([1.0, 0.2, 0.1])).all()
    assert not ground.mark_sunlit(points, -points[0]).any()


def test_axes_are_a_right_handed_frame_with_the_position_up():
    for position in np.vstack([np.eye(3), -np.eye(3), [[3.0, -2.0, 1.0]]]):
        axes = make_nadir_axes(position)
        assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-14)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        assert axes[2] == pytest.approx(position / np.linalg.norm(position))
