"""The small plots: round ticks, places where they belong, gaps for what is not finite."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from optnav_cli.report.svg import (
    Plot,
    PlotAxis,
    choose_log_ticks,
    choose_ticks,
    find_span,
    format_number,
)
from optnav_cli.report.views import GroundMap


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 10.0, [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]),
        (-0.31, 0.29, [-0.3, -0.2, -0.1, 0.0, 0.1, 0.2]),
        (1737.3, 1737.5, [1737.3, 1737.35, 1737.4, 1737.45, 1737.5]),
    ],
)
def test_ticks_are_round_numbers_inside_the_range(low, high, expected):
    assert choose_ticks(low, high) == pytest.approx(expected)


def test_ticks_of_logarithms_say_what_they_stand_for():
    places, numbers = zip(*choose_log_ticks(-1.1, 0.4), strict=True)
    assert numbers == (0.1, 0.2, 0.5, 1.0, 2.0)
    assert places == pytest.approx(np.log10(numbers))
    assert [number for _, number in choose_log_ticks(-2.5, 1.5)] == [0.01, 0.1, 1.0, 10.0]
    drawing = Plot(PlotAxis((-1.1, 0.4), log=True), (0.0, 1.0)).svg("counts")
    assert ">0.2</text>" in drawing


def test_a_tick_says_minus_and_no_trailing_digits():
    assert format_number(-0.30000000000000004) == "\N{MINUS SIGN}0.3"


def test_the_span_of_nothing_and_of_one_value_can_be_drawn():
    assert find_span([]) == (0.0, 1.0)
    plot = Plot(find_span([5.0]), find_span([np.nan]))
    assert plot.x == (4.5, 5.5)


def test_a_line_breaks_where_a_value_is_missing():
    plot = Plot((0.0, 5.0), (0.0, 1.0))
    plot.line([0, 1, 2, 3, 4, 5], [0, 1, np.nan, 1, 0, np.nan], "s1", closed=True)
    drawing = ET.fromstring(plot.svg("a line"))
    lines = [e.get("points").split() for e in drawing.iter("polyline")]
    assert [len(line) for line in lines] == [2, 2]
    assert not list(drawing.iter("polygon"))


def test_a_band_leaves_out_what_is_not_finite():
    plot = Plot((0.0, 4.0), (-2.0, 2.0))
    plot.band(np.arange(4.0), [-1.0, np.nan, -1.0, -np.inf], [1.0, 1.0, 1.0, 1.0], "s1")
    (outline,) = re.findall('class="band s1" points="([^"]+)"', plot.svg("bands"))
    assert len(outline.split()) == 4
    assert "nan" not in outline


def test_up_is_up_and_titles_are_escaped():
    plot = Plot(PlotAxis((0.0, 1.0), "a < b"), (0.0, 1.0))
    plot.dots([0.5, 0.5], [0.2, 0.8], "s1", titles=["<low>", "high"])
    low, high = ET.fromstring(plot.svg('"quoted"')).iter("circle")
    assert float(low.get("cy")) > float(high.get("cy"))
    assert low.find("title").text == "<low>"


def test_equal_axes_give_a_metre_the_same_length_both_ways():
    plot = Plot((0.0, 100.0), (0.0, 10.0), equal=True)
    across = float(plot.px(10.0) - plot.px(0.0))
    assert float(plot.py(0.0) - plot.py(10.0)) == pytest.approx(across)


@pytest.mark.parametrize("lon0", [-11.0, 179.5])
def test_a_regional_map_is_in_kilometres_about_its_middle_even_across_180_degrees(lon0):
    lat = np.array([-44.0, -43.0, -42.0])
    lon = lon0 + np.array([-1.0, 0.0, 1.0])
    ground = GroundMap.fit(lat, np.where(lon > 180.0, lon - 360.0, lon), 1737400.0)
    assert ground.regional
    x, y = ground.places(lat, lon)
    # One degree of latitude is 30.32 km on the Moon.
    assert y[2] - y[0] == pytest.approx(2 * 30.32, rel=0.02)
    assert np.abs(x).max() < 30.0
    ET.fromstring(ground.plot(x, y).svg("map"))


def test_places_all_over_a_body_get_a_plain_grid():
    lat, lon = np.array([-60.0, 0.0, 60.0]), np.array([-170.0, 0.0, 350.0])
    ground = GroundMap.fit(lat, lon, 1737400.0)
    assert not ground.regional
    np.testing.assert_allclose(ground.places(lat, lon)[0], [-170.0, 0.0, -10.0])
