"""The matching study: priors are wrong as named and in nothing else, curves are read rightly."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

from optnav_cli.control_points.reference import Reference
from tests.studies.matching import MatchingRow, borne, picture, report, summarise, tolerance
from tests.studies.matching_trials import (
    AXES,
    MATCHERS,
    NOISE,
    ROLL,
    SCALE,
    SLANT,
    Look,
    StudyPicture,
    Trial,
    Wrong,
    roll_search,
    wrong_pose,
)


@pytest.fixture(scope="module")
def look(rough_world):
    """Nine points near the middle of a picture from straight above."""
    lat, lon = np.radians([-43.0, -11.0])
    pose = rough_world.pose(100e3, lat=lat, lon=lon)
    sun = rough_world.sun(25.0, 70.0)
    scene = StudyPicture(0, rough_world.picture(pose, sun, snr=1e4, bits=12), pose, sun, 0.0)
    near = sorted(
        rough_world.control_points,
        key=lambda pair: np.linalg.norm(pair[0].xyz_m / 1.7374e6 - pose.position_m / 1.8374e6),
    )
    points = [Reference(*pair, rough_world.radius_m) for pair in near[:9]]
    return Look(scene, points, rough_world.camera, np.random.default_rng(5))


@pytest.mark.parametrize(
    "wrong", [Wrong(roll=0.1), Wrong(scale=0.1), Wrong(lean=True), Wrong(0.05, -0.1, True)]
)
def test_a_wrong_pose_sees_the_point_in_the_same_pixel(look, rough_world, wrong):
    point = look.points[3].point.xyz_m
    pose = look.scene.pose
    # far from nadir, so that a lean has something to take away
    pose = replace(pose, position_m=pose.position_m + 60e3 * np.array([0.3, 0.9, 0.1]))
    stated = wrong_pose(pose, point, wrong)

    def pixel(p):
        return rough_world.camera.project_from_body(
            point, p.position_m, p.camera_from_body.as_matrix()
        )

    np.testing.assert_allclose(pixel(stated), pixel(pose), atol=1e-6)
    distance = np.linalg.norm(stated.position_m - point) / np.linalg.norm(pose.position_m - point)
    assert distance == pytest.approx(1.0 + wrong.scale)
    away = (stated.position_m - point) / np.linalg.norm(stated.position_m - point)
    true_away = (pose.position_m - point) / np.linalg.norm(pose.position_m - point)
    wanted = point / np.linalg.norm(point) if wrong.lean else true_away
    np.testing.assert_allclose(away, wanted, atol=1e-9)
    if not wrong.lean:
        turn = (stated.camera_from_body * pose.camera_from_body.inv()).magnitude()
        assert turn == pytest.approx(abs(wrong.roll), abs=1e-9)


def found(look, axis, value, **how):
    return list(look.trials(axis, value, False, look.picture(50.0), **how))


def rate(trials, matcher="NCC"):
    chosen = [t for t in trials if t.matcher == matcher]
    return np.mean([t.error_nodes is not None and t.error_nodes < 3.0 for t in chosen])


def rms(trials, matcher="NCC"):
    good = [t.error_nodes for t in trials if t.matcher == matcher and (t.error_nodes or 9.0) < 3.0]
    return np.sqrt(np.mean(np.square(good)))


def test_points_are_found_from_a_right_pose_whatever_the_shift(look):
    trials = found(look, ROLL, 0.0)
    assert {t.matcher for t in trials} == set(MATCHERS)
    assert rate(trials) == 1.0
    assert rms(trials) < 0.3
    assert all(t.accepted for t in trials if t.matcher == "NCC")


def test_a_roll_harms_and_searching_rolls_mends_it(look):
    wrong = Wrong(roll=np.radians(12.0))
    raw, searched = (
        found(look, ROLL, 12.0, wrong=wrong),
        found(look, ROLL, 12.0, wrong=wrong, distortion=roll_search()),
    )
    assert rate(raw) < rate(searched)
    assert rate(searched) > 0.8
    assert rms(searched) < rms(raw)


def test_errors_are_in_finest_nodes_whatever_the_level(look):
    """At the level whose nodes are twice as wide the same ground errs by as much or little more."""
    fine, coarse = found(look, NOISE, 50.0), found(look, NOISE, 50.0, level=1)
    assert rate(coarse) == 1.0
    assert 0.5 * rms(fine) < rms(coarse) < 5.0 * rms(fine)


def test_a_slant_is_each_points_own(look):
    trials = found(look, SLANT, 25.0)
    for number, point in enumerate(look.points):
        place = point.point.xyz_m
        up = place / np.linalg.norm(place)
        away = look.scene.pose.position_m - place
        angle = np.degrees(np.arccos(up @ away / np.linalg.norm(away)))
        nearest = SLANT.values[int(np.argmin(np.abs(np.array(SLANT.values) - angle)))]
        held = {t.value for t in trials[number * len(MATCHERS) : (number + 1) * len(MATCHERS)]}
        assert held == {nearest}


def rows_of(axis, shares, matcher="NCC", aided=False):
    return [
        MatchingRow(axis.name, value, matcher, aided, 100, share, share, 0.0, 0.2)
        for value, share in zip(axis.values, shares, strict=False)
    ]


def test_the_tolerance_is_where_the_curve_crosses_nine_tenths():
    value, falls = tolerance(rows_of(SCALE, (1.0, 1.0, 0.95, 0.85)))
    assert falls
    assert value == pytest.approx((SCALE.values[2] + SCALE.values[3]) / 2.0)
    value, falls = tolerance(rows_of(SCALE, (1.0,) * len(SCALE.values)))
    assert not falls
    assert borne(SCALE, rows_of(SCALE, (1.0,) * len(SCALE.values))) == "> 30 %"
    assert borne(NOISE, rows_of(NOISE, (1.0,) * len(NOISE.values))) == "< SNR 1"
    assert borne(SLANT, rows_of(SLANT, (0.8, 0.95))) == "never"


def test_trials_add_up_to_shares_and_errors():
    trials = [
        Trial("roll", 2.0, "NCC", False, error, accepted)
        for error, accepted in ((0.3, True), (0.4, False), (5.0, True), (None, False))
    ]
    (row,) = summarise(trials)
    assert (row.trials, row.recognised, row.accepted, row.wrong) == (4, 0.5, 0.25, 0.25)
    assert row.error_nodes == pytest.approx(np.sqrt((0.3**2 + 0.4**2) / 2.0))


def test_table_and_picture_have_every_curve():
    rows = [
        row
        for axis in AXES
        for name in MATCHERS
        for aided in (False, True)
        for row in rows_of(axis, np.linspace(1.0, 0.5, len(axis.values)), name, aided)
    ]
    stated = report(rows).tables[-1].column("stated")
    assert len(stated) == 16
    assert stated[0] == "SNR 10"
    root = ET.fromstring(picture(rows))
    svg = "{http://www.w3.org/2000/svg}"
    panels = root.findall(f"{svg}svg")
    assert len(panels) == 8
    for panel in panels:
        marks = [e for e in panel.iter() if "mark" in (e.get("class") or "")]
        assert len(marks) in {4 * len(axis.values) for axis in AXES}
