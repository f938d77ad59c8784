"""Fixes, rows and reasons: what holds of them wherever they come from."""

import re

import numpy as np
import pytest

from catalog.errors import NoSolutionError
from optnav_cli.fix import Fix, Method, NoFix, PositionPrior, Solution
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode, format_distinct

DARK = Reason(ReasonCode.NO_LIMB, "no limb in view")
ARC = Reason(ReasonCode.CONTRADICTS_ARC, "3 km from the arc")


def test_every_code_is_words_with_underscores_and_has_a_meaning():
    for code in ReasonCode:
        assert re.fullmatch(r"([a-z]+(_[a-z]+)*)?", code)
        assert bool(code.meaning) is (code is not ReasonCode.NONE)
        assert ReasonCode(str(code)) is code


def test_an_error_gives_its_reason_and_back():
    assert Reason.from_error(NoSolutionError("why")) == Reason(ReasonCode.NO_SOLUTION, "why")
    assert Reason.from_error(DARK.error()) == DARK


def test_reasons_one_after_the_other_keep_the_code_of_the_first():
    both = DARK.add_sentence(ARC)
    assert (both.code, both.text) == (DARK.code, "no limb in view; 3 km from the arc")
    assert DARK.add_sentence(NO_REASON) == DARK
    assert NO_REASON.add_sentence(ARC) == ARC
    assert not NO_REASON


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_fix_that_is_not_finite_is_refused(bad):
    with pytest.raises(ValueError, match="finite"):
        Fix(Method.HORIZON, np.array([2e6, bad, 0.0]), np.eye(3))
    with pytest.raises(ValueError, match="finite"):
        Fix(Method.HORIZON, np.array([2e6, 0.0, 0.0]), np.full((3, 3), bad))


def test_a_row_reads_from_its_fix_or_from_why_there_is_none():
    fix = Fix(Method.HORIZON_SPHERE, np.array([2e6, 0.0, 0.0]), np.eye(3), reason=DARK)
    row = Solution("a.png", "", fix, "frames.csv").with_remark(ARC)
    assert (row.status, row.method, row.prior) == ("solved", "horizon_sphere", "frames.csv")
    assert (row.reason_code, row.reason) == (DARK.code, "no limb in view; 3 km from the arc")
    assert row.position_m is fix.position_m
    failed = Solution("a.png", "", NoFix(DARK))
    assert (failed.status, failed.method, failed.reason_code) == ("unsolved", "", DARK.code)
    assert (failed.fix, failed.position_m, failed.covariance_m2) == (None, None, None)


def test_a_method_has_a_label_for_sentences():
    assert Method.CONTROL_POINTS.label == "control points"


def test_an_isotropic_prior_has_its_sigma_in_every_direction():
    prior = PositionPrior.isotropic(np.zeros(3), 3.0, "frames.csv")
    assert np.array_equal(prior.covariance_m2, 9.0 * np.eye(3))


@pytest.mark.parametrize(
    ("value", "limit", "decimals", "wanted"),
    [
        (0.2996, 0.3, 2, ("0.2996", "0.3000")),
        (0.21, 0.3, 2, ("0.21", "0.30")),
        (0.3, 0.3, 2, ("0.30", "0.30")),
        (np.nextafter(0.3, 0.0), 0.3, 2, ("0.2999999999999999", "0.3000000000000000")),
        (np.nan, 0.3, 1, ("nan", "0.3")),
    ],
)
def test_a_number_and_its_limit_are_told_apart(value, limit, decimals, wanted):
    assert format_distinct(value, limit, decimals) == wanted


def test_each_reason_has_one_label_its_code_in_words():
    labels = [code.label for code in ReasonCode]
    assert len(set(labels)) == len(labels)
    assert all(code.label.replace(" ", "_") == code.value for code in ReasonCode if code.value)
