"""Windows in the joint state: how far they err alike, whatever order they join in."""

import numpy as np
import pytest

from catalog.arrays import FloatArray
from optnav_cli.navigate.descent.filter import TRACK, TrackErrors
from optnav_cli.navigate.descent.state import JointState, WindowError
from optnav_cli.navigate.descent.windows import STEP, WindowKey, compute_overlap

COMMON_SHARE = 0.15
WINDOWS = TRACK + 3  # what windows of a level have in common stands before them
ERRORS = TrackErrors(300.0, 0.8, 0.0, 6e-5, 4e-7, 1.5e-5)


def window(row: int, col: int, sigma_m: float = 8.0, side: int = 24) -> WindowError:
    """With a variance of which COMMON_SHARE is that of all windows."""
    root = sigma_m * np.diag([1.0, 1.0, 0.5])
    common, own = (np.sqrt(share) * root for share in (COMMON_SHARE, 1.0 - COMMON_SHARE))
    return WindowError(WindowKey(0, side, row, col), common, own)


def places(count: int) -> FloatArray:
    return np.tile([1.7374e6, 0.0, 0.0], (count, 1))


def test_windows_err_alike_as_far_as_they_share_ground() -> None:
    here = WindowKey(0, 24, 0, 0)
    assert compute_overlap(here, here) == 1.0
    assert compute_overlap(here, WindowKey(0, 24, 0, 24 // STEP)) == 0.0
    assert compute_overlap(here, WindowKey(0, 24, 0, 12 // STEP)) == pytest.approx(0.5)
    # a small window inside a large one: the root of its share
    assert compute_overlap(here, WindowKey(0, 12, 0, 0)) == pytest.approx(0.5)
    assert compute_overlap(here, WindowKey(1, 24, 0, 0)) == 0.0


def test_the_order_in_which_windows_join_does_not_matter() -> None:
    errors = [window(0, 0), window(0, 3, 12.0), window(2, 1, 6.0, 16)]
    together, one_by_one = JointState(ERRORS), JointState(ERRORS)
    together.join_windows(errors, places(3))
    for error in errors:
        one_by_one.join_windows([error], places(1))
    a, b = (state.filter.covariance[WINDOWS:, WINDOWS:] for state in (together, one_by_one))
    assert a == pytest.approx(b, abs=1e-4)
    tie = COMMON_SHARE + (1.0 - COMMON_SHARE) * 0.5
    assert a[0, 3] == pytest.approx(tie * 8.0 * 12.0, rel=1e-4)


def test_a_window_joins_where_its_neighbour_was_found_to_err() -> None:
    """A neighbour known to be 10 m off says half of it of a window that shares half its ground."""
    state = JointState(ERRORS)
    state.join_windows([window(0, 0)], places(1))
    state.filter.state[WINDOWS] = 10.0
    state.join_windows([window(0, 3)], places(1))
    assert state.filter.offsets_m[2] == pytest.approx([5.0, 0.0, 0.0], rel=1e-4)
    # the track is not touched by it
    assert not state.filter.state[:TRACK].any()


def test_what_is_kept_is_kept_in_order() -> None:
    state = JointState(ERRORS)
    errors = [window(0, col) for col in (0, 6, 12)]
    state.join_windows(errors, places(3))
    state.keep({errors[0].key, errors[2].key})
    assert state.windows == [errors[0].key, errors[2].key]
    assert state.filter.count == 3
    assert state.place_m(errors[1].key) is None


def test_what_windows_have_in_common_outlives_them() -> None:
    """All windows 3 m off east, and gone: the next one, elsewhere, is expected there in part."""
    state = JointState(ERRORS)
    state.join_windows([window(0, 0)], places(1))
    state.keep(set())
    assert state.windows == []
    state.filter.state[TRACK] = 1.0  # in units of a window's sigma
    state.join_windows([window(0, 900)], places(1))
    expected = 8.0 * np.sqrt(COMMON_SHARE)
    assert state.filter.offsets_m[1] == pytest.approx([expected, 0.0, 0.0], rel=1e-4)
