"""Pictures of studies: whole SVG, marks by shape, numbers along logarithms, never over others."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from catalog.errors import OutputError
from optnav_cli.report.sheet import LegendEntry, Panel, draw_sheet, write_sheet
from optnav_cli.report.svg import SHAPES, Plot, PlotAxis, draw_mark

SVG = "{http://www.w3.org/2000/svg}"


def a_plot(width=300):
    x_axis = PlotAxis((0.0, 2.0), log=True, numbers=(1, 40))
    plot = Plot(x_axis, PlotAxis((-6.0, 6.0), log=True), width=width)
    plot.marks([0.5, np.nan], [1.0, 2.0], "s1 hollow", "triangle", titles=["<a>", "b"])
    return plot


def test_panels_stand_side_by_side_below_the_legend_and_inside_the_picture():
    legend = [LegendEntry("s1 dashed", f"series {n} of some length") for n in range(6)]
    rows = [[Panel("left", a_plot(), "l"), Panel("right < left", a_plot(), "r")]]
    root = ET.fromstring(draw_sheet("A & B", legend, rows))
    width, height = float(root.get("width")), float(root.get("height"))
    plots = root.findall(f"{SVG}svg")
    left, right = ([float(p.get(k)) for k in ("x", "y", "width", "height")] for p in plots)
    assert left[0] + left[2] < right[0]
    assert right[0] + right[2] < width
    assert left[1] == right[1]
    assert left[1] + left[3] < height
    entries = [t for t in root.findall(f"{SVG}text") if "series" in t.text]
    assert len(entries) == 6
    assert all(float(t.get("x")) + 100.0 < width and float(t.get("y")) < left[1] for t in entries)


def test_numbers_along_logarithms_are_the_values_or_powers_of_ten():
    words = [t.text for t in ET.fromstring(a_plot().svg("p")).iter("text")]
    assert {"1", "40", "10⁻⁶", "0.01", "100", "10⁶"} <= set(words)


def test_what_is_not_finite_gets_no_mark_and_titles_are_escaped():
    drawn = list(ET.fromstring(a_plot().svg("p")).iter("polygon"))
    assert len(drawn) == 1
    assert drawn[0].find("title").text == "<a>"


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_lies_about_its_place(shape):
    text = draw_mark(50.0, 20.0, "s2", shape, 4.0)
    ET.fromstring(text)
    assert "s2" in text
    if shape in ("square", "diamond", "triangle", "down"):
        corners = ET.fromstring(text).get("points").split()
        points = np.array([[float(v) for v in corner.split(",")] for corner in corners])
        assert np.abs(points - (50.0, 20.0)).max() <= 5.0
        assert points[:, 0].mean() == pytest.approx(50.0, abs=0.1)


def test_a_picture_replaces_its_forerunner_and_nothing_else(tmp_path):
    picture = draw_sheet("t", [], [[Panel("h", a_plot(), "d")]])
    for _ in range(2):
        write_sheet(picture, tmp_path / "study.svg")
    (tmp_path / "mine.svg").write_text("<svg/>")
    with pytest.raises(OutputError, match="was not made by optnav"):
        write_sheet(picture, tmp_path / "mine.svg")
