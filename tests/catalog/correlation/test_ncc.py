"""Correlation against shifts made in Fourier space, noise of known size, OpenCV's own filter."""

import cv2
import numpy as np
import pytest
import scipy.fft
from scipy import ndimage

from catalog.correlation.filters import crop, filter_grid, filter_high_pass
from catalog.correlation.ncc import (
    _correlate_quickly,
    add_remainder_covariance,
    correlate_grids,
    match_in,
    match_ncc,
)
from catalog.correlation.peak import RIVAL_DISTANCE, locate_peak
from catalog.correlation.remainder import LAG_NODES, _smooth_spectrum, refine_by_remainder
from catalog.correlation.similarity import (
    match_similarity,
    rotate_and_scale,
    score_pairs,
    score_pairs_halved,
)


def texture(seed: int, size: int = 256, smooth: float = 1.5) -> np.ndarray:
    """A periodic random texture with a little smoothness, standing for shaded ground."""
    rng = np.random.default_rng(seed)
    field = ndimage.gaussian_filter(rng.normal(size=(size, size)), smooth, mode="wrap")
    return (field / field.std()).astype(np.float64)


def shifted(field: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """The field moved by (dx, dy) nodes, exactly, through the shift theorem."""
    return np.real(np.fft.ifft2(ndimage.fourier_shift(np.fft.fft2(field), (dy, dx))))


def cut(field: np.ndarray, size: int) -> np.ndarray:
    start = (field.shape[0] - size) // 2
    return field[start : start + size, start : start + size].astype(np.float32)


@pytest.mark.parametrize(("dx", "dy"), [(0.0, 0.0), (3.3, -2.6), (-7.5, 5.25)])
def test_a_fourier_shift_is_found_to_a_twentieth_of_a_node(dx, dy):
    field = texture(1)
    match = match_ncc(cut(field, 64), cut(shifted(field, dx, dy), 96))
    assert match.dx == pytest.approx(dx, abs=0.05)
    assert match.dy == pytest.approx(dy, abs=0.05)
    assert match.score > 0.9


def test_gain_offset_and_a_slope_of_brightness_change_nothing():
    field = texture(2)
    plain = match_ncc(cut(field, 64), cut(shifted(field, 1.4, 0.7), 80))
    ramp = np.linspace(0, 30, 256)[None, :]
    bright = match_ncc(cut(field, 64), cut(5.0 * shifted(field, 1.4, 0.7) + 40.0 + ramp, 80))
    assert bright.dx == pytest.approx(plain.dx, abs=0.02)
    assert bright.score == pytest.approx(plain.score, abs=0.01)


def test_stated_covariance_is_of_the_size_of_the_scatter():
    """The model's count of independent samples is fitted to terrain: here a factor of 3."""
    rng = np.random.default_rng(3)
    errors, stated = [], []
    for seed in range(60):
        field = texture(100 + seed)
        noise = ndimage.gaussian_filter(rng.normal(size=field.shape), 0.7)
        noise *= 0.6 / noise.std()
        match = match_ncc(cut(field, 64), cut(field + noise, 80))
        errors.append([match.dx, match.dy])
        stated.append(np.trace(match.covariance) / 2.0)
    ratio = np.mean(np.square(errors)) / np.mean(stated)
    assert 1 / 3 < ratio < 3


def test_holes_take_no_part_in_the_match():
    field = texture(4)
    search = cut(shifted(field, 2.0, -1.0), 96)
    search[:30, :20] = np.nan
    reference = cut(field, 64)
    reference[50:, 50:] = np.nan
    match = match_ncc(reference, search)
    assert (match.dx, match.dy) == pytest.approx((2.0, -1.0), abs=0.15)


def test_a_second_place_that_looks_alike_is_the_runner_up():
    field = texture(5)
    search = cut(field, 128).copy()
    reference = search[48:80, 48:80].copy()
    search[8:40, 8:40] = reference
    match = match_ncc(reference, search)
    assert match.runner_up > 0.9 * match.score


def test_flat_ground_gives_no_score():
    match = match_ncc(np.full((32, 32), 0.3, np.float32), cut(texture(6), 48))
    assert match.score <= 0.0


def test_scores_over_flat_parts_of_a_search_are_void_and_the_others_are_opencv_s():
    """Where the window's mean square, by OpenCV's box filter, is rounding, there is no score."""
    field = texture(10)
    search = cut(field, 96) * np.float32(1e-9) + np.float32(0.5)
    search[60:, 60:] = cut(field, 36)
    reference = cut(field, 32)
    found = correlate_grids(filter_grid(reference), filter_grid(search))
    image, template = filter_high_pass(search), filter_high_pass(reference)
    power = cv2.boxFilter(image * image, -1, (32, 32), anchor=(0, 0))[:65, :65]
    flat = power <= (1e-5 * np.abs(search).max()) ** 2
    assert 0.1 < flat.mean() < 0.9
    assert (found[flat] == -1.0).all()
    wanted = cv2.matchTemplate(image, template, cv2.TM_CCOEFF_NORMED)
    np.testing.assert_array_equal(found[~flat], wanted[~flat])


def test_the_runner_up_is_the_highest_local_maximum_away_from_the_peak():
    for seed in range(20):
        surface = cut(texture(20 + seed), 33)
        match = locate_peak(surface, 1000)
        row, col = np.unravel_index(np.argmax(surface), surface.shape)
        cross = ndimage.generate_binary_structure(2, 1)
        local = surface == ndimage.maximum_filter(surface, footprint=cross)
        away = np.maximum(*np.abs(np.mgrid[:33, :33] - np.array([row, col])[:, None, None]))
        local &= away > RIVAL_DISTANCE
        assert match.runner_up == surface[1:-1, 1:-1][local[1:-1, 1:-1]].max()


def test_the_peak_of_a_paraboloid_is_its_own_and_its_covariance_the_inverse_of_its_bend():
    bend = np.array([[0.02, 0.006], [0.006, 0.01]])
    y, x = np.mgrid[-6:7, -6:7].astype(float)
    offset = np.stack([x - 1.3, y + 2.4], axis=-1)
    surface = 0.8 - 0.5 * np.einsum("...i,ij,...j", offset, bend, offset)
    match = locate_peak(surface.astype(np.float32), 1600)
    assert (match.dx, match.dy) == pytest.approx((1.3, -2.4), abs=1e-4)
    expected = (1.0 - match.score**2) / (match.score * 1000.0) * np.linalg.inv(bend)
    np.testing.assert_allclose(match.covariance, expected, rtol=1e-3)
    border = locate_peak(surface[:, :8].astype(np.float32), 1600)
    assert np.isinf(np.diag(border.covariance)).all()


def test_a_filtered_search_grid_gives_the_same_match():
    field = texture(11)
    reference, search = cut(field, 48), cut(shifted(field, 2.2, 1.1), 64)
    again = match_in(reference, filter_grid(search, margin_nodes=4), 4)
    np.testing.assert_equal(again, match_ncc(reference, search, 4))


def test_high_pass_of_whole_data_is_the_difference_to_a_gaussian():
    grid = cut(texture(7), 64)
    expected = grid - cv2.GaussianBlur(grid, (0, 0), 5.0)
    assert np.allclose(filter_high_pass(grid, 5.0), expected)


def test_a_peak_on_the_border_of_the_search_has_no_finite_covariance():
    field = texture(8)
    match = match_ncc(cut(field, 64), cut(shifted(field, 9.0, 0.0), 72))
    assert not np.isfinite(match.covariance).all()


def test_grids_that_cannot_be_centred_are_refused():
    with pytest.raises(ValueError, match="centred"):
        correlate_grids(*(filter_grid(np.zeros((n, n), np.float32)) for n in (32, 41)))


def test_roll_and_scale_are_found_together_with_the_shift():
    field = texture(9, smooth=3.0)
    rolls = np.radians([-6.0, -3.0, 0.0, 3.0, 6.0])
    scales = [0.9, 0.95, 1.0, 1.05, 1.1]
    search = rotate_and_scale(cut(field, 161), np.radians(4.5), 1.06)[32:129, 32:129]
    found = match_similarity(cut(field, 65), search, list(rolls), scales)
    assert np.degrees(found.roll) == pytest.approx(4.5, abs=1.0)
    assert found.scale == pytest.approx(1.06, abs=0.02)
    assert abs(found.match.dx) < 0.5
    assert abs(found.match.dy) < 0.5


@pytest.mark.parametrize("margin", [0, 5])
@pytest.mark.parametrize("size", [32, 48, 65])
def test_pairs_are_scored_as_opencv_does_and_the_best_is_as_good_as_any(size, margin):
    """Noise as strong as the ground; turned references have holes, so scores differ a little."""
    rolls, scales = list(np.radians([-5.0, 0.0, 5.0])), [0.92, 1.0, 1.08]
    pairs = [(roll, scale) for roll in rolls for scale in scales]
    rng = np.random.default_rng(12)
    missed = []
    for seed in range(12):
        field = texture(40 + seed, smooth=2.0)
        roll, scale = rng.uniform(-0.1, 0.1), rng.uniform(0.9, 1.1)
        noisy = field + ndimage.gaussian_filter(rng.normal(size=field.shape), 0.7) * 2.0
        middle = slice(90 - size // 2 - 8, 90 - size // 2 + size + 8)
        search = rotate_and_scale(cut(noisy, 180), roll, scale)[middle, middle]
        reference = cut(field, 180)[middle, middle][8:-8, 8:-8]
        inner = slice(margin, size - margin)
        image = filter_grid(search, margin_nodes=margin)
        wanted = [
            cv2.matchTemplate(
                image.values,
                np.ascontiguousarray(
                    rotate_and_scale(filter_high_pass(reference), *pair, 0.0)[inner, inner]
                ),
                cv2.TM_CCOEFF_NORMED,
            ).max()
            for pair in pairs
        ]
        scores = score_pairs(reference, image, pairs, margin)
        np.testing.assert_allclose(scores, wanted, atol=1e-5)
        found = match_similarity(reference, search, rolls, scales, margin_nodes=margin)
        each = [
            match_ncc(rotate_and_scale(reference, *pair), search, margin).score for pair in pairs
        ]
        missed.append(max(each) - found.match.score)
    # no worse than the best of all pairs, but for what a parabola may miss
    assert max(missed) < 0.03
    assert np.mean(missed) < 0.0


@pytest.mark.parametrize("margin", [0, 4])
def test_roll_and_scale_from_half_as_many_nodes_are_as_good(margin):
    """Errors of roll and scale, and scores of the match, over 40 noisy places."""
    rolls, scales = list(np.radians([-5.0, 0.0, 5.0])), [0.92, 1.0, 1.08]
    rng = np.random.default_rng(21)
    errors, scores = {False: [], True: []}, {False: [], True: []}
    for seed in range(40):
        field = texture(100 + seed, smooth=2.0)
        roll, scale = rng.uniform(-0.1, 0.1), rng.uniform(0.92, 1.08)
        noisy = field + ndimage.gaussian_filter(rng.normal(size=field.shape), 0.7) * 2.0
        search = rotate_and_scale(cut(noisy, 180), roll, scale)[50:130, 50:130]
        reference = cut(field, 180)[58:122, 58:122]
        for halved in errors:
            found = match_similarity(
                reference, search, rolls, scales, margin_nodes=margin, halved=halved
            )
            errors[halved].append((found.roll - roll, found.scale - scale))
            scores[halved].append(found.match.score)
    whole, half = (np.sqrt(np.mean(np.square(errors[halved]), axis=0)) for halved in (False, True))
    assert (half < 1.25 * whole).all()
    assert np.mean(scores[True]) > np.mean(scores[False]) - 0.005


# few places, which one product of matrices compares, and many, which transforms do
@pytest.mark.parametrize("side", [64, 96])
@pytest.mark.parametrize("margin", [0, 4])
def test_scores_from_half_the_nodes_are_those_of_the_turned_template_at_each_place(margin, side):
    search, reference = cut(texture(21), side), cut(texture(21), 48 + 2 * margin)
    image = filter_grid(search, margin)
    pairs = [(roll, scale) for roll in (-0.1, 0.0, 0.2) for scale in (0.9, 1.0, 1.1)]
    small, wide = (
        cv2.resize(grid, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        for grid in (filter_high_pass(reference), image.values)
    )
    for pair, score in zip(pairs, score_pairs_halved(reference, image, pairs, margin), strict=True):
        template = crop(rotate_and_scale(small, *pair, beyond=0.0), margin // 2)
        surface = cv2.matchTemplate(wide, template, cv2.TM_CCOEFF_NORMED)
        # the top lies between places: as high as the best of them, or a little higher
        assert surface.max() - 1e-5 <= score <= surface.max() + 0.1


def test_no_pair_scores_on_flat_parts_of_a_search():
    search = np.full((96, 96), 0.5, np.float32)
    search[:, 80:] += cut(texture(13), 96)[:, 80:]
    scores = score_pairs(cut(texture(14), 32), filter_grid(search), [(0.0, 1.0), (0.1, 1.05)], 0)
    assert max(scores) < 0.9


def ground(rng: np.random.Generator, steepness: float, smooth: float, size: int = 128):
    """A periodic texture whose amplitude falls as a power of the wavelength and behind a blur."""
    cycles = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.rfftfreq(size), indexing="ij"))
    cycles[0, 0] = np.inf
    damped = cycles**-steepness * np.exp(-2.0 * (np.pi * cycles * smooth) ** 2)
    field = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(size, size))) * damped, (size, size))
    return field / field.std()


@pytest.mark.parametrize(
    ("steepness", "smooth", "size"), [(0.0, 1.5, 0.8), (1.0, 1.0, 0.6), (1.0, 2.0, 1.0)]
)
def test_the_remainder_refines_a_place_and_states_its_scatter(steepness, smooth, size):
    """What a reference lacks is correlated as relief and albedo are; 120 pictures tell 12 %."""
    rng = np.random.default_rng(3)
    errors, of_peaks, stated = [], [], []
    for _ in range(120):
        truth = ground(rng, 0.5, 1.2)
        unknown = size * ground(rng, steepness, smooth)
        dx, dy = rng.uniform(-0.5, 0.5, 2)
        reference, search = cut(truth, 96), cut(shifted(truth + unknown, dx, dy), 112)
        match = match_ncc(reference, search, 8)
        whole = add_remainder_covariance(match, reference, search, 8)
        errors.append([whole.dx - dx, whole.dy - dy])
        of_peaks.append([match.dx - dx, match.dy - dy])
        stated.append(np.trace(whole.covariance) / 2.0)
    assert 0.8 < np.mean(np.square(errors)) / np.mean(stated) < 1.25
    assert np.mean(np.square(errors)) < 0.5 * np.mean(np.square(of_peaks))


def test_a_perfect_match_stays_where_it_is():
    search = cut(ground(np.random.default_rng(6), 0.5, 1.2), 112)
    reference = np.ascontiguousarray(search[8:-8, 8:-8])
    whole = add_remainder_covariance(match_ncc(reference, search, 8), reference, search, 8)
    assert np.hypot(whole.dx, whole.dy) < 1e-3
    assert np.trace(whole.covariance) < 1e-4


def test_the_remainder_follows_the_direction_of_a_streaky_error():
    """Stripes along x hide places along y, as far as their weights leave them."""
    rng = np.random.default_rng(4)
    truth = ground(rng, 0.5, 1.2)
    stripes = np.repeat(ndimage.gaussian_filter1d(rng.normal(size=(128, 1)), 1.5, axis=0), 128, 1)
    search = cut(truth + stripes / stripes.std(), 112)
    reference = cut(truth, 96)
    match = add_remainder_covariance(match_ncc(reference, search, 8), reference, search, 8)
    assert match.covariance[1, 1] > 4.0 * match.covariance[0, 0]


def test_the_remainder_of_a_negative_is_no_match():
    template = cut(texture(6), 64)
    laid = np.stack([np.ones_like(template), template, *np.gradient(template)[::-1]])
    assert np.isfinite(refine_by_remainder(laid, template, template.size).covariance).all()
    assert np.isinf(refine_by_remainder(laid, -template, template.size).covariance[0, 0])
    laid[1] = 0.0
    assert np.isinf(refine_by_remainder(laid, template, template.size).covariance[0, 0])


def test_holes_leave_the_remainder_alone():
    rng = np.random.default_rng(5)
    truth = ground(rng, 0.5, 1.2)
    search = cut(truth + 0.6 * ground(rng, 1.0, 1.0), 112)
    reference = cut(truth, 96)
    match = match_ncc(reference, search, 8)
    whole = add_remainder_covariance(match, reference, search, 8).covariance
    search[:, 70:] = np.nan
    part = add_remainder_covariance(match, reference, search, 8).covariance
    # 54 of 80 columns are left
    assert 1.0 < np.trace(part) / np.trace(whole) < 3.0


@pytest.mark.parametrize("places", [7, 15, 17])
def test_scores_one_by_one_are_those_of_the_transforms(places):
    """7 and 15 places a side are summed one by one, 17 are not."""
    field = texture(40)
    template = filter_grid(cut(field, 42))
    image = filter_grid(cut(shifted(field, 1.4, -0.6), 42 + places - 1))
    exact = cv2.matchTemplate(image.values, template.values, cv2.TM_CCOEFF_NORMED)
    np.testing.assert_allclose(_correlate_quickly(template, image), exact, atol=1e-6)


@pytest.mark.parametrize("side", [60, 75])
def test_a_spectrum_is_smoothed_as_by_a_taper_of_its_correlation(side):
    """By transforms of the whole correlation, in double precision; 75 is odd."""
    field = np.random.default_rng(side).normal(size=(side - 28, side - 28))
    waves = scipy.fft.rfft2(field, s=(side, side))
    power = np.square(np.abs(waves))
    lag = np.minimum(np.arange(side), side - np.arange(side)) / LAG_NODES
    taper = np.exp(-0.5 * lag * lag)
    correlation = scipy.fft.irfft2(power, s=(side, side))
    wanted = scipy.fft.rfft2(correlation * np.outer(taper, taper)).real
    smooth, mean = _smooth_spectrum(power.astype(np.float32))
    np.testing.assert_allclose(smooth, wanted, atol=1e-6 * wanted.max())
    assert mean == pytest.approx(float(correlation[0, 0]), rel=1e-6)
