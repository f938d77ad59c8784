"""When a solved pose is accepted, and when not."""

from dataclasses import dataclass

import numpy as np
import pytest

from optnav_cli.control_points.acceptance import (
    PointLight,
    check_light,
    check_matches,
    check_parts,
    check_position,
    compute_decades,
    compute_part_decades,
    load_acceptance_limits,
)
from optnav_cli.control_points.solve import compute_min_score
from optnav_cli.fix import PositionPrior
from optnav_cli.reasons import ReasonCode

DECADES = load_acceptance_limits().decades


@dataclass
class Robust:
    degrees_of_freedom: int
    used: np.ndarray
    variance_factor: float = 1.0


def robust(count, freedom=3, factor=1.0):
    return Robust(freedom, np.ones(count, dtype=bool), factor)


def rejection(solution, decades, tried):
    factor = load_acceptance_limits().scatter.points
    return check_matches(solution, decades, tried, DECADES.least, factor)


def test_two_good_matches_of_two_are_a_solution():
    assert compute_decades([0.85, 0.8], 2, 80) > DECADES.least + 8.0
    assert not rejection(robust(2, freedom=1), DECADES.least + 0.1, 2)


def test_two_weak_matches_of_twenty_are_what_chance_offers():
    assert compute_decades([0.34, 0.31], 20, 80) < DECADES.least
    assert "by chance" in rejection(robust(2, freedom=1), DECADES.least - 0.1, 20).text


def test_three_matches_just_over_the_score_gate_are_no_solution():
    """Over rough ground such a frame was off by 618 m at a sigma of 113 m."""
    assert compute_decades([0.34, 0.33, 0.31], 3, 80) < DECADES.least
    assert compute_decades([0.5, 0.5, 0.45], 3, 80) > DECADES.least


def test_many_weak_matches_among_many_more_are_no_evidence():
    """Scores as a wrong pose found them with templates of 32 nodes: 23 of 116 'agreed'."""
    scores = np.linspace(0.31, 0.62, 23)
    assert compute_decades(scores, 116, 32) < DECADES.least


def test_narrow_templates_that_stand_in_for_finer_ones_score_what_chance_offers_once_in_a_hundred():
    for nodes in (32, 46, 67):
        least = compute_min_score(0.3, nodes, coarser=True)
        assert compute_decades([least], 1, nodes) == pytest.approx(2.0, abs=0.05)
        assert compute_min_score(0.3, nodes) == 0.3
    assert compute_min_score(0.3, 80, coarser=True) == 0.3
    assert compute_decades([compute_min_score(0.3, 80)], 1, 80) == pytest.approx(2.0, abs=0.05)


def test_a_match_at_a_coarse_level_takes_no_evidence_from_the_others():
    """Over a mare one of eight was matched with 32 nodes: 8 of 8 'agreed by chance'."""
    fine = compute_decades([0.39] * 7, 7, 80)
    assert compute_decades([0.39] * 8, 8, [80] * 7 + [32]) > fine > DECADES.least
    assert compute_decades([0.39] * 8, 8, 32) < DECADES.least


def test_a_real_frame_with_poor_scores_still_stands():
    assert compute_decades([0.45] * 8, 20, 80) > DECADES.least
    assert compute_decades([0.85] * 6, 7, 32) > DECADES.least


def test_evidence_grows_with_scores_points_and_template_and_falls_with_points_tried():
    base = compute_decades([0.6] * 4, 6, 64)
    assert compute_decades([0.7] * 4, 6, 64) > base
    assert compute_decades([0.6] * 5, 6, 64) > base
    assert compute_decades([0.6] * 4, 6, 80) > base
    assert compute_decades([0.6] * 4, 12, 64) < base
    assert compute_decades([], 5, 80) <= 0.0


def test_three_points_cannot_check_a_free_attitude():
    assert "at least 4" in rejection(robust(3, freedom=0), 30.0, 3).text
    assert not rejection(robust(4, freedom=2), 30.0, 4)


def test_matches_that_scatter_far_beyond_their_sigmas_are_no_solution():
    assert "scatter 5.0 times" in rejection(robust(9, factor=25.0), 30.0, 9).text
    assert not rejection(robust(9, factor=4.0), 30.0, 9)


def test_ground_that_two_templates_show_is_evidence_once():
    apart = compute_part_decades([6.0, 6.0], [1.0, 1.0], 2, 1.0)
    assert compute_part_decades([6.0, 6.0], [0.5, 0.5], 2, 1.0) == pytest.approx(apart / 2.0)
    assert compute_part_decades([6.0], [1.0], 1, 1.0) == pytest.approx(apart / 2.0)
    assert compute_part_decades([6.0, 6.0], [1.0, 1.0], 9, 1.0) < apart


def test_two_parts_behind_a_blur_are_no_solution():
    assert check_parts(2).code == ReasonCode.FEW_POINTS
    assert not check_parts(3)


def test_a_wide_search_offers_more_places_by_chance():
    near = compute_part_decades([7.0, 7.0], [1.0, 1.0], 2, 1.0)
    assert near > DECADES.least_of_near_parts
    # ten times as far to either side are a hundred times as many places for each template
    assert compute_part_decades([7.0, 7.0], [1.0, 1.0], 2, 15.0) == pytest.approx(near - 4.0)


PLACE_M = np.array([1.9e6, 0.0, 0.0])


@pytest.mark.parametrize(("away_m", "right"), [(9e3, True), (14e3, True), (20e3, False)])
def test_a_position_many_sigmas_from_the_prior_is_refused(away_m, right):
    prior = PositionPrior.isotropic(PLACE_M, 3e3, "test")
    reason = check_position(PLACE_M + [away_m, 0.0, 0.0], np.eye(3) * 20.0**2, prior)
    assert (not reason) is right
    if not right:
        assert "20.0 km from the prior" in reason.text


def test_a_prior_of_no_sigma_still_leaves_the_room_that_every_search_has():
    prior = PositionPrior.isotropic(PLACE_M, 0.0, "test")
    assert not check_position(PLACE_M + [0.0, 800.0, 0.0], np.eye(3) * 20.0**2, prior)


def test_a_weakly_determined_pose_is_not_held_against_the_prior():
    """With a free attitude and few points the pose itself may be kilometres uncertain."""
    prior = PositionPrior.isotropic(PLACE_M, 500.0, "test")
    assert not check_position(PLACE_M + [0.0, 9e3, 0.0], np.eye(3) * 4e3**2, prior)


def lights(ratio, turns_deg):
    """Points whose light explains so many times as much from those sides as from the stated Sun."""
    turns = np.radians(turns_deg)
    return [PointLight(0.2, 0.2 * ratio, np.cos(turn), np.sin(turn)) for turn in turns]


AGREEING, SCATTERED = [-150.0, -140.0, -160.0, -170.0], [-150.0, -60.0, 160.0, -120.0]


@pytest.mark.parametrize(
    ("ratio", "turns_deg", "refused"),
    [
        (1.9, AGREEING, True),
        (1.3, AGREEING, False),
        (1.9, SCATTERED, False),
        (2.1, SCATTERED, True),
        (2.1, [-30.0, 20.0, 30.0, 10.0], False),
        (1.9, [-30.0, 20.0, 30.0, 10.0], False),
    ],
)
def test_a_side_that_the_points_agree_about_needs_less_gain(ratio, turns_deg, refused):
    reason = check_light(lights(ratio, turns_deg))
    assert (reason.code == ReasonCode.WRONG_SUN) is refused
