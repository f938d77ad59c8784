"""Peaks and spacing: what is taken, in which order, and what never happens."""

import numpy as np
import pytest

from catalog.geometry.latlon import angular_distance
from catalog.pipeline.cell_map import RELAXED, choose_spaced, find_peaks


def test_the_strongest_peaks_are_taken_in_order_and_apart():
    response = np.zeros((30, 30), np.float32)
    response[5, 5], response[5, 7], response[20, 20], response[10, 25] = 9.0, 8.0, 7.0, 1.0
    assert find_peaks(response, 4.0, 3) == [(5, 5), (20, 20), (10, 25)]
    assert find_peaks(response, 1.5, 2) == [(5, 5), (5, 7)]


def test_unknown_and_worthless_places_are_never_peaks():
    response = np.full((9, 9), np.nan, np.float32)
    response[4, 4], response[1, 1] = 2.0, 0.0
    assert find_peaks(response, 2.0, 5) == [(4, 4)]
    assert find_peaks(np.zeros((5, 5), np.float32), 2.0, 5) == []


def test_equal_responses_are_taken_in_row_order():
    assert find_peaks(np.ones((4, 4), np.float32), 10.0, 2) == [(0, 0)]


def scattered(seed, near_lat, near_lon):
    """Five candidates in each of 6 x 6 cells of a degree about a place, scores random."""
    rng = np.random.default_rng(seed)
    cells = np.repeat(np.arange(36), 5)
    lat = near_lat + cells // 6 + rng.uniform(0.0, 1.0, 180)
    lon = near_lon + (cells % 6 + rng.uniform(0.0, 1.0, 180)) / np.cos(np.radians(near_lat + 3.0))
    return cells, lat, lon, rng.uniform(0.1, 1.0, 180)


@pytest.mark.parametrize(("lat", "lon"), [(0.0, 10.0), (60.0, 177.0), (-45.0, -181.0)])
def test_whatever_the_cells_take_they_keep_their_distance(lat, lon):
    cells, lats, lons, scores = scattered(1, lat, lon)
    choices = choose_spaced(cells, lats, lons, scores, 0.6)
    assert sorted(choices) == list(range(36))
    for cell, choice in choices.items():
        for other, theirs in choices.items():
            if cell >= other or not choice.spacing or not theirs.spacing:
                continue
            least = 0.6 * min(choice.spacing, theirs.spacing)
            for i in choice.order:
                for j in theirs.order:
                    apart = angular_distance(*np.radians([lats[i], lons[i], lats[j], lons[j]]))
                    assert np.degrees(apart) >= least - 1e-9
    assert sum(choice.spacing == 1.0 for choice in choices.values()) > 25


def test_a_cell_tries_its_candidates_in_the_order_of_their_scores():
    cells, lats, lons, scores = scattered(2, 10.0, 20.0)
    for cell, choice in choose_spaced(cells, lats, lons, scores, 0.4).items():
        assert set(choice.order) <= set(np.flatnonzero(cells == cell))
        assert list(scores[list(choice.order)]) == sorted(scores[list(choice.order)])


def test_the_cell_with_the_worse_best_choice_goes_first():
    # cell 0 can go elsewhere, cell 1 has a single poor candidate close to cell 0's best
    cells = [0, 0, 1]
    lat, lon = np.array([0.0, 0.0, 0.0]), np.array([0.9, 0.1, 1.1])
    choices = choose_spaced(cells, lat, lon, np.array([0.2, 0.3, 0.8]), 0.6)
    assert choices[1].order == (2,)
    assert choices[1].spacing == 1.0
    assert choices[0].order == (1,)


def test_a_cell_that_is_crowded_out_falls_back_and_says_so():
    lat, lon = np.zeros(2), np.array([0.0, 0.4])
    choices = choose_spaced([0, 1], lat, lon, np.array([0.9, 0.2]), 0.6)
    assert choices[0].spacing == 1.0
    assert choices[1] == ((1,), RELAXED)
    tight = choose_spaced([0, 1], lat, lon / 10.0, np.array([0.9, 0.2]), 0.6)
    assert tight[1] == ((1,), 0.0)


def test_scores_that_are_infinite_or_unknown_come_last():
    choices = choose_spaced(
        [0, 0, 0, 1], np.zeros(4), np.array([0.0, 0.3, 0.6, 5.0]),
        np.array([np.inf, 0.5, np.nan, np.inf]), 0.6,
    )  # fmt: skip
    assert choices[0].order[0] == 1
    assert choices[1].order == (3,)


def test_no_candidates_are_no_choices():
    empty = np.empty(0)
    assert choose_spaced([], empty, empty, empty, 0.6) == {}
