"""The pose tables of ISIS cubes."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import compute_sun_direction_inertial
from catalog.bodies.rotation import body_from_inertial
from catalog.errors import DataError
from catalog.geometry.latlon import latlon_from_xyz
from optnav_cli.archives.isis_cube import read_cube_label, read_cube_pose
from tests.optnav_cli.archives.made_cubes import Cube, write_cube

CUBE = "apollo15/AS15-M-0297_crop.cub"


def test_the_label_is_read_with_lists_units_and_broken_words(
    shared_data: Callable[[str], Path],
) -> None:
    label = read_cube_label(shared_data(CUBE))
    assert label["IsisCube"]["Code"]["SpacecraftAltitude"]["value"] == 115978.0
    assert len(label["Table_BodyRotation"]["ConstantRotation"]) == 9
    # "...apollo15_metric_v2.0001.-" and "ti" stand on two lines
    assert label["IsisCube"]["Kernels"]["Instrument"].endswith("apollo15_metric_v2.0001.ti")


def test_the_spacecraft_is_where_the_mission_says(shared_data: Callable[[str], Path]) -> None:
    """The label's altitude, 115 978 m, is a radar one above relief of -2 to +6 km."""
    pose = read_cube_pose(shared_data(CUBE))
    lat, lon, radius = latlon_from_xyz(pose.position_m)
    assert radius - 1737400.0 == pytest.approx(115978.0, abs=6000.0)
    # in the middle of the farside crop: 8-30 S, 130-156 E
    assert np.degrees(lat) == pytest.approx(-20.8, abs=0.1)
    assert np.degrees(lon) == pytest.approx(144.8, abs=0.1)
    assert pose.utc == "1971-07-31T01:25:02.243"


def test_the_camera_looks_down_along_its_minus_z(shared_data: Callable[[str], Path]) -> None:
    """The label calls the observation "Nadir"; the first-guess tilt is a third of a degree."""
    pose = read_cube_pose(shared_data(CUBE))
    boresight_body = pose.isis_from_body.inv().apply([0.0, 0.0, -1.0])
    down = -pose.position_m / np.linalg.norm(pose.position_m)
    assert np.degrees(np.arccos(boresight_body @ down)) < 0.5


def test_the_body_rotation_is_the_lunar_one(shared_data: Callable[[str], Path]) -> None:
    """ISIS used DE403 and the Mean Earth frame; the series may differ by 155 m at the surface."""
    pose = read_cube_pose(shared_data(CUBE))
    ours = body_from_inertial(load_body("moon"), pose.tdb_s)
    difference = ours @ pose.body_from_inertial.as_matrix().T
    angle = np.linalg.norm(difference - difference.T) / 8**0.5
    assert angle * 1737400.0 < 155.0


def test_the_sun_is_the_one_of_our_theory(shared_data: Callable[[str], Path]) -> None:
    """Same inertial direction to 0.1 arcsec: the table holds the apparent Sun."""
    pose = read_cube_pose(shared_data(CUBE))
    theirs = pose.body_from_inertial.inv().apply(pose.sun_body)
    ours = compute_sun_direction_inertial(load_body("moon"), pose.tdb_s)
    assert np.degrees(np.linalg.norm(np.cross(ours, theirs))) * 3600.0 < 0.1
    up = pose.position_m / np.linalg.norm(pose.position_m)
    assert np.degrees(np.arcsin(pose.sun_body @ up)) == pytest.approx(22.2, abs=0.1)


def test_a_cube_without_pose_says_what_to_do(shared_data: Callable[[str], Path]) -> None:
    with pytest.raises(DataError, match="no table BodyRotation; run spiceinit"):
        read_cube_pose(shared_data("moon/gld100_lola_reduced.cub"))


def test_a_truncated_cube_is_refused(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    raw = shared_data(CUBE).read_bytes()
    path = tmp_path / "cut.cub"
    for size in (1117600, 900):
        path.write_bytes(raw[:size])
        with pytest.raises(DataError, match=r"cut\.cub"):
            read_cube_pose(path)


def test_what_is_no_cube_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.cub"
    path.write_bytes(b"\x00" * 70000)
    with pytest.raises(DataError, match="not an ISIS cube"):
        read_cube_pose(path)
    with pytest.raises(DataError, match="no such file"):
        read_cube_pose(tmp_path / "none.cub")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (rb"(Name += Instrument)Position", rb"\1Xosition", "no table InstrumentPosition"),
        (rb"J2000X\n", rb"J2000W\n", "has no field 'J2000X'"),
        (rb"(Records += )1\n", rb"\g<1>2\n", "has 2 records; wanted 1"),
        (rb"= Double", rb"= Text  ", "a field that is no number"),
        (rb"(Bytes += )64", rb"\g<1>65", "is cut short"),
        (rb"(ConstantRotation += \()0", rb"\1x", "ConstantRotation that is not 9"),
        (rb"(ConstantRotation += \()0", rb"\g<1>7", "ConstantRotation that is no rotation"),
    ],
)
def test_a_damaged_label_is_refused(
    shared_data: Callable[[str], Path], tmp_path: Path, old: bytes, new: bytes, message: str
) -> None:
    damaged, times = re.subn(old, new, shared_data(CUBE).read_bytes())
    assert times
    (tmp_path / "a.cub").write_bytes(damaged)
    with pytest.raises(DataError, match=rf"a\.cub: .*{message}.*; run spiceinit"):
        read_cube_pose(tmp_path / "a.cub")


def test_a_table_without_fields_is_refused(tmp_path: Path) -> None:
    cube = write_cube(tmp_path / "a.cub", Cube())
    data = cube.read_bytes()
    at = data.index(b"Name = InstrumentPosition")
    cube.write_bytes(data[:at] + data[at:].replace(b"Group = Field", b"Group = Other", 7))
    with pytest.raises(DataError, match=r"its table InstrumentPosition has a field that is no"):
        read_cube_pose(cube)
