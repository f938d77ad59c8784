"""The closed-form score against sums written out, against OpenCV and against rendered pictures."""

import cv2
import numpy as np
import pytest
import rasterio

from catalog.config import resource
from catalog.correlation.filters import HIGH_PASS_NODES, filter_high_pass
from catalog.photometry.laws import find_law
from catalog.rendering.map_view import render_map
from catalog.selection.localisation import (
    compute_azimuth_products,
    compute_hessian_eigenvalue,
    compute_hessian_eigenvalue_map,
    compute_sun_products,
    predict_match,
)

POSTING_M = 118.45
MOON_M = 1_737_400.0


@pytest.fixture(scope="module")
def tycho():
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as dataset:
        window = rasterio.windows.Window(900, 900, 256, 256)
        return dataset.read(1, window=window).astype(np.float32)


def sun(azimuth_deg, elevation_deg):
    a, e = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])


def hessian(heights, posting):
    h = heights.astype(np.float64) / posting
    north = -np.gradient(h, axis=0)
    xx = h[1:-1, :-2] - 2 * h[1:-1, 1:-1] + h[1:-1, 2:]
    yy = h[:-2, 1:-1] - 2 * h[1:-1, 1:-1] + h[2:, 1:-1]
    xy = np.gradient(north, axis=1)[1:-1, 1:-1]
    return xx, xy, yy


def test_the_map_equals_eigenvalues_of_tensors_written_out(tycho):
    window, row, col = 48, 31, 77
    cut = np.s_[row - 1 : row - 1 + window, col - 1 : col - 1 + window]
    xx, xy, yy = (part[cut] for part in hessian(tycho, POSTING_M))
    smallest = []
    for azimuth in np.pi * np.arange(8) / 8:
        gx = xx * np.sin(azimuth) + xy * np.cos(azimuth)
        gy = xy * np.sin(azimuth) + yy * np.cos(azimuth)
        tensor = [[(gx * gx).sum(), (gx * gy).sum()], [(gx * gy).sum(), (gy * gy).sum()]]
        smallest.append(np.linalg.eigvalsh(tensor)[0])
    found = compute_hessian_eigenvalue_map(tycho, POSTING_M, window)
    assert found.shape == (256 - window + 1, 256 - window + 1)
    assert found[row, col] == pytest.approx(min(smallest), rel=1e-5)
    coarse = compute_hessian_eigenvalue_map(tycho, POSTING_M, window, step=4)
    np.testing.assert_allclose(coarse, found[::4, ::4], rtol=1e-5)


def test_one_sun_agrees_with_opencv_on_a_linear_picture(tycho):
    # the picture of the linear law, made here; OpenCV's own corner measure of it
    direction = sun(60.0, 30.0)
    h = tycho.astype(np.float64) / POSTING_M
    east, north = np.gradient(h, axis=1), -np.gradient(h, axis=0)
    picture = (-(east * direction[0] + north * direction[1]) / direction[2]).astype(np.float32)
    window = 41
    theirs = cv2.cornerMinEigenVal(picture, window, ksize=3)
    found = compute_hessian_eigenvalue_map(
        tycho, POSTING_M, window, compute_sun_products(direction[None])
    )
    ours = found[40:-40, 40:-40].ravel()
    theirs = theirs[20:-20, 20:-20][40:-40, 40:-40].ravel()
    # other difference stencils, so not the same numbers, but the same ground is good
    assert np.corrcoef(np.log(ours), np.log(theirs))[0, 1] > 0.95


def test_the_score_does_not_depend_on_how_the_ground_is_turned(tycho):
    turned = np.rot90(tycho)
    a = compute_hessian_eigenvalue_map(tycho, POSTING_M, 64)
    b = compute_hessian_eigenvalue_map(turned, POSTING_M, 64)
    np.testing.assert_allclose(np.rot90(a), b, rtol=1e-4)


def test_a_ridge_is_no_corner_and_a_plane_is_nothing():
    x, y = np.meshgrid(np.arange(64.0), np.arange(64.0))
    plane = (3.0 * x - 2.0 * y).astype(np.float32)
    assert compute_hessian_eigenvalue(plane, 1.0) == pytest.approx(0.0, abs=1e-6)
    ridge = (5.0 * np.cos(x / 5.0)).astype(np.float32)
    bowl = (5.0 * np.cos(np.hypot(x - 32.0, y - 32.0) / 5.0)).astype(np.float32)
    assert compute_hessian_eigenvalue(ridge, 1.0) < 1e-3 * compute_hessian_eigenvalue(bowl, 1.0)


def test_a_window_with_holes_has_no_score_and_a_speck_is_forgiven(tycho):
    holed = tycho.copy()
    holed[100:130, 100:130] = np.nan
    holed[20, 20] = np.nan
    scores = compute_hessian_eigenvalue_map(holed, POSTING_M, 64)
    assert np.isnan(scores[80, 80])
    assert np.isfinite(scores[0, 0])


def test_half_a_turn_of_azimuths_is_enough():
    angle = np.radians([10.0, 190.0])
    suns = np.stack([np.sin(angle), np.cos(angle), np.ones(2)], axis=1)
    products = compute_sun_products(suns)
    np.testing.assert_allclose(products[0], products[1], atol=1e-6)
    assert compute_azimuth_products(8).shape == (8, 3)


def test_the_closed_form_ranks_ground_as_renders_do(tycho):
    # smoothed, so that both difference stencils see the same; high Sun, so that there is no shadow
    smooth = cv2.GaussianBlur(tycho, (0, 0), 2.0)
    direction = sun(30.0, 50.0)
    picture = render_map(smooth, POSTING_M, direction, radius_m=MOON_M, law=find_law("lambert"))
    predicted, rendered = [], []
    for row in range(2, 190, 31):
        for col in range(2, 190, 31):
            cut = np.s_[row : row + 64, col : col + 64]
            value = compute_hessian_eigenvalue(
                smooth[cut], POSTING_M, compute_sun_products(direction[None])
            )
            predicted.append(1.0 / (20.0 * np.sqrt(value)))
            rendered.append(predict_match(picture[cut], 20.0).error_px)
    ratio = np.array(rendered) / np.array(predicted)
    assert np.corrcoef(np.log(predicted), np.log(rendered))[0, 1] > 0.9
    assert 0.7 < np.median(ratio) < 1.4


def test_matches_of_noisy_pictures_scatter_as_predicted(tycho):
    # smooth ground: differences of neighbours are then derivatives, as the prediction supposes
    picture = render_map(
        cv2.GaussianBlur(tycho, (0, 0), 2.0), POSTING_M, sun(90.0, 25.0), radius_m=MOON_M
    )[40:104, 40:104]
    snr = 10.0
    rng = np.random.default_rng(3)
    inner = picture[1:-1, 1:-1].astype(np.float64)
    gx = (picture[1:-1, 2:] - picture[1:-1, :-2]).astype(np.float64) / 2.0
    gy = (picture[2:, 1:-1] - picture[:-2, 1:-1]).astype(np.float64) / 2.0
    design = np.stack([gx.ravel(), gy.ravel()], axis=1)
    noise = rng.normal(0.0, inner.mean() / snr, (2000, inner.size))
    shifts = noise @ np.linalg.pinv(design).T
    worst = np.sqrt(np.linalg.eigvalsh(np.cov(shifts.T))[-1])
    found = predict_match(picture, snr).error_px
    assert found == pytest.approx(worst, rel=0.08)
    least = np.linalg.eigvalsh(design.T @ design)[0]
    assert found == pytest.approx(inner.mean() / (snr * np.sqrt(least)), rel=1e-5)


def test_darkness_and_uniform_light_cannot_be_matched():
    dark = predict_match(np.zeros((32, 32), np.float32), 20.0)
    assert (dark.error_px, dark.correlation, dark.score) == (np.inf, 0.0, np.inf)
    even = predict_match(np.full((32, 32), 0.3, np.float32), 20.0)
    assert even.error_px == even.score == np.inf


def test_the_predicted_correlation_is_what_correlation_with_noise_gives(tycho):
    picture = render_map(tycho, POSTING_M, sun(90.0, 30.0), radius_m=MOON_M)[:96, :96]
    snr = 5.0
    rng = np.random.default_rng(4)
    scores = []
    for _ in range(20):
        noisy = picture + rng.normal(0.0, picture.mean() / snr, picture.shape).astype(np.float32)
        scores.append(
            np.corrcoef(filter_high_pass(picture).ravel(), filter_high_pass(noisy).ravel())[0, 1]
        )
    # the high-pass takes a little of the noise too
    found = predict_match(picture, snr)
    assert found.correlation == pytest.approx(np.mean(scores), abs=0.03)
    assert found.score == found.error_px / found.correlation


@pytest.mark.parametrize(("rows", "cols"), [(64, 64), (48, 72), (16, 4), (2, 2)])
def test_contrast_is_that_of_opencv_on_half_as_many_nodes(tycho, rows, cols):
    picture = render_map(tycho, POSTING_M, sun(90.0, 30.0), radius_m=MOON_M)[:rows, :cols]
    means = cv2.resize(picture, (cols // 2, rows // 2), interpolation=cv2.INTER_AREA)
    means = cv2.GaussianBlur(means, (0, 0), np.sqrt(HIGH_PASS_NODES**2 - 1.0) / 2.0)
    local = cv2.resize(means, (cols, rows), interpolation=cv2.INTER_LINEAR)
    mean = picture[1:-1, 1:-1].astype(np.float64).mean() if rows > 2 else 1.0
    contrast = (picture - local).astype(np.float64).std() / mean
    found = predict_match(picture, 20.0).correlation
    if rows > 2:
        assert found == pytest.approx(contrast / np.hypot(contrast, 0.05), rel=1e-5)
    holed = picture.copy()
    holed[0, 0] = np.nan
    assert np.isfinite(predict_match(holed, 20.0).correlation)


def test_a_window_that_does_not_fit_is_refused(tycho):
    with pytest.raises(ValueError, match="does not fit"):
        compute_hessian_eigenvalue_map(tycho, POSTING_M, 300)
