"""The skyline against peaks of known place and height, and against the shadows themselves."""

import math

import cv2
import numpy as np
import pytest
import rasterio

from catalog.config import resource
from catalog.rendering.shadow import make_lit_mask
from catalog.terrain.skyline.local import _find_lowest, _find_steeper, compute_skyline_limits_deg

MOON_M = 1_737_400.0
POSTING_M = 118.45


def sun(elevation_deg, azimuth_deg):
    el, az = np.radians([elevation_deg, azimuth_deg])
    return np.array([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)])


def flat_levels(size=40, count=4, posting=100.0):
    return [(np.zeros((size, size), np.float32), posting * 2**k) for k in range(count)]


def tycho_levels(row, col, size=80, count=5):
    half = size * 2 ** (count - 1) // 2
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as dataset:
        window = rasterio.windows.Window(col - half, row - half, 2 * half, 2 * half)
        grid = dataset.read(1, window=window).astype(np.float32)
    levels, posting = [], POSTING_M
    for _ in range(count):
        middle = grid.shape[0] // 2
        cut = slice(middle - size // 2, middle + size // 2)
        levels.append((np.ascontiguousarray(grid[cut, cut]), posting))
        grid = cv2.resize(grid, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        posting *= 2
    return levels


def test_a_bare_sphere_has_only_the_tilt_of_its_corners():
    """At a corner the local horizon stands higher, on the centre's side, by its distance / R."""
    corner = math.degrees(math.hypot(1950.0, 1950.0) / MOON_M)
    limits = compute_skyline_limits_deg(flat_levels(), 0, MOON_M)
    assert 0.0 < limits.max() < corner
    assert compute_skyline_limits_deg(flat_levels(), 0, 1e12).max() < 1e-6


@pytest.mark.parametrize(
    ("azimuth_bin", "d_row", "d_col"), [(0, -1, 0), (9, 0, 1), (18, 1, 0), (27, 0, -1)]
)
def test_a_ridge_outside_stands_in_its_own_direction(azimuth_bin, d_row, d_col):
    levels = flat_levels()
    ridge = levels[2][0]
    centre = 19.5
    row, col = round(centre + d_row * 14.5), round(centre + d_col * 14.5)
    ridge[row - 1 : row + 2, col - 1 : col + 2] = 1000.0
    limits = compute_skyline_limits_deg(levels, 0, MOON_M)
    assert limits[azimuth_bin] > limits.max() - 0.05
    # from the near edge of the patch (1.95 km) to the near edge of the ridge (5.4 km); the step of
    # 400 m between samples of a cliff makes it up to 1.7 deg lower
    steepest = math.degrees(math.atan2(1000.0, 3450.0))
    assert steepest - 1.7 < limits[azimuth_bin] < steepest + 0.1
    assert limits[(azimuth_bin + 18) % 36] < 0.1


def test_a_hill_inside_the_patch_is_no_foreign_skyline():
    levels = flat_levels()
    levels[0][0][15:25, 15:25] = 3000.0
    np.testing.assert_array_equal(
        compute_skyline_limits_deg(levels, 0, MOON_M),
        compute_skyline_limits_deg(flat_levels(), 0, MOON_M),
    )


def test_curvature_hides_far_peaks():
    levels = flat_levels(count=5, posting=1000.0)
    bare = compute_skyline_limits_deg(levels, 0, MOON_M)
    levels[4][0][19:21, 33:35] = 3000.0  # 232 km away: its foot is 15 km below the tangent plane
    np.testing.assert_array_equal(compute_skyline_limits_deg(levels, 0, MOON_M), bare)
    assert compute_skyline_limits_deg(levels, 0, 1e12).max() > 0.5


def test_no_foreign_shadow_falls_above_the_limit_and_some_do_below():
    levels = tycho_levels(1080, 1500)
    limits = compute_skyline_limits_deg(levels, 0, MOON_M)
    fallen = 0
    for azimuth in range(0, 360, 20):
        # 0.5 deg: the stated error of the planes' spacing
        towards = sun(limits[azimuth // 10] + 0.5, azimuth)
        own = make_lit_mask(*levels[0], towards, MOON_M)
        joined = make_lit_mask(*levels[0], towards, MOON_M, levels[1:])
        assert (own & ~joined).sum() <= 6, azimuth
        towards = sun(max(limits[azimuth // 10] - 3.0, 0.2), azimuth)
        own = make_lit_mask(*levels[0], towards, MOON_M)
        fallen += (own & ~make_lit_mask(*levels[0], towards, MOON_M, levels[1:])).any()
    assert fallen >= 9


def test_the_coarsest_level_knows_nothing_outside():
    levels = tycho_levels(1080, 1500, count=3)
    assert (compute_skyline_limits_deg(levels, 2, MOON_M) == 0.0).all()
    with pytest.raises(ValueError, match="not a level 3"):
        compute_skyline_limits_deg(levels, 3, MOON_M)


@pytest.mark.parametrize("start", [0.0, 0.05, 0.3])
def test_the_steepest_line_is_that_of_all_pairs(start):
    rng = np.random.default_rng(11)
    for _ in range(200):
        near_s, far_s = rng.uniform(-50.0, 0.0, 30), rng.uniform(0.1, 300.0, 40)
        near_z, far_z = rng.normal(0.0, 5.0, 30), rng.normal(0.0, rng.uniform(1.0, 20.0), 40)
        foot = _find_lowest(near_s, near_z, 30, start)
        found, foot = _find_steeper(near_s, near_z, 30, far_s, far_z, 40, start, foot)
        slopes = (far_z - near_z[:, None]) / (far_s - near_s[:, None])
        assert found == max(slopes.max(), start)
        assert foot == np.argmin(near_z - found * near_s)


def test_a_level_without_ground_hides_nothing_and_a_patch_without_ground_sees_nothing():
    levels = tycho_levels(1080, 1500, count=4)
    known = compute_skyline_limits_deg(levels[:3], 0, MOON_M)
    levels[3][0][:] = np.nan
    np.testing.assert_array_equal(compute_skyline_limits_deg(levels, 0, MOON_M), known)
    levels[0][0][:] = np.nan
    assert not compute_skyline_limits_deg(levels, 0, MOON_M).any()


def test_points_that_two_grids_share_make_no_wall():
    # at some postings, rounding once put the last point inside and the first outside at one place
    for posting in (118.45058759433391, 99.9, 237.1):
        assert compute_skyline_limits_deg(flat_levels(80, 4, posting), 0, MOON_M).max() < 1.0
