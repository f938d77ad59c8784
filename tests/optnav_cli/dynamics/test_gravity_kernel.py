"""Pull and gradient against Legendre functions of scipy, differences and Laplace's equation."""

import math

import numpy as np
import pytest
from scipy.special import assoc_legendre_p_all

from catalog.bodies.body import load_body
from catalog.config import resource
from optnav_cli.dynamics.gravity_field import read_field
from optnav_cli.dynamics.gravity_kernel import gradient, harmonic_tables, pull

MOON = load_body("moon")
FIELD = read_field(resource("data/moon_glgm3_50.tab"), MOON)
SCALE = MOON.gm_m3_s2, FIELD.radius_m
PLACES = [(1.2e6, -0.9e6, 1.05e6), (-1.0e5, 4.0e5, -1.75e6), (0.0, 0.0, 1.9e6), (1.74e6, 0.0, 0.0)]
STEP_M = 20.0


def potential(place, field, degree):
    """Degrees 2 and up by scipy's associated Legendre functions, in latitude and longitude."""
    r, lon = float(np.linalg.norm(place)), math.atan2(place[1], place[0])
    legendre = assoc_legendre_p_all(degree, degree, place[2] / r)[0]
    total = 0.0
    for n in range(2, degree + 1):
        for m in range(n + 1):
            logs = math.lgamma(n - m + 1) - math.lgamma(n + m + 1)
            norm = math.sqrt((1 if m == 0 else 2) * (2 * n + 1)) * math.exp(0.5 * logs)
            # scipy has the Condon-Shortley phase, geodesy has not
            term = field.c[n, m] * math.cos(m * lon) + field.s[n, m] * math.sin(m * lon)
            total += (field.radius_m / r) ** n * norm * (-1) ** m * legendre[n, m] * term
    return MOON.gm_m3_s2 / r * total


def pull_at(place, field):
    out = np.empty(3)
    pull(np.asarray(place, dtype=float), SCALE, harmonic_tables(field, 2)[0], out)
    return out


@pytest.mark.parametrize("degree", [2, 3, 20, 50])
@pytest.mark.parametrize("place", PLACES)
def test_the_pull_is_the_slope_of_the_potential(degree, place):
    field, slope = FIELD.cut(degree), np.empty(3)
    for k, step in enumerate(STEP_M * np.eye(3)):
        ahead, back = (potential(np.array(place) + s, field, degree) for s in (step, -step))
        slope[k] = (ahead - back) / (2.0 * STEP_M)
    assert np.abs(pull_at(place, field) - slope).max() < 1e-6 * np.linalg.norm(slope)


@pytest.mark.parametrize("degree", [2, 10, 50])
@pytest.mark.parametrize("place", PLACES)
def test_the_gradient_is_the_slope_of_the_pull(degree, place):
    field, found, slope = FIELD.cut(degree), np.empty((3, 3)), np.empty((3, 3))
    gradient(np.array(place), SCALE, harmonic_tables(field, degree)[1], found)
    for k, step in enumerate(STEP_M * np.eye(3)):
        ahead, back = (pull_at(np.array(place) + s, field) for s in (step, -step))
        slope[:, k] = (ahead - back) / (2.0 * STEP_M)
    assert np.abs(found - slope).max() < 1e-6 * np.abs(slope).max()
    assert abs(np.trace(found)) < 1e-12 * np.abs(found).max()


def test_high_degrees_keep_their_digits_at_the_poles():
    """Degree 150 on the axis: the zonal sum in closed form, P_n = 1."""
    n = np.arange(151.0)
    c = np.zeros((151, 151))
    c[2:, 0] = 1e-4 / n[2:] ** 2
    field = type(FIELD)(FIELD.radius_m, c, np.zeros_like(c), None, "zonal")
    r = 1.76e6
    wanted = -(n + 1.0) * np.sqrt(2.0 * n + 1.0) * c[:, 0] * (FIELD.radius_m / r) ** n
    found = pull_at((0.0, 0.0, r), field)
    assert found[2] == pytest.approx(MOON.gm_m3_s2 / r**2 * wanted.sum(), rel=1e-12)
    assert np.abs(found[:2]).max() < 1e-18
