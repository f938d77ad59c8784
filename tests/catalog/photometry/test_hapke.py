"""Hapke's law against its theory, a second writing of it, and the Moon's measured phase curve."""

import math

import numpy as np
import pytest

from catalog.photometry import hapke
from catalog.photometry.sets import LUNAR, HapkeParameters

SMOOTH = LUNAR._replace(theta_bar=0.0)
ROUGHER = LUNAR._replace(theta_bar=math.radians(35.0))


def geometries(count, seed, least=0.02):
    """Random cosines of incidence, emission and of a phase that these two allow."""
    rng = np.random.default_rng(seed)
    mu0, mu = rng.uniform(least, 1.0, (2, count))
    cos_psi = np.cos(rng.uniform(0.0, np.pi, count))
    return mu0, mu, mu0 * mu + np.sqrt(1 - mu0**2) * np.sqrt(1 - mu**2) * cos_psi


def written_again(incidence, emission, psi, p):
    """The same law in angles, as the book prints it, with none of the code's shortcuts."""
    i, e = incidence, emission
    cos_g = np.cos(i) * np.cos(e) + np.sin(i) * np.sin(e) * np.cos(psi)
    g = np.arccos(cos_g)
    tan_t = np.tan(p.theta_bar)
    chi = 1 / np.sqrt(1 + np.pi * tan_t**2)

    def e1(x):
        return np.exp(-2 / np.pi / tan_t / np.tan(x))

    def e2(x):
        return np.exp(-1 / np.pi / tan_t**2 / np.tan(x) ** 2)

    def eta(x):
        return chi * (np.cos(x) + np.sin(x) * tan_t * e2(x) / (2 - e1(x)))

    f = np.exp(-2 * np.tan(psi / 2))
    half = np.sin(psi / 2) ** 2
    if i <= e:
        below = 2 - e1(e) - psi / np.pi * e1(i)
        mu0e = chi * (np.cos(i) + np.sin(i) * tan_t * (np.cos(psi) * e2(e) + half * e2(i)) / below)
        mue = chi * (np.cos(e) + np.sin(e) * tan_t * (e2(e) - half * e2(i)) / below)
        last = chi / (1 - f + f * chi * np.cos(i) / eta(i))
    else:
        below = 2 - e1(i) - psi / np.pi * e1(e)
        mu0e = chi * (np.cos(i) + np.sin(i) * tan_t * (e2(i) - half * e2(e)) / below)
        mue = chi * (np.cos(e) + np.sin(e) * tan_t * (np.cos(psi) * e2(i) + half * e2(e)) / below)
        last = chi / (1 - f + f * chi * np.cos(e) / eta(e))
    shadowing = mue / eta(e) * np.cos(i) / eta(i) * last
    surge = 1 + p.bs0 / (1 + np.tan(g / 2) / p.hs)
    lobe = 1 - p.b**2
    single = (1 + p.c) / 2 * lobe / (1 - 2 * p.b * cos_g + p.b**2) ** 1.5
    single += (1 - p.c) / 2 * lobe / (1 + 2 * p.b * cos_g + p.b**2) ** 1.5
    r0 = (1 - np.sqrt(1 - p.w)) / (1 + np.sqrt(1 - p.w))

    def h(x):
        return 1 / (1 - p.w * x * (r0 + (1 - 2 * r0 * x) / 2 * np.log((1 + x) / x)))

    bracket = single * surge + h(mu0e) * h(mue) - 1
    return p.w / 4 * mu0e / (mu0e + mue) * bracket * shadowing


def disc_brightness(phase, surface, n=300):
    """Light of a whole sphere at a phase, over that of a white flat disc facing the Sun."""
    x, weight = np.polynomial.legendre.leggauss(n)
    lat = x * np.pi / 2
    lon = phase - np.pi / 2 + (x + 1) / 2 * (np.pi - phase)
    lat, lon = np.meshgrid(lat, lon, indexing="ij")
    mu, mu0 = np.cos(lat) * np.cos(lon), np.cos(lat) * np.cos(lon - phase)
    area = np.outer(weight, weight) * np.pi / 2 * (np.pi - phase) / 2 * np.cos(lat)
    return (hapke.reflectance(mu0, mu, np.cos(phase), surface) * mu * area).sum() / np.pi


@pytest.mark.parametrize("w", [0.1, 0.3854, 0.8, 0.99])
def test_h_solves_chandrasekhars_equation_within_one_percent(w):
    x, weight = np.polynomial.legendre.leggauss(200)
    x, weight = (x + 1) / 2, weight / 2
    h = np.ones(x.size)
    for _ in range(3000):  # 1/H(x) = sqrt(1-w) + w/2 int y H(y) / (x + y) dy
        new = 1 / (np.sqrt(1 - w) + w / 2 * ((x * h * weight) / (x[:, None] + x)).sum(axis=1))
        if np.abs(new - h).max() < 1e-12:
            break
        h = new
    ours = np.array([hapke.h_function(float(a), w) for a in x])
    assert np.abs(ours / h - 1).max() < 0.01


def test_h_of_a_white_medium_is_chandrasekhars_number():
    assert hapke.h_function(1.0, 1.0) == pytest.approx(2.9078, rel=0.01)


def test_the_phase_function_has_mean_one():
    x, weight = np.polynomial.legendre.leggauss(100)
    values = np.array([hapke.phase_function(float(c), LUNAR.b, LUNAR.c) for c in x])
    assert (values * weight).sum() / 2 == pytest.approx(1.0, abs=1e-12)


def test_a_positive_c_scatters_backwards():
    assert hapke.phase_function(1.0, 0.24, 0.3) > 1.4 * hapke.phase_function(-1.0, 0.24, 0.3)


@pytest.mark.parametrize("surface", [SMOOTH, LUNAR, ROUGHER])
def test_light_paths_can_be_reversed(surface):
    mu0, mu, cos_g = geometries(20_000, seed=1)
    there = hapke.reflectance(mu0, mu, cos_g, surface) / mu0
    back = hapke.reflectance(mu, mu0, cos_g, surface) / mu
    np.testing.assert_allclose(there, back, rtol=1e-10)


@pytest.mark.parametrize("surface", [SMOOTH, LUNAR, ROUGHER])
def test_brightness_is_never_negative_and_always_finite(surface):
    mu0, mu, cos_g = geometries(50_000, seed=2, least=1e-6)
    values = hapke.reflectance(mu0, mu, cos_g, surface)
    assert np.isfinite(values).all()
    assert (values >= 0.0).all()


def test_brightness_is_zero_without_sun_or_sight():
    assert (
        hapke.reflectance([0.0, -0.2, 0.5, 0.5], [0.5, 0.5, 0.0, -0.2], 0.3, LUNAR) == 0.0
    ).all()


def test_the_law_agrees_with_its_second_writing():
    rng = np.random.default_rng(3)
    for _ in range(300):
        i, e = rng.uniform(0.05, 1.5, 2)
        psi = rng.uniform(0.01, 3.0)
        cos_g = np.cos(i) * np.cos(e) + np.sin(i) * np.sin(e) * np.cos(psi)
        expected = written_again(i, e, psi, LUNAR)
        assert hapke.reflectance(np.cos(i), np.cos(e), cos_g, LUNAR) == pytest.approx(
            expected, rel=1e-7
        )


def test_a_dark_smooth_surface_scatters_once():
    dark = HapkeParameters(w=1e-4, b=0.24, c=0.3, bs0=0.0, hs=0.07, theta_bar=0.0)
    mu0, mu, cos_g = geometries(1000, seed=4)
    phase = np.array([hapke.phase_function(float(c), 0.24, 0.3) for c in cos_g])
    once = 1e-4 / 4 * mu0 / (mu0 + mu) * phase
    np.testing.assert_allclose(hapke.reflectance(mu0, mu, cos_g, dark), once, rtol=3e-4)


def test_roughness_vanishes_smoothly():
    mu0, mu, cos_g = geometries(1000, seed=5, least=0.2)
    nearly = hapke.reflectance(mu0, mu, cos_g, LUNAR._replace(theta_bar=math.radians(0.1)))
    np.testing.assert_allclose(nearly, hapke.reflectance(mu0, mu, cos_g, SMOOTH), rtol=1e-3)


def test_the_two_branches_of_roughness_meet():
    mu = np.linspace(0.05, 0.95, 50)
    cos_g = mu * mu + (1 - mu * mu) * np.cos(1.0)
    over = hapke.reflectance(mu * (1 + 1e-9), mu, cos_g, LUNAR)
    under = hapke.reflectance(mu * (1 - 1e-9), mu, cos_g, LUNAR)
    np.testing.assert_allclose(over, under, rtol=1e-6)


def test_brightness_surges_towards_zero_phase():
    phases = np.radians([0.0, 1.0, 2.0, 5.0, 10.0, 20.0])
    values = hapke.reflectance(np.cos(phases), 1.0, np.cos(phases), LUNAR)
    assert (np.diff(values) < 0).all()
    assert values[0] > 1.2 * values[3]


def test_the_disc_fades_with_phase_as_the_moon_does():
    """Allen, Astrophysical Quantities (3rd ed., 1973), Moon's phase law: magnitudes below full.

    Counted from 5 deg (inside, the surge depends on the Sun's size and on eclipses). 0.2 mag covers
    the difference of the bands (V there, 643 nm here) and of waxing and waning.
    """
    allen = {5: 0.08, 10: 0.23, 20: 0.51, 40: 1.06, 60: 1.62, 80: 2.24, 100: 3.04, 120: 3.93}
    at_five = disc_brightness(math.radians(5.0), LUNAR)
    for degrees, magnitude in allen.items():
        fading = -2.5 * math.log10(disc_brightness(math.radians(degrees), LUNAR) / at_five)
        assert fading == pytest.approx(magnitude - allen[5], abs=0.2), degrees


def test_the_disc_is_as_dark_as_the_moon():
    """V geometric albedo 0.12, redder by a third at 643 nm, taken a few degrees off full Moon."""
    assert 0.12 < disc_brightness(math.radians(5.0), LUNAR) < 0.18
