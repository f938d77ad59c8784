"""The response over wide ground against the response of single grids, and against brute force."""

import cv2
import numpy as np
import pytest
import rasterio

from catalog.config import resource
from catalog.pipeline.cell_map import find_peaks
from catalog.selection.localisation import (
    compute_azimuth_products,
    compute_hessian_eigenvalue_map,
    compute_sun_products,
)
from catalog.selection.sweep import (
    MARGIN,
    compute_window_eigenvalues,
    find_strongest_windows,
    sum_tiles,
)

POSTING_M = 118.45
STEP, TALL = 4, 16


@pytest.fixture(scope="module")
def tycho():
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as dataset:
        return dataset.read(1, window=((800, 1200), (800, 1200))).astype(np.float32)


def swept(heights, step=STEP, tall=TALL, products=None, stretch=1.0, wide=None):
    """Response of a grid whose row 0 is south, from its first whole tile on."""
    rows = (heights.shape[0] - 2 * MARGIN) // step * step
    cols = (heights.shape[1] - 2 * MARGIN) // step * step
    inner = heights[: rows + 2 * MARGIN, : cols + 2 * MARGIN]
    tiles = sum_tiles(inner, POSTING_M, np.full(rows, stretch), step)
    windows = np.full(tiles.shape[1] - tall + 1, wide or tall)
    suns = compute_azimuth_products() if products is None else products
    return compute_window_eigenvalues(tiles, tall, windows, suns)


@pytest.mark.parametrize(("step", "tall"), [(4, 16), (1, 16), (3, 16), (16, 16), (5, 7)])
def test_response_is_that_of_a_blurred_grid(tycho, step, tall):
    """The same formula, other order of sums: single precision is left.

    The map lacks the products on a window's border where that is the grid's: it is cut wider.
    """
    suns = np.array([[0.9, 0.1, 0.2], [-0.5, 0.2, 0.6], [0.1, 0.8, 0.4]])
    suns /= np.linalg.norm(suns, axis=1)[:, None]
    ground = tycho[: 2 * MARGIN + 300, : 2 * MARGIN + 310]
    found = swept(ground, step, tall, compute_sun_products(suns))
    blurred = cv2.GaussianBlur(ground, (9, 9), 1.0)
    # rows go north here, south there
    wanted = compute_hessian_eigenvalue_map(
        blurred[::-1], POSTING_M, tall * step, compute_sun_products(suns)
    )
    wanted = wanted[::-1][MARGIN::step, MARGIN::step]
    rows, cols = (min(a, b) for a, b in zip(found.shape, wanted.shape, strict=True))
    cols = min(cols, int(np.isfinite(found).all(axis=0).sum()))
    np.testing.assert_allclose(found[:rows, :cols], wanted[:rows, :cols], rtol=2e-3)
    assert min(rows, cols) >= 3


def test_crowded_columns_give_the_response_of_the_ground():
    """A surface written down twice, with columns 1.25 times as dense: 3 % (finite differences)."""
    rng = np.random.default_rng(2)
    waves = rng.uniform(-0.25, 0.25, (40, 2))
    phases, heights = rng.uniform(0.0, 6.0, 40), rng.uniform(5.0, 20.0, 40)

    def surface(along):
        # half a node within the first tile, in both grids
        y = np.arange(320 + 2 * MARGIN)
        x = (np.arange(int(400 * along) + 2 * MARGIN) - MARGIN + 0.5) / along
        angle = waves[:, 0, None, None] * x + waves[:, 1, None, None] * y[:, None]
        return np.tensordot(heights, np.sin(angle + phases[:, None, None]), 1).astype(np.float32)

    plain = swept(surface(1.0))
    crowded = swept(surface(1.25), stretch=1.25, wide=20)
    # five of the crowded tiles are as wide as four plain ones
    np.testing.assert_allclose(crowded[:, 0:75:5], plain[:, 0:60:4], rtol=0.06)
    ratio = crowded[:, 0:75:5] / plain[:, 0:60:4]
    assert abs(np.median(ratio) - 1.0) < 0.03


def test_a_window_is_the_same_whatever_else_is_swept(tycho):
    whole = swept(tycho)
    for row, col, height, width in ((0, 0, 200, 90), (8, 4, 333, 107), (40, 100, 90, 300)):
        part = swept(tycho[row : row + height, col : col + width])
        fit = np.isfinite(part).all(axis=0).sum()
        wanted = whole[row // STEP :, col // STEP :][: part.shape[0], :fit]
        assert part[:, :fit].tobytes() == np.ascontiguousarray(wanted).tobytes()


def test_windows_about_a_hole_are_unknown_and_no_others(tycho):
    holed = tycho.copy()
    holed[200, 150] = np.nan
    found, plain = swept(holed), swept(tycho)
    reach = TALL * STEP
    i, j = np.nonzero(np.isnan(found) & np.isfinite(plain))
    rows, cols = i * STEP + MARGIN, j * STEP + MARGIN  # first nodes of the unknown windows
    assert rows.min() >= 200 - reach - MARGIN
    assert rows.max() <= 200 + MARGIN
    assert cols.min() >= 150 - reach - MARGIN
    assert cols.max() <= 150 + MARGIN
    assert len(i) >= TALL * TALL
    known = np.isfinite(found)
    assert found[known].tobytes() == plain[known].tobytes()


@pytest.mark.parametrize("separation", [1.0, 4.0, 9.5])
def test_strongest_windows_are_those_of_a_search_with_numpy(separation):
    rng = np.random.default_rng(8)
    response = rng.uniform(0.1, 1.0, (30, 90)).astype(np.float32)
    response[4:9, 10:20] = np.nan
    wide = np.full(30, 16)
    west, east = np.array([10.0, 30.0, 60.5]), np.array([29.0, 59.0, 89.0])
    found = find_strongest_windows(response, wide, west, east, np.ones(30), separation, 6)
    for n in range(3):
        first, last = int(np.ceil(west[n] - 8.0)), int(np.floor(east[n] - 8.0))
        wanted = find_peaks(response[:, first : last + 1], separation, 6)
        assert [(r, c - first) for r, c in found[n].tolist()] == wanted


def test_separation_counts_metres_where_columns_crowd():
    response = np.zeros((3, 40), np.float32)
    response[1, 10], response[1, 13], response[1, 15] = 3.0, 2.0, 1.0
    args = response, np.full(3, 2), np.array([0.0]), np.array([40.0])
    found = find_strongest_windows(*args, np.full(3, 0.5), 2.4, 3)
    assert found[0, :, 1].tolist() == [10, 15, -1]
    assert find_strongest_windows(*args, np.ones(3), 2.4, 3)[0, :2, 1].tolist() == [10, 13]


def test_tiles_that_do_not_fit_are_refused(tycho):
    with pytest.raises(ValueError, match="no tiles"):
        sum_tiles(tycho, POSTING_M, np.ones(390), 4)
    tiles = sum_tiles(tycho[:50, :50], POSTING_M, np.ones(40), 4)
    with pytest.raises(ValueError, match="do not fit"):
        compute_window_eigenvalues(tiles, 4, np.full(7, 11), compute_azimuth_products())
