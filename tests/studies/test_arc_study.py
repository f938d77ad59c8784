"""Horizon errors against the arc: the seed's statements, closed forms, and the picture."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from tests.studies.arc import (
    ARCS_DEG,
    FITS,
    INTERVALS_DEG,
    ROUND,
    STEP_DEG,
    ArcRow,
    limb_errors,
    one_arc,
    picture,
    report,
)

FAR_KM = 1e6  # the Moon is so small there that its limb is a plane circle


def errors(interval, count, seed=3):
    return limb_errors(np.random.default_rng(seed), interval, count)


def of(arc, interval, trials=25, height_km=200.0):
    return one_arc(arc, interval, height_km, errors(interval, trials))[0]


def test_errors_along_a_limb_are_correlated_as_they_should_be():
    drawn = np.array(errors(1.0, 40))
    assert drawn.shape == (40, ROUND)
    assert drawn.std() == pytest.approx(1.0, abs=0.03)
    for degrees in (0.5, 1.0, 2.0):
        shifted = np.roll(drawn, round(degrees / STEP_DEG), axis=1)
        # 40 limbs of 360 intervals: the mean of 14 400 products
        assert (drawn * shifted).mean() == pytest.approx(np.exp(-degrees), abs=0.03)


def test_a_whole_circle_of_independent_points_is_as_good_as_the_closed_form():
    """N points of unit error: sqrt(2/N) a component of the centre and sqrt(1/N) of the radius."""
    white = [np.random.default_rng(n).normal(size=ROUND) for n in range(60)]
    row, _ = one_arc(360.0, 0.0, FAR_KM, white)
    assert row.direction == pytest.approx(np.sqrt(4.0 / ROUND), rel=0.2)
    assert row.radius == pytest.approx(np.sqrt(1.0 / ROUND), rel=0.25)


def test_errors_are_below_one_sigma_of_a_point_from_half_a_limb_on():
    """Zhukov 2025, ch. 2: 0.01-1 delta at 180-360 degrees for intervals of 0.01-10 degrees."""
    low, high = of(360.0, 0.01), of(180.0, 10.0, trials=60)
    assert 0.005 < low.radius < low.direction < 0.03
    assert 0.3 < high.radius < high.direction < 1.3


def test_at_a_hundred_degrees_they_are_a_tenth_to_three():
    assert 0.07 < of(100.0, 0.01).direction < 0.25
    assert 1.5 < of(100.0, 10.0, trials=60).direction < 5.0


def test_below_they_are_tens():
    assert of(40.0, 1.0).direction > 8.0
    assert of(20.0, 1.0).direction > 20.0


def test_of_short_arcs_the_linear_fit_finds_too_small_a_body():
    own, linear = one_arc(40.0, 0.01, 200.0, errors(0.01, 40))
    assert linear.radius_bias < -1.0
    assert abs(own.radius_bias) < 0.5 * abs(linear.radius_bias)


def test_table_and_picture_hold_every_arc_and_interval():
    rows = [
        ArcRow(fit, arc, interval, 0.5, 0.25, 0.0, 0.1 if arc < 50.0 else 0.0)
        for fit in FITS
        for arc in ARCS_DEG
        for interval in INTERVALS_DEG
    ]
    tables = report(rows).tables
    cells = [cell for table in tables for row in table.rows for cell in row[1:-1]]
    assert cells == [0.5, 0.25] * len(rows)
    assert {table.column("unsolved")[-1] for table in tables} == {10.0}
    root = ET.fromstring(picture(rows))
    svg = "{http://www.w3.org/2000/svg}"
    for panel in root.findall(f"{svg}svg"):
        assert len(panel.findall(f".//{svg}polyline")) == len(INTERVALS_DEG) + 2
