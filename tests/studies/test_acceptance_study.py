"""The acceptance study: its situations are what they are called, and its limits are found."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from catalog.errors import NothingToDoError
from catalog.geometry.vectors import unit
from catalog.progress import SilentProgress
from optnav_cli.control_points import acceptance as gates
from optnav_cli.fix import GateMargins
from optnav_cli.frames.folder import Observation
from optnav_cli.frames.picture import Picture
from optnav_cli.reasons import ReasonCode
from tests.studies import acceptance
from tests.studies import acceptance_situations as making
from tests.studies.acceptance import Acceptance, chance_limit, is_accepted
from tests.studies.acceptance_situations import (
    RIGHT,
    WRONG,
    PosedPicture,
    SituationOutcome,
    Surround,
)


@pytest.fixture(scope="session")
def view(rough_world):
    """A picture of rough ground with its pose, whose priors are off by up to a kilometre."""
    pose = rough_world.pose(100e3, roll=0.3, tilt=(0.01, -0.008))
    sun = rough_world.sun(30.0, 65.0)
    taken = Picture(rough_world.picture(pose, sun, noise_seed=4), 255.0)
    turn = pose.camera_from_body
    seen = Observation("a.png", "", 0.0, rough_world.camera, taken, turn, 0.0, sun)
    return PosedPicture(seen, pose.position_m, turn, (300.0, 1000.0), np.radians(0.2))


@pytest.fixture
def around(rough_world, field_of):
    """Its control points, and a bright disc."""
    x, y = np.meshgrid(np.arange(200), np.arange(200))
    disc = np.where(np.hypot(x - 120, y - 90) < 60, x, 0).astype(np.float32)
    return Surround(field_of(rough_world).xyz_m, [disc])


@pytest.fixture
def good(view):
    return making.right(view, np.random.default_rng(3))


def test_right_situations_are_solved_and_wrong_ones_are_not(rough_world, field_of, view, around):
    field = field_of(rough_world)
    made = making.situations(view, around, np.random.default_rng(5), 3, 1)
    found = [making.outcome("rough", one, view, field) for one in made]
    assert [one.kind for one in found] == [RIGHT] * 3 + list(WRONG)
    assert [one.solved for one in found] == [True] * 3 + [False] * len(WRONG)
    for one in found[:3]:
        assert one.margins.chance_decades > 0.0
        assert one.margins.scatter < 1.0
        assert one.sigmas < 5.0


def test_pictures_without_ground_are_never_solved(rough_world, field_of, view, around, good):
    field, rng = field_of(rough_world), np.random.default_rng(11)
    sizes = set()
    for _ in range(16):
        made = making.smooth(making.right(view, rng), view, around, rng)
        sizes.add(made.observation.picture.values.shape)
        assert made.observation.picture.values.shape == made.observation.camera.shape
        assert not making.outcome("rough", made, view, field).solved
    assert len(sizes) == 4


def test_a_refusal_by_chance_has_a_margin_below_zero(rough_world, field_of, view, monkeypatch):
    good = making.right(view, np.random.default_rng(3))
    field = field_of(rough_world)
    solved = making.outcome("rough", good, view, field)
    limits = gates.load_acceptance_limits()
    more = limits.decades.least + solved.margins.chance_decades + 1.0
    limits = structs.replace(limits, decades=structs.replace(limits.decades, least=more))
    monkeypatch.setattr(gates, "load_acceptance_limits", lambda: limits)
    refused = making.outcome("rough", good, view, field)
    assert (refused.solved, refused.code) == (False, ReasonCode.BY_CHANCE)
    assert refused.margins.chance_decades == pytest.approx(-1.0)
    assert refused.margins.scatter == pytest.approx(solved.margins.scatter)


def test_a_part_of_a_picture_looks_where_the_whole_does(view, good):
    seen = good.observation
    assert seen.picture.values.shape == seen.camera.shape
    x, y = np.subtract(view.observation.camera.principal_point_px, seen.camera.principal_point_px)
    size = seen.camera.width_px
    part = view.observation.picture.values[int(y) : int(y) + size, int(x) : int(x) + size]
    np.testing.assert_array_equal(part, seen.picture.values)
    assert 0.6 * 512 - 1 <= size <= 512


def test_a_turned_picture_shows_what_was_seen_after_a_turn_about_the_boresight(view, good):
    """What a pixel shows and where it looks go together, but for the roll that is not stated."""
    good.observation.picture.values[40, 25] = 1000.0
    wrong = making.turned(good, view, Surround(np.empty((0, 3)), []), np.random.default_rng(1))
    before, after = good.observation, wrong.observation
    ((row, column),) = np.argwhere(after.picture.values == 1000.0)
    centre = np.array(before.camera.principal_point_px)
    moved = np.array(after.camera.principal_point_px)
    assert np.hypot(*(centre - (25, 40))) == pytest.approx(np.hypot(*(moved - (column, row))))


def test_a_mirrored_picture_keeps_the_boresight_on_its_ground(view, good):
    wrong = making.mirrored(good, view, Surround(np.empty((0, 3)), []), np.random.default_rng(1))
    width = good.observation.camera.width_px
    x, _ = good.observation.camera.principal_point_px
    assert wrong.observation.camera.principal_point_px[0] == width - 1 - x
    np.testing.assert_array_equal(
        wrong.observation.picture.values, good.observation.picture.values[:, ::-1]
    )


def test_another_ground_is_stated_with_the_same_view_and_light(view, good, around):
    wrong = making.other_ground(good, view, around, np.random.default_rng(1))
    before, after = good.observation, wrong.observation
    place, other = good.prior.position_m, wrong.prior.position_m
    angle = np.arccos(np.clip(unit(place) @ unit(other), -1.0, 1.0))
    assert angle >= view.apart_rad
    np.testing.assert_allclose(
        before.camera_from_body.apply(place), after.camera_from_body.apply(other), atol=1e-6
    )
    np.testing.assert_allclose(
        before.camera_from_body.apply(before.sun_body),
        after.camera_from_body.apply(after.sun_body),
        atol=1e-12,
    )
    assert after.picture is before.picture


def test_a_wrong_sun_stands_as_high_on_another_side(view, good, around):
    wrong = making.wrong_sun(good, view, around, np.random.default_rng(1))
    up = unit(view.position_m)
    before, after = good.observation.sun_body, wrong.observation.sun_body
    assert after @ up == pytest.approx(before @ up)
    flat = unit(np.array([before - (before @ up) * up, after - (after @ up) * up]))
    assert flat[0] @ flat[1] < 0.01


def test_noise_has_the_brightnesses_and_about_the_spectrum_of_the_picture(view, good, around):
    made = making.noise(good, view, around, np.random.default_rng(1)).observation.picture.values
    values = good.observation.picture.values
    np.testing.assert_array_equal(np.sort(made, axis=None), np.sort(values, axis=None))
    assert abs(np.corrcoef(made.ravel(), values.ravel())[0, 1]) < 0.2
    steps = [float(np.std(np.diff(one))) for one in (made, values)]
    assert steps[0] == pytest.approx(steps[1], rel=0.3)


def test_another_body_fills_the_picture(view, good, around):
    made = making.other_body(good, view, around, np.random.default_rng(1)).observation
    assert made.picture.values.shape == made.camera.shape
    assert made.picture.values[made.camera.height_px // 2].min() > 0


def test_an_archive_s_label_is_taken_as_it_is(view):
    label = replace(view, camera_from_body=None, prior_sigma_m=(1500.0, 1500.0))
    prior = making.right(label, np.random.default_rng(2)).prior
    np.testing.assert_array_equal(prior.position_m, view.position_m)
    assert prior.covariance_m2[0, 0] == pytest.approx(1500.0**2)


def outcomes():
    """20 right ones, two of them refused, one too poor; 2000 wrong ones, three of them solved."""
    good = [SituationOutcome("a", RIGHT, "", GateMargins(10.0, 0.5), 1.0)] * 18
    good += [
        SituationOutcome("a", RIGHT, ReasonCode.BY_CHANCE, GateMargins(-2.0, 0.5)),
        SituationOutcome("a", RIGHT, ReasonCode.POINTS_DISAGREE, GateMargins(5.0, 1.2)),
    ]
    good.append(SituationOutcome("a", RIGHT, ReasonCode.NO_SOLUTION, points=3))
    bad = [
        SituationOutcome("a", "noise", "", GateMargins(margin, 0.9)) for margin in (0.5, 1.0, 1.5)
    ]
    bad += [SituationOutcome("a", "noise", ReasonCode.BY_CHANCE, GateMargins(-3.0, 0.9))] * 10
    bad += [SituationOutcome("a", "mirrored", ReasonCode.NO_SOLUTION)] * 1987
    return good, bad


def test_the_tables_count_what_is_refused_and_what_is_solved():
    good, bad = outcomes()
    right, wrong = acceptance.report(Acceptance(good + bad, False)).tables
    assert right.column("case") == wrong.column("case") == ["a", "all"]
    assert right.rows[1][1:8] == (1, 20, 2, 10.0, 1, 1, 0)
    assert (right.column("within")[0], right.column("nees")[0]) == (100.0, pytest.approx(1 / 3))
    assert wrong.rows[1][1:4] == (2000, 3, 0.15)
    assert (wrong.column("noise")[0], wrong.column("mirrored")[0]) == ("3 of 13", "0 of 1987")


def test_the_limit_is_the_least_that_solves_one_wrong_one_in_a_thousand():
    good, bad = outcomes()
    least = chance_limit(bad)
    assert 0.5 < least <= 1.0
    assert sum(is_accepted(one, least) for one in bad) == 2
    assert sum(is_accepted(one, -2.0) for one in good) == 19
    assert sum(is_accepted(one, 0.0, 1.3) for one in good) == 19
    note, same = acceptance.report(Acceptance(good + bad, True)).notes[2:]
    assert same == note.replace("all kinds", "all but a wrong Sun")
    assert "+0.5 powers of ten" in note
    assert "refuses 10.0 %" in note
    assert chance_limit([]) == -np.inf
    unjudged = [one for one in bad if one.margins is None]
    assert "no limit is needed" in acceptance.report(Acceptance(good + unjudged, True)).notes[2]


def test_both_curves_are_drawn_and_end_at_what_is_refused_today():
    good, bad = outcomes()
    drawn = acceptance.picture(Acceptance(good + bad, False))
    assert drawn.count("<svg") == 3  # the sheet and two plots
    assert "of 2000 wrong situations solved" in drawn
    assert "of 20 right situations refused" in drawn


def test_binned_pixels_see_the_same_field():
    camera = acceptance.preset_camera("unk")
    small = acceptance.binned(camera)
    corners = np.array([[-0.5, -0.5], [camera.width_px - 0.5, camera.height_px - 0.5]])
    wanted = unit(camera.unproject(corners))
    np.testing.assert_allclose(unit(small.unproject((corners + 0.5) / 4 - 0.5)), wanted, atol=1e-9)


@pytest.mark.parametrize("row", acceptance.ROWS, ids=lambda row: row.name)
def test_every_case_is_of_shipped_files(row):
    if row is not acceptance.ROSETTA:
        assert acceptance.resource(f"configs/catalogs/{row.catalog}.toml").is_file()
    if row.scenario:
        scenario = acceptance.load_scenario(
            acceptance.resource(f"configs/scenarios/{row.scenario}.toml")
        )
        acceptance.binned(acceptance.preset_camera(scenario.camera.name))


def test_a_case_that_is_not_there_is_refused_before_anything_is_made(tmp_path, monkeypatch):
    with pytest.raises(NothingToDoError, match="Mars"):
        acceptance.run(tmp_path / "out", SilentProgress(), rows="Mars")
    assert not (tmp_path / "out").exists()
    monkeypatch.delenv("OPTNAV_SHARED_DATA", raising=False)
    assert acceptance.comet_labels() == []
