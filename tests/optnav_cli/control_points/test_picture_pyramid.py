"""Sampling a picture at several resolutions; a grid averaged as pixels see it, against rays."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.control_points.picture_pyramid import (
    ASSUMED_PSF_PX,
    PicturePyramid,
    average_as_seen,
    get_blur_px,
)

SIZE, BORDER = 48, 3
RNG_SEED = 5


def ramp(height=120, width=160):
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return (x + 1000.0 * y).astype(np.float32)


@pytest.mark.parametrize("pixels_per_node", [0.2, 1.0, 1.9, 2.0, 3.0, 4.4, 8.0])
def test_a_ramp_gives_the_coordinate_back_at_every_resolution(pixels_per_node):
    rng = np.random.default_rng(1)
    places = rng.uniform([24.0, 24.0], [130.0, 90.0], (300, 2))
    pyramid = PicturePyramid(ramp())
    sampled = pyramid.sample(places, pixels_per_node)
    # cv2.remap steps in 1/32 of a block; a step in y is worth 1000
    step = max(1.0, pixels_per_node) / 32.0
    assert_allclose(sampled, places[:, 0] + 1000.0 * places[:, 1], atol=1001.0 * step)
    columns = PicturePyramid(ramp() % 1000.0).sample(places, pixels_per_node)
    assert_allclose(columns, places[:, 0], atol=step)
    # nothing is shifted on the whole
    assert abs(np.mean(columns - places[:, 0])) < 0.1 * step


def test_pixel_centres_give_the_pixels_themselves():
    picture = np.random.default_rng(2).uniform(0, 255, (40, 50)).astype(np.float32)
    x, y = np.meshgrid(np.arange(50.0), np.arange(40.0))
    sampled = PicturePyramid(picture).sample(np.stack([x, y], axis=-1), 1.0)
    assert_allclose(sampled, picture, atol=1e-3)


def test_a_coarse_node_takes_the_mean_over_its_footprint():
    """White noise over blocks of 6 x 6 pixels keeps a sixth of its scatter, not all of it."""
    picture = np.random.default_rng(3).normal(size=(600, 600)).astype(np.float32)
    places = np.stack(np.meshgrid(np.arange(50, 550, 6.0), np.arange(50, 550, 6.0)), axis=-1) - 0.5
    assert PicturePyramid(picture).sample(places, 6.0).std() < 0.3
    assert PicturePyramid(picture).sample(places, 1.0).std() > 0.5


@pytest.mark.parametrize("pixels_per_node", [1.0, 5.0])
def test_outside_the_picture_there_is_nothing(pixels_per_node):
    pyramid = PicturePyramid(np.full((120, 160), 7.0, dtype=np.float32))
    edge = [[-0.51, 5.0], [5.0, -0.51], [159.51, 5.0], [5.0, 119.51], [np.nan, 5.0], [1e9, 5.0]]
    assert np.isnan(pyramid.sample(np.array(edge), pixels_per_node)).all()
    inside = [[-0.5, -0.5], [159.5, 119.5], [0.0, 119.0]]
    assert_allclose(pyramid.sample(np.array(inside), pixels_per_node), 7.0, rtol=1e-5)


def test_a_pixel_without_a_value_has_none_and_its_far_neighbours_keep_theirs():
    picture = ramp()
    picture[60, 80] = np.nan
    sampled = PicturePyramid(picture).sample(np.array([[80.0, 60.0], [90.0, 60.0]]), 1.0)
    assert np.isnan(sampled[0])
    assert sampled[1] == pytest.approx(90.0 + 60000.0, rel=1e-6)


def test_a_picture_smaller_than_the_asked_blocks_still_answers():
    tiny = PicturePyramid(np.full((9, 12), 3.0, dtype=np.float32))
    assert tiny.sample(np.array([[5.0, 4.0]]), 50.0)[0] == pytest.approx(3.0)


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
    found = average_as_seen(grid, seen_obliquely(0.3, 0.6), blur)
    wanted = gaussian_filter(grid, (blur / 0.3, blur / 0.6))
    inner = slice(11, -11)
    off = np.std((found - wanted)[inner, inner]) / np.std(wanted[inner, inner])
    assert off < 0.05
    assert np.std(grid[inner, inner]) > 1.5 * np.std(wanted[inner, inner])


def test_a_blur_far_below_a_node_changes_nothing():
    grid = noise()
    assert average_as_seen(grid, seen_obliquely(6.0, 6.0), 0.75) is grid


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
    found = average_as_seen(np.ascontiguousarray(bright[inside, inside]), pixels, blur)
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
    found = average_as_seen(grid, pixels, 0.75)
    np.testing.assert_allclose(found[:, 12:-12], 1.0, atol=1e-6)


def test_holes_stay_and_spread_nowhere():
    grid = np.full((SIZE, SIZE), 2.0, np.float32)
    grid[20:23, 20:26] = np.nan
    found = average_as_seen(grid, seen_obliquely(0.4, 0.5), 0.75)
    assert np.array_equal(np.isnan(found), np.isnan(grid))
    np.testing.assert_allclose(found[np.isfinite(found)], 2.0, rtol=1e-6)


def test_nodes_out_of_the_camera_s_view_are_left_as_they_are():
    grid, pixels = noise(), seen_obliquely(0.4, 0.5)
    pixels[: BORDER + 10] = np.nan
    found = average_as_seen(grid, pixels, 0.75)
    np.testing.assert_array_equal(found[:8], grid[:8])
    assert np.isfinite(found).all()


def test_the_blur_is_that_of_lens_and_pixels():
    camera = preset_camera("shnk")
    assert get_blur_px(camera) == pytest.approx(np.hypot(0.7, np.sqrt(1.0 / 12.0)))
    unknown = replace(camera, psf_sigma_px=None, psf_error_px=None)
    assert get_blur_px(unknown) == pytest.approx(np.hypot(ASSUMED_PSF_PX, np.sqrt(1.0 / 12.0)))


def test_areas_of_full_pixels_and_those_without_a_value_show_nothing():
    """A clipped area has no pattern to compare; a single full pixel is one like others."""
    rng = np.random.default_rng(2)
    picture = rng.uniform(10.0, 200.0, (60, 60)).astype(np.float32)
    picture[20:32, 30:50], picture[5, 5], picture[50, :] = 255.0, 255.0, np.nan
    rows, cols = np.mgrid[:60, :60].astype(float)
    pixels = np.stack([cols, rows], axis=-1)
    plain = PicturePyramid(picture).sample(pixels, 1.0)
    marked = PicturePyramid(picture, 255.0).sample(pixels, 1.0)
    assert np.isfinite(plain[22:30, 32:48]).all()
    assert np.isnan(marked[20:32, 30:50]).all()
    assert np.isfinite(marked[3:8, 3:8]).all()
    assert np.isnan(marked[50]).all()
    same = np.isfinite(marked)
    np.testing.assert_array_equal(marked[same], plain[same])
