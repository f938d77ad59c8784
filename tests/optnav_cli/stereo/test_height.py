"""Heights of planes that two cameras see, against the planes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.stereo.height import measure_height
from tests.optnav_cli.stereo.pairs import DOWN, brightness, picture, rig


@pytest.mark.parametrize("height_m", [25.0, 50.0])
def test_the_height_over_a_plane_is_within_its_sigma(height_m: float) -> None:
    pair = rig()
    first = picture(pair.first, height_m, slope=(0.1, -0.05), noise=1.0, seed=1)
    second = picture(pair.second, height_m, slope=(0.1, -0.05), noise=1.0, seed=2)
    found = measure_height(first, second, pair, DOWN)
    assert abs(found.height_m - height_m) < 4.0 * found.sigma_m
    assert found.sigma_m < 1e-4 * height_m**2
    assert found.sigma_mounting_m == 0.0


def test_a_ship_that_is_turned_measures_the_height_straight_down() -> None:
    pair, turn = rig(), Rotation.from_euler("xyz", [3.0, -2.0, 20.0], degrees=True)
    seen = [picture(eye, 30.0, ground_from_ship=turn) for eye in (pair.first, pair.second)]
    found = measure_height(seen[0], seen[1], pair, turn.inv().apply(DOWN))
    assert found.height_m == pytest.approx(30.0, abs=0.02)


def test_a_camera_that_is_rolled_in_its_mount_measures_the_same() -> None:
    pair = rig(turn=Rotation.from_euler("z", 30.0, degrees=True))
    seen = [picture(eye, 30.0) for eye in (pair.first, pair.second)]
    found = measure_height(seen[0], seen[1], pair, DOWN)
    assert found.height_m == pytest.approx(30.0, abs=0.02)


def test_a_mounting_that_is_off_moves_the_height_by_its_stated_sigma() -> None:
    error = 100.0 * ARCSEC
    stated, true = rig(error_rad=error), rig(turn=Rotation.from_rotvec([0.0, error, 0.0]))
    first, second = picture(true.first, 40.0), picture(true.second, 40.0)
    found = measure_height(first, second, stated, DOWN)
    # one axis of the three turns along the base, the others hardly count
    assert abs(found.height_m - 40.0) == pytest.approx(found.sigma_mounting_m, rel=0.05)
    assert found.sigma_mounting_m == pytest.approx(40.0**2 * error, rel=0.05)


def test_sigmas_grow_with_the_square_of_the_height() -> None:
    pair = rig(error_rad=20.0 * ARCSEC)
    near, far = (
        measure_height(
            *(picture(e, h, noise=2.0, seed=k) for k, e in enumerate((pair.first, pair.second))),
            pair,
            DOWN,
        )
        for h in (20.0, 40.0)
    )
    assert far.sigma_mounting_m / near.sigma_mounting_m == pytest.approx(4.0, rel=0.05)


def test_pictures_of_other_ground_have_no_height() -> None:
    pair = rig()
    first = picture(pair.first, 30.0)
    y, x = np.mgrid[:320, :320] * 0.04
    other = brightness(x, y, seed=9).astype(np.float32)
    with pytest.raises(NoSolutionError, match=r"one ground|correlates nearly"):
        measure_height(first, other, pair, DOWN)


def test_ground_that_is_too_far_for_the_base_has_no_height() -> None:
    pair = rig(base_m=0.001)
    seen = [picture(e, 90.0, noise=9.0, seed=k) for k, e in enumerate((pair.first, pair.second))]
    with pytest.raises(NoSolutionError, match="too far off for a base"):
        measure_height(seen[0], seen[1], pair, DOWN)


def test_a_mounting_turned_across_the_base_is_said() -> None:
    pair, true = rig(), rig(turn=Rotation.from_rotvec([0.005, 0.0, 0.0]))
    seen = [picture(eye, 30.0) for eye in (true.first, true.second)]
    with pytest.raises(NoSolutionError, match="the mounting is not as"):
        measure_height(seen[0], seen[1], pair, DOWN)


def test_the_ground_below_out_of_the_picture_is_said() -> None:
    pair = rig()
    seen = [picture(eye, 30.0) for eye in (pair.first, pair.second)]
    with pytest.raises(NoSolutionError, match="below lies outside the picture"):
        measure_height(seen[0], seen[1], pair, np.array([0.0, 0.6, 0.8]))


def test_the_change_of_pixels_with_places_is_that_of_differences() -> None:
    eye = rig(turn=Rotation.from_euler("xyz", [5.0, -8.0, 30.0], degrees=True)).second
    away = np.array([[1.0, 2.0, 30.0], [-4.0, 3.0, 25.0]])
    _, by_vector = eye.linearise_projection(away)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-5
        slope = (eye.project(away + step) - eye.project(away - step)) / 2e-5
        np.testing.assert_allclose(by_vector[:, :, axis], slope, rtol=1e-6, atol=1e-6)
