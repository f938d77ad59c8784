"""Folders with points.csv: what is solved, and what is said of input that is wrong."""

import contextlib
import csv

import cv2
import numpy as np
import pyproj
import pytest

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.errors import DataError, NothingToDoError
from catalog.progress import SilentProgress
from optnav_cli.control_points.settings import NavigateSettings, PickedSettings
from optnav_cli.evaluation.files import evaluate_run
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.points import locate_points
from optnav_cli.frames.run_settings import PointsSettings
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.output.run_folder import read_run
from optnav_cli.reasons import ReasonCode
from tests.optnav_cli.made_picks import rows_of, scene, write_picked

LAT, LON, HEIGHT, SIGMA_PX, NAME = 3, 4, 5, 6, 8


def solved(folder, run, **settings):
    """The rows of solution.csv and of matches.csv."""
    given = NavigateSettings(points=PickedSettings(**settings))
    with contextlib.suppress(NothingToDoError):
        navigate_folder(RunInputs(folder, settings=given), run, SilentProgress())
    found = read_run(run)
    return found.solutions, found.matches


def test_a_folder_of_points_alone_is_solved_and_every_point_named(tmp_path):
    made = scene(3)
    rows = rows_of(made)
    rows[4][1] += 70.0
    (row,), matches = solved(write_picked(tmp_path / "f", made, rows), tmp_path / "run")
    assert row.method == "picked_points"
    assert row.attitude_source == "points"
    assert np.linalg.norm(row.position_m - made.pose.position_m) < 500.0
    assert [m.label for m in matches] == [r[NAME] for r in rows]
    (bad,) = [m for m in matches if not m.used]
    assert bad.label == "crater 5"
    assert "blunder" in bad.reason
    assert (tmp_path / "run/overlays/a.png.png").stat().st_size > 1000
    with (tmp_path / "run/matches.csv").open() as file:
        assert next(csv.DictReader(file))["id"] == "crater 1"


def test_the_bundled_example_lies_inside_its_sigmas(tmp_path):
    example = resource("data/picked_points/run.toml").parent
    rows, matches = solved(example, tmp_path / "run")
    assert all(row.solved for row in rows)
    assert [m.label for m in matches if not m.used] == ["site 2-08"]
    found = evaluate_run(tmp_path / "run", example / "truth.csv").figures_if_any()
    assert found.nees < 2.1
    assert sum(p.stat().st_size for p in example.rglob("*") if p.is_file()) < 50_000


@pytest.mark.parametrize("construction", ["circles", "tori"])
def test_a_construction_gives_its_own_place_and_sigmas(tmp_path, construction):
    made = scene(2)
    rows = rows_of(made)
    for number, row in enumerate(rows):
        row[1] += 0.5 * (-1) ** number
    folder = write_picked(tmp_path / "f", made, rows)
    (plain,), _ = solved(folder, tmp_path / "plain")
    (row,), _ = solved(folder, tmp_path / "run", construction=construction)
    assert np.linalg.norm(row.position_m - plain.position_m) > 1.0
    assert np.trace(row.covariance_m2) > np.trace(plain.covariance_m2)
    off = row.position_m - made.pose.position_m
    assert off @ np.linalg.solve(row.covariance_m2, off) < 14.2


def test_geodetic_places_are_those_of_pyproj():
    body, rng = load_body("earth"), np.random.default_rng(0)
    latlon = np.column_stack([rng.uniform(-89, 89, 50), rng.uniform(-179, 179, 50)])
    heights = rng.uniform(-400.0, 8000.0, 50)
    ours = locate_points(latlon, heights, body, PointsSettings("geodetic", "ellipsoid"))
    to_xyz = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    theirs = np.column_stack(to_xyz.transform(latlon[:, 1], latlon[:, 0], heights))
    assert np.abs(ours - theirs).max() < 1e-3
    above = locate_points(latlon, heights - 9000.0, body, PointsSettings("geodetic", "sphere"))
    assert np.allclose(np.linalg.norm(above, axis=1), body.radius_m + heights - 9000.0)


def test_three_points_are_unsolved_with_their_places_unless_a_prior_decides(tmp_path):
    made = scene(5, 3)
    rows = rows_of(made)
    (row,), _ = solved(write_picked(tmp_path / "a", made, rows), tmp_path / "run-a")
    assert not row.solved
    assert row.reason_code == ReasonCode.DEGENERATE
    assert row.reason.count("km high") >= 2
    x, y, z = made.pose.position_m + (4000.0, -3000.0, 5000.0)
    prior = f"{x},{y},{z},5000"
    (row,), _ = solved(write_picked(tmp_path / "b", made, rows, prior), tmp_path / "run-b")
    assert row.solved
    off = row.position_m - made.pose.position_m
    assert off @ np.linalg.solve(row.covariance_m2, off) < 14.2


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_points_are_a_row_with_a_reason(tmp_path, count):
    made = scene(1, 8)
    rows = [*rows_of(made)[:count], *rows_of(made, "b.png")]
    folder = write_picked(tmp_path / "f", made, rows, files=("a.png", "b.png"))
    (row, other), _ = solved(folder, tmp_path / "run")
    assert not row.solved
    assert other.solved
    assert row.reason_code == ReasonCode.FEW_POINTS


def test_points_outside_the_picture_are_left_out(tmp_path):
    made = scene(1, 9)
    rows = rows_of(made)
    rows[0][1] = 9000.0
    (row,), matches = solved(write_picked(tmp_path / "f", made, rows), tmp_path / "run")
    assert row.solved
    assert matches[0].reason_code == ReasonCode.OUTSIDE_FRAME


def test_points_all_outside_the_picture_are_said_to_be_so(tmp_path):
    rows = [[row[0], 9000.0, *row[2:]] for row in rows_of(scene(1, 9))]
    rows += rows_of(scene(1, 9), "b.png")
    folder = write_picked(tmp_path / "f", scene(1, 9), rows, files=("a.png", "b.png"))
    (row, other), _ = solved(folder, tmp_path / "run")
    assert not row.solved
    assert other.solved
    assert row.reason_code == ReasonCode.OUTSIDE_FRAME
    assert "all 9 points lie outside the picture of 5616 x 3744 px" in row.reason


def exchanged(rows):
    for row in rows:
        row[LAT], row[LON] = row[LON], row[LAT]


def west(rows):
    for row in rows:
        row[LON] = -row[LON]


def in_km(rows):
    for row in rows:
        row[HEIGHT] /= 1000.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (exchanged, "lat_deg and lon_deg are exchanged"),
        (west, "taken as west"),
        (in_km, "heights 1000 times larger"),
    ],
)
def test_coordinates_read_wrongly_are_named(tmp_path, change, words):
    made = scene(6, relief_m=5000.0)
    rows = rows_of(made)
    change(rows)
    (row,), _ = solved(write_picked(tmp_path / "f", made, rows), tmp_path / "run")
    assert not row.solved
    assert words in row.reason


def test_a_lens_wrong_by_a_tenth_is_named_or_held_by_its_sigma(tmp_path):
    made = scene(6, off_deg=45.0, relief_m=5000.0, height_m=50e3)
    rows = rows_of(made, sigma=(0.3, 1.0))
    for row in rows:
        row[1] = 2807.5 + 1.1 * (row[1] - 2807.5)
        row[2] = 1871.5 + 1.1 * (row[2] - 1871.5)
    kept = [r for r in rows if 0 < r[1] < 5615 and 0 < r[2] < 3743]
    (row,), _ = solved(write_picked(tmp_path / "f", made, kept), tmp_path / "run")
    assert not row.solved
    assert "focal length" in row.reason


@pytest.mark.parametrize(
    ("change", "words"),
    [(exchanged, "lat_deg and lon_deg are exchanged"), (west, "taken as west")],
)
def test_a_mirrored_ground_is_said_to_be_so_through_air_too(tmp_path, change, words):
    made = scene(6, body="earth")
    rows = rows_of(made)
    change(rows)
    (row,), _ = solved(write_picked(tmp_path / "f", made, rows), tmp_path / "run")
    assert row.reason_code == ReasonCode.MIRRORED
    assert words in row.reason


def test_points_seen_through_much_air_are_counted(tmp_path):
    made = scene(1, 9, off_deg=67.0, body="earth")
    (row,), _ = solved(write_picked(tmp_path / "f", made, rows_of(made)), tmp_path / "run")
    assert row.reason_code == ReasonCode.FEW_POINTS
    assert "9 of 9 points are seen more than 70 deg from the vertical" in row.reason


@pytest.mark.parametrize("factor", [0.9, 1.1])
@pytest.mark.parametrize("stated", [0.0, 0.005])
def test_a_tele_lens_wrong_by_a_tenth_is_no_position_of_small_sigma(tmp_path, factor, stated):
    made = scene(3, body="earth")
    folder = write_picked(tmp_path / "f", made, rows_of(made))
    lens = folder / "cameras/tele.toml"
    text = lens.read_text().replace("62400", f"{62400 * factor:.0f}")
    lens.write_text(text + f"focal_length_error = {stated}\n")
    (row,), _ = solved(folder, tmp_path / "run")
    assert not row.solved
    assert "focal length" in row.reason
    assert ("shorter" if factor > 1.0 else "longer") in row.reason


def test_a_lens_off_by_less_than_points_can_tell_is_not_refused(tmp_path):
    made = scene(3, body="earth")
    folder = write_picked(tmp_path / "f", made, rows_of(made))
    lens = folder / "cameras/tele.toml"
    lens.write_text(lens.read_text().replace("62400", "62960"))
    (row,), _ = solved(folder, tmp_path / "run")
    assert row.solved


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        (SIGMA_PX, 0, "line 3: sigma_px is 0"),
        (SIGMA_PX, "", "line 3: sigma_px is ''"),
        (LAT, 120.0, "line 3: lat_deg is 120"),
        (HEIGHT, 90000.0, "line 3: height_m is 90000"),
        (NAME, "crater 1", "line 3: name 'crater 1' stands twice"),
        (0, "b.png", "line 3: file is 'b.png', which frames.csv does not have"),
    ],
)
def test_a_wrong_row_of_points_is_refused_with_its_line(tmp_path, column, value, words):
    made = scene(1, 6)
    rows = rows_of(made)
    rows[1][column] = value
    with pytest.raises(DataError, match=words):
        read_folder(write_picked(tmp_path / "f", made, rows))


def overlay_of(run):
    (path,) = run.glob("overlays/*.png")
    return cv2.imread(str(path))


def test_the_overlay_shows_a_colour_picture_and_a_resized_one_is_an_error(tmp_path):
    """A black overlay would hide which craters were picked."""
    made = scene(3)
    folder = write_picked(tmp_path / "f", made, rows_of(made))
    solved(folder, tmp_path / "none")
    height, width = made.camera.shape
    x = np.linspace(40, 250, width).astype(np.uint8)
    colour = np.dstack([np.tile(x // part, (height, 1)) for part in (1, 2, 3)])
    cv2.imwrite(str(folder / "a.png"), colour)
    (row,), _ = solved(folder, tmp_path / "colour")
    assert row.fix is not None
    black, shown = (overlay_of(tmp_path / run) for run in ("none", "colour"))
    assert np.median(shown[: height // 4]) > np.median(black[: height // 4]) + 40
    cv2.imwrite(str(folder / "a.png"), colour[::2, ::2])
    (row,), _ = solved(folder, tmp_path / "resized")
    assert row.outcome.reason.code == ReasonCode.BAD_PICTURE
    assert f"a.png: the picture is {(width + 1) // 2} x" in row.outcome.reason.text
