"""Matches whose ground looks alike elsewhere prove nothing, however near the search stays."""

import re

import numpy as np
import pytest

from catalog.correlation.ncc import match_ncc
from optnav_cli.control_points import method
from optnav_cli.control_points.acceptance import drop_disproven
from optnav_cli.control_points.settings import NavigateSettings
from optnav_cli.fix import PositionPrior, UnsolvedFrameError
from optnav_cli.frames.folder import Observation
from optnav_cli.frames.picture import Picture
from optnav_cli.reasons import ReasonCode

NEAR_M = 20.0  # sigma of a prior from which no search has room for a rival
APART_PX = 12  # of the ground that a picture shows twice


@pytest.fixture(scope="session")
def single(rough_world):
    """A picture of rough ground, its pose and Sun."""
    pose, sun = rough_world.pose(100e3), rough_world.sun(30.0, 65.0)
    return rough_world.picture(pose, sun, noise_seed=4), pose, sun


def solve(world, field, values, pose, sun):
    seen = Observation(
        "a.png", "", 0.0, world.camera, Picture(values, 255.0), pose.camera_from_body, 0.0, sun
    )
    prior = PositionPrior.isotropic(pose.position_m + [12.0, -9.0, 15.0], NEAR_M, "test")
    return method.navigate(seen, prior, field, NavigateSettings(), match_ncc)


def test_a_picture_that_shows_its_ground_twice_is_refused(
    rough_world, field_of, single, monkeypatch
):
    picture, pose, sun = single
    field = field_of(rough_world)
    double = ((picture + np.roll(picture, APART_PX, axis=1)) / 2.0).astype(np.float32)
    with pytest.raises(UnsolvedFrameError) as caught:
        solve(rough_world, field, double, pose, sun)
    assert caught.value.code == ReasonCode.BY_CHANCE
    assert re.search(r"by chance: \d+ match as well elsewhere nearby", str(caught.value))
    assert {row.runner_up for row in caught.value.evidence.matches if row.score} == {-1.0}
    assert caught.value.evidence.margins.chance_decades < 0.0
    # by the scores of its narrow search alone it would be solved
    monkeypatch.setattr(method, "drop_disproven", lambda _, strongest, *limits: strongest)
    assert solve(rough_world, field, double, pose, sun).evidence.n_used > 10


def test_a_picture_of_the_ground_is_proven_by_its_best_points(
    rough_world, field_of, single, monkeypatch
):
    picture, pose, sun = single
    asked = []

    def counted(stands_alone, *limits):
        def alone(k):
            asked.append(k)
            return stands_alone(k)

        return drop_disproven(alone, *limits)

    monkeypatch.setattr(method, "drop_disproven", counted)
    fix = solve(rough_world, field_of(rough_world), picture, pose, sun)
    assert fix.evidence.margins.chance_decades > 0.0
    assert 1 <= len(asked) <= 3 < fix.evidence.n_used


@pytest.mark.parametrize(
    ("alone", "kept", "asked"),
    [
        ({1, 2, 3, 4}, [1, 2, 3, 4], 2),  # two are enough
        ({2, 4}, [2, 4], 4),
        ({2, 3}, [2, 3, 4], 3),
        ({3}, [3], 4),
        (set(), [], 4),
    ],
)
def test_points_are_asked_until_those_that_stand_alone_are_enough(alone, kept, asked):
    tried = []

    def stands_alone(k):
        tried.append(k)
        return k in alone

    assert drop_disproven(stands_alone, [1, 2, 3, 4], lambda some: 6.0 * len(some), 12.0) == kept
    assert len(tried) == asked
