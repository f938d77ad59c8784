"""Positions from limb directions, against cones built and fitted by other routes."""

import numpy as np
import pytest
from scipy.optimize import brentq, least_squares

from catalog.errors import NoSolutionError
from catalog.terrain.skyline.limb import make_nadir_axes
from optnav_cli.outline.limb.model import fit_limb, solve_linear_position

SHAPES = {
    "sphere": (1737400.0, 1737400.0, 1737400.0),
    "spheroid": (6378137.0, 6378137.0, 6356752.3),
    "triaxial": (13000.0, 11400.0, 9100.0),
}


def tangent_rays(position, radii, azimuths):
    """Rays that touch the ellipsoid: the double root of the ray's crossing, by bisection."""
    quadric = np.diag(1.0 / np.square(radii))
    axes = make_nadir_axes(position)

    def ray(azimuth, angle):
        across = np.cos(azimuth) * axes[0] + np.sin(azimuth) * axes[1]
        return np.sin(angle) * across - np.cos(angle) * axes[2]

    def discriminant(angle, azimuth):
        d = ray(azimuth, angle)
        return (d @ quadric @ position) ** 2 - (d @ quadric @ d) * (
            position @ quadric @ position - 1.0
        )

    angles = [brentq(discriminant, 0.0, np.pi / 2.0, (a,), xtol=1e-15) for a in azimuths]
    return np.array([ray(a, angle) for a, angle in zip(azimuths, angles, strict=True)])


def place(radii, height=1.15, seed=4):
    direction = np.random.default_rng(seed).normal(size=3)
    return height * max(radii) * direction / np.linalg.norm(direction)


def arc(degrees, count=60):
    return np.radians(np.linspace(-0.5 * degrees, 0.5 * degrees, count, endpoint=False))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("degrees", [360.0, 120.0])
@pytest.mark.parametrize("height", [1.03, 2.0, 60.0])
def test_an_exact_cone_gives_its_position(shape, degrees, height):
    radii = SHAPES[shape]
    position = place(radii, height)
    rays = 3.7 * tangent_rays(position, radii, arc(degrees))
    size = np.linalg.norm(position)
    # the discriminant is a small difference of squares that grow with the height: bisection finds
    # the angle to 1e-16 of these, and a distance is an angle times the squared height
    limit = 1e-11 * height**3 * size
    assert np.linalg.norm(solve_linear_position(rays, radii) - position) < limit
    fit = fit_limb(rays, 1e-8, radii)
    assert np.linalg.norm(fit.state - position) < limit
    assert np.abs(fit.measured.residuals).max() < 1e-8


@pytest.mark.parametrize("shape", SHAPES)
def test_scipy_finds_the_same_minimum(shape):
    """Another optimiser over trigonometric residuals with numerical gradients."""
    radii = np.array(SHAPES[shape])
    position = place(radii)
    rng = np.random.default_rng(8)
    rays = tangent_rays(position, radii, arc(200.0)) + rng.normal(0.0, 2e-4, (60, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]

    def beyond(p, d):
        e, q = d / radii, p / radii
        cosine = -(e @ q) / (np.linalg.norm(e, axis=-1) * np.linalg.norm(q))
        return np.arccos(cosine) - np.arcsin(1.0 / np.linalg.norm(q))

    def residuals(scaled):
        p = scaled * position
        rate = np.zeros(len(rays))
        for axis in np.eye(3):
            turn = np.cross(axis, rays)
            rate += ((beyond(p, rays + 1e-6 * turn) - beyond(p, rays - 1e-6 * turn)) / 2e-6) ** 2
        return 1e4 * beyond(p, rays) / np.sqrt(rate)

    found = least_squares(residuals, np.ones(3), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    fit = fit_limb(rays, 1e-4, radii)
    sigma = np.sqrt(np.diag(fit.noise))
    assert (np.abs(fit.state - found.x * position) < 1e-2 * sigma).all()


@pytest.mark.parametrize("shape", SHAPES)
def test_the_gain_is_what_a_turned_ray_does(shape):
    radii = SHAPES[shape]
    position = place(radii)
    rays = tangent_rays(position, radii, arc(250.0, 40))
    fit = fit_limb(rays, 1e-4, radii)
    quadric = np.diag(1.0 / np.square(radii))
    for k in (0, 7, 31):
        # across the limb: away from the body, along the normal at the point of touch
        d = rays[k]
        touch = position - d * (d @ quadric @ position) / (d @ quadric @ d)
        normal = quadric @ touch / np.linalg.norm(quadric @ touch)
        moved = []
        for side in (1e-6, -1e-6):
            turned = rays.copy()
            turned[k] = d + side * normal
            moved.append(fit_limb(turned, 1e-4, radii).state)
        numeric = (moved[0] - moved[1]) / 2e-6
        gain = fit.measured.gain(fit.noise)[:, k]
        assert numeric == pytest.approx(gain, rel=1e-4, abs=1e-4 * abs(numeric).max())


def test_each_ray_may_touch_a_body_of_its_own_size():
    position = place(SHAPES["sphere"], 1.1)
    sizes = 1.0 + 0.003 * np.sin(5.0 * arc(360.0))
    rays = []
    for azimuth, size in zip(arc(360.0), sizes, strict=True):
        rays.append(tangent_rays(position, size * np.array(SHAPES["sphere"]), [azimuth])[0])
    fit = fit_limb(rays, 1e-4, SHAPES["sphere"], scales=sizes)
    assert np.linalg.norm(fit.state - position) < 0.01


def test_far_away_wrong_points_lose_their_weight():
    radii = SHAPES["sphere"]
    position = place(radii)
    rng = np.random.default_rng(2)
    rays = tangent_rays(position, radii, arc(300.0)) + rng.normal(0.0, 1e-5, (60, 3))
    axes = make_nadir_axes(position)
    rays[12:18] -= 0.01 * axes[2]
    fit = fit_limb(rays, 1e-5, radii, start_m=position * 1.0001, cut=1e-3)
    assert (fit.measured.weights[12:18] == 0.0).all()
    assert np.linalg.norm(fit.state - position) < 30.0


def test_independent_errors_have_the_stated_covariance():
    radii = SHAPES["sphere"]
    position = place(radii, 1.2)
    rays = tangent_rays(position, radii, arc(360.0))
    rng = np.random.default_rng(6)
    squares, noise = [], []
    for _ in range(300):
        fit = fit_limb(rays + rng.normal(0.0, 1e-4, rays.shape), 1e-4, radii)
        error = fit.state - position
        squares.append(error @ np.linalg.solve(fit.covariance, error) / 3.0)
        noise.append(error @ np.linalg.solve(fit.noise, error) / 3.0)
    # 900 squared normal numbers: 1 +- 0.05; the sandwich is wide where its few windows scatter
    assert np.mean(noise) == pytest.approx(1.0, abs=0.15)
    assert 0.6 < np.mean(squares) < 1.1


def test_errors_common_to_neighbours_are_in_the_covariance():
    """Waves over some 20 deg of azimuth: the stated noise alone is wrong by a large factor.

    Two thirds of the assumed correlation: the triangle's estimate of such errors is some 40 % low.
    """
    radii = SHAPES["sphere"]
    position = place(radii, 1.2)
    azimuths = arc(360.0, 240)
    rays = tangent_rays(position, radii, azimuths)
    axes = make_nadir_axes(position)
    rng = np.random.default_rng(7)
    honest, naive = [], []
    for _ in range(200):
        wave = np.fft.irfft(
            np.exp(-((np.arange(121) / 12.0) ** 2)) * (rng.normal(size=(121, 2)) @ [1.0, 1.0j]), 240
        )
        wave *= 1e-4 / wave.std()
        fit = fit_limb(rays + wave[:, None] * axes[2], 1e-4, radii)
        error = fit.state - position
        honest.append(error @ np.linalg.solve(fit.covariance, error) / 3.0)
        naive.append(error @ np.linalg.solve(fit.noise, error) / 3.0)
    assert np.mean(naive) > 5.0
    assert 0.7 < np.mean(honest) < 1.8


@pytest.mark.parametrize(
    "rays",
    [
        np.eye(3),
        np.array([[1.0, 0.0, 0.0]] * 20),
        np.random.default_rng(1).normal(size=(50, 3)),
    ],
    ids=["too few", "all the same", "no cone"],
)
def test_what_is_no_limb_has_no_position(rays):
    with pytest.raises(NoSolutionError):
        fit_limb(rays, 1e-4, SHAPES["sphere"])


def test_directions_must_be_vectors_of_three():
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        fit_limb(np.ones((5, 2)), 1e-4, SHAPES["sphere"])
