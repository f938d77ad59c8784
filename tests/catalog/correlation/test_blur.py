"""The blur before matching grids that are finer than what is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from catalog.correlation.filters import (
    blur_nodes,
    choose_thinning,
    crop,
    downsample_blurred,
    filter_high_pass_masked,
    filter_high_pass_quickly,
    filter_low_pass,
)


def test_only_grids_finer_than_the_model_are_blurred_and_the_finer_the_more() -> None:
    assert blur_nodes(320.0, 320.0) == blur_nodes(640.0, 320.0) == 0.0
    sigmas = [blur_nodes(posting, 320.0) * posting for posting in (40.0, 80.0, 160.0)]
    assert sigmas == pytest.approx([sigmas[0]] * 3)
    assert sigmas[0] > 0.0


def test_the_blur_is_a_gaussian() -> None:
    grid = np.random.default_rng(3).standard_normal((60, 60)).astype(np.float32)
    inner = (slice(15, -15),) * 2
    expected = gaussian_filter(grid.astype(np.float64), 2.0, truncate=6.0)
    assert filter_low_pass(grid, 2.0)[inner] == pytest.approx(expected[inner], abs=5e-3)


def test_holes_stay_and_take_no_part() -> None:
    grid = np.full((40, 40), 7.0, np.float32)
    grid[10:20, 5:15] = np.nan
    blurred = filter_low_pass(grid, 3.0)
    assert (np.isnan(blurred) == np.isnan(grid)).all()
    assert blurred[np.isfinite(blurred)] == pytest.approx(7.0, rel=1e-5)


@pytest.mark.parametrize("side", [80, 81])
def test_thinned_nodes_lie_about_the_same_centre(side: int) -> None:
    """A ramp gives the places of its nodes back; at the border the blur bends it."""
    ramp = np.tile(np.arange(side, dtype=np.float32) - (side - 1) / 2.0, (side, 1))
    for even in (True, False):
        kept = downsample_blurred(ramp, 2.2, even)
        assert kept.shape[0] % 2 == (0 if even else 1)
        places = (np.arange(kept.shape[1]) - (kept.shape[1] - 1) / 2.0) * choose_thinning(2.2)
        assert kept[10, 5:-5] == pytest.approx(places[5:-5], abs=1e-3)


def test_a_blur_below_a_node_keeps_all_nodes() -> None:
    grid = np.random.default_rng(3).standard_normal((40, 40)).astype(np.float32)
    assert downsample_blurred(grid, 0.7, True) == pytest.approx(filter_low_pass(grid, 0.7))


@pytest.mark.parametrize("side", [1, 9, 57, 96, 102])
@pytest.mark.parametrize("holes", [False, True])
def test_the_quick_high_pass_is_the_other_to_the_rounding(side: int, holes: bool) -> None:
    rng = np.random.default_rng(side)
    grids = tuple((100.0 + rng.normal(size=(2, side, side))).astype(np.float32))
    valid = np.ones((side, side), bool)
    if holes:
        valid[side // 3 :, : side // 2] = False
    for margin in (0, 8) if side > 16 else (0,):
        quick = filter_high_pass_quickly(grids, valid, margin)
        for one, other in zip(quick, filter_high_pass_masked(grids, valid), strict=True):
            assert one == pytest.approx(crop(other, margin), abs=1e-4)  # 1e-6 of the grids
