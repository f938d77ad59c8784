"""Quaternions, cross matrices and RNB axes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from catalog.geometry.rotations import (
    cross_matrix,
    quaternion_from_rotation,
    rnb_axes,
    rotation_from_quaternion,
)


def test_quaternions_are_scalar_first_and_turn_as_the_textbook_says():
    half = np.radians(30.0) / 2.0
    turn = rotation_from_quaternion(np.cos(half), 0.0, 0.0, np.sin(half))
    # a positive turn about z takes x toward y
    assert_allclose(turn.apply([1, 0, 0]), [np.cos(2 * half), np.sin(2 * half), 0.0], atol=1e-15)


def test_quaternions_go_to_rotations_and_back_with_a_scalar_that_is_not_negative():
    rng = np.random.default_rng(14)
    for quaternion in rng.normal(size=(200, 4)):
        back = quaternion_from_rotation(rotation_from_quaternion(*quaternion))
        unit = quaternion / np.linalg.norm(quaternion)
        assert back[0] >= 0.0
        assert_allclose(back, unit if unit[0] >= 0.0 else -unit, atol=1e-12)


@pytest.mark.parametrize(
    "bad", [(0, 0, 0, 0), (np.nan, 0, 0, 1), (np.inf, 0, 0, 0), (1e-300, 0, 0, 0)]
)
def test_a_quaternion_without_a_direction_is_refused(bad):
    with pytest.raises(ValueError, match="no direction"):
        rotation_from_quaternion(*bad)


def test_a_cross_matrix_takes_the_cross_product():
    rng = np.random.default_rng(15)
    a, b = rng.normal(size=(2, 7, 3))
    assert_allclose(np.einsum("nij,nj->ni", cross_matrix(a), b), np.cross(a, b), atol=1e-14)
    assert_allclose(cross_matrix(a[0]) @ b[0], np.cross(a[0], b[0]), atol=1e-14)


def test_rnb_axes_are_right_handed_with_n_along_the_motion():
    rng = np.random.default_rng(16)
    for _ in range(100):
        position, forward = rng.normal(size=(2, 3)) * [[1e6], [1e3]]
        axes = rnb_axes(position, forward)
        assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert_allclose(np.linalg.det(axes), 1.0, atol=1e-12)
        r, n, b = axes
        assert_allclose(r, position / np.linalg.norm(position), atol=1e-12)
        assert n @ forward > 0.0
        assert_allclose(b @ forward, 0.0, atol=1e-9)


def test_of_an_eastward_orbit_over_the_equator_b_is_north():
    assert_allclose(rnb_axes([1.0, 0, 0], [0.3, 2.0, 0]), np.eye(3), atol=1e-15)


@pytest.mark.parametrize("forward", [(5.0, 0.0, 0.0), (-1e3, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_a_motion_along_the_position_has_no_orbit_plane(forward):
    with pytest.raises(ValueError, match="radial"):
        rnb_axes([1.0, 0.0, 0.0], forward)


def test_rotations_and_quaternions_agree_with_scipy():
    turn = Rotation.from_euler("zyx", [0.3, -1.1, 2.0])
    assert_allclose(quaternion_from_rotation(turn)[[1, 2, 3, 0]], turn.as_quat(canonical=True))
