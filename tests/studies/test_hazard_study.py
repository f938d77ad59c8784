"""The study of hazard maps: its fields, how pads are judged, what is fitted."""

from itertools import product
from pathlib import Path

import msgspec
import numpy as np
import pytest

from catalog.terrain.slopes import CRITICAL_DEG, DANGEROUS_DEG
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.hazard.pads import PadBrightness, choose_pads, rate_slopes
from optnav_cli.hazard.settings import load_hazard_model
from optnav_cli.hazard.shading import map_slopes
from tests.optnav_cli.hazard.views import view_of
from tests.studies import hazard as study
from tests.studies.hazard_descent import FlownDescent, cut_field
from tests.studies.hazard_fields import (
    DRAWN_M,
    field_view,
    make_field,
    sun_vector,
    true_shares,
)
from tests.studies.hazard_variance import BRIGHTEST, FittedField, fit_bounds, judge_bounds
from tests.studies.stored import read_stored

MODEL = load_hazard_model()
LIMITS = {"dangerous": DANGEROUS_DEG, "critical": CRITICAL_DEG}
NUMBERS = [
    (part, name, number)
    for part in LIMITS
    for name in getattr(MODEL.shading, part).__struct_fields__
    for number in range(len(MODEL.shading.sun_elevation_deg))
]


@pytest.fixture(scope="module")
def small():
    return make_field("rough", 5, 880)


def test_the_flattest_pads_are_those_of_least_slope_whole_in_their_squares():
    squares = np.full((410, 410), 9.0, np.float32)
    squares[5 + 10, 5 + 10] = 1.0  # the first pad that lies whole in the first square
    squares[5 + 9, 300] = 0.0  # of a pad that does not
    assert study.flattest_pads(squares) == [1.0, 9.0, 9.0, 9.0]


def test_a_field_is_as_rough_as_it_is_meant_to_be(small):
    assert 0.2 < small.share_above(7.0) < 0.6
    assert make_field("even", 5, 440).share_above(7.0) < small.share_above(7.0)


def test_the_sun_comes_from_another_side_for_each_seed(small):
    assert small.azimuth_deg() == pytest.approx(5 * 137.508 % 360.0)
    east = sun_vector(0.0, 90.0)
    np.testing.assert_allclose(east, [1.0, 0.0, 0.0], atol=1e-12)


def test_relief_shifts_what_an_oblique_camera_sees(small):
    """A hill of 20 m is seen 7.3 m away from where it is, towards where the camera is not."""
    from dataclasses import replace

    hill = np.zeros_like(small.heights)
    hill[400:480, 400:480] = 20.0
    field = replace(small, heights=hill)
    straight = field_view(field, 20.0, albedo_rms=0.0)
    oblique = field_view(field, 20.0, albedo_rms=0.0, off_nadir_deg=20.0)
    assert oblique.camera_m[2] < straight.camera_m[2]
    for view in (straight, oblique):
        assert view.brightness.shape == (440, 440)
    moved = np.abs(straight.brightness - oblique.brightness) > 0.5 * straight.brightness.mean()
    assert moved[190:250, 190:250].any()
    assert not moved[:150].any()


def test_pads_by_shading_are_safer_than_the_field_and_than_those_by_variance(small):
    truth = true_shares(small, study.PAD_CELLS)
    found = {}
    for method in ("shading", "variance"):
        score = study.Score()
        study.judge(study.HazardCase("rough", 20.0, method), small, truth, MODEL, score)
        found[method] = np.array(score.pads)[:, 1].mean()
        assert score.squares == len(score.pads) == 4
    assert found["shading"] < 0.5 * small.share_above(7.0)
    assert found["shading"] <= found["variance"]


def test_a_picture_on_half_a_map_has_its_pads_below_it(small):
    """Judging by cells of the whole field and by places from its middle agree."""
    view = field_view(small, 20.0)
    risk = rate_slopes(view, map_slopes(view, MODEL), study.PAD_M, MODEL)
    pads = choose_pads(view, risk, study.SQUARE_M)
    below = np.array(study.pads_below(small, view, pads))
    truth = true_shares(small, study.PAD_CELLS)
    for pad, row in zip(pads, below, strict=True):
        at = round(pad.cell[0]), round(pad.cell[1])
        assert row[1] == pytest.approx(truth["dangerous"][at], abs=0.06)


def test_a_prior_map_has_the_slopes_of_the_ground(small):
    view = field_view(small, 20.0)
    prior = study.prior_slopes(small, view)
    assert prior.shape == view.brightness.shape
    assert 1.0 < float(np.median(prior)) < 8.0
    assert len(small.heights) * DRAWN_M == len(prior)


def drawn(terms, limit_deg, count=60_000):
    """Cells whose slopes are above a limit as often as terms say: features, and which are."""
    rng = np.random.default_rng(4)
    limit = np.tan(np.radians(limit_deg))
    local = rng.uniform(0.02, 0.25, count)
    data = np.stack(
        [
            rng.uniform(0.0, 3.0 * limit, count),
            local,
            rng.uniform(0.05, 0.2, count),
            rng.uniform(0.0, 0.6, count),
            rng.choice([0.0, 1.0], count),
        ]
    )
    return data, rng.uniform(size=count) < study.chances(np.array(terms), data, limit_deg)


def shipped(part, number):
    """The terms of one Sun."""
    fitted = getattr(MODEL.shading, part)
    return [getattr(fitted, name)[number] for name in fitted.__struct_fields__]


@pytest.mark.parametrize(("part", "name", "number"), NUMBERS)
def test_half_or_twice_a_fitted_number_fits_worse(part, name, number):
    """What is drawn by the shipped numbers is less likely by any other."""
    terms, limit_deg = np.array(shipped(part, number)), LIMITS[part]
    at = getattr(MODEL.shading, part).__struct_fields__.index(name)
    if abs(terms[at]) < 0.02:
        pytest.skip("is as good as nothing")
    data, above = drawn(terms, limit_deg)
    right = study.misfit(terms, data, above, limit_deg)
    for factor in (0.5, 2.0):
        other = terms.copy()
        other[at] *= factor
        assert study.misfit(other, data, above, limit_deg) - right > 2.0 / data.shape[1]


def test_the_fit_finds_the_numbers_that_cells_were_drawn_by():
    terms = [1.4, 0.4, 0.1, 0.03, 0.03, 0.1, 0.05, 0.1, 0.05]
    data, above = drawn(terms, DANGEROUS_DEG)
    true = np.where(above, 10.0, 3.0)
    found = study.fit_terms(np.vstack([data, true]), DANGEROUS_DEG)
    right = study.misfit(np.array(terms), data, above, DANGEROUS_DEG)
    best = study.misfit(np.array(found), data, above, DANGEROUS_DEG)
    assert best == pytest.approx(right, abs=5e-4)


def bright_field(kind: str, sun_deg: float, bounds: tuple[float, float]) -> FittedField:
    """Pads of ten squares that are safe where their mean lies within bounds, else dangerous.

    The variance of brightness tells nothing: it is drawn at random, and often least outside.
    """
    rng = np.random.default_rng([4, round(sun_deg), len(kind)])
    view = view_of(np.ones((400, 1000), np.float32), sun_deg)
    shape = 77, 197
    level = rng.uniform(0.7, 1.3, shape).astype(np.float32)
    inside = (level >= bounds[0]) & (level <= bounds[1])
    alpha = rng.uniform(0.0, 100.0, shape).astype(np.float32)
    none, every = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    brightness = PadBrightness(alpha, level, none, every, 5, 20)
    at = [np.clip(np.rint((np.arange(n) - 9.5) / 5).astype(int), 0, m - 1)
          for n, m in zip((400, 1000), shape)]  # fmt: skip
    dangerous = (~inside)[np.ix_(*at)].astype(np.float32)
    return FittedField(kind, sun_deg, view, brightness, dangerous, 0.5)


def test_the_fit_finds_the_bounds_within_which_pads_are_safe():
    """Level is drawn evenly, so that few squares lack a pad: the narrowest upper bound is best."""
    fields = [bright_field(k, s, (0.9, 1.04)) for k in ("rough", "even") for s in (5.0, 20.0)]
    fitted = fit_bounds(fields, MODEL).variance
    assert fitted.darkest == 0.9
    assert fitted.brightest == BRIGHTEST[0]


def test_half_or_twice_a_fitted_bound_chooses_worse_pads():
    """Of pads that are safe within the shipped bounds."""
    numbers = MODEL.variance
    fields = [bright_field("rough", 5.0, (numbers.darkest, numbers.brightest))]
    right = judge_bounds(fields, MODEL)[0]
    for name, factor in product(("darkest", "brightest"), (0.5, 2.0)):
        changed = {name: factor * getattr(numbers, name)}
        other = msgspec.structs.replace(numbers, **changed)
        ratio, found = judge_bounds(fields, msgspec.structs.replace(MODEL, variance=other))
        assert ratio > right or found == 0.0


def test_stored_pads_by_variance_are_as_safe_as_asked_on_fields_not_fitted():
    """15 and 17 % of rough ground, and of even ground, asked where 16 % are steep, a like share."""
    table = read_stored("hazard").tables[0]
    names = [column.name for column in table.columns]
    rows = [dict(zip(names, row, strict=True)) for row in table.rows]
    asked = [row for row in rows if row["pads_limit"] is not None]
    assert len(asked) == 4
    for row in asked:
        steeper = row["area_7"] / 16.0 if row["ground"] == "even" else 1.0
        assert row["pads_7"] <= row["pads_limit"] * steeper


def test_carried_pads_lie_within_three_sigmas_and_are_no_worse_than_those_of_one_picture():
    table = read_stored("hazard_descent").tables[0]
    names = [column.name for column in table.columns]
    rows = [dict(zip(names, row, strict=True)) for row in table.rows]
    worst = {(row["sun"], row["picture"]): row["worst"] for row in rows if row["worst"] is not None}
    # asked at 500 m and below; of the hundreds of places above, one in 90 right ones is farther off
    assert max(worst[sun, "500 m and below"] for sun in (20.0, 5.0)) <= 3.0
    assert max(worst.values()) <= 4.0
    for sun in (20.0, 5.0):
        shares = {row["picture"]: row["pads_7"] for row in rows if row["sun"] == sun}
        assert shares["500 m and below"] <= shares["500 m alone"]
        assert shares["500 m, all of its squares"] <= shares["500 m alone"]


def test_places_in_drawn_descents_are_found_from_their_pixels(small):
    """A pad at a pixel lies where a point of the ground there is seen."""
    camera = preset_camera("tsnn2_narrow")
    flown = FlownDescent(small, 20.0, Path(), camera, {"a": (12.0, -7.0, 300.0)})
    x, y = 40.0, -30.0
    middle = 0.5 * (len(small.heights) - 1)
    height = float(small.heights[round(middle - y / DRAWN_M), round(middle + x / DRAWN_M)])
    pixel = camera.project(np.array([x - 12.0, -(y + 7.0), 300.0 - height]))
    np.testing.assert_allclose(flown.find_true_place("a", pixel), (x, y), atol=0.2)
    assert cut_field(small, 100.0, (20.0, -10.0)).heights.shape == (600, 600)


def test_fitted_sections_are_printed_as_the_file_has_them():
    text = study.model_sections(MODEL)
    assert "[shading.critical]" in text
    assert text.count("sigma_narrow = [") == 2


def test_the_report_shows_all_cases(small):
    score = study.Score(4, [(0.4, 0.05, 64.0)], [(0.03, 0.04, 0.0, 16.0)] * 4)
    score.bins[:] = 300.0
    figures = study.HazardFigures(
        dict.fromkeys(study.CASES, score), {5.0: score}, {"rough": [4.0], "even": [4.0]}, 1
    )
    first, second = study.report(figures).tables
    assert len(first.rows) == len(study.CASES) + 1
    assert first.column("rms")[0] == pytest.approx(50.0)
    assert len(second.rows) == 10 * len(study.BINNED)


def test_choices_of_pads_are_judged_on_fields_of_their_own_kind_alone(small, monkeypatch):
    made = []

    def field(kind, seed):
        made.append((kind, seed))
        return small

    monkeypatch.setattr(study, "make_field", field)
    monkeypatch.setattr(study, "FIT_FIELDS", 1)
    choices = study.judge_choices(MODEL)
    assert made == [("rough", 101), ("even", 101)]
    assert len(choices) == len(study.BINNED) * len(study.CHOICES)
    assert all(score.squares == 4 and len(score.area) == 1 for score in choices.values())
    table = study._choices(study.HazardFigures({}, {}, {}, 0, "fitted", choices))
    assert {row[:4] for row in table.rows} == {
        (case.kind, case.elevation_deg, *choice)
        for case in study.BINNED
        for choice in study.CHOICES
    }
