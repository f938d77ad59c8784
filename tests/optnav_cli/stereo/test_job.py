"""A folder of stereo pairs to heights.csv, and what is wrong with such folders."""

from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.epochs import compute_tdb_s_after
from catalog.config import resource
from catalog.errors import ConfigError, NothingToDoError
from catalog.progress import SilentProgress
from optnav_cli.camera.camera_file import camera_toml
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import MountSettings, RunSettings, check_mounts
from optnav_cli.frames.tables import HEIGHTS
from optnav_cli.simulation.job import simulate_folder
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.stereo.job import measure_stereo_folder
from tests.optnav_cli.stereo.pairs import CAMERA, picture, rig

LEFT = MountSettings(camera="left", position_m=(0.0, 0.0, 0.0))
RIGHT = MountSettings(camera="right", position_m=(1.0, 0.0, 0.0), error_arcsec=20.0)
# the ship level over the north pole of the body, z down
SHIP_FROM_BODY = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
PLACE = np.array([0.0, 0.0, 1_737_500.0])
STEP_M = np.array([0.6, -0.4, 0.0])


def folder(
    place: Path,
    *,
    times: tuple[tuple[float, float], ...] = ((0.0, 0.0), (1.0, 1.0)),
    mounts: tuple[MountSettings, ...] = (LEFT, RIGHT),
    attitude: bool = True,
) -> Path:
    """Pairs of pictures 30 m over a plane, the second one farther on; times in s of each pair."""
    pair = rig()
    frames = []
    for number, both in enumerate(times):
        for eye, seconds in zip((pair.first, pair.second), both, strict=True):
            name = f"{number}_{eye.camera.name}.png"
            values = picture(eye, 30.0, at_m=number * STEP_M, noise=0.5, seed=number)
            place.mkdir(exist_ok=True)
            cv2.imwrite(str(place / name), np.clip(np.rint(values), 0, 255).astype(np.uint8))
            frame = Frame(name, f"2026-01-01T00:00:0{seconds:.3f}Z", eye.camera.name)
            if attitude:
                frame = replace(
                    frame,
                    tdb_s=float(compute_tdb_s_after("2026-01-01T00:00:00Z", seconds)[0]),
                    camera_from_body=SHIP_FROM_BODY,
                    attitude_sigma_rad=1e-6,
                    position_m=PLACE,
                    position_sigma_m=100.0,
                )
            frames.append(frame)
    settings = RunSettings("moon", "camera_from_body", mount=mounts)
    cameras = [CAMERA, replace(CAMERA, name="right")]
    write_folder(place, settings, cameras, frames)
    return place


def test_a_folder_of_pairs_becomes_heights_and_velocities(tmp_path: Path) -> None:
    pictures = folder(tmp_path / "pairs")
    first, second = measure_stereo_folder(pictures, tmp_path / "out", SilentProgress())
    assert first.velocity is None
    assert first.height is not None
    assert first.height.height_m == pytest.approx(30.0, abs=4.0 * first.height.sigma_m)
    assert second.velocity is not None
    np.testing.assert_allclose(second.velocity.velocity_m_s[:2], STEP_M[:2], atol=3e-3)
    rows = HEIGHTS.rows(tmp_path / "out" / "heights.csv")
    assert [row["status"] for row in rows] == ["solved", "solved"]
    assert float(rows[1]["velocity_x_m_s"]) == pytest.approx(0.6, abs=3e-3)
    assert rows[0]["velocity_x_m_s"] == ""
    assert (tmp_path / "out" / "manifest.json").exists()


def test_the_same_pairs_give_the_same_bytes(tmp_path: Path) -> None:
    pictures = folder(tmp_path / "pairs", times=((0.0, 0.0),))
    for name in ("a", "b"):
        measure_stereo_folder(pictures, tmp_path / name, SilentProgress())
    one, other = ((tmp_path / name / "heights.csv").read_bytes() for name in ("a", "b"))
    assert one == other


def test_mounts_are_read_back_as_they_were_written(tmp_path: Path) -> None:
    pictures = folder(tmp_path / "pairs", times=((0.0, 0.0),))
    assert read_folder(pictures).settings.mount == (LEFT, RIGHT)


@pytest.mark.parametrize("name", ["", "/dev/zero", "a\\b", 'a"b', "a,b", "a\0"])
def test_a_mounted_camera_has_a_name_that_a_file_can_have(name: str) -> None:
    with pytest.raises(ConfigError, match="wanted a plain word"):
        check_mounts([LEFT, MountSettings(camera=name, position_m=(1.0, 0.0, 0.0))])


def test_pictures_of_different_times_are_rows_with_a_reason(tmp_path: Path) -> None:
    pictures = folder(tmp_path / "pairs", times=((0.0, 0.0), (1.0, 1.4)))
    rows = measure_stereo_folder(pictures, tmp_path / "out", SilentProgress())
    assert [row.height is not None for row in rows] == [True, False, False]
    assert "no picture of this time: the nearest" in rows[1].reason
    assert "0.4 s away" in rows[1].reason


def test_without_attitudes_there_is_a_height_and_no_velocity(tmp_path: Path) -> None:
    pictures = folder(tmp_path / "pairs", attitude=False)
    rows = measure_stereo_folder(pictures, tmp_path / "out", SilentProgress())
    assert rows[1].height is not None
    assert rows[1].velocity is None
    assert "along the ship's z axis" in rows[1].reason
    assert "a turn looks like a motion" in rows[1].reason


def test_two_pairs_of_one_time_give_no_velocity(tmp_path: Path) -> None:
    pictures = folder(tmp_path / "pairs", times=((0.0, 0.0), (0.0, 0.0)))
    rows = measure_stereo_folder(pictures, tmp_path / "out", SilentProgress())
    assert [row.height is not None for row in rows] == [True, True]
    assert rows[1].velocity is None
    assert rows[1].reason == "no velocity: the pair before is of the same time"


@pytest.mark.parametrize(
    ("mounts", "said"),
    [
        ((LEFT, msgspec.structs.replace(RIGHT, position_m=(0.0, 0.0, 0.0))), "needs a base"),
        ((LEFT,), "1 .*sections; wanted two"),
        ((LEFT, msgspec.structs.replace(RIGHT, camera="other")), "which has no file"),
        ((LEFT, LEFT), "twice"),
        (
            (LEFT, msgspec.structs.replace(RIGHT, ship_from_camera=(1.0, 1.0, 0.0, 0.0))),
            "wanted a unit quaternion",
        ),
    ],
)
def test_mounts_that_are_no_pair_are_refused(
    tmp_path: Path, mounts: tuple[MountSettings, ...], said: str
) -> None:
    pictures = folder(tmp_path / "pairs", times=((0.0, 0.0),), mounts=mounts)
    with pytest.raises(ConfigError, match=said):
        measure_stereo_folder(pictures, tmp_path / "out", SilentProgress())


def test_a_damaged_picture_is_a_row_with_its_reason_and_nothing_solved_is_said(
    tmp_path: Path,
) -> None:
    pictures = folder(tmp_path / "pairs", times=((0.0, 0.0),))
    (pictures / "0_right.png").write_bytes(b"")
    with pytest.raises(NothingToDoError, match="empty file"):
        measure_stereo_folder(pictures, tmp_path / "out", SilentProgress())
    assert (tmp_path / "out" / "heights.csv").exists()


def test_a_drawn_pair_over_craters_is_measured_within_its_sigmas(tmp_path: Path) -> None:
    scenario = load_scenario(resource("configs/scenarios/stereo_100m.toml"))
    small = replace(CAMERA, name="small", focal_length_px=800.0)
    (tmp_path / "small.toml").write_text(camera_toml(small), encoding="utf-8")
    names = {"camera": type(scenario.camera)(str(tmp_path / "small.toml"))}
    few = msgspec.structs.replace(scenario.shortened(1), **names)
    simulate_folder(few, tmp_path / "pairs", SilentProgress())
    rows = measure_stereo_folder(tmp_path / "pairs", tmp_path / "out", SilentProgress())
    height = rows[0].height
    assert height is not None
    # straight below stands the ground that the scenario puts 100 m under the ship
    assert abs(height.height_m - 100.0) < 3.0 * height.whole_sigma_m
    velocity = rows[1].velocity
    assert velocity is not None
    # ship frame: x to the right, y backward
    assert abs(velocity.velocity_m_s[0] - 1.0) < 4.0 * velocity.side_sigma_m_s
    assert abs(velocity.velocity_m_s[1] + 2.0) < 4.0 * velocity.side_sigma_m_s


def test_a_camera_mounted_below_the_ground_is_refused(tmp_path: Path) -> None:
    scenario = load_scenario(resource("configs/scenarios/stereo_100m.toml"))
    low = msgspec.structs.replace(scenario.mount[0], position_m=(0.0, 0.0, 150.0))
    scenario = msgspec.structs.replace(scenario, mount=(low, scenario.mount[1]))
    with pytest.raises(ConfigError, match=r"comes to -.* over the ground"):
        simulate_folder(scenario, tmp_path / "pictures", SilentProgress())


def ranged(place: Path, ranges: tuple[float | None, ...], down_m: float = 0.0) -> Path:
    """One camera's pictures 30 m over a plane and an altimeter's ranges, s apart."""
    eye, frames = rig().first, []
    place.mkdir()
    for number, measured in enumerate(ranges):
        name = f"{number}.png"
        at = number * (STEP_M + [0.0, 0.0, down_m])
        values = picture(eye, 30.0, at_m=at, noise=0.5, seed=number)
        cv2.imwrite(str(place / name), np.clip(np.rint(values), 0, 255).astype(np.uint8))
        frame = Frame(
            name,
            f"2026-01-01T00:00:0{number}.000Z",
            "left",
            tdb_s=float(compute_tdb_s_after("2026-01-01T00:00:00Z", float(number))[0]),
            camera_from_body=SHIP_FROM_BODY,
            attitude_sigma_rad=1e-6,
            position_m=PLACE,
            position_sigma_m=100.0,
            range_m=measured,
            range_sigma_m=None if measured is None else 0.05,
        )
        frames.append(frame)
    write_folder(place, RunSettings("moon", "camera_from_body"), [CAMERA], frames)
    return place


def test_one_camera_and_an_altimeter_give_the_side_velocity(tmp_path: Path) -> None:
    pictures = ranged(tmp_path / "pictures", (30.0, 29.5), down_m=0.5)
    first, second = measure_stereo_folder(pictures, tmp_path / "out", SilentProgress())
    assert first.height is not None
    assert first.velocity is None
    assert second.velocity is not None
    off = second.velocity.velocity_m_s - (STEP_M + [0.0, 0.0, 0.5])
    assert np.abs(off[:2]).max() < 0.01  # a hundredth of the way
    assert np.abs(off[:2]).max() < 4.0 * second.velocity.side_sigma_m_s
    rows = HEIGHTS.rows(tmp_path / "out" / "heights.csv")
    assert [row["file_left"] for row in rows] == ["0.png", "1.png"]
    assert rows[0]["file_right"] == ""


def test_ranges_that_contradict_the_pictures_are_refused_with_both(tmp_path: Path) -> None:
    pictures = ranged(tmp_path / "pictures", (30.0, 22.0))
    _, second = measure_stereo_folder(pictures, tmp_path / "out", SilentProgress())
    assert second.height is None
    assert "ranges of 30.0 and 22.0 m say that the ship sank by 8.0 m" in second.reason
    assert "sigma" in second.reason


def test_a_picture_without_a_range_has_a_row_with_the_reason(tmp_path: Path) -> None:
    pictures = ranged(tmp_path / "pictures", (30.0, None))
    _, second = measure_stereo_folder(pictures, tmp_path / "out", SilentProgress())
    assert second.height is None
    assert second.reason == "no range_m: one camera needs an altimeter"
