"""Windows cut from a point's patches: own level inside, coarser ones around it, right places."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from catalog.control_point import Patch
from catalog.geometry.grid import interpolate_bicubic
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.projection import Stereographic, make_node_grid
from catalog.photometry.laws import find_law
from catalog.rendering.map_view import render_map
from optnav_cli.control_points.reference import Reference, _fill_from


@pytest.fixture
def reference(rough_world):
    point, patches = rough_world.control_points[len(rough_world.control_points) // 2]
    return Reference(point, patches, rough_world.radius_m)


@pytest.mark.parametrize("size", [16, 40, 64])
def test_inside_a_patch_the_window_is_the_patch(reference, size):
    own = reference.patches[1].heights_m
    cut = (own.shape[0] - size) // 2
    middle = own[cut : cut + size, cut : cut + size]
    assert_allclose(reference.heights(1, size), middle)


def test_a_window_of_odd_size_lies_between_the_nodes(reference):
    """Its centre is the patch's centre, between the four middle nodes."""
    own = reference.patches[0].heights_m.astype(np.float64)
    window = reference.heights(0, 31)
    middle = own[31:33, 31:33].mean()
    # cubic convolution at half a node differs from the mean of four by the ground's curvature
    assert window[15, 15] == pytest.approx(middle, abs=np.abs(np.diff(own)).mean() / 2)


def test_a_window_wider_than_its_patch_goes_on_with_the_coarser_levels(reference):
    window = reference.heights(0, 100)
    own, coarse = reference.patches[0].heights_m, reference.patches[1]
    assert np.isfinite(window).all()
    assert_allclose(window[18:82, 18:82], own)
    # on a plane the seam would vanish; on this ground the levels differ by the finer relief
    x, y = make_node_grid(100, 120.0)
    e, n = x / coarse.posting_m + 31.5, 31.5 - y / coarse.posting_m
    nearest = coarse.heights_m[np.rint(n).astype(int), np.rint(e).astype(int)]
    ring = np.ones((100, 100), dtype=bool)
    ring[18:82, 18:82] = False
    assert np.abs(window - nearest)[ring].max() < 4.0 * np.abs(np.diff(coarse.heights_m)).max()
    assert np.abs(window - nearest)[ring].mean() < 0.1 * coarse.heights_m.std() + 10.0


def test_levels_of_one_plane_join_without_a_seam():
    x0, y0 = make_node_grid(16, 10.0)
    x1, y1 = make_node_grid(16, 20.0)
    point_patches = (
        Patch(10.0, (0.1 * x0 - 0.2 * y0).astype(np.float32)),
        Patch(20.0, (0.1 * x1 - 0.2 * y1).astype(np.float32)),
    )
    window = Reference(None, point_patches, 1e6).heights(0, 30)
    x, y = make_node_grid(30, 10.0)
    assert_allclose(window, 0.1 * x - 0.2 * y, atol=1e-4)


def test_where_no_level_has_data_the_window_has_none():
    holed = np.zeros((16, 16), dtype=np.float32)
    holed[:4] = np.nan
    reference = Reference(None, (Patch(10.0, holed), Patch(20.0, holed.copy())), 1e6)
    window = reference.heights(0, 16)
    # the coarser level knows the four middle rows of its northern half only
    assert np.isfinite(window).all()
    wide = reference.heights(0, 40)
    assert np.isnan(wide[:8]).all()
    assert np.isnan(wide[:, :4]).all()
    assert np.isfinite(wide[14:26, 14:26]).all()
    assert np.isnan(reference.heights(1, 16)[:4]).all()


def test_points_of_a_surface_lie_at_their_place_and_height(reference):
    size, level = 40, 1
    surface = reference.surface(level, reference.heights(level, size))
    lat, lon, radius = latlon_from_xyz(surface)
    assert_allclose(radius - reference.radius_m, reference.heights(level, size), atol=1e-6)
    point = reference.point
    projection = Stereographic(*np.radians([point.lat_deg, point.lon_deg]), reference.radius_m)
    x, y = projection.xy_from_latlon(lat, lon)
    want_x, want_y = make_node_grid(size, reference.patches[level].posting_m)
    assert_allclose(x, want_x, atol=1e-5)
    assert_allclose(y, want_y, atol=1e-5)
    # row 0 is north, column 0 west
    assert lat[0, 20] > lat[-1, 20]
    assert lon[20, 0] < lon[20, -1]


def test_a_reference_is_the_rendered_patch_and_dark_in_the_ground_s_shadow(reference, rough_world):
    sun = rough_world.sun(8.0, 90.0)
    camera = rough_world.pose().position_m
    rendered = reference.render(0, reference.heights(0, 64), sun, camera)
    turn = reference.projection.body_from_local
    alone = render_map(
        reference.patches[0].heights_m,
        120.0,
        sun @ turn,
        camera_local=camera @ turn - [0.0, 0.0, reference.radius_m],
        law=find_law("lommel_seeliger"),
        radius_m=reference.radius_m,
    )
    assert rendered.shape == (64, 64)
    # ground beyond the patch can only take light away
    assert (rendered <= alone + 1e-6).all()
    assert (rendered == 0.0).mean() >= (alone == 0.0).mean()
    assert (reference.render(0, reference.heights(0, 64), -sun, camera) == 0.0).all()


def test_a_window_from_a_coarser_level_is_bicubic_at_every_node():
    """Beside a hole and the border too; what the window has stays."""
    patch = np.random.default_rng(2).normal(size=(30, 30)).astype(np.float32)
    patch[12, 17] = np.nan
    window = np.full((40, 40), np.nan, np.float32)
    window[15:20, 10:30] = 7.0
    wanted = window.copy()
    _fill_from(window, 3.0, patch, 4.0)
    places = 14.5 + (np.arange(40) - 19.5) * 0.75
    for i, row in enumerate(places):
        for j, col in enumerate(places):
            if np.isnan(wanted[i, j]) and 0.0 <= min(row, col) <= max(row, col) <= 29.0:
                wanted[i, j] = interpolate_bicubic(patch, row, col)
    assert_allclose(window, wanted, atol=1e-6)
    assert np.isnan(window).any()
    assert (window[15:20, 10:30] == 7.0).all()
