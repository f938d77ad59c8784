"""Smooth brightness and rounding are no ground, however well they correlate with a template."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from optnav_cli.matching.smoothness import find_count_step, shows_ground
from optnav_cli.studies.smooth_pictures import BITS, KINDS, draw_smooth_picture

MARGIN = 8


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
        assert shows_ground(lit.astype(np.float32), MARGIN, 1.0)


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
        assert not shows_ground(patch, MARGIN, 1.0)


def test_contrast_below_the_rounding_of_counts_is_no_ground():
    faint = ground(64, 0.2)
    assert shows_ground(faint, MARGIN, 0.0)
    assert not shows_ground(faint, MARGIN, 1.0)


def test_holes_take_no_part_and_a_patch_without_pixels_shows_nothing():
    holed = ground(64, 30.0)
    holed[:20] = np.nan
    assert shows_ground(holed, MARGIN, 1.0)
    assert not shows_ground(np.full((64, 64), np.nan, np.float32), MARGIN, 1.0)


def test_the_step_of_counts_is_their_greatest_common_divisor():
    counts = np.random.default_rng(0).integers(0, 4096, (50, 50))
    assert find_count_step(counts.astype(np.float32)) == 1.0
    assert find_count_step((16 * counts).astype(np.float32)) == 16.0
    assert find_count_step((counts + 0.5).astype(np.float32)) == 0.0
    assert find_count_step(np.full((5, 5), 7.0, np.float32)) == 0.0
