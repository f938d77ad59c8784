"""SURF-64 against a direct sum over the square, and as a matcher on known shifts."""

import cv2
import numpy as np
import pytest

from catalog.correlation.ncc import match_ncc
from catalog.correlation.surf64 import (
    compute_descriptors,
    compute_self_similarity_surface,
    compute_similarity_surface,
    make_cell_weights,
    match_surf,
)


def relief(size, seed, sigma=2.0):
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((size, size)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), sigma) * 10.0 + 5.0


def direct_descriptor(image, row, col, cell_px, cells):
    """The definition, written out with numpy over the square alone."""
    side = cells * cell_px
    part = image[row - side // 2 :, col - side // 2 :][: side + 1, : side + 1].astype(float)
    a, b, c, d = part[:-1, :-1], part[:-1, 1:], part[1:, :-1], part[1:, 1:]
    dx, dy = (b + d - a - c) / 2.0, (c + d - a - b) / 2.0
    weights = make_cell_weights(cells)
    values = []
    for i in range(cells):
        for j in range(cells):
            cut = np.s_[i * cell_px : (i + 1) * cell_px, j * cell_px : (j + 1) * cell_px]
            sums = [dx[cut].sum(), dy[cut].sum(), abs(dx[cut]).sum(), abs(dy[cut]).sum()]
            values += [weights[i, j] * s for s in sums]
    return np.array(values) / np.linalg.norm(values)


@pytest.mark.parametrize(("cell_px", "cells"), [(5, 4), (8, 4), (8, 8), (7, 5)])
def test_descriptors_equal_the_sums_of_their_definition(cell_px, cells):
    image = relief(90, 1)
    rows, cols = np.array([36, 40, 52]), np.array([38, 50, 45])
    found = compute_descriptors(image, rows, cols, cell_px, cells)
    assert found.shape == (3, 4 * cells * cells)
    for one, row, col in zip(found, rows, cols, strict=True):
        wanted = direct_descriptor(image, row, col, cell_px, cells)
        np.testing.assert_allclose(one, wanted, atol=2e-6)


def test_a_descriptor_knows_neither_gain_nor_offset():
    image = relief(64, 2)
    at = np.array([30]), np.array([31])
    np.testing.assert_allclose(
        compute_descriptors(image, *at, 8),
        compute_descriptors(image * 3.0 + 40.0, *at, 8),
        atol=1e-5,
    )


def test_flat_ground_has_a_zero_descriptor_and_holes_do_not_spread():
    flat = np.full((40, 40), 7.0, np.float32)
    assert not compute_descriptors(flat, np.array([20]), np.array([20]), 8).any()
    holed = relief(80, 3)
    holed[5, 5] = np.nan
    far = compute_descriptors(holed, np.array([50]), np.array([50]), 8)
    holed[5, 5] = 0.0
    np.testing.assert_allclose(
        far, compute_descriptors(holed, np.array([50]), np.array([50]), 8), atol=1e-6
    )
    assert np.isfinite(far).all()


def test_a_square_that_leaves_the_image_is_refused():
    image = relief(40, 5)
    with pytest.raises(ValueError, match="leaves the 40 x 40 image"):
        compute_descriptors(image, np.array([15]), np.array([20]), 8)
    with pytest.raises(ValueError, match="leaves"):
        compute_descriptors(image, np.array([20]), np.array([24]), 8)
    middle = np.array([16])
    with pytest.raises(ValueError, match="leaves"):
        compute_descriptors(relief(32, 5), middle, middle, 8)
    assert compute_descriptors(relief(33, 5), middle, middle, 8).shape == (1, 64)


@pytest.mark.parametrize("size", [32, 64, 80])
@pytest.mark.parametrize("shift", [(0, 0), (3, -5), (-7, 6)])
def test_surf_finds_a_shifted_reference_under_noise_as_correlation_does(size, shift):
    ground = relief(size + 40, size)
    rng = np.random.default_rng(6)
    rows, cols = 12 - shift[1], 12 - shift[0]
    search = ground[rows : rows + size + 16, cols : cols + size + 16]
    reference = ground[20 : 20 + size, 20 : 20 + size]
    noisy = search + rng.normal(0.0, 0.2, search.shape).astype(np.float32)
    found = match_surf(reference, noisy)
    # the quadratic's bias and the noise: a tenth of a node
    assert (found.dx, found.dy) == pytest.approx(shift, abs=0.1)
    by_correlation = match_ncc(reference, noisy)
    assert found.score == pytest.approx(by_correlation.score, abs=0.02)
    assert np.isfinite(found.covariance).all()
    assert found.runner_up < found.score


def test_two_equal_places_give_a_match_without_weight():
    tile = relief(40, 7)
    search = np.hstack([tile, tile])[:, :80]
    search = np.vstack([search, search])
    reference = tile[4:36, 4:36]
    found = match_surf(reference, np.ascontiguousarray(search))
    assert not np.isfinite(found.covariance).any() or np.isinf(found.covariance[0, 0])
    assert found.runner_up == pytest.approx(found.score, abs=0.02)


def test_the_similarity_of_the_true_place_is_one():
    ground = relief(80, 8)
    surface = compute_similarity_surface(ground[8:72, 8:72], ground)
    assert surface.shape == (17, 17)
    # the search grid is smoothed with its surroundings, the reference without
    assert surface[8, 8] == surface.max() > 0.999


@pytest.mark.parametrize(("size", "side"), [(80, 64), (81, 33), (40, 24)])
def test_a_surface_holds_the_cosines_of_the_descriptors_it_stands_for(size, side):
    ground = relief(size, 10)
    ground[3, 4] = np.nan
    first = (size - side) // 2
    middle = ground[first : first + side, first : first + side]
    cells = max(4, round((side - 1) / 8))
    cell_px = (side - 1) // cells
    smooth = cv2.GaussianBlur(ground, (0, 0), 1.0)
    at = np.arange(size - side + 1) + (side - 1 - cells * cell_px) // 2 + cells * cell_px // 2
    rows, cols = np.meshgrid(at, at, indexing="ij")
    there = compute_descriptors(smooth, rows, cols, cell_px, cells)
    wanted = (there @ there[there.shape[0] // 2]).reshape(rows.shape)
    np.testing.assert_allclose(compute_self_similarity_surface(ground, side), wanted, atol=2e-6)
    own = cv2.GaussianBlur(middle, (0, 0), 1.0)
    middles = np.array([(at.size // 2)])
    own = compute_descriptors(own, at[middles] - first, at[middles] - first, cell_px, cells)[0]
    wanted = (there @ own).reshape(rows.shape)
    np.testing.assert_allclose(compute_similarity_surface(middle, ground), wanted, atol=2e-6)


def test_sizes_that_cannot_be_centred_are_refused():
    with pytest.raises(ValueError, match="cannot be centred"):
        compute_similarity_surface(relief(33, 9), relief(80, 9))
    with pytest.raises(ValueError, match="cannot be centred"):
        compute_similarity_surface(relief(80, 9), relief(64, 9))
    with pytest.raises(ValueError, match="cannot be centred"):
        compute_self_similarity_surface(relief(80, 9), 33)
