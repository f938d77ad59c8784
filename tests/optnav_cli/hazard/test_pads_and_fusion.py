"""Pads in squares, and slopes joined with a prior map."""

import math

import numpy as np
import pytest

from catalog.errors import NoSolutionError
from catalog.terrain.slopes import compute_slope_components, convert_to_degrees
from optnav_cli.hazard.hazard_map import combine_slopes, find_too_steep
from optnav_cli.hazard.pads import REFUSED, choose_pads, count_pad_cells, rate_slopes
from optnav_cli.hazard.settings import load_hazard_model
from optnav_cli.hazard.shading import ShadedSlopes, map_slopes
from tests.optnav_cli.hazard.views import bumps, drawn, view_of

MODEL = load_hazard_model()


def slopes_of(dangerous: np.ndarray, shadow: np.ndarray | None = None) -> ShadedSlopes:
    """A map whose only content is how likely cells are dangerous."""
    none = np.zeros_like(dangerous)
    return ShadedSlopes(none, none, dangerous, none, none, none if shadow is None else shadow)


def test_the_pad_of_each_square_is_its_safest_place() -> None:
    dangerous = np.full((120, 160), 0.9, np.float32)
    dangerous[20:31, 40:51] = 0.1
    dangerous[90:101, 100:111] = 0.2
    view = view_of(np.ones_like(dangerous))
    risk = rate_slopes(view, slopes_of(dangerous), 11.0, MODEL)
    pads = {pad.square: pad for pad in choose_pads(view, risk, 60.0)}
    assert set(pads) == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert pads[0, 0].cell == (25.0, 45.0)
    assert pads[1, 1].cell == (95.0, 105.0)
    assert pads[1, 1].shares["expected_dangerous_share"] == pytest.approx(0.2)
    assert risk.code[25, 45] == round(254 * 0.1)


def test_pads_in_shadow_and_at_the_border_are_refused() -> None:
    dangerous = np.zeros((60, 60), np.float32)
    shadow = np.zeros_like(dangerous)
    shadow[:, :30] = 1.0
    view = view_of(np.ones_like(dangerous))
    risk = rate_slopes(view, slopes_of(dangerous, shadow), 9.0, MODEL)
    assert (risk.code[:, :30] == REFUSED).all()
    assert (risk.code[4:-4, 34:-4] < REFUSED).all()
    assert (risk.code[:4] == REFUSED).all()
    assert (risk.code[:, -4:] == REFUSED).all()


@pytest.mark.parametrize(
    ("sun_deg", "least"), [(60.0, 0.1), (20.0, 0.1), (10.0, 0.206), (5.0, 0.3), (1.0, 0.3)]
)
def test_under_a_low_sun_the_shadows_of_the_same_rocks_are_let_pass(sun_deg, least) -> None:
    """As their lengths go, tan 20 deg / tan 10 deg = 2.06, but never over three times as much."""
    assert MODEL.limit_shadow(sun_deg) == pytest.approx(least, abs=5e-4)


def test_of_pads_as_safe_the_flattest_is_chosen_and_of_others_the_safest() -> None:
    none = np.zeros((60, 60), np.float32)
    steep, dangerous = none + 0.09, none + 0.3
    steep[20:29, 40:49] = 0.03  # tangents: 3.4 deg less
    view = view_of(np.ones_like(none))
    slopes = slopes_of(dangerous)._replace(toward=steep)
    for at, safer in (((24.0, 44.0), 0.29), ((24.0, 14.0), 0.2)):
        dangerous[20:29, 10:19] = safer
        (pad,) = choose_pads(view, rate_slopes(view, slopes, 9.0, MODEL), 60.0)
        assert pad.cell == at


def test_a_square_without_a_pad_says_what_refused_them() -> None:
    dangerous = np.zeros((60, 60), np.float32)
    shown = np.ones(dangerous.shape, bool)
    shown[:30] = False
    view = view_of(np.ones_like(dangerous), valid=shown)
    risk = rate_slopes(view, slopes_of(dangerous, dangerous + 1.0), 9.0, MODEL)
    (pad,) = choose_pads(view, risk, 100.0)
    assert pad.cell is None
    assert "shadow" in pad.reason
    assert "not whole in the picture" in pad.reason


def test_a_pad_is_at_least_as_wide_as_it_should_be() -> None:
    view = view_of(np.ones((40, 40), np.float32))
    assert (
        count_pad_cells(view, 20.0),
        count_pad_cells(view, 21.0),
        count_pad_cells(view, 3.0),
    ) == (21, 21, 3)
    for wrong in (2.0, 41.0):
        with pytest.raises(NoSolutionError):
            count_pad_cells(view, wrong)


def test_a_prior_gives_back_the_tilt_that_shading_does_not_see() -> None:
    """Hills on a plane that falls by 5 deg across the Sun."""
    tilt = math.tan(math.radians(5.0))
    rows = np.arange(160, dtype=np.float32)[::-1, None]
    heights = bumps(height_m=0.4) + tilt * rows
    view = drawn(heights.astype(np.float32), 20.0, 90.0)
    true = convert_to_degrees(compute_slope_components(heights.astype(np.float32), 1.0, 1.0, 3.0))
    alone = map_slopes(view, MODEL)
    prior = np.full(true.shape, 5.0, np.float32)
    joined = combine_slopes(view, alone, prior, 20.0, MODEL)
    inner = np.s_[20:-20, 20:-20]
    means = [
        float(convert_to_degrees(np.stack([part.toward, part.across]))[inner].mean())
        for part in (alone, joined)
    ]
    truth = float(true[inner].mean())
    assert abs(means[1] - truth) < 0.5 * abs(means[0] - truth)
    none = combine_slopes(view, alone, np.full_like(prior, np.nan), 20.0, MODEL)
    np.testing.assert_allclose(none.toward, alone.toward, atol=1e-6)


def test_pads_on_steep_ground_of_the_prior_are_refused() -> None:
    prior = np.full((40, 60), 2.0, np.float32)
    prior[:, 30:] = 8.0
    prior[:, 55:] = np.nan
    means, steep = find_too_steep(prior, 5, MODEL)
    assert not steep[:, :27].any()
    assert steep[:, 34:50].all()
    assert means[20, 10] == pytest.approx(2.0)
    assert np.isnan(means[20, 59])
