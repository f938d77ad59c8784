"""Windows in the joint state: how far they err alike, whatever order they join in."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from catalog.arrays import FloatArray
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.control_points.field import StatedSigmas
from optnav_cli.navigate.descent.filter import TRACK, TrackErrors
from optnav_cli.navigate.descent.state import (
    JointState,
    WindowError,
    WindowGround,
    load_descent_sizes,
)
from optnav_cli.navigate.descent.windows import (
    STEP,
    SeenGround,
    WindowField,
    WindowKey,
    compute_overlap,
)

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
    # of the next level, whose postings are twice as wide: a quarter of its ground is the first's
    assert compute_overlap(here, WindowKey(1, 24, 0, 0)) == pytest.approx(0.5)
    assert compute_overlap(WindowKey(1, 24, 0, 9), here) == 0.0
    assert compute_overlap(WindowKey(1, 24, 0, 12), WindowKey(0, 24, 0, 24)) == pytest.approx(0.5)


def choose(distance_m: float, resolution_m: float | None) -> tuple[int, int] | None:
    """Choose the level and side over patches of 118, 237 and 474 m."""
    field = object.__new__(WindowField)
    layer = SimpleNamespace(postings_m=118.45 * np.array([1.0, 2.0, 4.0]))
    points: Any = SimpleNamespace(layers=[layer], resolution_m=lambda place: resolution_m)
    field.points = points
    camera = preset_camera("tsnn2_wide")
    view = SeenGround(np.zeros(3), distance_m / camera.coarse_focal_px, np.zeros((0, 3)))
    return field.choose_level(view, camera)


@pytest.mark.parametrize("distance_m", [2e3, 5e3, 2e4])
def test_windows_over_a_model_of_coarse_resolution_are_wider(distance_m: float) -> None:
    level, side = choose(distance_m, None) or (9, 0)
    assert level == 0
    coarse, wide = choose(distance_m, 1600.0) or (9, 0)
    if distance_m > 4e3:
        # six waves, or what the picture shows
        assert (coarse, wide) == (1, 40 if distance_m > 1e4 else 16)
    else:  # a picture from 2 km shows too little for a window of the next level
        assert (coarse, wide) == (level, side)


def test_what_a_model_states_widens_its_windows() -> None:
    sizes = load_descent_sizes()
    axes, none = np.eye(3), np.zeros((2, 2))
    key = WindowKey(0, 24, 0, 0)
    plain = WindowGround(key, axes, 118.45, none, np.eye(2)).compute_error(sizes)
    stated = StatedSigmas(100.0, 20.0, 24.0, 7.0)
    error = WindowGround(key, axes, 118.45, none, np.eye(2), stated).compute_error(sizes)
    gained = np.diag(error.own_m) ** 2 - np.diag(plain.own_m) ** 2
    shift = (sizes.stated_shift * 100.0) ** 2
    assert gained == pytest.approx([shift, shift, (sizes.stated_height * 20.0) ** 2])
    shared = np.diag(error.common_m) ** 2 - np.diag(plain.common_m) ** 2
    region = (sizes.stated_region * 24.0) ** 2
    assert shared == pytest.approx([region, region, (sizes.stated_height * 7.0) ** 2])


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
