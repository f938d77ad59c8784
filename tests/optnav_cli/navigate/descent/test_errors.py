"""Errors of a descent's windows, and how they learn that the model is wrong."""

import numpy as np
import pytest

from optnav_cli.navigate.descent.state import (
    SCALES,
    WindowGround,
    WindowSpread,
    correlate_errors,
    load_descent_sizes,
)
from optnav_cli.navigate.descent.windows import STEP, WindowKey

SIZES = load_descent_sizes()


def ground(col: int, left_m2: tuple[float, float] = (25.0, 100.0)) -> WindowGround:
    """A window whose match leaves over different variances east and north."""
    key = WindowKey(0, 24, 0, col)
    return WindowGround(key, np.eye(3), 118.0, np.diag(left_m2), 25.0 * np.eye(2))


def squares(rng: np.random.Generator, count: int, scale: float, stated: float) -> np.ndarray:
    """Of drawn misses of windows as `ground`, by the scale that they are stated with."""
    stays, scaled = ground(0).compute_level_m2(SIZES)
    misses = rng.multivariate_normal(np.zeros(2), stays + scale * scaled, count)
    inverse = np.linalg.inv(stays + stated * scaled)
    return np.asarray(np.einsum("ni,ij,nj->n", misses, inverse, misses))


@pytest.mark.parametrize("scale", [1.0, 15.0])
@pytest.mark.parametrize("stated", [1.0, float(SCALES[-1])])
def test_windows_tell_the_scale_of_what_their_matches_leave_over(
    scale: float, stated: float
) -> None:
    """Whatever scale they are first stated with; the model that is wrong by 3 m rms has 12 to 17.

    From too small a scale the widest are cut off, so that it is raised in steps.
    """
    rng = np.random.default_rng(5)
    for _ in range(6):
        spread = WindowSpread().add_windows(
            [ground(k) for k in range(200)], squares(rng, 200, scale, stated), stated, SIZES
        )
        stated = spread.scale
    assert spread.scale == pytest.approx(scale, rel=0.25)
    assert spread.count == 200


def test_one_wrong_match_does_not_widen_all_windows_by_much() -> None:
    rng = np.random.default_rng(6)
    found = squares(rng, 40, 1.0, 1.0)
    without, among = (
        WindowSpread().add_windows([ground(k) for k in range(40)], each, 1.0, SIZES).scale
        for each in (found, np.append(found[1:], np.inf))
    )
    assert among / without < 1.4


def test_a_scale_widens_what_the_match_left_over_along_its_own_axes() -> None:
    """Neither the height nor what all windows have in common, and north more than east."""
    narrow, wide = (ground(0).compute_error(SIZES, scale) for scale in (1.0, 10.0))
    grown = (wide.own_m @ wide.own_m - narrow.own_m @ narrow.own_m).round(6)
    assert grown == pytest.approx(9.0 * SIZES.remainder * np.diag([25.0, 100.0, 0.0]))
    assert wide.common_m == pytest.approx(narrow.common_m)


def test_windows_without_ground_in_common_share_the_common_part_alone() -> None:
    near, far = ground(0).compute_error(SIZES), ground(24 // STEP).compute_error(SIZES)
    tie = correlate_errors([near], [far])
    assert tie == pytest.approx(near.common_m @ far.common_m)
    own = correlate_errors([near], [near])
    assert own == pytest.approx(near.common_m @ near.common_m + near.own_m @ near.own_m, rel=1e-5)
