"""The selection study: its intervals against published ones, and a small run of it."""

import numpy as np
import pytest
from scipy.stats import binomtest

from catalog.selection.trial import TrialOutcome
from tests.studies.selection import SelectionRow, difference, report, summarise, wilson


@pytest.mark.parametrize(("successes", "trials"), [(0, 10), (7, 10), (81, 263), (1000, 1000)])
def test_wilson_intervals_are_those_of_scipy(successes, trials):
    theirs = binomtest(successes, trials).proportion_ci(method="wilson")
    share, low, high = wilson(successes, trials)
    assert share == successes / trials
    assert (low, high) == pytest.approx((theirs.low, theirs.high), abs=1e-7)  # z has 7 digits


def outcomes(recognised, missed, wrong=0, error=0.3):
    good = TrialOutcome((error, 0.0), 0.8, 0.2, True)
    bad = TrialOutcome((0.4, 0.1), 0.3, 0.2, False)
    far = TrialOutcome((9.0, 0.0), 0.6, 0.2, True)
    return [good] * recognised + [bad] * missed + [far] * wrong


def test_a_difference_has_newcombe_s_interval():
    # Newcombe 1998, table II, method 10, the case 56/70 - 48/80
    a = summarise("a", outcomes(56, 14), 1.5, 100.0)
    b = summarise("b", outcomes(48, 32), 1.5, 100.0)
    value, low, high = difference(a, b)
    assert value == pytest.approx(0.2)
    assert (low, high) == pytest.approx((0.0524, 0.3339), abs=5e-4)


def test_only_accepted_places_near_the_truth_are_recognised():
    found = summarise("x", outcomes(6, 3, wrong=1), 1.5, 100.0)
    assert (found.trials, found.recognised, found.wrong) == (10, 6, 0.1)
    assert found.error_m[0] == pytest.approx(30.0)


def test_the_table_names_strategies_gains_and_intervals():
    one = summarise("chosen", outcomes(90, 10), 1.5, 118.0)
    other = summarise("random", outcomes(70, 30), 1.5, 118.0)
    strategies, gains = report([SelectionRow(118.0, 7, (other, one))]).tables
    assert [row[:3] for row in strategies.rows] == [(118.0, 7, "random"), (118.0, 7, "chosen")]
    assert dict(zip(gains.column("over"), gains.column("gain")))["random"] == pytest.approx(20.0)


def test_intervals_of_nothing_are_wide_open():
    share, low, high = wilson(0, 0)
    assert np.isnan(share)
    assert (low, high) == (0.0, 1.0)
