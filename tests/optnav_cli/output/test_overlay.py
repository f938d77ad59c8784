"""Overlays: marks stand where the frame's pixels are, at every size."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from catalog.geometry.projection import Stereographic
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import MatchRow, OutlineMarks
from optnav_cli.output.canvas import Canvas, measure_text, scale_to_eight_bits
from optnav_cli.output.overlay import (
    DISC,
    FOUND,
    MAX_PX,
    OUTLINE,
    PREDICTED,
    PRIOR,
    REJECTED,
    RESIDUAL,
    draw_overlay,
    encode_overlay,
    overlay_path,
    project_patches,
)
from tests.optnav_cli.rows import solved, unsolved

RADIUS_M = 1737400.0


def a_match(x, y, shift=None, used=True, residual=None):
    predicted = np.array([x, y])
    measured = None if shift is None else predicted + shift
    return MatchRow(
        "a.png", 41, 0, np.ones(3), predicted, measured, 0.9, 0.1, used,
        residual_px=None if residual is None else np.array(residual),
    )  # fmt: skip


def near(image, x, y, colour, reach=9):
    """How near the colour of any pixel around (x, y) comes, 0 = met exactly."""
    window = image[int(y) - reach : int(y) + reach + 1, int(x) - reach : int(x) + reach + 1]
    return int(np.abs(window.astype(int) - colour).max(axis=-1).min())


@pytest.mark.parametrize("side", [600, 1200, 2400])
def test_marks_stand_where_the_frames_pixels_are(side):
    factor = min(1.0, MAX_PX / side)
    matches = [
        a_match(100, 150, (0.2, 0.1), residual=(2.0, 0.0)),
        a_match(400, 300, (60.0, 0.0), used=False),
        a_match(150, 450),
    ]
    image = draw_overlay(
        np.zeros((side, side), np.uint8), unsolved("a.png", "", "too few"), matches
    )
    assert image.shape[1] == min(side, MAX_PX)
    assert image.shape[0] > image.shape[1]  # the legend

    def at(x, y, colour):
        return near(image, x * factor, y * factor, colour)

    assert at(100, 150, PREDICTED) < 60
    assert at(100, 150, FOUND) < 60
    assert at(200, 150, RESIDUAL) < 60  # 2 px, 50 times
    assert at(460, 300, REJECTED) < 60
    assert at(150, 450, PREDICTED) < 60
    assert at(150, 450, FOUND) > 100
    assert at(300, 500, PREDICTED) > 100


def test_the_prior_s_prediction_is_drawn_beside_the_solution_s_and_named():
    match = replace(a_match(100, 150, (0.2, 0.1)), prior_px=np.array([140.0, 180.0]))
    blank = np.zeros((400, 400), np.uint8)
    with_prior, without = (
        draw_overlay(blank, unsolved("a.png", "", ""), [m])
        for m in (match, replace(match, prior_px=None))
    )
    assert near(with_prior, 140, 180, PRIOR) < 60
    assert near(with_prior, 120, 165, PRIOR, 2) < 60  # a line joins them
    assert near(without, 140, 180, PRIOR) > 100
    legends = [np.abs(image[400:].astype(int) - PRIOR).max(axis=-1).min() for image in
               (with_prior, without)]  # fmt: skip
    assert legends[0] < 40 < legends[1]


def dense(gap, side=600):
    """Points on a grid, found and used, with patches 80 px wide about them."""
    places = np.stack(np.meshgrid(*[np.arange(100.0, 500.0, gap)] * 2), axis=-1).reshape(-1, 2)
    matches = [replace(a_match(*xy, (0.0, 0.0)), cp_id=1000 + k) for k, xy in enumerate(places)]
    square = 40.0 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    outlines = {("", m.cp_id): [m.predicted_px + square] for m in matches}
    image = draw_overlay(np.zeros((side, side), np.uint8), unsolved("", "", ""), matches, outlines)
    return places, image[:side]


def test_marks_that_stand_densely_are_smaller_and_their_patches_are_no_net():
    patches, green = [], []
    for gap in (90.0, 20.0):
        places, image = dense(gap)
        patches.append((np.abs(image.astype(int) - OUTLINE).max(axis=-1) < 20).any())
        x, y = places[0].astype(int)
        mark = image[y - 9 : y + 10, x - 9 : x + 10]
        green.append((mark.max(axis=-1) > 60).sum())
    assert patches == [True, False]
    assert green[1] < 0.6 * green[0]


def test_numbers_of_points_stand_beside_marks_and_never_over_each_other(monkeypatch):
    boxes = []
    monkeypatch.setattr(
        Canvas,
        "text",
        lambda _, words, x, y, __: boxes.append((words, x, y, x + measure_text(words))),
    )
    places, _ = dense(60.0)
    labels = [box for box in boxes if box[0].isdigit()]
    assert len(places) / 2 < len(labels) <= len(places)
    for k, (_, left, foot, right) in enumerate(labels):
        for _, other_left, other_foot, other_right in labels[:k]:
            assert right <= other_left or left >= other_right or abs(foot - other_foot) >= 11.0


def test_a_frame_without_points_says_nothing_of_them(monkeypatch):
    said = []
    monkeypatch.setattr(Canvas, "text", lambda _, words, *__: said.append(words))
    draw_overlay(np.zeros((600, 600), np.uint8), unsolved("a.png", "", "too little limb"), [])
    assert said == ["a.png: unsolved: too little limb"]


def test_a_long_reason_is_broken_into_lines(monkeypatch):
    said = []
    monkeypatch.setattr(Canvas, "text", lambda _, words, *__: said.append(words))
    reason = "; ".join(f"reason number {k} of many" for k in range(12))
    draw_overlay(np.zeros((600, 600), np.uint8), unsolved("a.png", "", reason), [])
    assert len(said) == 3
    assert all(measure_text(line) <= 580 for line in said)
    assert " ".join(said)[:60] == f"a.png: unsolved: {reason}"[:60]


def test_the_overlay_of_a_name_of_any_length_is_a_file_of_its_own(tmp_path):
    names = ["a" * 251, "a" * 252, "a" * 251 + "b", "é" * 127, "sub/" + "a" * 252]
    paths = {overlay_path(tmp_path, name) for name in names}
    assert len(paths) == len(names)
    for path in paths:
        path.write_bytes(b"")
    assert overlay_path(tmp_path, "a" * 251).name == "a" * 251 + ".png"


def a_limb(centre, radius, count, out=()):
    """Marks of a circle's upper half, 0.2 px outside the fitted one but for points left out."""
    angle = np.linspace(-np.pi, 0.0, count)
    outward = np.column_stack([np.cos(angle), np.sin(angle)])
    residuals = np.full(count, 0.2)
    residuals[list(out)] = np.nan
    return OutlineMarks(centre + radius * outward, -outward, residuals)


def test_a_limb_is_drawn_with_its_fit_and_what_was_left_out():
    marks = a_limb(np.array([300.0, 400.0]), 200.0, 400, range(300, 320))
    # the fitted limb has a gap where 20 points are missing
    fitted = marks.curves(0.0)
    assert [len(piece) for piece in fitted] == [300, 80]
    np.testing.assert_allclose(np.hypot(*(fitted[0] - [300.0, 400.0]).T), 199.8)
    image = draw_overlay(np.zeros((600, 600), np.uint8), unsolved("a.png", "", ""), [], marks=marks)
    angle = np.radians(-150.0)
    x, y = 300.0 + 200.0 * np.cos(angle), 400.0 + 200.0 * np.sin(angle)
    assert near(image, x, y, FOUND, 3) < 60
    assert near(image, x, y, PREDICTED, 3) < 60
    # residuals stand outwards, 50 times 0.2 px
    x, y = 300.0 + 209.8 * np.cos(angle), 400.0 + 209.8 * np.sin(angle)
    assert near(image, x, y, RESIDUAL, 1) < 60
    angle = np.pi * (310.0 / 399.0 - 1.0)
    x, y = 300.0 + 200.0 * np.cos(angle), 400.0 + 200.0 * np.sin(angle)
    assert near(image, x, y, REJECTED, 3) < 60
    assert near(image, x, y, PREDICTED, 3) > 100


@pytest.mark.parametrize("centre", [(100.0, 120.0), (900.0, 120.0), (500.0, 950.0)])
def test_a_small_outline_is_shown_enlarged_away_from_it(centre):
    picture = np.zeros((1000, 1000), np.float32)
    disc = OutlineMarks.mark_disc(np.array(centre))
    cv2.circle(picture, (int(centre[0]), int(centre[1])), 9, 200.0, -1)
    image = draw_overlay(scale_to_eight_bits(picture), unsolved("a.png", "", ""), [], marks=disc)
    assert near(image, centre[0] + 20, centre[1], DISC, 3) < 60
    left = 0 if centre[0] > 500 else 600
    top = 0 if centre[1] > 500 else 600
    inset = image[top : top + 400, left : left + 400]
    # 48 px of the frame are 400 here: the disc of 19 px is 158
    assert 140 < (inset[200 - 30, :, 0] > 150).sum() < 170
    assert near(inset, 220, 200, DISC, 3) < 60


def test_a_small_disc_in_a_noisy_sky_is_stretched_by_its_own_light():
    rng = np.random.default_rng(7)
    picture = rng.normal(20.0, 1.5, (1000, 1000)).astype(np.float32)
    cv2.circle(picture, (500, 500), 15, 180.0, -1)
    picture[500:, 500:515] *= 0.5
    shown = scale_to_eight_bits(picture)
    # noise of 1.5 in a range of 160; stretched by percentiles it would fill all 255 levels
    assert np.ptp(np.percentile(shown[:400], [1.0, 99.0])) < 25
    assert shown[490, 500] == 255
    assert 100 < shown[508, 506] < 200


def test_a_line_tells_the_result_and_long_reasons_are_cut(tmp_path):
    picture = np.full((300, 300), 100.0, np.float32)
    image = draw_overlay(scale_to_eight_bits(picture), unsolved("a.png", "", "σ " * 400), [])
    assert image.shape[1] == 300
    strip = image[300:]
    assert (strip[:, 290:] > 100).sum() == 0
    assert (strip > 200).sum() > 50


def test_points_without_a_place_do_not_hinder():
    match = MatchRow("a.png", 1, 0, np.ones(3), np.array([np.nan, np.nan]), reason="not in view")
    image = draw_overlay(np.zeros((50, 50), np.uint8), unsolved("a.png", "", ""), [match])
    assert (image[:50] == 0).all()


def test_the_same_frame_gives_the_same_file_with_its_whole_name(tmp_path):
    rng = np.random.default_rng(4)
    picture = rng.normal(size=(200, 300)).astype(np.float32)
    solution = solved(
        "sub/a.tif", "", "control_points", np.ones(3), np.eye(3), Rotation.identity(), 0.0,
        n_predicted=1, n_matched=1, n_used=1, residual_rms_px=0.1,
        matches=(a_match(20, 30, (0, 0)),),
    )  # fmt: skip
    drawn = [encode_overlay(scale_to_eight_bits(picture), solution) for _ in range(2)]
    assert drawn[0] == drawn[1]
    assert overlay_path(tmp_path, "sub/a.tif") == tmp_path / "sub_a.tif.png"
    assert cv2.imdecode(np.frombuffer(drawn[0], np.uint8), cv2.IMREAD_COLOR).shape[1] == 300


def test_patch_outlines_are_squares_seen_from_above():
    camera = Camera("unk", "pinhole", 2048, 2048, 4184.0, (1023.5, 1023.5))
    lat, lon = np.radians(-43.0), np.radians(-11.0)
    axes = body_from_local(lat, lon)
    position = xyz_from_latlon(lat, lon, RADIUS_M + 200e3)
    nadir = Rotation.from_matrix(np.stack([axes[:, 0], -axes[:, 1], -axes[:, 2]]))
    (outline,) = project_patches(
        Stereographic(lat, lon, RADIUS_M), 1000.0, [3776.0], camera, position, nadir
    )
    # Level ground 199 km below: half a side is 3776 m * f / 199 km, but for the body's curvature
    # (the border lies 2 * 3776^2 / 2R = 8 m lower at the corners).
    expected = 3776.0 * 4184.0 / 199e3
    reach = np.abs(outline - 1023.5).max(axis=0)
    np.testing.assert_allclose(reach, expected, rtol=1e-3)
    assert outline[0, 1] < 1023.5  # north is up


def test_counts_are_stretched_by_a_table_as_other_numbers_are():
    counts = np.random.default_rng(4).gamma(2.0, 40.0, (80, 120)).astype(np.uint16)
    halves = counts.astype(np.float32)
    halves[0, 0] += 0.5  # no whole number: no table
    assert (scale_to_eight_bits(counts)[1:] == scale_to_eight_bits(halves)[1:]).all()


def test_infinite_brightness_is_drawn_white() -> None:
    counts = np.arange(256, dtype=np.float32).reshape(16, 16)
    counts[5, 5] = np.inf
    shown = scale_to_eight_bits(counts)
    assert shown[5, 5] == 255
    assert shown[0, 0] < shown[15, 14]
