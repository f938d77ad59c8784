"""Stated errors of terrain models against what was measured of GLD100, and their limits."""

import math

import numpy as np
import pytest

from catalog.terrain.error_model import (
    REFERENCE_SLOPE,
    StatedError,
    TerrainErrorModel,
    load_terrain_laws,
    measure_rms_slope,
)

POSTING_M = 118.45


def error_of(product="gld100", posting_m=POSTING_M):
    return TerrainErrorModel.make(StatedError(product), posting_m)


def test_the_place_of_a_template_errs_as_measured_on_highlands_by_its_size():
    # rms an axis, m, GLD100 against LOLA; whatever the posting
    for size_m, low, high in ((4.7e3, 160, 170), (9.5e3, 95, 105), (19e3, 23, 24)):
        assert low <= error_of().point_sigma_m(size_m, REFERENCE_SLOPE).shift_m <= high
    wide = error_of().point_sigma_m(150e3, REFERENCE_SLOPE).shift_m
    assert 15 <= wide <= 45  # what stereo models shift by over regions


def test_the_mean_height_of_a_box_errs_as_measured_on_highlands_by_its_size():
    measured = ((2, 28, 28), (4, 14, 14), (8, 7, 7), (15, 5, 8), (30, 5, 8), (121, 8, 10))
    for side_km, low, high in measured:
        height = error_of().point_sigma_m(side_km * 1e3, REFERENCE_SLOPE).height_m
        assert low - 0.2 <= height <= high + 0.2, side_km


def test_heights_err_more_on_steep_ground_and_places_less():
    # rms at 2 km, m, by the local slope, GLD100 minus LOLA
    for slope, height_m in ((0.02, 9), (0.03, 15), (0.055, 22), (0.12, 32), (0.15, 34)):
        assert error_of().point_sigma_m(2e3, slope).height_m == pytest.approx(height_m, abs=0.2)
    flat, steep = (error_of().point_sigma_m(9.5e3, slope).shift_m for slope in (0.03, 0.12))
    assert flat > 1.5 * steep
    # beyond what was measured, and where no slope is known, it stays finite
    assert error_of().point_sigma_m(2e3, 0.0) == error_of().point_sigma_m(2e3, 0.02)
    assert error_of().point_sigma_m(2e3, 2.0) == error_of().point_sigma_m(2e3, 0.15)
    assert error_of().point_sigma_m(2e3, math.nan) == error_of().point_sigma_m(2e3, 0.085)


def test_simulated_ground_is_off_by_what_is_stated_of_the_model():
    """But for what a sum of octaves adds where the fall meets the floor; see terrain.toml."""
    for name, spectrum in load_terrain_laws().spectrum.items():
        for side_km, rms_m in zip(spectrum.box_km, spectrum.rms_m, strict=True):
            stated = error_of(name).point_sigma_m(side_km * 1e3, REFERENCE_SLOPE).height_m
            assert 0.8 < rms_m / stated < 1.4, side_km
        for slope, rms_m in zip(spectrum.slope, spectrum.slope_rms_m, strict=True):
            stated = error_of(name).point_sigma_m(2e3, slope).height_m
            assert rms_m == pytest.approx(stated, rel=0.01), slope


def test_a_template_below_the_resolution_has_the_error_of_one_as_wide():
    model = error_of()
    assert model.point_sigma_m(500.0, 0.085) == model.point_sigma_m(1600.0, 0.085)
    assert model.point_sigma_m(1600.0, 0.085).shift_m > model.point_sigma_m(4700.0, 0.085).shift_m


def test_a_better_product_places_templates_better_in_proportion():
    laws, wide = load_terrain_laws(), 30e3
    gld100 = error_of().point_sigma_m(wide, REFERENCE_SLOPE).shift_m
    for name, product in laws.product.items():
        found = error_of(name).point_sigma_m(wide, REFERENCE_SLOPE).shift_m
        assert found == pytest.approx(gld100 * product.error_m / laws.product["gld100"].error_m)
        assert product.source


def test_errors_of_models_are_compared_with_gld100_by_error_and_resolution():
    assert error_of().against_gld100 == pytest.approx(1.0)
    # a model that is right but for what its grid cannot hold, and one as coarse as GLD100's waves
    for stated, least, most in (((0.5, 0.237), 0.10, 0.12), ((0.5, 1.6), 0.70, 0.72)):
        model = TerrainErrorModel.make(StatedError(None, *stated), POSTING_M)
        assert least < model.against_gld100 < most
    # a mesh whose vertices lie as far apart as half of GLD100's waves errs as it does
    assert error_of("mesh", 800.0).against_gld100 == pytest.approx(1.0)
    assert error_of("mesh", 80.0).against_gld100 == pytest.approx(0.1)


def test_numbers_stand_for_a_product_and_a_mesh_goes_by_its_posting():
    stated = TerrainErrorModel.make(StatedError(None, 28.0, 1.6), POSTING_M)
    assert stated.point_sigma_m(9.5e3, 0.05) == error_of().point_sigma_m(9.5e3, 0.05)
    assert TerrainErrorModel.make(StatedError(None, 3.0), 100.0).resolution_km == pytest.approx(0.2)
    assert TerrainErrorModel.make(StatedError(), POSTING_M) is None
    fine, coarse = (error_of("mesh", posting_m) for posting_m in (2.0, 400.0))
    one, other = fine.point_sigma_m(50.0, 0.3), coarse.point_sigma_m(10e3, 0.3)
    assert np.multiply(one, 200.0) == pytest.approx(other)


def test_a_slope_is_that_of_a_plane_and_holes_take_no_part():
    rows, cols = np.mgrid[:21, :21]
    plane = (0.3 * cols + 0.4 * rows) * 100.0
    assert measure_rms_slope(plane, 100.0, 800.0) == pytest.approx(0.5)
    plane[10, 10] = np.nan
    assert measure_rms_slope(plane, 100.0, 800.0) == pytest.approx(0.5)
    assert math.isnan(measure_rms_slope(np.full((8, 8), np.nan), 100.0, 800.0))
