"""Residuals that follow a pattern along an arc: the stated chance holds, and patterns are seen."""

import numpy as np
import pytest

from optnav_cli.orbit.fit.missing_forces import pattern_probability

TIMES = np.linspace(0.0, 43_200.0, 720)
SERIES = np.arange(720) % 3
REVOLUTION_S = 7200.0


def probability(values, revolution_s=REVOLUTION_S):
    return pattern_probability(values, SERIES, TIMES, revolution_s)


def test_right_residuals_have_the_stated_chance():
    """Of 600 draws 5 % lie below 0.05 (4 sigmas of the count: 21), none below 1e-5."""
    rng = np.random.default_rng(5)
    chances = np.array([probability(rng.normal(size=720)) for _ in range(600)])
    assert abs(np.count_nonzero(chances < 0.05) - 30) < 21
    assert chances.min() > 1e-5


def test_sigmas_stated_too_small_do_not_matter():
    values = np.random.default_rng(6).normal(size=720)
    assert probability(1e3 * values) == pytest.approx(probability(1e2 * values), rel=1e-9)


def test_a_pattern_within_the_stated_sigmas_is_none():
    values = 0.01 * np.random.default_rng(8).normal(size=720)
    assert probability(values + 0.1 * np.sin(2.0 * np.pi * TIMES / REVOLUTION_S)) > 0.5


def test_a_pattern_of_one_sigma_is_seen():
    values = np.random.default_rng(7).normal(size=720)
    wave = 1.0 * np.sin(2.0 * np.pi * TIMES / REVOLUTION_S + SERIES)
    assert probability(values) > 0.01
    assert probability(values + wave) < 1e-12


@pytest.mark.parametrize("count", [0, 1, 5, 12])
def test_too_few_residuals_say_nothing(count):
    values = np.ones(count)
    assert pattern_probability(values, np.zeros(count, int), TIMES[:count], REVOLUTION_S) == 1.0
