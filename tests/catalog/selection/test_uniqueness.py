"""Uniqueness margins on ground made unique or repeated, and shadow limits against given Suns."""

import cv2
import numpy as np
import pytest
from scipy import ndimage

from catalog.pipeline.check import measure_shadowed_share
from catalog.selection.localisation import compute_uniqueness_margin, find_best_rival


def relief(size, seed):
    rng = np.random.default_rng(seed)
    return cv2.GaussianBlur(rng.standard_normal((size, size)).astype(np.float32), (0, 0), 2.0)


def test_repeated_ground_has_no_margin_and_other_ground_has_one():
    tile = relief(6, 1)
    repeated = np.tile(tile, (14, 14))[:80, :80]  # every 6 nodes the same again
    assert compute_uniqueness_margin(repeated, 64, 8.0) < 0.02
    assert compute_uniqueness_margin(relief(80, 2), 64, 8.0) > 0.1


def test_rivals_out_of_reach_do_not_count():
    tile = relief(6, 1)
    repeated = np.tile(tile, (14, 14))[:80, :80]
    assert compute_uniqueness_margin(repeated, 64, 5.0) > 0.05


def test_the_slope_of_the_true_peak_is_no_rival():
    y, x = np.mgrid[-8:9, -8:9]
    cone = (1.0 - 0.05 * np.hypot(x, y)).astype(np.float32)
    assert find_best_rival(cone, 8.0) == -1.0
    cone[2, 3] = 0.9
    assert find_best_rival(cone, 8.0) == pytest.approx(0.9)
    assert find_best_rival(cone, 5.0) == -1.0


def test_the_best_rival_is_the_highest_of_scipy_s_local_maxima_in_reach():
    rng = np.random.default_rng(3)
    away = np.maximum(*np.abs(np.mgrid[-8:9, -8:9]))
    for reach in (5.0, 6.5, 100.0):
        surface = rng.random((17, 17), dtype=np.float32)
        local = surface == ndimage.maximum_filter(surface, 3, mode="constant", cval=-1.0)
        wanted = surface[local & (away > 3) & (away <= reach)].max()
        assert find_best_rival(surface, reach) == wanted


def sun(azimuth_deg, elevation_deg):
    a, e = np.radians([azimuth_deg, elevation_deg])
    return [np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)]


def test_suns_are_compared_with_the_limit_of_their_own_azimuth():
    limits = np.zeros(36)
    limits[9] = 20.0  # due east
    suns = np.array([sun(90, 15), sun(94, 15), sun(96, 15), sun(90, 25), sun(-90, 15)])
    assert measure_shadowed_share(limits, suns) == pytest.approx(2 / 5)


def test_azimuths_just_west_of_north_belong_to_the_first_bin():
    limits = np.zeros(36)
    limits[0] = 10.0
    assert measure_shadowed_share(limits, np.array([sun(357, 5)])) == 1.0
    assert measure_shadowed_share(limits, np.array([sun(354, 5)])) == 0.0
