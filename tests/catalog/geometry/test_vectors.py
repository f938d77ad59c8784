"""Directions, axes across them, angles and distances in sigmas."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from catalog.geometry.vectors import angle_between, perpendicular_basis, squared_distance, unit


@pytest.mark.parametrize("shape", [(3,), (5, 3), (2, 4, 3)])
def test_units_have_length_one_and_the_vectors_direction(shape: tuple[int, ...]) -> None:
    vectors = np.random.default_rng(1).normal(0.0, 1e6, shape)
    directions = unit(vectors)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(angle_between(directions, vectors), 0.0, atol=1e-15)


@pytest.mark.parametrize(
    "axis", [*np.eye(3), *-np.eye(3), *np.random.default_rng(2).normal(size=(9, 3))]
)
def test_a_basis_and_its_axis_are_a_right_handed_frame(axis: np.ndarray) -> None:
    axis = unit(axis)
    frame = np.stack([*perpendicular_basis(axis), axis])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(frame) == pytest.approx(1.0)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-3, 1.0, np.pi / 2, np.pi - 1e-9, np.pi])
def test_angles_keep_their_digits_at_both_ends(angle: float) -> None:
    one = np.array([3.0, 0.0, 0.0])
    other = 7.0 * np.array([np.cos(angle), np.sin(angle), 0.0])
    assert angle_between(one, other) == pytest.approx(angle, rel=1e-12, abs=1e-15)
    np.testing.assert_allclose(angle_between([one, one], [other, one]), [angle, 0.0], rtol=1e-9)


def test_the_squared_distance_is_the_exponent_of_the_normal_density() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(4, 4))
    covariance, offset = root @ root.T, rng.normal(size=4)
    normal = multivariate_normal(np.zeros(4), covariance)
    exponent = -2.0 * (normal.logpdf(offset) - normal.logpdf(np.zeros(4)))
    assert squared_distance(offset, covariance) == pytest.approx(exponent)
