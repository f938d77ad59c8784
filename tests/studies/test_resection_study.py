"""The behaviour that Zhukov (2025), ch. 3, states for resection, from trials of our own solver."""

import itertools
import xml.etree.ElementTree as ET

import pytest

from tests.studies.resection import ANGLES_DEG, COUNTS, ResectionRow, one_geometry, picture


def horizontal(count: int, angle: float, free: bool = False) -> float:
    return one_geometry(count, angle, free, trials=150, seed=7).horizontal


def test_the_horizontal_error_falls_with_points_and_stays_below_their_own():
    errors = [horizontal(count, 40.0) for count in (2, 4, 8, 16, 32)]
    assert all(b < a for a, b in itertools.pairwise(errors))
    assert errors[0] < 1.0


def test_the_height_error_grows_fast_below_twenty_degrees():
    wide, middle, narrow = (
        one_geometry(4, angle, False, trials=150, seed=7).height for angle in (40.0, 20.0, 10.0)
    )
    assert middle > 1.5 * wide
    assert narrow > 3.0 * wide
    assert narrow > 5.0 * horizontal(4, 10.0)


@pytest.mark.parametrize(("angle", "low", "high"), [(80.0, 3.0, 5.0), (40.0, 10.0, 25.0)])
def test_a_free_attitude_costs_four_times_at_80_and_over_ten_at_40_degrees(angle, low, high):
    assert low < horizontal(4, angle, free=True) / horizontal(4, angle) < high


def test_the_picture_has_a_curve_for_every_number_of_points():
    rows = [
        ResectionRow(n, angle, free, 0.5, 2.0)
        for n, angle, free in itertools.product(COUNTS, ANGLES_DEG, (False, True))
        if n >= 4 or not free
    ]
    root = ET.fromstring(picture(rows))
    svg = "{http://www.w3.org/2000/svg}"
    panels = root.findall(f"{svg}svg")
    assert len(panels) == 6
    # the known attitude is solved from two points too; every panel has the line at 1
    curves = [len(panel.findall(f".//{svg}polyline")) for panel in panels]
    assert curves == [6, 6, 3, 5, 5, 3]
