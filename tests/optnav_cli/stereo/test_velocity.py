"""Side velocities over a plane, against the motion that the pictures were made with."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.stereo.height import StereoHeight, measure_height
from optnav_cli.stereo.rig import Rig
from optnav_cli.stereo.velocity import Step, measure_velocity
from tests.optnav_cli.stereo.pairs import DOWN, picture, rig

TURN = Rotation.from_rotvec([0.002, -0.003, 0.004])  # of the ship between the pictures


def state(pair: Rig, height_m: float, **more: object) -> tuple[object, StereoHeight]:
    first, second = (picture(eye, height_m, **more) for eye in (pair.first, pair.second))  # type: ignore[arg-type]
    turn = more.get("ground_from_ship") or Rotation.identity()
    assert isinstance(turn, Rotation)
    return first, measure_height(first, second, pair, turn.inv().apply(DOWN))


def test_the_velocity_of_a_ship_that_turns_and_sinks_is_measured() -> None:
    pair, moved = rig(), np.array([1.2, -0.7, 0.5])
    before = state(pair, 30.0)
    now = state(pair, 30.0, at_m=moved, ground_from_ship=TURN)
    step = Step(2.0, TURN, 0.0, TURN.inv().apply(DOWN))
    found = measure_velocity(before, now, pair.first, step)  # type: ignore[arg-type]
    wanted = TURN.inv().apply(moved / 2.0)
    np.testing.assert_allclose(found.velocity_m_s[:2], wanted[:2], atol=2e-3)
    assert found.side_sigma_m_s < 0.01


def test_an_attitude_error_is_the_height_times_the_rate() -> None:
    pair, rate = rig(), 50.0 * ARCSEC
    before, now = state(pair, 30.0), state(pair, 30.0, at_m=np.array([0.5, 0.0, 0.0]))
    sure = measure_velocity(before, now, pair.first, Step(1.0, Rotation.identity(), 0.0, DOWN))  # type: ignore[arg-type]
    wrong = Rotation.from_rotvec([0.0, rate, 0.0])
    off = measure_velocity(before, now, pair.first, Step(1.0, wrong, rate, DOWN))  # type: ignore[arg-type]
    error = np.abs(off.velocity_m_s - sure.velocity_m_s)[0]
    assert error == pytest.approx(30.0 * rate, rel=0.05)
    added = np.sqrt(off.side_sigma_m_s**2 - sure.side_sigma_m_s**2)
    assert added == pytest.approx(30.0 * rate, rel=0.1)


def test_ground_that_is_not_found_again_gives_no_velocity() -> None:
    pair = rig()
    before, now = state(pair, 30.0), state(pair, 30.0, at_m=np.array([40.0, 0.0, 0.0]))
    step = Step(1.0, Rotation.identity(), 0.0, DOWN)
    with pytest.raises(NoSolutionError, match="is not found"):
        measure_velocity(before, now, pair.first, step)  # type: ignore[arg-type]
