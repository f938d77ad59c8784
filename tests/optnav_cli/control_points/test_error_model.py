"""The errors that a correlation peak does not show: their sizes, directions and limits."""

from dataclasses import replace

import numpy as np
import pytest

from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from optnav_cli.control_points.error_model import (
    MatchedPoints,
    compute_bias_px,
    compute_common_errors_px,
    compute_point_covariances_px2,
    compute_point_sigma_m,
    compute_scatter_shares,
    load_error_sizes,
)

RADIUS_M, POSTING_M = 1_737_400.0, 118.45
ENU = body_from_local(-0.75, -0.2)
FOOT = xyz_from_latlon(-0.75, -0.2, RADIUS_M)
# one pixel a metre, looking straight down: x east, y south
BY_GROUND = np.stack([ENU[:, 0], -ENU[:, 1]])


def points(offsets):
    return FOOT + np.asarray(offsets, dtype=float) @ ENU[:, :2].T


def sun(elevation_deg, azimuth_deg=90.0):
    e, a = np.radians([elevation_deg, azimuth_deg])
    return ENU @ np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])


def matched(offsets, score=1.0, unresolved_posting_m=0.0, levels=1.0, skipped_m=0.0, sun_deg=30.0):
    places = points(offsets)
    n = len(places)
    ground, finest = np.tile(BY_GROUND, (n, 1, 1)), np.full(n, POSTING_M)
    unresolved = np.full(n, unresolved_posting_m)
    return MatchedPoints(
        places,
        ground,
        np.full(n, score),
        np.full(n, sun_deg),
        POSTING_M * levels * np.ones(n),
        finest,
        unresolved,
        np.full(n, skipped_m),
        np.full(n, 80.0 * POSTING_M),
    )


def errors(offsets, elevation_deg=30.0, **changes):
    return compute_common_errors_px(matched(offsets, **changes), sun(elevation_deg))


SQUARE = [(-2e4, -2e4), (2e4, -2e4), (2e4, 2e4), (-2e4, 2e4)]


def test_a_coarser_level_has_a_larger_error_of_its_own():
    sigmas = [compute_point_sigma_m(POSTING_M * 2**level, POSTING_M, 30.0) for level in range(5)]
    assert sigmas == sorted(sigmas)
    assert compute_point_sigma_m(0.0, POSTING_M, 30.0) > 0.0


def test_a_lower_sun_leaves_a_larger_error_of_a_points_own():
    sigmas = [
        compute_point_sigma_m(POSTING_M, POSTING_M, elevation) for elevation in (0, 5, 10, 30, 90)
    ]
    assert sigmas == sorted(sigmas, reverse=True)
    assert np.isfinite(sigmas).all()


def test_long_shadows_move_all_points_along_the_sun_and_the_lower_the_more():
    low, high = errors(SQUARE, 10.0)[:, :, 0], errors(SQUARE, 40.0)[:, :, 0]
    assert np.allclose(low, low[0])
    assert abs(low[0, 1]) < 1e-2 * abs(low[0, 0])  # the Sun stands in the east
    ratio = np.tan(np.radians(40.0)) / np.tan(np.radians(10.0))
    assert low[0, 0] / high[0, 0] == pytest.approx(ratio, rel=1e-3)


def test_a_sun_on_the_horizon_has_a_finite_error():
    assert np.isfinite(errors(SQUARE, 0.0)).all()


def test_a_sun_overhead_has_a_finite_error():
    assert np.isfinite(errors(SQUARE, 90.0)).all()


def test_a_worse_score_leaves_a_larger_shift_along_and_across_the_sun():
    good, poor = errors(SQUARE, score=1.0), errors(SQUARE, score=0.5)
    for k in (1, 2):
        assert np.linalg.norm(poor[0, :, k]) > 2.0 * np.linalg.norm(good[0, :, k])
    assert abs(good[0, :, 1] @ good[0, :, 2]) < 1e-9


def test_the_stretch_points_outward_and_has_no_net_shift():
    stretch = errors(SQUARE)[:, :, 3]
    assert np.allclose(stretch.mean(axis=0), 0.0, atol=1e-6)
    outward = np.asarray(SQUARE) * [1.0, -1.0]
    assert (np.einsum("ni,ni->n", stretch, outward) > 0.0).all()


def test_a_single_point_has_finite_errors():
    assert np.isfinite(errors([(0.0, 0.0)])).all()


def test_what_a_shape_model_hides_adds_to_what_is_common_and_to_what_is_a_points_own():
    known, hidden = errors(SQUARE), errors(SQUARE, unresolved_posting_m=300.0)
    growth = np.linalg.norm(hidden, axis=1) - np.linalg.norm(known, axis=1)
    grown = np.flatnonzero((growth > 1e-9).all(axis=0))
    # the rise that is the same on all sides, and both shifts
    assert {12, 15, 16} <= set(grown.tolist())
    # behind a blur the shifts stand for what is left of that away from the Sun
    assert not hidden[:, :, 17].any()
    assert (np.delete(growth, 17, axis=1) > -1e-12).all()
    flat = [
        compute_point_covariances_px2(matched(SQUARE, unresolved_posting_m=m)) for m in (0.0, 300.0)
    ]
    assert (np.linalg.eigvalsh(flat[1] - flat[0]) > 0.0).all()


def test_a_terrain_models_error_moves_a_point_along_the_ground_and_in_height():
    """Seen from 45 degrees the height moves a point along one axis of the picture alone.

    The most of the shift is in the match's own covariance: a fourth is added.
    """
    oblique = BY_GROUND + np.array([[1.0], [0.0]]) * ENU[:, 2]
    plain = replace(matched(SQUARE), pixel_per_metre=np.tile(oblique, (4, 1, 1)))
    for sigmas, wanted in (((0.0, 0.0), (0.0, 0.0)), ((60.0, 0.0), (225.0, 225.0)),
                           ((0.0, 20.0), (400.0, 0.0))):  # fmt: skip
        stated = replace(plain, terrain_sigmas_m=np.tile(sigmas, (4, 1)))
        added = compute_point_covariances_px2(stated) - compute_point_covariances_px2(plain)
        # the corners lie 28 km from the middle, where the ground leans by 0.016
        assert np.diagonal(added, axis1=1, axis2=2) == pytest.approx(
            np.tile(wanted, (4, 1)), rel=0.04, abs=3.0
        )


def test_what_is_common_shrinks_where_the_model_is_stated_right_and_explains_the_frame():
    others = np.r_[0:7, 10:20]  # but for a view round the body, [curved]

    def common(score, stated):
        known = None if stated is None else np.full(4, stated)
        points = replace(matched(SQUARE, score=score), terrain_errors=known)
        return compute_common_errors_px(points, sun(30.0))[:, :, others]

    whole = common(0.98, None)
    np.testing.assert_allclose(common(0.98, 0.3), 0.3 * whole, atol=1e-12)
    np.testing.assert_allclose(
        common(0.98, 0.0), load_error_sizes().terrain.right * whole, atol=1e-12
    )
    assert (common(0.98, 1.0) == whole).all()
    assert (common(0.98, 5.0) == whole).all()
    # of coarse levels, what averaging moves stays
    nodes = np.r_[12:17]
    coarse, finest = (
        compute_common_errors_px(matched(SQUARE, score=0.98, levels=level), sun(30.0))[:, :, nodes]
        for level in (4.0, 1.0)
    )
    points = replace(matched(SQUARE, score=0.98, levels=4.0), terrain_errors=np.full(4, 0.3))
    some = compute_common_errors_px(points, sun(30.0))[:, :, nodes]
    np.testing.assert_allclose(some, coarse - 0.7 * finest, atol=1e-12)
    # a right model under albedo, and one that errs but is seen well
    np.testing.assert_allclose(common(0.85, 0.1), common(0.85, None))
    np.testing.assert_allclose(common(0.92, 0.1), 0.8**4 * common(0.92, None), atol=1e-12)
    plain = matched(SQUARE, score=0.98)
    seen_well = replace(plain, terrain_errors=np.full(4, 0.3))
    of_plain, of_right = (np.array(compute_scatter_shares(points)) for points in (plain, seen_well))
    np.testing.assert_allclose(of_right, 0.3 * of_plain)


def test_a_view_round_the_body_stretches_what_a_coarse_level_averages():
    curved = errors(SQUARE, levels=np.array([1.0, 2.0, 3.0, 1.0]))[:, :, 7:10]
    size = np.linalg.norm(curved, axis=1)
    assert np.allclose(size[2], 2.0 * size[1])
    # the finest level's part goes with the square of the view, and this view is small
    assert (size[[0, 3]] > 0.0).all()
    assert (size[[0, 3]] < 0.1 * size[1]).all()


def test_the_pattern_moves_along_the_sun_more_than_across_it():
    along, across = errors(SQUARE)[0, :, 15], errors(SQUARE)[0, :, 16]
    assert abs(along @ across) < 1e-9
    assert abs(along[1]) < 1e-2 * abs(along[0])  # the Sun stands in the east
    assert np.linalg.norm(along) == pytest.approx(1.5 * np.linalg.norm(across), rel=0.01)


def test_a_pattern_is_found_away_from_a_low_sun():
    """0.9 m, and 15 m for a score of 0, for a cotangent of 1 above 1.5; the Sun is in the east."""
    size = 1.0 / np.tan(np.radians(20.0)) - 1.5
    for score, moved_m in ((1.0, 0.9), (0.5, 8.4)):
        bias = compute_bias_px(matched(SQUARE, score=score, sun_deg=20.0), sun(20.0))
        assert bias[:, 0] == pytest.approx(-moved_m * size, rel=0.02)  # 1 px a metre
    high = matched(SQUARE, score=0.5, sun_deg=40.0)
    assert compute_bias_px(high, sun(40.0)) == pytest.approx(np.zeros((4, 2)))
    hidden = matched(SQUARE, score=0.5, sun_deg=20.0, unresolved_posting_m=319.0)
    assert compute_bias_px(hidden, sun(20.0)) == pytest.approx(np.zeros((4, 2)))


def test_a_level_coarser_than_the_picture_resolves_errs_by_what_it_skips():
    plain, skipped = matched(SQUARE, levels=4.0), matched(SQUARE, levels=4.0, skipped_m=355.0)
    wider = compute_point_covariances_px2(skipped) - compute_point_covariances_px2(plain)
    assert np.trace(wider, axis1=1, axis2=2) == pytest.approx(2.0 * 5.0**2, rel=0.05)


def test_templates_of_poor_score_are_moved_as_a_whole_the_less_the_wider_they_are():
    """15 m an axis for a score of 0 over 9.5 km, and 22.5 more for a cotangent of 1."""
    good, poor = matched(SQUARE), matched(SQUARE, score=0.5)
    added = compute_point_covariances_px2(poor) - compute_point_covariances_px2(good)
    cotangent = 1.0 / np.tan(np.radians(poor.sun_elevation_deg[0]))
    square = 7.5**2 + (11.25 * cotangent) ** 2
    assert np.trace(added, axis1=1, axis2=2) == pytest.approx(2.0 * square, rel=0.05)
    wide = replace(poor, sizes_m=2.0 * poor.sizes_m)
    less = compute_point_covariances_px2(wide) - compute_point_covariances_px2(good)
    assert less == pytest.approx(added / 4.0, rel=1e-6)
