"""`optnav hazard RUN`: pads carried from frame to frame, and runs that cannot be mapped."""

import json
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from catalog.store.geopackage import list_columns
from optnav_cli.fix import Fix, Method, NoFix, Solution
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.frames.tables import CARRIED_PADS, PADS
from optnav_cli.hazard import descent
from optnav_cli.hazard.hazard_map import map_hazard
from optnav_cli.main import run
from optnav_cli.output.manifest import write_manifest
from optnav_cli.output.run_folder import copy_inputs
from optnav_cli.output.tables import write_solutions
from optnav_cli.reasons import Reason, ReasonCode
from tests.optnav_cli.hazard.test_registration import (
    CAMERA,
    LOCAL,
    POSE,
    RADIUS,
    SIZE,
    ground_picture,
    move,
)

OPTIONS = ("--square-m", "120", "-o", "out")
SIGMA_M = 2.0


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path)
    return tmp_path


def make_run(place: Path, unsolved: tuple[str, ...] = ()) -> None:
    """A run of three frames at 400, 300 and 200 m, whose poses err by 2 m."""
    (place / "pictures").mkdir()
    (place / "run").mkdir()
    rng = np.random.default_rng(3)
    frames, solutions, hashes = [], [], {}
    for number, lower_m in enumerate((0.0, 100.0, 200.0)):
        true = move(POSE, -lower_m * LOCAL[:, 2], np.zeros(3))
        file, utc = f"{number}.png", f"2026-01-01T00:0{number}:00Z"
        values = 20000.0 + 100.0 * ground_picture(true).values
        cv2.imwrite(str(place / "pictures" / file), values.astype(np.uint16))
        position = true.position_m + SIGMA_M * rng.standard_normal(3)
        turn = true.camera_from_body
        frames.append(
            Frame(
                file,
                utc,
                "cam",
                0.0,
                turn,
                0.0,
                position,
                100.0,
                POSE.sun_body,
            )
        )
        fix = Fix(Method.DESCENT, position, SIGMA_M**2 * np.eye(3), turn, 0.0)
        none = NoFix(Reason(ReasonCode.FEW_POINTS, "too few matches"))
        solutions.append(Solution(file, utc, none if file in unsolved else fix))
    settings = RunSettings("moon", "camera_from_body")
    write_folder(place / "pictures", settings, [CAMERA], frames)
    copy_inputs(place / "pictures", settings, place / "run")
    folder = read_folder(place / "pictures")
    write_solutions(place / "run" / "solution.csv", solutions, folder.attitude)
    from catalog.files import hash_file

    hashes = {frame.file: hash_file(place / "pictures" / frame.file) for frame in frames}
    write_manifest(
        place / "run", "run", command="navigate", options={}, started=datetime.now(UTC),
        inputs={"pictures": "pictures", "files_sha256": hashes},
    )  # fmt: skip


def test_pads_are_carried_with_their_covariance(place: Path) -> None:
    assert run(["hazard", "run", *OPTIONS]) == 0
    rows = CARRIED_PADS.rows(place / "out" / "carried_pads.csv")
    assert {row["file"] for row in rows} > {"2.png"}
    last = [row for row in rows if row["n_seen"] == "3"]
    assert last
    for row in last:
        pixel = [row.number("x_px"), row.number("y_px")]
        camera = move(POSE, -200.0 * LOCAL[:, 2], np.zeros(3))
        ray = camera.camera_from_body.inv().apply(CAMERA.unproject(np.array(pixel))) @ LOCAL
        true = (200.0 / -ray[2] * ray)[:2]
        lat, lon = (np.radians(row.number(name)) for name in ("lat_deg", "lon_deg"))
        stated = RADIUS * np.array([(lon - np.radians(20.0)) * np.cos(lat), lat + np.radians(70.0)])
        sigmas = [row.number("sigma_east_m"), row.number("sigma_north_m")]
        assert np.abs((stated - true) / sigmas).max() < 3.0
        assert max(sigmas) < 1.1 * np.hypot(SIGMA_M, 0.1 * SIGMA_M)
        assert row["status"] == "carried"
    names = list_columns(place / "out" / "carried_pads.gpkg", "landing_pads")
    assert "sigma_east_m" in names
    assert json.loads((place / "out" / "manifest.json").read_text())["results"]["mapped"] == 3


def test_rocks_are_looked_for_on_the_ground_that_the_pose_was_refined_with(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its height over the model is found with the pose: both views have one scale."""
    heights = []

    def map_view(view, settings, prior, earlier, look):
        heights.append((view.camera_m[2], look(view.cell_m).camera_m[2]))
        return map_hazard(view, settings, prior, earlier)

    monkeypatch.setattr(descent, "map_hazard", map_view)
    assert run(["hazard", "run", *OPTIONS]) == 0
    for over_ground_m, looked_m in heights:
        assert looked_m == pytest.approx(over_ground_m, abs=1e-3)


def test_the_same_run_gives_the_same_bytes(place: Path) -> None:
    for out in ("one", "two"):
        assert run(["hazard", "run", *OPTIONS[:-1], out]) == 0
    for name in ("carried_pads.csv", "carried_pads.gpkg", "pads.csv", "hazard.mcap"):
        assert (place / "one" / name).read_bytes() == (place / "two" / name).read_bytes()


def test_an_unsolved_frame_is_a_row_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path, unsolved=("1.png",))
    assert run(["hazard", "run", *OPTIONS]) == 0
    rows = PADS.rows(tmp_path / "out" / "pads.csv")
    (row,) = [row for row in rows if row["file"] == "1.png"]
    assert "is not solved: too few matches" in row["reason"]
    assert "1.png" in capsys.readouterr().err


def test_a_run_without_a_solved_frame_ends_with_4(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path, unsolved=("0.png", "1.png", "2.png"))
    assert run(["hazard", "run", *OPTIONS]) == 4
    assert "is not solved" in capsys.readouterr().err


def test_pictures_of_another_folder_are_refused(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "pictures").rename(place / "moved")
    assert run(["hazard", "run", *OPTIONS]) == 3
    assert "--pictures" in capsys.readouterr().err
    assert run(["hazard", "run", "--pictures", "moved", *OPTIONS]) == 0
    values = np.full((SIZE, SIZE), 3000, np.uint16)
    for number in range(3):
        cv2.imwrite(str(place / "moved" / f"{number}.png"), values)
    assert run(["hazard", "run", "--pictures", "moved", *OPTIONS]) == 4
    assert "is not the picture that the run was made from" in capsys.readouterr().err


def test_a_run_at_another_body_is_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    toml = place / "pictures" / "run.toml"
    toml.write_text(toml.read_text().replace('"moon"', '"mercury"'))
    assert run(["hazard", "run", *OPTIONS]) == 3
    assert "show mercury" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("hazard", "run", "--height-m", "300", *OPTIONS), "--height-m"),
        (("hazard", "pictures", "--pictures", "pictures", *OPTIONS), "--pictures is for a run"),
    ],
)
def test_options_that_do_not_go_with_a_run_are_refused(
    place: Path, words: tuple[str, ...], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(list(words)) == 2
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("east_m", "code", "told"), [(5000.0, 4, "does not cover"), (700.0, 0, "brightness alone")]
)
def test_a_slope_map_that_does_not_cover_the_pads_is_reported(
    place: Path, east_m: float, code: int, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    crs = rasterio.CRS.from_proj4(f"+proj=stere +lat_0=-70 +lon_0=20 +R={RADIUS} +units=m")
    grid = rasterio.Affine(10, 0, east_m - 700.0, 0, -10, 700)
    with rasterio.open("slopes.tif", "w", "GTiff", 140, 140, 1, crs, grid, "float32") as file:
        file.write(np.full((140, 140), 2.0, np.float32), 1)
    assert run(["hazard", "run", "--slopes", "slopes.tif", *OPTIONS]) == code
    assert told in capsys.readouterr().err
