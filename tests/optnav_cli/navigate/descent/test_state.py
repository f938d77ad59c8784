"""Windows in the joint state: how far they err alike, whatever order they join in."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from catalog.arrays import FloatArray
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.control_points.field import BAND_SIDES_M, StatedBands
from optnav_cli.navigate.descent.filter import TRACK, TrackErrors
from optnav_cli.navigate.descent.state import (
    NO_ROOTS,
    JointState,
    WindowError,
    WindowGround,
    correlate_errors,
    load_descent_sizes,
)
from optnav_cli.navigate.descent.windows import (
    STEP,
    SeenGround,
    WindowField,
    WindowKey,
    compute_overlaps,
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
    expected = {
        here: 1.0,
        WindowKey(0, 24, 0, 24 // STEP): 0.0,
        WindowKey(0, 24, 0, 12 // STEP): 0.5,
        # a small window inside a large one: the root of its share
        WindowKey(0, 12, 0, 0): 0.5,
        # of the next level, whose postings are twice as wide: a quarter of its ground
        WindowKey(1, 24, 0, 0): 0.5,
        WindowKey(1, 24, 0, 9): 0.0,
    }
    assert compute_overlaps([here], list(expected))[0] == pytest.approx(list(expected.values()))
    assert compute_overlaps(list(expected), [here])[:, 0] == pytest.approx(list(expected.values()))
    far = WindowKey(1, 24, 0, 12), WindowKey(0, 24, 0, 24)
    assert compute_overlaps([far[0]], [far[1]]) == pytest.approx(0.5)


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


def stated_window(col: int, level: int = 0) -> WindowError:
    """A window of ground whose stated error is the same in each band."""
    bands = StatedBands(BAND_SIDES_M, np.tile([10.0, 4.0], (len(BAND_SIDES_M), 1)))
    key, none = WindowKey(level, 24, 0, col), np.zeros((2, 2))
    place = np.array([1.7374e6, STEP * 118.45 * 2.0**level * col, 0.0])
    ground = WindowGround(key, np.eye(3), 118.45, none, np.eye(2), bands, place)
    return ground.compute_error(load_descent_sizes())


def plain_window() -> WindowError:
    """The same window of a model that states nothing."""
    none = np.zeros((2, 2))
    ground = WindowGround(WindowKey(0, 24, 0, 0), np.eye(3), 118.45, none, np.eye(2))
    return ground.compute_error(load_descent_sizes())


def test_what_a_model_states_widens_its_windows() -> None:
    sizes, count = load_descent_sizes(), len(BAND_SIDES_M)
    total = correlate_errors([stated_window(0)], [stated_window(0)])
    plain = replace(stated_window(0), stated=NO_ROOTS, own_m=plain_window().own_m)
    gained = np.diag(total) - np.diag(correlate_errors([plain], [plain]))
    shift = 100.0 * (sizes.stated_shift**2 + sizes.stated_own**2)
    height = 16.0 * sizes.stated_height**2
    assert gained == pytest.approx(count * np.array([shift, shift, height]), rel=1e-5)


def test_neighbours_share_the_long_waves_of_a_stated_error() -> None:
    """Also windows of other levels; ground 900 km away shares nothing but the level's own part."""
    sizes = load_descent_sizes()
    here, near, coarse, far = (stated_window(*at) for at in ((0, 0), (12, 0), (6, 1), (2000, 0)))
    apart = STEP * 118.45 * 12.0
    lengths = sizes.stated_width * BAND_SIDES_M
    expected = 16.0 * sizes.stated_height**2 * np.exp(-apart / lengths).sum()
    bare = [replace(each, stated=NO_ROOTS) for each in (here, near, coarse, far)]
    shared = [
        (correlate_errors([here], [each]) - correlate_errors([bare[0]], [other]))[2, 2]
        for each, other in zip((near, coarse, far), bare[1:], strict=True)
    ]
    assert shared == pytest.approx([expected, expected, 0.0], abs=0.1)


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
