"""A lens by pictures of a grid of dots that were drawn through a known one."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.calibration.dots import find_dots, find_grid
from optnav_cli.calibration.grid_calibration import (
    GridCalibration,
    GridDistance,
    GridModel,
    GridView,
    calibrate_by_grids,
)
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera
from optnav_cli.estimation.models.common import Common
from optnav_cli.main import run
from tests.optnav_cli.made_grids import drawn_grid

LENS = Camera("lab", "pinhole", 320, 240, 450.0, (162.0, 118.0), "brown", (-0.2, 0.05, 0, 0, 0))
BLANK = Camera("lab", "pinhole", 320, 240, 320.0, (0.0, 0.0))
KINDS = (Common.FOCAL, Common.CENTRE, Common.DISTORTION)
TURNS = ((30.0, -10.0, 5.0), (-25.0, 15.0, 50.0), (5.0, 30.0, 90.0))
TRUTH = np.array([0.0, 162.0, 118.0, -0.2, 0.05])


def view(turn: tuple[float, float, float], seed: int = 0) -> GridView:
    dots = find_dots(drawn_grid(LENS, (7, 5), 160.0, turn, seed=seed), None)
    return GridView(dots.pixels, dots.places)


def errors(found: GridCalibration) -> FloatArray:
    camera = found.camera
    numbers = [np.log(camera.focal_length_px / 450.0), *camera.principal_point_px]
    return np.array([*numbers, *camera.coefficients[:2]]) - TRUTH


def write(values: FloatArray, path: Path) -> Path:
    cv2.imwrite(str(path), np.asarray(values).astype(np.uint8))
    return path


def test_a_drawn_lens_is_found_again_inside_its_stated_errors() -> None:
    for seed in range(2):
        found = calibrate_by_grids(BLANK, [view(turn, seed) for turn in TURNS], 10.0, KINDS)
        off = errors(found)
        assert abs(off[0]) < 2e-3
        assert np.abs(off[1:3]).max() < 1.0
        assert off @ np.linalg.solve(found.covariance, off) / 5.0 < 3.0
        assert found.distances_mm == pytest.approx([160.0] * 3, rel=3e-3)


def test_it_agrees_with_opencv() -> None:
    views = [view(turn) for turn in TURNS]
    found = calibrate_by_grids(BLANK, views, 10.0, KINDS)
    points = [GridModel(v, 10.0, 0, 1).points.astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32) for v in views]
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    guess = np.array([[450.0, 0, 160], [0, 450.0, 120], [0, 0, 1]])
    flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    _, matrix, terms, _, _ = cv2.calibrateCamera(
        points, pixels, (320, 240), guess, np.zeros(5), flags=flags
    )
    sigmas = np.sqrt(np.diag(found.covariance))
    theirs = [np.log(matrix[0, 0]), matrix[0, 2], matrix[1, 2], *terms.ravel()[:2]]
    ours = [np.log(found.camera.focal_length_px), *found.camera.principal_point_px]
    ours += found.camera.coefficients[:2]
    # only our weak priors differ
    assert np.abs((np.array(theirs) - ours) / sigmas).max() < 0.5


def test_derivatives_are_those_of_differences() -> None:
    model = GridModel(view(TURNS[0]), 10.0, 0, 1)
    _, pose = model.solve_pose(450.0, np.array([162.0, 118.0]))
    state = np.array([np.log(450.0), 162.0, 118.0, -0.2, 0.05, *pose])
    jacobian = model.linearise(state).jacobian
    for k in range(state.size):
        step = np.zeros(state.size)
        step[k] = 1e-6
        ahead, back = (model.linearise(state + s).residuals for s in (step, -step))
        assert (back - ahead) / 2e-6 == pytest.approx(jacobian[:, k], rel=1e-4, abs=1e-3)


def test_a_grid_seen_straight_on_leaves_the_focal_length_open_without_its_distance() -> None:
    flat = view((0.0, 0.0, 0.0))
    with pytest.raises(NoSolutionError, match="straight on looks the same"):
        calibrate_by_grids(BLANK, [flat], 10.0, KINDS)
    found = calibrate_by_grids(BLANK, [flat], 10.0, KINDS, GridDistance(160.0, 0.5))
    assert abs(errors(found)[0]) < 3.0 * found.focal_error < 0.015


def test_a_folder_of_the_calibration_is_written_and_its_camera_loads(tmp_path: Path) -> None:
    names = [write(drawn_grid(LENS, (7, 5), 160.0, t), tmp_path / f"{t[0]}.png") for t in TURNS[:2]]
    names.append(write(drawn_grid(LENS, (2, 2), 160.0), tmp_path / "cut.png"))
    words = ["-q", "calibrate", *map(str, names), "--grid-spacing-mm", "10", "--name", "web"]
    assert run([*words, "-o", str(tmp_path / "out")]) == 0
    camera = load_camera(tmp_path / "out" / "cameras" / "web.toml")
    assert camera.focal_length_px == pytest.approx(450.0, rel=2e-3)
    assert 0.0 < camera.focal_length_error < 2e-3
    assert camera.principal_point_error_px > 0.0
    assert "left out: cut.png" in (tmp_path / "out" / "calibration.json").read_text("utf-8")
    assert run(["-q", "report", str(tmp_path / "out"), "-o", str(tmp_path / "out.html")]) == 0


def test_one_picture_says_what_it_cannot_tell_apart(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = write(drawn_grid(LENS, (7, 5), 160.0, (12.0, 0.0, 0.0)), tmp_path / "one.png")
    words = ["calibrate", str(one), "--grid-spacing-mm", "10", "-o", str(tmp_path / "out")]
    assert run(words) == 0
    said = capsys.readouterr().err
    assert "hardly tells the focal length from the distance of the grid" in said
    assert "% only: tilt the grid" in said


def test_a_spacing_that_contradicts_the_distance_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = write(drawn_grid(LENS, (7, 5), 160.0, TURNS[0]), tmp_path / "one.png")
    words = ["-q", "calibrate", str(one), "--grid-spacing-mm", "12", "--distance-mm", "160"]
    assert run([*words, "--distance-error-mm", "0.5", "-o", str(tmp_path / "out")]) == 3
    said = capsys.readouterr().err
    assert "they are 10" in said or "they are 9.9" in said
    assert not (tmp_path / "out").exists()


def test_pictures_without_a_grid_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    grey = drawn_grid(LENS, (7, 5), 160.0, TURNS[0])
    cases = {
        "noise": (np.clip(rng.normal(128, 40, (240, 320)), 0, 255), 4, "no grid"),
        "flat": (np.full((240, 320), 90.0), 3, "the same value"),
        "colour": (np.stack([0.8 * grey, grey, grey], axis=-1), 0, "its luminance is used"),
        "cut": (drawn_grid(LENS, (7, 5), 160.0, TURNS[0], at_mm=(40.0, 0.0)), 4, "spots lie on"),
        "few": (drawn_grid(LENS, (2, 2), 160.0), 4, "at least 3 x 3"),
    }
    for name, (values, code, words) in cases.items():
        place = write(values, tmp_path / f"{name}.png")
        command = ["-q", "calibrate", str(place), "--grid-spacing-mm", "10"]
        assert run([*command, "-o", str(tmp_path / "out")]) == code
        assert words in capsys.readouterr().err
    place = write(grey, tmp_path / "other.png")
    small = write(grey[::2, ::2], tmp_path / "small.png")
    command = ["-q", "calibrate", str(place), str(small), "--grid-spacing-mm", "10"]
    assert run([*command, "-o", str(tmp_path / "out")]) == 3
    assert "the picture is 160 x 120" in capsys.readouterr().err


def test_a_picture_that_is_too_large_is_refused_before_it_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    huge = tmp_path / "huge.pgm"
    huge.write_bytes(b"P5 20000 20000 255\n")
    assert run(["-q", "calibrate", str(huge), "--grid-spacing-mm", "10", "-o", "x"]) == 3
    assert "huge.pgm" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "say --catalog of a route, or --grid-spacing-mm"),
        (("--grid-spacing-mm", "0"), "0.0 is not in the range"),
        (("--grid-spacing-mm", "10", "--catalog", "x"), "--catalog goes without"),
        (("--grid-spacing-mm", "10", "--solve", "focal,clock"), "takes focal, and with it centre"),
        (("--grid-spacing-mm", "10", "--grid", "9"), "is not COLUMNSxROWS"),
        (("--grid-spacing-mm", "10", "--distance-error-mm", "1"), "wants --distance-mm"),
        (("--grid-spacing-mm", "10", "--name", "a/b"), "wanted a plain word"),
        (("--catalog", "x", "--distance-mm", "10"), "--distance-mm wants --grid-spacing-mm"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["-q", "calibrate", "one.png", *words, "-o", "out"]) == 2
    assert said in capsys.readouterr().err


PATTERNS = {"acircles": ((4, 11), 150.0, 7.0), "chessboard": ((7, 5), 160.0, 10.0)}


def pattern_view(pattern: str, turn: tuple[float, float, float]) -> GridView:
    size, distance, spacing = PATTERNS[pattern]
    picture = drawn_grid(LENS, size, distance, turn, spacing_mm=spacing, pattern=pattern)
    # of dots either kind is found by itself
    named = None if pattern == "acircles" else pattern
    grid = find_grid(picture, None if named is None else size, named)
    assert grid.size == size
    return GridView(grid.pixels, grid.places)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_opencvs_other_patterns_give_the_drawn_lens_and_opencvs_own_answer(pattern: str) -> None:
    (columns, rows), _, spacing = PATTERNS[pattern]
    views = [pattern_view(pattern, turn) for turn in TURNS]
    found = calibrate_by_grids(BLANK, views, spacing, KINDS)
    off = errors(found)
    assert abs(off[0]) < 3e-3
    assert off @ np.linalg.solve(found.covariance, off) / 5.0 < 3.0
    # OpenCV's own numbering of the pattern, its own detector, its own fit
    i, j = np.mgrid[:rows, :columns]
    steps = np.stack([2 * j + i % 2 if pattern == "acircles" else j, i, 0 * i], axis=-1)
    board = (spacing * steps.reshape(-1, 3)).astype(np.float32)
    seen = []
    for turn in TURNS:
        size, distance, _ = PATTERNS[pattern]
        picture = drawn_grid(LENS, size, distance, turn, spacing_mm=spacing, pattern=pattern)
        eight = picture.astype(np.uint8)
        if pattern == "acircles":
            done, points = cv2.findCirclesGrid(eight, size, flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
        else:
            done, points = cv2.findChessboardCorners(eight, size)
            ending = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
            points = cv2.cornerSubPix(eight, points, (8, 8), (-1, -1), ending) if done else points
        if done:
            seen.append(points)
    assert len(seen) >= 2
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    guess = np.array([[450.0, 0, 160], [0, 450.0, 120], [0, 0, 1]])
    flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    _, matrix, _, _, _ = cv2.calibrateCamera(
        [board] * len(seen), seen, (320, 240), guess, np.zeros(5), flags=flags
    )
    assert found.camera.focal_length_px == pytest.approx(matrix[0, 0], rel=8e-3)


def test_dots_of_an_asymmetric_grid_are_numbered_as_opencv_numbers_them() -> None:
    grid = find_grid(
        drawn_grid(LENS, (4, 11), 150.0, (5.0, 10.0, 5.0), spacing_mm=7.0, pattern="acircles"),
        None,
    )
    assert grid.size == (4, 11)
    wanted = {(2 * j + i % 2, i) for i in range(11) for j in range(4)}
    assert {(int(x), int(y)) for x, y in grid.places} == wanted


def test_another_pattern_than_the_stated_one_is_refused() -> None:
    picture = drawn_grid(LENS, (4, 11), 150.0, spacing_mm=7.0, pattern="acircles")
    with pytest.raises(NoSolutionError, match=r"no grid \(circles\)"):
        find_grid(picture, None, "circles")
    with pytest.raises(NoSolutionError, match="count inner corners, not squares"):
        find_grid(picture, (9, 6), "chessboard")
    with pytest.raises(NoSolutionError, match="size is not stated"):
        find_grid(picture, None, "chessboard")


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_command_takes_opencvs_patterns(pattern: str, tmp_path: Path) -> None:
    size, distance, spacing = PATTERNS[pattern]
    files = []
    for number, turn in enumerate(TURNS):
        picture = drawn_grid(LENS, size, distance, turn, spacing_mm=spacing, pattern=pattern)
        files.append(str(write(picture, tmp_path / f"{number}.png")))
    words = ["--grid-spacing-mm", str(spacing), "--pattern", pattern, "-o", str(tmp_path / "out")]
    assert run(["calibrate", *files, *words, "--grid", f"{size[0]}x{size[1]}"]) == 0
    camera = load_camera(tmp_path / "out/cameras/grid.toml")
    assert camera.focal_length_px == pytest.approx(450.0, rel=5e-3)
    if pattern == "chessboard":
        assert run(["calibrate", *files, *words]) == 2
