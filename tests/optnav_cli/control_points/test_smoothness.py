"""Smooth brightness and rounding are no ground, however well they correlate with a template."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from catalog.correlation.filters import downsample_blurred
from optnav_cli.control_points.picture_pyramid import find_count_step, is_ground_shown
from optnav_cli.control_points.point_match import thin_pixels
from tests.studies.smooth_pictures import BITS, KINDS, draw_smooth_picture

MARGIN = 8


def plain(size):
    """Pixels (size, size, 2) of nodes that lie on the picture's own."""
    return np.stack(np.meshgrid(*2 * [np.arange(float(size))]), axis=-1)


def is_ground(patch, count_step):
    return is_ground_shown(patch, plain(len(patch)), MARGIN, count_step)


def ground(size, rms, seed=0):
    """Brightness of relief as a picture shows it: waves of all lengths down to two nodes."""
    rng = np.random.default_rng(seed)
    waves = sum(gaussian_filter(rng.normal(size=(size, size)), s) * s for s in (0.7, 1.5, 3.0, 6.0))
    return (100.0 + rms * (waves - waves.mean()) / waves.std()).astype(np.float32)


@pytest.mark.parametrize("size", [48, 64, 96])
@pytest.mark.parametrize("rms", [1.0, 30.0])
def test_ground_is_ground_under_any_gradient(size, rms):
    for seed in range(5):
        lit = np.rint(ground(size, rms, seed) + 0.3 * np.arange(size))
        assert is_ground(lit.astype(np.float32), 1.0)


@pytest.mark.parametrize("kind", [k for k in KINDS if k != "defocus"])
@pytest.mark.parametrize("bits", BITS)
def test_smooth_fields_are_no_ground(kind, bits):
    rng = np.random.default_rng(3)
    for _ in range(5):
        # without noise, which correlates by chance alone
        whole = draw_smooth_picture(512, bits, kind, ground(64, 30.0), rng)
        patch = np.rint(gaussian_filter(whole, 4.0))[200:296, 200:296].astype(np.float32)
        if kind == "slow gradient":
            patch = whole[100:164, 100:164]
        assert not is_ground(patch, 1.0)


@pytest.mark.parametrize("kind", ["gradient", "slow gradient", "vignette", "stray light"])
def test_a_smooth_picture_over_relief_seen_from_aside_is_no_ground(kind):
    """Its brightness at the nodes shows the relief of the terrain model, not of the ground."""
    rng = np.random.default_rng(4)
    for _ in range(5):
        whole = draw_smooth_picture(512, 16, kind, ground(64, 30.0), rng)
        whole = gaussian_filter(whole.astype(np.float64), 4.0)  # without noise and rounding
        pixels = plain(96) + 200.0
        relief = ground(96, 1.0) - 100.0  # of some pixels of parallax
        pixels += 3.0 * relief[..., None] * [1.0, 0.7]
        patch = map_coordinates(whole, pixels[..., ::-1].reshape(-1, 2).T, order=3)
        patch = patch.reshape(96, 96).astype(np.float32)
        assert is_ground(patch, 0.0)  # relief it is, by its waves alone
        assert not is_ground_shown(patch, pixels, MARGIN, 0.0)


def test_contrast_below_the_rounding_of_counts_is_no_ground():
    faint = ground(64, 0.2)
    assert is_ground(faint, 0.0)
    assert not is_ground(faint, 1.0)


def test_holes_take_no_part_and_a_patch_without_pixels_shows_nothing():
    holed = ground(64, 30.0)
    holed[:20] = np.nan
    assert is_ground(holed, 1.0)
    assert not is_ground(np.full((64, 64), np.nan, np.float32), 1.0)


def test_the_step_of_counts_is_their_greatest_common_divisor():
    counts = np.random.default_rng(0).integers(0, 4096, (50, 50))
    assert find_count_step(counts.astype(np.float32)) == 1.0
    assert find_count_step((16 * counts).astype(np.float32)) == 16.0
    assert find_count_step((counts + 0.5).astype(np.float32)) == 0.0
    assert find_count_step(np.full((5, 5), 7.0, np.float32)) == 0.0


@pytest.mark.parametrize("blur_nodes", [0.6, 2.0, 3.3])
@pytest.mark.parametrize("side", [96, 97])
def test_behind_a_blur_a_smooth_picture_is_no_ground_and_ground_is(blur_nodes, side):
    """Thinned nodes lie where the thinned picture has them: linear pixels stay linear."""
    side += int(16 * blur_nodes)
    even = side % 2 == 0
    pixels = 0.7 * plain(side) + [100.0, 150.0]
    kept = thin_pixels(pixels, blur_nodes, even)
    middle = len(kept) // 2
    step = kept[middle, middle] - kept[middle - 1, middle - 1]
    np.testing.assert_allclose(step, 0.7 * max(1.0, blur_nodes), rtol=1e-4)
    relief = ground(side, 1.0) - 100.0
    seen = pixels + 3.0 * relief[..., None] * [1.0, 0.7]
    x, y = seen[..., 0], seen[..., 1]
    smooth = (0.01 * (x - 180.0) ** 2 + 0.004 * x * y).astype(np.float32)
    for patch, shown in ((smooth, False), (ground(side, 30.0), True)):
        thin = downsample_blurred(patch, blur_nodes, even)
        assert is_ground_shown(thin, thin_pixels(seen, blur_nodes, even), MARGIN, 0.0) is shown
