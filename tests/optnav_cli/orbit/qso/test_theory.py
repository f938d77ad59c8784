"""The averaged theory of quasi-satellite orbits against quadrature, its own roots and its bound."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ellipk

from optnav_cli.orbit.qso.search import (
    KAPPA,
    MIN_A,
    MIN_DE,
    averaged_rates,
    axes_of,
    first_guess,
    inner_axes,
    integral,
    phase_rate,
)


def inverse_distance(theta: float, a: float, xi: float, big_a: float, kappa: float) -> float:
    x = a * np.cos(theta + xi) + big_a / 2.0 * np.cos(theta)
    y = -kappa * a * np.sin(theta + xi) - big_a * np.sin(theta)
    return float(1.0 / np.hypot(x, y))


@pytest.mark.parametrize(
    ("a", "xi", "big_a", "kappa"), [(0.5, np.pi, 3.5, 2.0), (0.3, 2.5, 4.0, 1.7)]
)
def test_the_elliptic_integral_is_that_over_a_turn(
    a: float, xi: float, big_a: float, kappa: float
) -> None:
    """Equation (1) without the factor 1/(2 pi) that the source's text has."""
    wanted, _ = quad(inverse_distance, 0.0, 2.0 * np.pi, args=(a, xi, big_a, kappa), epsabs=1e-12)
    assert integral(a, xi, big_a, kappa) == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("de", [1.8, 2.57, 5.0, 8.8])
def test_nothing_drifts_on_the_ellipse_of_the_theory(de: float) -> None:
    a, big_a = axes_of(de)
    rates = averaged_rates(a, np.pi, big_a)
    assert np.abs(rates[:3]).max() < 1e-8
    assert rates[3] == pytest.approx(phase_rate(de), rel=1e-7)
    assert rates[3] > 0.0  # quicker than the moon: the source's (2) has the other sign


def test_the_axes_are_roots_of_the_printed_equation() -> None:
    a, big_a = axes_of(2.57)
    equation = 10.0 * big_a * a**2 - 5.0 * big_a**2 * a + 32.0 / np.pi * ellipk(0.75)
    assert abs(equation) < 1e-9
    small, large = inner_axes(big_a)
    assert small == pytest.approx(a)
    assert small + large == pytest.approx(big_a / 2.0)


def test_the_roots_meet_at_the_bound() -> None:
    assert pytest.approx(256.0 * ellipk(0.75) / (5.0 * np.pi)) == MIN_A**3
    small, large = inner_axes(MIN_A * (1.0 + 1e-12))
    assert small == pytest.approx(large, rel=1e-4)
    assert axes_of(MIN_DE)[1] == pytest.approx(MIN_A)
    with pytest.raises(ValueError, match="no real root"):
        inner_axes(0.999 * MIN_A)


def test_the_first_guess_runs_backwards_behind_the_moon() -> None:
    x, y, dx, dy = first_guess(-np.pi / 2.0, 2.57)
    assert (x, y) == pytest.approx((0.0, -2.57), abs=1e-12)
    assert (dx, dy) == pytest.approx((-axes_of(2.57)[1] / 2.0, 0.0), abs=1e-12)
    assert KAPPA == 2.0
