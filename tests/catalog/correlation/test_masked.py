"""Correlation of grids with holes: as without where there are none, right where they cut."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from catalog.correlation.filters import filter_grid
from catalog.correlation.ncc import (
    add_remainder_covariance,
    match_cut,
    match_masked,
    match_ncc,
)

MARGIN, SIDE, ROOM = 8, 40, 6


def scene(shift=(2, -3), seed=5):
    """A search grid and a template that lies `shift` (x, y) off its middle."""
    size = SIDE + 2 * (MARGIN + ROOM)
    rng = np.random.default_rng(seed)
    ground = gaussian_filter(rng.normal(size=(size + 40, size + 40)), 1.5).astype(np.float32)
    search = ground[20 : 20 + size, 20 : 20 + size].copy()
    x, y = shift
    side = SIDE + 2 * MARGIN
    first = 20 + ROOM
    return ground[first + y : first + y + side, first + x : first + x + side].copy(), search


def test_without_holes_it_is_plain_correlation():
    template, search = scene()
    masked, plain = match_masked(template, search, MARGIN), match_ncc(template, search, MARGIN)
    assert masked.score == pytest.approx(plain.score, abs=1e-4)
    assert (masked.dx, masked.dy) == pytest.approx((plain.dx, plain.dy), abs=1e-3)
    assert np.allclose(masked.covariance, plain.covariance, rtol=0.05)


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_a_frame_that_cuts_the_ground_away_leaves_the_place_and_the_score(share):
    template, search = scene()
    search[:, int(search.shape[1] * (1.0 - share)) :] = np.nan
    cut = match_masked(template, search, MARGIN)
    assert (cut.dx, cut.dy) == pytest.approx((2.0, -3.0), abs=0.15)
    assert cut.score > 0.97
    # plain correlation counts what is cut as ground that does not agree
    assert match_ncc(template, search, MARGIN).score < cut.score
    whole = match_masked(*scene(), MARGIN)
    assert np.trace(cut.covariance) > 0.0
    assert np.isfinite(whole.covariance).all()


@pytest.mark.parametrize("flat", [0, 1])
def test_a_side_without_contrast_matches_nowhere(flat):
    grids = list(scene())
    grids[flat] = np.full_like(grids[flat], 7.0)
    match = match_masked(grids[0], grids[1], MARGIN)
    assert match.score == -1.0
    assert not np.isfinite(match.covariance).all()


def test_a_search_without_ground_matches_nowhere():
    template, search = scene()
    match = match_masked(template, np.full_like(search, np.nan), MARGIN)
    assert match.score == -1.0


def test_a_grid_is_compared_in_part_where_it_is_cut_and_whole_where_it_is_not():
    template, search = scene()
    # with nothing left over the covariance would be that of rounding
    search += gaussian_filter(np.random.default_rng(8).normal(size=search.shape), 2.0) / 2.0
    search = search.astype(np.float32)
    cut = search.copy()
    cut[:, 44:] = np.nan
    for grid, match in ((search, match_ncc), (cut, match_masked)):
        plain = match(template, grid, MARGIN)
        again = match_cut(template, grid, filter_grid(grid, MARGIN), MARGIN, remainder=False)
        # scores of few places are summed one by one, not by transforms: rounding alone differs
        assert again[:4] == pytest.approx(plain[:4], abs=2e-7)
        np.testing.assert_allclose(again.covariance, plain.covariance, rtol=1e-5)


def test_a_filtered_search_grid_gives_the_covariance_of_the_remainder():
    template, search = scene()
    search += gaussian_filter(np.random.default_rng(8).normal(size=search.shape), 2.0) / 20.0
    apart = add_remainder_covariance(match_ncc(template, search, MARGIN), template, search, MARGIN)
    at_once = match_cut(template, search, filter_grid(search, MARGIN), MARGIN, remainder=True)
    assert np.allclose(at_once.covariance, apart.covariance, rtol=0.1, atol=1e-5)
    assert np.allclose(at_once[:2], apart[:2], atol=2e-3)
