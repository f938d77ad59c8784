"""A grid averaged as pixels see it, against pictures that are summed up ray by ray."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.matching.pixel_blur import ASSUMED_PSF_PX, as_seen, sigma_px

SIZE, BORDER = 48, 3
RNG_SEED = 5


def seen_obliquely(per_row, per_col, heights=None, tangent=0.0):
    """Pixels of nodes seen along the rows: higher ground looks farther out."""
    rows, cols = np.mgrid[: SIZE + 2 * BORDER, : SIZE + 2 * BORDER].astype(float)
    rise = np.zeros_like(rows) if heights is None else heights * tangent
    return np.stack([cols * per_col, (rows + rise) * per_row], axis=-1)


def noise(sigma=1.5):
    rng = np.random.default_rng(RNG_SEED)
    return gaussian_filter(rng.standard_normal((SIZE, SIZE)), sigma).astype(np.float32)


def test_over_even_ground_it_is_a_gaussian_as_wide_as_the_blur_is_on_the_ground():
    grid, blur = noise(), 0.75
    found = as_seen(grid, seen_obliquely(0.3, 0.6), blur)
    wanted = gaussian_filter(grid, (blur / 0.3, blur / 0.6))
    inner = slice(11, -11)
    off = np.std((found - wanted)[inner, inner]) / np.std(wanted[inner, inner])
    assert off < 0.05
    assert np.std(grid[inner, inner]) > 1.5 * np.std(wanted[inner, inner])


def test_a_blur_far_below_a_node_changes_nothing():
    grid = noise()
    assert as_seen(grid, seen_obliquely(6.0, 6.0), 0.75) is grid


def test_relief_is_averaged_as_a_picture_of_it_is():
    """Against a picture: every facet's light, by the place where it is seen, under a Gaussian."""
    fine, blur = 8, 0.75
    rng = np.random.default_rng(RNG_SEED)
    size = SIZE + 2 * BORDER
    heights = gaussian_filter(rng.standard_normal((size, size)), 2.0)
    heights *= 0.15 / np.std(np.gradient(heights, axis=0))  # 8.5 deg, one node a metre
    pixels = seen_obliquely(0.35, 0.7, heights, 1.5)
    bright = (1.0 + np.gradient(heights, axis=0) + np.gradient(heights, axis=1)).astype(np.float32)
    inside = slice(BORDER, -BORDER)
    found = as_seen(np.ascontiguousarray(bright[inside, inside]), pixels, blur)
    # between the nodes, linearly
    at = np.linspace(0.0, size - 1.0, (size - 1) * fine + 1)
    low = np.minimum(at.astype(int), size - 2)
    part = at - low

    def between(grid):
        down = grid[low] + part.reshape(-1, *[1] * (grid.ndim - 1)) * (grid[low + 1] - grid[low])
        step = part.reshape(1, -1, *[1] * (grid.ndim - 2))
        return down[:, low] + step * (down[:, low + 1] - down[:, low])

    places, light = between(pixels), between(bright.astype(float))
    down, along = np.gradient(places, axis=0), np.gradient(places, axis=1)
    area = np.abs(down[..., 0] * along[..., 1] - down[..., 1] * along[..., 0])
    for row, col in ((20, 20), (24, 30), (31, 17), (27, 27)):
        away = ((places - pixels[row, col]) ** 2).sum(axis=-1)
        weight = np.exp(-0.5 * away / blur**2) * area
        wanted = (weight * light).sum() / weight.sum()
        spread = float(np.std(bright[inside, inside]))
        assert found[row - BORDER, col - BORDER] == pytest.approx(wanted, abs=0.04 * spread)


def test_ground_turned_from_the_camera_takes_no_part():
    heights = np.zeros((SIZE + 2 * BORDER,) * 2)
    heights[24:30] = np.array([0.0, 2.0, 4.0, 4.0, 2.0, 0.0])[:, None]  # a ridge, one node a metre
    pixels = seen_obliquely(0.5, 0.5, heights, 1.5)
    grid = np.ones((SIZE, SIZE), np.float32)
    dark = slice(28 - BORDER, 29 - BORDER)
    grid[dark] = 0.0  # the middle of its far side
    found = as_seen(grid, pixels, 0.75)
    np.testing.assert_allclose(found[:, 12:-12], 1.0, atol=1e-6)


def test_holes_stay_and_spread_nowhere():
    grid = np.full((SIZE, SIZE), 2.0, np.float32)
    grid[20:23, 20:26] = np.nan
    found = as_seen(grid, seen_obliquely(0.4, 0.5), 0.75)
    assert np.array_equal(np.isnan(found), np.isnan(grid))
    np.testing.assert_allclose(found[np.isfinite(found)], 2.0, rtol=1e-6)


def test_nodes_out_of_the_camera_s_view_are_left_as_they_are():
    grid, pixels = noise(), seen_obliquely(0.4, 0.5)
    pixels[: BORDER + 10] = np.nan
    found = as_seen(grid, pixels, 0.75)
    np.testing.assert_array_equal(found[:8], grid[:8])
    assert np.isfinite(found).all()


def test_the_blur_is_that_of_lens_and_pixels():
    camera = preset_camera("shnk")
    assert sigma_px(camera) == pytest.approx(np.hypot(0.7, np.sqrt(1.0 / 12.0)))
    unknown = replace(camera, psf_sigma_px=None, psf_error_px=None)
    assert sigma_px(unknown) == pytest.approx(np.hypot(ASSUMED_PSF_PX, np.sqrt(1.0 / 12.0)))
