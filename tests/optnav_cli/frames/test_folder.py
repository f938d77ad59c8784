"""Picture folders: run.toml, cameras, frames.csv."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.rotation import body_from_inertial
from catalog.config import resource
from catalog.errors import ConfigError, DataError, OptnavError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings

HEADER = (
    "file,utc,camera,qw,qx,qy,qz,attitude_sigma_arcsec,"
    "x_m,y_m,z_m,position_sigma_m,sun_x,sun_y,sun_z"
)
UTC = "2023-08-17T05:23:00Z"
ROW = f"a.png,{UTC},wide,1,0,0,0,10,1937400,0,0,3000,0,0.6,0.8"
CAMERA = Camera("wide", "pinhole", 640, 480, 500.0, (319.5, 239.5))


def folder_with(tmp_path: Path, *rows: str, header: str = HEADER, end: str = "\n") -> Path:
    write_folder(tmp_path, RunSettings("moon", "camera_from_body"), [CAMERA], [])
    text = end.join([header, *rows]) + end
    (tmp_path / "frames.csv").write_bytes(text.encode())
    return tmp_path


def only_frame(folder: Path) -> Frame:
    (frame,) = read_folder(folder).frames
    return frame


def test_a_folder_carries_the_body_file_that_its_run_toml_names(tmp_path: Path) -> None:
    text = (
        resource("configs/bodies/moon.toml").read_text().replace('name = "moon"', 'name = "ours"')
    )
    (tmp_path / "ours.toml").write_text(text)
    settings = RunSettings(str(tmp_path / "ours.toml"), "camera_from_body")
    frame = Frame("a.png", UTC, "wide", tdb_s=utc_to_tdb_s(UTC))
    write_folder(tmp_path / "a", settings, [CAMERA], [frame])
    folder = read_folder(tmp_path / "a")
    assert (folder.body.name, folder.settings.body) == ("ours", str(tmp_path / "a" / "ours.toml"))
    (tmp_path / "a" / "run.toml").write_text('body = "none.toml"\nattitude = "camera_from_body"\n')
    with pytest.raises(ConfigError, match=r"run.toml: .*none.toml"):
        read_folder(tmp_path / "a")


def test_a_row_is_read_into_radians_and_metres(tmp_path: Path) -> None:
    folder = read_folder(folder_with(tmp_path, ROW))
    (frame,) = folder.frames
    assert frame.problem is None
    assert folder.cameras == {"wide": CAMERA}
    assert folder.body.name == "moon"
    assert folder.picture_path(frame) == tmp_path / "a.png"
    assert frame.attitude_sigma_rad == pytest.approx(np.radians(10.0 / 3600.0))
    assert frame.position_m is not None
    assert frame.camera_from_body is not None
    assert frame.sun_body is not None
    np.testing.assert_array_equal(frame.position_m, [1937400.0, 0.0, 0.0])
    assert frame.position_sigma_m == 3000.0
    np.testing.assert_allclose(frame.sun_body, [0.0, 0.6, 0.8])
    np.testing.assert_allclose(frame.camera_from_body.as_matrix(), np.eye(3))
    assert frame.tdb_s == utc_to_tdb_s(UTC)


def test_empty_cells_mean_free_unknown_or_from_the_time(tmp_path: Path) -> None:
    frame = only_frame(folder_with(tmp_path, f"a.png,{UTC},wide,,,,,,,,,,,,"))
    assert frame.problem is None
    assert frame.camera_from_body is None
    assert frame.attitude_sigma_rad is None
    assert frame.position_m is None
    assert frame.position_sigma_m is None
    expected = AnalyticEphemeris(load_body("moon")).sun_body(utc_to_tdb_s(UTC))
    assert frame.sun_body is not None
    np.testing.assert_array_equal(frame.sun_body, expected)


def test_columns_that_may_be_empty_may_be_left_out(tmp_path: Path) -> None:
    frame = only_frame(folder_with(tmp_path, f"a.png,{UTC},wide", header="file,utc,camera"))
    assert frame.problem is None
    assert frame.camera_from_body is None
    header = "utc,file,camera,qw,qx,qy,qz"
    frame = only_frame(folder_with(tmp_path, f"{UTC},a.png,wide,1,0,0,0", header=header))
    assert (frame.problem, frame.position_m, frame.attitude_sigma_rad) == (None, None, None)
    assert frame.camera_from_body is not None
    assert frame.sun_body is not None


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("file,utc", "no column 'camera'"),
        ("file,utc,camera,qw,qx,qy", "no column 'qz'"),
        ("file,utc,camera,qw,qx,qy,qz,attitude_sigma_arcsecs", "is 'attitude_sigma_arcsecs' meant"),
        ("file,utc,camera,postion_sigma_m", "'position_sigma_m'; is 'postion_sigma_m' meant"),
    ],
)
def test_a_missing_or_misspelt_column_is_named(header: str, words: str, tmp_path: Path) -> None:
    row = ",".join(["a.png", UTC, *["1"] * (header.count(",") - 1)])
    with pytest.raises(DataError, match=words):
        read_folder(folder_with(tmp_path, row, header=header))


def test_a_sigma_of_zero_is_not_an_empty_one(tmp_path: Path) -> None:
    frame = only_frame(folder_with(tmp_path, ROW.replace(",10,", ",0,")))
    assert frame.attitude_sigma_rad == 0.0


def test_spreadsheet_habits_are_forgiven(tmp_path: Path) -> None:
    header = "\ufeff" + HEADER.replace(",", " , ") + ",note"
    rows = [ROW.replace(",", " , ") + ",fine", "", ROW.replace("a.png", '"b, c.png"') + ",,,"]
    frames = read_folder(folder_with(tmp_path, *rows, header=header, end="\r\n")).frames
    assert [frame.file for frame in frames] == ["a.png", "b, c.png"]
    assert [frame.problem for frame in frames] == [None, None]


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (",1,0,0,0,", ",0,0,0,0,", "quaternion .* is zero"),
        (",1,0,0,0,", ",2,0,0,0,", "length of 2; wanted 1"),
        (",1,0,0,0,", ",nan,0,0,0,", "qw is nan; wanted a finite number"),
        (",1,0,0,0,", ",1,0,0,,", "qz is empty"),
        (",1,0,0,0,", ",one,0,0,0,", "qw is 'one'"),
        (",1937400,0,0,", ",1937400,NaN,0,", "y_m is NaN"),
        (",1937400,0,0,", ",1937.4,0,0,", "inside the body, 1.9 km"),
        (",1937400,0,0,", ",inf,0,0,", "x_m is inf"),
        (",3000,", ",,", "position_sigma_m is empty"),
        (",3000,", ",-1,", r"position_sigma_m is -1; wanted 0 to 1e\+12"),
        (",3000,", ",1e200,", "position_sigma_m is 1e200"),
        (",1937400,0,0,", ",1937400,-1e200,0,", r"farther off than 1e\+12 m"),
        (",1,0,0,0,", ",1e200,1e200,0,0,", "length of 1.41421e.200; wanted 1"),
        (",10,", ",1e-300,", "attitude_sigma_arcsec is 1e-300; wanted 0, or 1e-06 to 648000"),
        (",10,", ",1e200,", "attitude_sigma_arcsec is 1e200"),
        ("a.png", "a" * 256, "is no name of a file; wanted 1 to 255 bytes"),
        ("a.png", "a\0.png", "is no name of a file"),
        ("a.png", ".", "is no name of a file"),
        (",10,", ",-10,", "attitude_sigma_arcsec is -10"),
        ("05:23:00Z", "05:23:00+03:00", "not UTC"),
        ("2023-08-17T05:23:00Z", "17.08.2023", "not understood"),
        ("2023-08-17T05:23:00Z", "", "not understood"),
        (",wide,", ",wid,", "camera 'wid' has no file in cameras/; did you mean 'wide'"),
        (",0,0.6,0.8", ",0,0,0", "Sun.* is zero"),
        (",0,0.6,0.8", ",0,0.6,", "sun_z is empty"),
        (",0,0.6,0.8", ",0,0.6", "the row has 14 values; wanted 15"),
        ("a.png", "../a.png", "outside the folder"),
        ("a.png", "/etc/a.png", "outside the folder"),
    ],
)
def test_a_wrong_row_is_its_frames_problem_and_the_others_go_on(
    old: str, new: str, problem: str, tmp_path: Path
) -> None:
    assert old in ROW
    good = ROW.replace("a.png", "good.png")
    frames = read_folder(folder_with(tmp_path, ROW.replace(old, new, 1), good)).frames
    assert len(frames) == 2
    assert frames[1].problem is None
    with pytest.raises(DataError, match=problem):
        raise DataError(frames[0].problem)


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        (HEADER.replace(",qz", ""), [ROW], "no column 'qz'"),
        (HEADER.replace("sun_x", "sunx"), [ROW], "no column 'sun_x'; is 'sunx' meant"),
        (HEADER + ",qw", [ROW + ",1"], "'qw' twice"),
        (HEADER.replace(",", ";"), [ROW], "set apart by commas"),
        (HEADER, [], "no rows"),
        ("", [], "is empty"),
        (HEADER, [ROW, ROW], "'a.png' stands in rows 1 and 2"),
        (HEADER, [ROW.replace("a.png", "")], "row 1 names no picture"),
    ],
)
def test_a_wrong_frames_file_is_refused(
    header: str, rows: list[str], message: str, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=message) as caught:
        read_folder(folder_with(tmp_path, *rows, header=header))
    assert "frames.csv" in str(caught.value)


def test_a_binary_frames_file_is_refused(tmp_path: Path) -> None:
    folder_with(tmp_path, ROW)
    (tmp_path / "frames.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(DataError, match="not UTF-8"):
        read_folder(tmp_path)


@pytest.mark.parametrize("name", ["run.toml", "frames.csv", "cameras/wide.toml"])
def test_a_missing_part_of_a_folder_is_named(name: str, tmp_path: Path) -> None:
    folder_with(tmp_path, ROW)
    (tmp_path / name).unlink()
    with pytest.raises(OptnavError, match=name.split("/")[0]):
        read_folder(tmp_path)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        read_folder(tmp_path / "none")


def test_an_unknown_body_or_attitude_is_refused(tmp_path: Path) -> None:
    folder_with(tmp_path, ROW)
    run = tmp_path / "run.toml"
    run.write_text('body = "mon"\nattitude = "camera_from_body"\n')
    with pytest.raises(ConfigError, match=r"run\.toml: no body 'mon'; did you mean 'moon'"):
        read_folder(tmp_path)
    run.write_text('body = "moon"\nattitude = "body_from_camera"\n')
    with pytest.raises(ConfigError, match="attitude"):
        read_folder(tmp_path)


def test_a_camera_file_must_bear_its_own_name(tmp_path: Path) -> None:
    folder_with(tmp_path, ROW)
    (tmp_path / "cameras/wide.toml").rename(tmp_path / "cameras/narrow.toml")
    with pytest.raises(ConfigError, match="name is 'wide'; wanted the file's own name, 'narrow'"):
        read_folder(tmp_path)


@pytest.mark.parametrize("attitude", ["camera_from_body", "camera_from_inertial"])
def test_a_written_folder_reads_back(attitude: str, tmp_path: Path) -> None:
    rotation = Rotation.from_rotvec([0.3, -1.2, 2.0])
    sun = np.array([0.48, 0.6, 0.64])
    utc = "2009-07-20T20:17:40.125Z"
    full = Frame(
        file="sub/a.png",
        utc=utc,
        camera="wide",
        tdb_s=utc_to_tdb_s(utc),
        camera_from_body=rotation,
        attitude_sigma_rad=20.0 * ARCSEC,
        position_m=np.array([1.1e6, -1.2e6, 0.9e6]) + 0.1234,
        position_sigma_m=2500.0,
        sun_body=sun,
    )
    empty = Frame(file="b.png", utc=utc, camera="wide", tdb_s=full.tdb_s)
    settings = RunSettings("moon", attitude)  # type: ignore[arg-type]
    write_folder(tmp_path, settings, [CAMERA], [full, empty])
    folder = read_folder(tmp_path)
    assert folder.settings == settings
    assert folder.cameras == {"wide": CAMERA}
    back, back_empty = folder.frames
    assert back.problem is None
    assert (back.file, back.utc, back.camera, back.tdb_s) == ("sub/a.png", utc, "wide", full.tdb_s)
    assert back.camera_from_body is not None
    assert (back.camera_from_body * rotation.inv()).magnitude() < 1e-11
    # what the body's own rotation adds to an attitude against the stars: 0.6 m of its radius
    body_sigma = 0.0 if attitude == "camera_from_body" else 0.6 / 1737400.0
    assert back.common_sigma_rad == pytest.approx(body_sigma)
    assert back.attitude_sigma_rad == pytest.approx(np.hypot(20.0 * ARCSEC, body_sigma))
    write_folder(tmp_path / "again", settings, [CAMERA], [back])
    assert only_frame(tmp_path / "again").attitude_sigma_rad == pytest.approx(
        back.attitude_sigma_rad
    )
    np.testing.assert_allclose(np.asarray(back.position_m), full.position_m, atol=1e-4)
    np.testing.assert_allclose(np.asarray(back.sun_body), sun, atol=1e-11)
    assert back_empty.camera_from_body is None
    assert back_empty.position_m is None


def test_an_inertial_attitude_turns_with_the_body(tmp_path: Path) -> None:
    """camera_from_body = camera_from_inertial @ inertial_from_body at the frame's own time."""
    later = ROW.replace("a.png", "b.png").replace("05:23:00", "15:23:00")
    folder_with(tmp_path, ROW, later)
    (tmp_path / "run.toml").write_text('body = "moon"\nattitude = "camera_from_inertial"\n')
    moon = load_body("moon")
    for frame in read_folder(tmp_path).frames:
        assert frame.camera_from_body is not None
        assert frame.tdb_s is not None
        expected = body_from_inertial(moon, frame.tdb_s).T
        np.testing.assert_allclose(frame.camera_from_body.as_matrix(), expected, atol=1e-12)


def body_with_a_catalog_frame(folder: Path) -> Path:
    text = resource("configs/bodies/moon.toml").read_text()
    frame = "turn_deg = [0.3, -0.7, 1.1]\noffset_m = [400.0, -900.0, 250.0]\nscale = 1.004\n"
    path = folder / "moved.toml"
    path.write_text(f"{text}\n[catalog_frame]\n{frame}")
    return path


@pytest.mark.parametrize("attitude", ["camera_from_body", "camera_from_inertial"])
def test_a_catalog_in_another_frame_is_seen_where_its_stated_places_are(
    attitude: str, tmp_path: Path
) -> None:
    path = body_with_a_catalog_frame(tmp_path)
    moved, moon = load_body(str(path)), load_body("moon")
    catalog_m = np.array([1.2e6, 1.1e6, 0.4e6])
    stated_m = moved.catalog_frame.transform_to_stated(catalog_m)
    np.testing.assert_allclose(
        moved.catalog_frame.transform_to_catalog(stated_m), catalog_m, rtol=1e-12
    )
    turned = replace(CAMERA, boresight_arcsec=(400.0, -900.0, 3000.0))
    position_m, tdb_s = np.array([1.5e6, 1.3e6, 0.5e6]), utc_to_tdb_s(UTC)
    looking = Rotation.align_vectors([[0.0, 0.05, 1.0]], [catalog_m - position_m])[0]
    frame = Frame("a.png", UTC, "wide", tdb_s, looking, 1e-4, position_m, 100.0)
    # the folder of somebody who knows nothing of the catalog's frame nor of the boresight
    settings = RunSettings("moon", attitude)  # type: ignore[arg-type]
    write_folder(tmp_path / "stated", settings, [CAMERA], [frame])
    (tmp_path / "stated/moved.toml").write_text(path.read_text())
    (tmp_path / "stated/cameras/wide.toml").write_text(camera_toml(turned))
    (tmp_path / "stated/run.toml").write_text(f'body = "moved.toml"\nattitude = "{attitude}"\n')
    folder = read_folder(tmp_path / "stated")
    (back,) = folder.frames
    assert back.camera_from_body is not None
    assert back.position_m is not None
    seen = back.camera_from_body.apply(catalog_m - back.position_m) * moved.catalog_frame.scale
    expected = turned.boresight.apply(looking.apply(stated_m - position_m))
    np.testing.assert_allclose(seen, expected, atol=1e-3)
    assert back.position_sigma_m == pytest.approx(100.0 / 1.004)
    sun = AnalyticEphemeris(moon).sun_body(tdb_s)
    np.testing.assert_allclose(
        moved.catalog_frame.rotate_to_stated(np.asarray(back.sun_body)), sun, atol=1e-12
    )
    # and written again it is what was stated
    write_folder(tmp_path / "again", folder.settings, folder.cameras.values(), [back])
    first, again = (read_rows(tmp_path / name / "frames.csv") for name in ("stated", "again"))
    np.testing.assert_allclose(again, first, atol=1e-4)


def read_rows(path: Path) -> list[float]:
    cells = path.read_text().splitlines()[1].split(",")[3:12]
    return [float(cell) for cell in cells]


def test_the_same_folder_is_written_with_the_same_bytes(tmp_path: Path) -> None:
    source = read_folder(folder_with(tmp_path / "a", ROW))
    for name in ("b", "c"):
        write_folder(tmp_path / name, source.settings, source.cameras.values(), source.frames)
    for name in ("run.toml", "frames.csv", "cameras/wide.toml"):
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "c" / name).read_bytes()


def test_fifty_thousand_rows_are_looked_through_once(tmp_path: Path) -> None:
    """Comparing each name with all before it took minutes; one pass takes a second."""
    rows = [ROW.replace("a.png", f"{number}.png") for number in range(50_000)]
    folder = folder_with(tmp_path, *rows, rows[-1])
    began = time.process_time()
    with pytest.raises(DataError, match=r"'49999.png' stands in rows 50000 and 50001"):
        read_folder(folder)
    assert time.process_time() - began < 20.0


def test_a_boresight_sigma_is_part_of_every_stated_attitude_and_not_written(tmp_path: Path) -> None:
    """20" of the sensor and 48" of the mounting are 52"; an exact attitude is good to 48"."""
    camera = replace(CAMERA, boresight_sigma_arcsec=48.0)
    stated, exact, free = (
        Frame(
            file=f"{name}.png",
            utc=UTC,
            camera="wide",
            tdb_s=utc_to_tdb_s(UTC),
            camera_from_body=Rotation.identity(),
            attitude_sigma_rad=sigma,
        )
        for name, sigma in (("a", 20.0 * ARCSEC), ("b", 0.0), ("c", None))
    )
    settings = RunSettings("moon", "camera_from_body")
    write_folder(tmp_path, settings, [camera], [stated, exact, free])
    frames = read_folder(tmp_path).frames
    sigmas = [frame.attitude_sigma_rad for frame in frames]
    assert sigmas[0] == pytest.approx(52.0 * ARCSEC)
    assert sigmas[1] == pytest.approx(48.0 * ARCSEC)
    assert sigmas[2] is None
    write_folder(tmp_path / "again", settings, [camera], frames)
    again = [frame.attitude_sigma_rad for frame in read_folder(tmp_path / "again").frames]
    assert again[:2] == pytest.approx(sigmas[:2])
