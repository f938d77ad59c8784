"""Sampling a picture at places between and beyond its pixels, at several resolutions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from optnav_cli.matching.picture_pyramid import PicturePyramid


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
