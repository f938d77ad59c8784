"""Directions of motion from true positions: passes, lone frames, descents, poles."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from optnav_cli.evaluation.figures import find_motion_axes
from optnav_cli.frames.truth import Truth

RADIUS_M = 1837400.0


def truths(places, step_s=20.0):
    return [
        Truth(
            str(i),
            "",
            step_s * i,
            xyz_from_latlon(np.radians(lat), np.radians(lon), r),
            Rotation.identity(),
        )
        for i, (lat, lon, r) in enumerate(places)
    ]


def test_n_points_along_the_way_and_b_completes_r_n_b():
    places = [(0.0, lon, RADIUS_M) for lon in (-1.0, 0.0, 1.0)]  # along the equator, east
    _, (axes, forward), _ = find_motion_axes(truths(places))
    assert forward == "motion"
    np.testing.assert_allclose(axes, [[1, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1]])
def test_the_order_of_the_file_does_not_matter(order):
    given = truths([(lat, 30.0, RADIUS_M) for lat in (10.0, 11.0, 12.0)])
    found = find_motion_axes([given[i] for i in order])
    for index, (axes, _) in zip(order, found, strict=True):
        lat = np.radians(10.0 + index)
        np.testing.assert_allclose(axes[1], body_from_local(lat, np.radians(30.0))[:, 1], atol=2e-2)


def test_a_pass_across_the_pole_keeps_its_direction():
    places = [(89.0, 0.0, RADIUS_M), (90.0, 0.0, RADIUS_M), (89.0, 180.0, RADIUS_M)]
    _, (axes, forward), _ = find_motion_axes(truths(places))
    assert forward == "motion"
    np.testing.assert_allclose(axes[1], [-1.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("places", "step_s"),
    [
        ([(-43.0, -11.0, RADIUS_M)], 20.0),
        ([(0.0, 0.0, RADIUS_M), (1.0, 0.0, RADIUS_M)], 5000.0),  # another pass
        ([(0.0, 0.0, RADIUS_M), (170.0 - 100.0, 0.0, RADIUS_M)], 600.0),  # too far round
        ([(0.0, 0.0, RADIUS_M), (0.0, 0.0, RADIUS_M)], 20.0),  # standing still
        ([(20.0, 0.0, RADIUS_M), (20.0, 0.0, RADIUS_M - 3000.0)], 20.0),  # straight down
        ([(0.0, 0.0, RADIUS_M), (5.0, 0.0, RADIUS_M)], 0.0),  # two at one time
    ],
)
def test_without_a_neighbour_n_is_local_north(places, step_s):
    for truth, (axes, forward) in zip(
        truths(places, step_s), find_motion_axes(truths(places, step_s)), strict=True
    ):
        assert forward == "north"
        assert axes[1] @ truth.position_m == pytest.approx(0.0, abs=1e-6)
        assert axes[1, 2] > 0.0


def test_at_a_pole_the_axes_stay_defined():
    ((axes, forward),) = find_motion_axes(truths([(90.0, 0.0, RADIUS_M)]))
    assert forward == "north"
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_cameras_of_one_moment_share_their_neighbours():
    places = [(0.0, lon, RADIUS_M) for lon in (-1.0, 0.0, 1.0) for _ in range(3)]
    times = [20.0 * (i // 3) for i in range(9)]
    given = [replace(truth, tdb_s=t) for truth, t in zip(truths(places), times, strict=True)]
    for axes, forward in find_motion_axes(given):
        assert forward == "motion"
        assert axes[1, 1] > 0.99


@pytest.mark.parametrize(("radius_m", "forward"), [(1.0e8, "motion"), (2.0e6, "north")])
def test_far_away_an_hour_is_not_long(radius_m, forward):
    given = truths([(0.0, lon, radius_m) for lon in (0.0, 1.0)], step_s=3600.0)
    assert {found for _, found in find_motion_axes(given)} == {forward}
