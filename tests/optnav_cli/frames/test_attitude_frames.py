"""What quaternions of a folder mean, with the body turned by theory and by SPICE kernels."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris, SpiceEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.geometry.rotations import quaternion_from_rotation
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.folder import Folder, read_folder, write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.frames.tables import FRAMES

CAMERA = Camera("wide", "pinhole", 640, 480, 500.0, (319.5, 239.5))
UTCS = ("1998-03-01T02:03:04.5Z", "2004-11-21T22:10:00Z", "2009-07-20T20:17:40Z")
CAMERA_FROM_BODY = Rotation.from_rotvec([0.3, -1.2, 2.0])


def folder_of(tmp_path: Path, quaternions: dict[str, np.ndarray], sigma: str = "10") -> Path:
    """A folder with an attitude against the stars for each time; Sun and position are left out."""
    write_folder(tmp_path, RunSettings("moon", "camera_from_inertial"), [CAMERA], [])
    lines = [",".join(FRAMES.names)]
    for number, (utc, quaternion) in enumerate(quaternions.items()):
        texts = ",".join(f"{value:.15f}" for value in quaternion)
        lines.append(f"{number}.png,{utc},wide,{texts},{sigma}" + "," * (len(FRAMES.names) - 8))
    (tmp_path / "frames.csv").write_text("\n".join(lines) + "\n")
    return tmp_path


def by_toolkit(utc: str) -> Rotation:
    """inertial_from_body as the toolkit itself gives it."""
    import spiceypy

    return Rotation.from_matrix(spiceypy.pxform("MOON_ME", "J2000", utc_to_tdb_s(utc)))


def star_folder(tmp_path: Path, kernels: list[Path]) -> Path:
    """One camera attitude relative to the body, written against the stars by the toolkit."""
    SpiceEphemeris(load_body("moon"), kernels).body_from_inertial(0.0)  # loads the kernels
    given = {
        utc: quaternion_from_rotation(CAMERA_FROM_BODY * by_toolkit(utc).inv()) for utc in UTCS
    }
    return folder_of(tmp_path, given)


def attitudes(folder: Folder) -> list[Rotation]:
    found = [frame.camera_from_body for frame in folder.frames]
    assert [frame.problem for frame in folder.frames] == [None] * len(found)
    return [rotation for rotation in found if rotation is not None]


def test_with_kernels_the_toolkits_attitude_comes_back(tmp_path: Path, kernels: list[Path]) -> None:
    folder = read_folder(star_folder(tmp_path, kernels), kernels)
    for rotation in attitudes(folder):
        assert (rotation * CAMERA_FROM_BODY.inv()).magnitude() < 1e-13
    assert "SPICE" in folder.motion.name


def test_by_theory_it_comes_back_to_five_metres_of_the_surface(
    tmp_path: Path, kernels: list[Path]
) -> None:
    folder = read_folder(star_folder(tmp_path, kernels))
    for rotation in attitudes(folder):
        apart = (rotation * CAMERA_FROM_BODY.inv()).magnitude() * 1737400.0
        assert 0.01 < apart < 5.0
    assert "analytic" in folder.motion.name


def test_a_star_is_where_the_quaternion_puts_it(tmp_path: Path, kernels: list[Path]) -> None:
    """The one convention, spelled out: qw first, and camera = rotation times inertial.

    A star along the rotation's own third row stands on the boresight; the body's pole, found by
    the toolkit, projects to the same pixel by either way.
    """
    folder = read_folder(star_folder(tmp_path, kernels), kernels)
    for frame, utc in zip(folder.frames, UTCS, strict=True):
        assert frame.camera_from_body is not None
        written = CAMERA_FROM_BODY * by_toolkit(utc).inv()
        pole = by_toolkit(utc).apply([0.0, 0.0, 1.0])
        np.testing.assert_allclose(
            frame.camera_from_body.apply([0.0, 0.0, 1.0]), written.apply(pole), atol=1e-13
        )
        inverse = written.inv() * by_toolkit(utc)
        assert (inverse * CAMERA_FROM_BODY.inv()).magnitude() > 0.5


def test_the_body_turns_under_a_fixed_camera_by_half_a_degree_an_hour(tmp_path: Path) -> None:
    """A sign slip in time or rotation would show: 13.18 deg a day, eastward."""
    written = dict.fromkeys(
        ("2023-08-17T05:00:00Z", "2023-08-17T06:00:00Z"), np.array([1.0, 0.0, 0.0, 0.0])
    )
    first, later = attitudes(read_folder(folder_of(tmp_path, written)))
    # the same inertial direction moves west over the turning body
    boresight = [rotation.inv().apply([1.0, 0.0, 0.0]) for rotation in (first, later)]
    turned = [np.arctan2(direction[1], direction[0]) for direction in boresight]
    assert np.degrees(turned[1] - turned[0]) == pytest.approx(-13.18 / 24.0, rel=0.02)


def test_the_sun_comes_from_the_same_source(tmp_path: Path, kernels: list[Path]) -> None:
    path = star_folder(tmp_path, kernels)
    moon = load_body("moon")
    for named, motion in ((kernels, SpiceEphemeris(moon, kernels)), ([], AnalyticEphemeris(moon))):
        for frame in read_folder(path, named).frames:
            assert frame.tdb_s is not None
            assert frame.sun_body is not None
            np.testing.assert_array_equal(frame.sun_body, motion.sun_body(frame.tdb_s))


def test_a_frame_outside_the_kernels_is_its_own_problem(
    tmp_path: Path, kernels: list[Path]
) -> None:
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    path = folder_of(tmp_path, {UTCS[0]: identity, "2023-08-17T05:23:00Z": identity})
    good, late = read_folder(path, kernels).frames
    assert good.problem is None
    assert late.problem is not None
    assert "they cover 1997-01-01T00:00:00Z to 2010-01-01T23:59:57Z" in late.problem


def test_the_bodys_own_error_is_part_of_an_attitude_against_the_stars(tmp_path: Path) -> None:
    """Beyond the years of the fitted correction the series alone is good to 80 m: 9.5"."""
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    written = {UTCS[0]: identity, "2070-01-01T00:00:00Z": identity}
    near, far = read_folder(folder_of(tmp_path, written, sigma="0")).frames
    moon = load_body("moon")
    assert moon.rotation_correction is not None
    for frame, error_m in ((near, moon.rotation_correction.error_m), (far, 80.0)):
        assert frame.attitude_sigma_rad == pytest.approx(error_m / moon.radius_m)
        assert frame.common_sigma_rad == frame.attitude_sigma_rad
    free: Frame = read_folder(folder_of(tmp_path, written, sigma="")).frames[0]
    assert free.attitude_sigma_rad is None
