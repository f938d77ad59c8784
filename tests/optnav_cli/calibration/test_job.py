"""`optnav calibrate`: pictures taken with one lens and told another, and folders that cannot."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.epochs import utc_from_tdb_s
from catalog.geometry.rotations import ARCSEC
from optnav_cli import main
from optnav_cli.camera.camera_file import load_camera
from optnav_cli.estimation.models.points import Pose
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings
from tests.optnav_cli.navigate.test_job import catalog_path  # noqa: F401, a fixture

TDB_S = 8e8
STEP_S, SPEED = 4.0, 8.4e-4  # between frames; rad/s of the orbit
SHIFT_PX, TURN = (3.0, -2.0), Rotation.from_rotvec(np.array([60.0, -40.0, 80.0]) * ARCSEC)
NUMBERS = {("focal", ""), ("centre", "x"), ("centre", "y"), ("mounting", "z")}


@pytest.fixture(scope="module")
def route(rough_world, tmp_path_factory):
    """Pictures over the rough world whose camera is told wrong, and so is its mounting."""
    place = tmp_path_factory.mktemp("route") / "pictures"
    place.mkdir()
    told = rough_world.camera
    true = replace(told.with_lens(1.002, SHIFT_PX, 0.0), name="cam")
    world = replace(rough_world, camera=true)
    vars(world).update({k: v for k, v in vars(rough_world).items() if k != "camera"})
    frames = []
    rng = np.random.default_rng(1)
    for number in range(6):
        height = 90e3 if number < 3 else 105e3
        after = STEP_S * (number % 3 - 1)
        lat = np.radians(-43.0) + SPEED * after
        stated = world.pose(height, roll=1.1 * number, lat=lat)
        pose = Pose(stated.position_m, TURN * stated.camera_from_body)
        sun = world.sun(30.0, 200.0)
        name = f"{number}.png"
        cv2.imwrite(str(place / name), world.picture(pose, sun, noise_seed=number).astype(np.uint8))
        tdb_s = TDB_S + after + 1000.0 * (number // 3)
        sigma = 10.0 * ARCSEC
        frames.append(
            Frame(
                name,
                utc_from_tdb_s(tdb_s, 3),
                "cam",
                tdb_s,
                Rotation.from_rotvec(rng.normal(0.0, sigma, 3)) * stated.camera_from_body,
                sigma,
                stated.position_m + rng.normal(0.0, 10.0, 3),
                10.0,
                sun,
            )
        )
    write_folder(place, RunSettings("moon", "camera_from_body"), [told], frames)
    return place


def calibrated(*args):
    return main.run(["-q", "calibrate", *map(str, args)])


@pytest.fixture(scope="module")
def calibration(route, catalog_path, tmp_path_factory):  # noqa: F811
    output = tmp_path_factory.mktemp("calibration") / "out"
    words = (route, "--catalog", catalog_path, "--solve", "focal,centre,mounting,clock")
    assert calibrated(*words, "--workers", 1, "-o", output) == 0
    return output


def test_the_lens_that_took_the_pictures_is_found(calibration):
    camera = load_camera(calibration / "cameras" / "cam.toml")
    document = json.loads((calibration / "calibration.json").read_text())
    rows = {(row["name"], row["axis"]): row for row in document["numbers"]}
    assert abs(camera.focal_length_px - 1002.0) < 4.0 * rows["focal", ""]["sigma"]
    assert rows["focal", ""]["sigma"] < 0.5
    for axis, true in zip("xy", 255.5 + np.array(SHIFT_PX), strict=True):
        row = rows["centre", axis]
        assert abs(row["value"] - true) < 4.0 * row["sigma"]
    for axis, true in zip("xyz", TURN.as_rotvec() / ARCSEC, strict=True):
        row = rows["mounting", axis]
        assert abs(row["value"] - true) < 4.0 * row["sigma"]
    np.testing.assert_allclose(
        camera.boresight_arcsec, [rows["mounting", a]["value"] for a in "xyz"]
    )
    assert all(row["observed"] for key, row in rows.items() if key in NUMBERS)
    residuals = document["residual_rms_px"]
    assert residuals["before"] > 3.0 * residuals["after"]
    assert residuals["after"] == pytest.approx(document["sigma_px"], rel=0.1)
    correlations = np.array(document["correlations"])
    assert correlations.shape == (7, 7)
    np.testing.assert_allclose(np.diag(correlations), 1.0)


def test_residuals_are_written_from_before_and_after(calibration):
    with (calibration / "residuals.csv").open() as file:
        rows = list(csv.DictReader(file))
    kept = [row for row in rows if float(row["weight"]) > 0.0]
    assert len(kept) > 30
    before, after = (
        np.array([[float(row[f"{name}_{axis}_px"]) for axis in "xy"] for row in kept])
        for name in ("before", "after")
    )
    assert np.abs(before).mean() > 3.0 * np.abs(after).mean()
    assert (calibration / "manifest.json").exists()


def test_a_wrong_lens_that_is_not_solved_for_is_told_by_the_poses(
    route,
    catalog_path,  # noqa: F811
    calibration,
    tmp_path,
    capsys,
):
    """The clock alone: pictures fit to a tenth of a pixel, from poses that frames.csv refutes."""
    right = json.loads((calibration / "calibration.json").read_text())
    assert right["off_statements_sigmas"] < 1.2
    assert not any("sigmas (rms)" in note for note in right["notes"])
    words = (route, "--catalog", catalog_path, "--solve", "clock", "--workers", 1)
    assert calibrated(*words, "-o", tmp_path / "out") == 0
    document = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert document["residual_rms_px"]["after"] < 0.1
    assert document["off_statements_sigmas"] > 5.0
    assert "focal, centre, distortion, mounting may be wrong" in document["notes"][0]


def test_a_calibration_has_a_page(calibration, tmp_path):
    assert main.run(["-q", "report", str(calibration), "-o", str(tmp_path / "page.html")]) == 0
    page = (tmp_path / "page.html").read_text()
    assert "principal point" in page
    assert "Residuals" in page


def without(folder, place, **changes):
    """A copy of a folder whose frames have something else."""
    read = read_folder(folder)
    frames = [replace(frame, **changes) for frame in read.frames]
    write_folder(place, read.settings, read.cameras.values(), frames)
    return place


def test_frames_without_positions_or_attitudes_are_refused(
    route,
    catalog_path,  # noqa: F811
    tmp_path,
    capsys,
):
    nowhere = without(route, tmp_path / "nowhere", position_m=None, position_sigma_m=None)
    assert calibrated(nowhere, "--catalog", catalog_path, "-o", tmp_path / "out") == 3
    assert "against known positions" in capsys.readouterr().err
    unturned = without(route, tmp_path / "unturned", camera_from_body=None)
    assert calibrated(unturned, "--catalog", catalog_path, "-o", tmp_path / "out") == 3
    told = capsys.readouterr().err
    assert "0 of 6 rows have an attitude with their position" in told
    assert "the camera against known attitudes" in told
    loose = without(route, tmp_path / "loose", attitude_sigma_rad=None)
    assert calibrated(loose, "--catalog", catalog_path, "-o", tmp_path / "out") == 3
    assert "0 rows have a sigma of their attitude" in capsys.readouterr().err


def test_a_row_that_cannot_be_read_is_named_where_too_few_are_left(
    route,
    catalog_path,  # noqa: F811
    tmp_path,
    capsys,
):
    folder = without(route, tmp_path / "negative")
    text = (folder / "frames.csv").read_text().splitlines()
    column = text[0].split(",").index("position_sigma_m")
    rows = [row.split(",") for row in text[1:]]
    changed = [",".join([*row[:column], "-5", *row[column + 1 :]]) for row in rows]
    (folder / "frames.csv").write_text("\n".join([text[0], *changed]) + "\n")
    assert calibrated(folder, "--catalog", catalog_path, "-o", tmp_path / "out") == 3
    told = capsys.readouterr().err
    assert "0 of 6 rows" in told
    assert "0.png: position_sigma_m" in told


def test_one_frame_with_pictures_is_not_enough(
    route,
    catalog_path,  # noqa: F811
    tmp_path,
    capsys,
):
    lonely = without(route, tmp_path / "lonely")
    (lonely / "0.png").write_bytes((route / "0.png").read_bytes())
    words = (lonely, "--catalog", catalog_path, "--workers", 1, "-o", tmp_path / "out")
    assert calibrated(*words) == 4
    assert "wants 2 frames and 12 points" in capsys.readouterr().err


def test_a_word_that_cannot_be_solved_for_is_refused(route, tmp_path, capsys):
    words = (route, "--catalog", "x.gpkg", "--solve", "focal,shape", "-o", tmp_path / "out")
    assert calibrated(*words) == 2
    assert "'shape' is none of focal, centre" in capsys.readouterr().err
