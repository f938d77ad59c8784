"""The stated errors of matches: positive, and larger where a match is coarser or poorer."""

import numpy as np

from optnav_cli.navigation.error_model import common_errors_px, own_sigma_m

PIXELS = np.random.default_rng(1).uniform(0.0, 2000.0, (20, 2))
GSD = np.full(20, 50.0)


def test_a_coarser_level_errs_more():
    sigmas = [own_sigma_m(118.0 * 2**level, 118.0) for level in range(5)]
    assert sigmas[0] > 0.0
    assert sigmas == sorted(sigmas)
    assert own_sigma_m(474.0, 474.0) > own_sigma_m(474.0, 118.0)


def test_a_better_score_leaves_a_smaller_common_error():
    good = common_errors_px(PIXELS, GSD, np.full(20, 0.95), 118.0)
    poor = common_errors_px(PIXELS, GSD, np.full(20, 0.5), 118.0)
    assert good.shape == (20, 2, 3)
    assert (np.abs(good[:, :, :2]).sum(axis=1) > 0.0).all()
    assert np.linalg.norm(good) < np.linalg.norm(poor)


def test_a_common_error_is_a_shift_or_a_stretch_about_the_middle():
    along_x, along_y, stretch = np.moveaxis(
        common_errors_px(PIXELS, GSD, np.full(20, 0.8), 118.0), 2, 0
    )
    assert np.ptp(along_x, axis=0).max() == 0.0
    assert np.ptp(along_y, axis=0).max() == 0.0
    assert abs(along_x[0] @ along_y[0]) == 0.0
    assert np.abs(stretch.mean(axis=0)).max() < 1e-12
    outward = PIXELS - PIXELS.mean(axis=0)
    assert np.allclose(stretch[:, 0] * outward[:, 1], stretch[:, 1] * outward[:, 0])


def test_a_single_point_has_finite_errors():
    assert np.isfinite(common_errors_px(PIXELS[:1], GSD[:1], np.array([0.9]), 118.0)).all()
