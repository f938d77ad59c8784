"""Margins of one value: ragged ones, lost lines, straight ones; and skies that are none."""

import cv2
import numpy as np
import pytest

from optnav_cli.frames.picture import find_margins

SIDE = 300


def disc(noise: float, sky: float, centre=(150.0, 150.0), radius=90.0, blur=1.0) -> np.ndarray:
    """Counts of a Lambert sphere at phase 60 deg, 8 bits, over a sky with noise."""
    rng = np.random.default_rng(6)
    y, x = np.indices((SIDE, SIDE), float)
    u, v = (x - centre[0]) / radius, (y - centre[1]) / radius
    w = np.sqrt(np.maximum(1.0 - u**2 - v**2, 0.0))
    light = np.where(w > 0.0, np.maximum(0.87 * u + 0.5 * w, 0.0), 0.0)
    counts = sky + 200.0 * cv2.GaussianBlur(light, (0, 0), blur) + rng.normal(0.0, noise, x.shape)
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8)


def ragged() -> np.ndarray:
    """A margin as vidicon pictures have it, after their geometry was corrected."""
    y, x = np.indices((SIDE, SIDE))
    edge = 12.0 + 5.0 * np.sin(x / 40.0)
    return (y < edge) | (x < 10.0 + y / 30.0) | (x > SIDE - 14)


@pytest.mark.parametrize("centre", [(150.0, 150.0), (40.0, 150.0), (290.0, 20.0)])
def test_ragged_margins_are_found_to_the_pixel_or_two(centre: tuple[float, float]) -> None:
    picture = disc(1.5, 9.0, centre)
    picture[ragged()] = 0
    found = find_margins(picture, None)
    assert found is not None
    assert not (found & ~ragged()).any()
    assert (ragged() & ~found).sum() < 0.02 * ragged().sum()


def test_blocks_of_lost_lines_are_found() -> None:
    picture = disc(1.5, 9.0)
    picture[200:203, 60:] = 0
    picture[220:232] = 0
    picture[100:140, 120:180] = 0
    lost = picture == 0
    found = find_margins(picture, None)
    assert found is not None
    np.testing.assert_array_equal(found, lost)


@pytest.mark.parametrize("value", [0, 4])
def test_a_straight_margin_of_ground_that_fills_the_picture_is_found(value: int) -> None:
    rng = np.random.default_rng(1)
    ground = rng.normal(0.0, 1.0, (SIDE, SIDE))
    picture = np.rint(130.0 + 60.0 * cv2.GaussianBlur(ground, (0, 0), 4.0)).astype(np.uint16)
    picture[:, :9] = picture[-3:] = value
    found = find_margins(picture, None)
    assert found is not None
    np.testing.assert_array_equal(found, picture == value)


@pytest.mark.parametrize(
    ("noise", "sky"), [(0.0, 0.0), (0.0, 7.0), (0.3, 0.0), (1.0, 0.0), (1.5, 9.0)]
)
@pytest.mark.parametrize("centre", [(150.0, 150.0), (40.0, 150.0), (150.0, 400.0)])
@pytest.mark.parametrize("radius", [20.0, 90.0, 280.0])
def test_skies_without_noise_are_no_margins(
    noise: float, sky: float, centre: tuple[float, float], radius: float
) -> None:
    """Night sides of one value, and ground that the frame cuts, neither."""
    assert find_margins(disc(noise, sky, centre, radius), None) is None


def test_ground_at_full_scale_that_the_frame_cuts_is_no_margin() -> None:
    picture = disc(1.5, 9.0, (40.0, 150.0))
    full = np.minimum(picture.astype(int) * 4, 255).astype(np.uint8)
    full[:, :30] = 255
    assert find_margins(full, None) is None


def test_pixels_that_have_no_value_anyway_are_passed_over() -> None:
    picture = disc(1.5, 9.0)
    picture[ragged()] = 0
    assert find_margins(picture, ragged()) is None
    assert find_margins(picture, np.ones(picture.shape, bool)) is None
