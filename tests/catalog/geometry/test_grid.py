"""Sampling of grids against SciPy and a kernel written out by hand."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import map_coordinates

from catalog.geometry.grid import interpolate_bicubic, sample_bicubic, sample_rows


def keys(distance):
    """Keys (1981), eq. with a = -1/2, as a function of the distance."""
    d = abs(distance)
    if d < 1.0:
        return 1.5 * d**3 - 2.5 * d**2 + 1.0
    if d < 2.0:
        return -0.5 * d**3 + 2.5 * d**2 - 4.0 * d + 2.0
    return 0.0


@pytest.fixture
def grid():
    return np.random.default_rng(10).normal(size=(17, 23)).astype(np.float32)


def test_the_outermost_cells_are_bilinear_as_in_scipy(grid):
    rng = np.random.default_rng(11)
    row = np.concatenate([rng.uniform(0, 1, 250), rng.uniform(15, 16, 250)])
    col = rng.uniform(0, 22, 500)
    wanted = map_coordinates(grid.astype(np.float64), [row, col], order=1)
    assert_allclose(sample_bicubic(grid, row, col), wanted, atol=1e-6)


def test_bicubic_is_keys_convolution_inside(grid):
    rng = np.random.default_rng(12)
    for row, col in zip(rng.uniform(1, 14.999, 200), rng.uniform(1, 20.999, 200), strict=True):
        wanted = sum(
            keys(row - r) * keys(col - c) * float(grid[r, c]) for r in range(17) for c in range(23)
        )
        assert interpolate_bicubic(grid, row, col) == pytest.approx(wanted, abs=1e-6)


def test_bicubic_gives_nodes_and_quadratics_back_exactly():
    r, c = np.mgrid[0:12, 0:12].astype(np.float64)

    def surface(y, x):
        return 2.0 + 0.5 * x - 0.25 * y + 0.125 * x * x - 0.5 * x * y + 0.25 * y * y

    heights = surface(r, c).astype(np.float32)
    assert_allclose(sample_bicubic(heights, r, c), heights, atol=1e-6)
    rng = np.random.default_rng(13)
    row, col = rng.uniform(1, 9.99, (2, 300))
    assert_allclose(sample_bicubic(heights, row, col), surface(row, col), atol=3e-6)


def test_half_a_cell_beyond_the_outer_nodes_belongs_to_them_and_no_more(grid):
    edges = np.array([-0.5, -0.25, 16.25, 16.5])
    wanted = np.array([grid[0, 5], grid[0, 5], grid[16, 5], grid[16, 5]])
    assert_allclose(sample_bicubic(grid, edges, np.full(4, 5.0)), wanted, atol=1e-6)
    assert np.isnan(sample_bicubic(grid, np.array([-0.51, 16.51]), np.full(2, 5.0))).all()
    assert np.isnan(sample_bicubic(grid, np.full(2, 5.0), np.array([-0.51, 22.51]))).all()
    assert np.isnan(sample_bicubic(grid, np.array([np.nan, 3.0]), np.array([3.0, np.inf]))).all()


def test_a_hole_stays_a_hole_and_spreads_no_further(grid):
    holed = grid.copy()
    holed[8, 11] = np.nan
    assert np.isnan(sample_bicubic(holed, np.array([8.0]), np.array([11.0])))[0]
    # a quarter of a node away the hole still has the larger weight
    assert np.isnan(sample_bicubic(holed, np.array([8.25]), np.array([11.25])))[0]
    row, col = np.mgrid[0:17, 0:23].astype(np.float64)
    at_nodes = sample_bicubic(holed, row, col)
    assert np.isnan(at_nodes).sum() == 1
    far = np.array([8.0]), np.array([14.3])
    assert_allclose(sample_bicubic(holed, *far), sample_bicubic(grid, *far))


def test_beside_a_hole_the_value_comes_from_the_nodes_that_are_known():
    holed = np.full((8, 8), 5.0, dtype=np.float32)
    holed[4, 4] = np.nan
    assert sample_bicubic(holed, np.array([3.4]), np.array([3.4]))[0] == pytest.approx(5.0)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (2, 2), (3, 1)])
def test_grids_too_small_to_interpolate_still_answer(shape):
    tiny = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    row, col = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    assert_allclose(sample_bicubic(tiny, row, col), tiny)


def test_the_shape_of_the_places_is_kept(grid):
    row = np.full((2, 3, 4), 5.0)
    assert sample_bicubic(grid, row, row).shape == (2, 3, 4)
    assert sample_bicubic(grid, row, row).dtype == np.float32


def rows_across(slope: float, count: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Places (5, count) in rows that climb `slope` rows a column, 0.7 columns apart."""
    col = 5.3 + 0.7 * np.arange(count) + 0.01 * np.arange(5)[:, None]
    return 8.2 + 1.1 * np.arange(5)[:, None] + slope * (col - 5.0), col


@pytest.mark.parametrize("slope", [0.0, 0.2, -0.24])
@pytest.mark.parametrize("wide", [0.5, 1.8, 3.3])
def test_rows_are_sampled_as_their_places_one_by_one(slope, wide):
    """On ground that cubics follow; a footprint of so many columns has as many samples."""
    down, along = np.mgrid[:32, :48]
    ground = (8000.0 + 900.0 * np.sin(down / 9.0) * np.cos(along / 11.0)).astype(np.float32)
    row, col = rows_across(slope)
    out = np.empty(row.shape, np.float32)
    # half of the rows and columns that the grid has, and none of its first three
    fit = (2.0, 3.0, 2.0, 1.0)
    given = (row - fit[1]) / fit[0], (col - fit[3]) / fit[2]
    assert sample_rows(ground, *given, fit, np.full(5, wide), 0.25, out)
    samples = max(1, int(wide + 0.5))
    aside = ((np.arange(samples) + 0.5) / samples - 0.5) * wide
    wanted = np.mean([sample_bicubic(ground, row + slope * by, col + by) for by in aside], axis=0)
    assert_allclose(out, wanted, atol=0.02)  # of relief of 900


def test_rows_that_cross_columns_too_steeply_or_leave_the_grid_are_refused():
    ground = np.zeros((32, 48), np.float32)
    fit, wide = (1.0, 0.0, 1.0, 0.0), np.full(5, 1.0)
    row, col = rows_across(0.3)
    out = np.empty(row.shape, np.float32)
    assert not sample_rows(ground, row, col, fit, wide, 0.25, out)
    assert sample_rows(ground, row, col, fit, wide, 0.35, out)
    assert not sample_rows(ground, row, col[:, ::-1].copy(), fit, wide, 0.35, out)
    for beyond in (-12.0, 30.0):
        assert not sample_rows(ground, row + beyond, col, fit, wide, 0.35, out)
        assert not sample_rows(ground, row, col + beyond, fit, wide, 0.35, out)


def test_a_hole_is_known_where_a_row_touches_it():
    ground = np.full((32, 48), 5.0, np.float32)
    ground[10, 20] = np.nan
    row, col = rows_across(0.0)
    out = np.empty(row.shape, np.float32)
    assert sample_rows(ground, row, col, (1.0, 0.0, 1.0, 0.0), np.full(5, 1.0), 0.25, out)
    near = (np.floor(row) - 1 <= 10) & (np.floor(row) + 2 >= 10)
    near &= (np.floor(col) - 1 <= 20) & (np.floor(col) + 2 >= 20)
    assert near.any()
    np.testing.assert_array_equal(np.isnan(out), near)
    assert np.allclose(out[~near], 5.0)
