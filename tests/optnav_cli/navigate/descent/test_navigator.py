"""A small descent of four pictures: flown from end to end, and with what may be wrong with it."""

import csv
import re
import shutil
from collections.abc import Callable
from contextlib import closing
from datetime import datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.api import build_catalog
from catalog.config import resource
from catalog.errors import ConfigError, DataError, NoSolutionError, NothingToDoError
from catalog.geometry.vectors import squared_distance
from catalog.terrain.dem.source import DemSettings
from optnav_cli.api import evaluate, navigate_folder, report
from optnav_cli.estimation.models.points import Pose
from optnav_cli.evaluation.files import write_evaluation
from optnav_cli.fix import MatchKind, Method
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import InertialSettings
from optnav_cli.frames.truth import read_truth
from optnav_cli.navigate.descent import navigator as descent
from optnav_cli.navigate.worker import FrameWorker, RunInputs
from optnav_cli.output.run_folder import RECORDING, read_run
from optnav_cli.output.tables import read_matches
from optnav_cli.reasons import NO_REASON, ReasonCode
from optnav_cli.simulation.descent import Descent, DescentSettings
from optnav_cli.simulation.passes import SunSettings
from optnav_cli.simulation.sections import (
    AltimeterSection,
    DetailSettings,
    GlobeSettings,
    MainCamera,
)
from tests.optnav_cli.simulation.simulated import simulate
from tests.studies import descent_flights

CAMERA = """name = "small"
model = "pinhole"
width_px = 300
height_px = 300
focal_length_px = 192.0
principal_point_px = [149.5, 149.5]
psf_sigma_px = 0.7
psf_error_px = 0.05
"""
FOUND = SimpleNamespace(reason="")
BOX = (-16.2, -44.0, -14.2, -43.0)


@pytest.fixture(scope="module")
def catalog(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tycho's terrain where the descent ends."""
    path = tmp_path_factory.mktemp("catalog") / "descent.gpkg"
    build_catalog(resource("configs/catalogs/tycho_descent.toml"), path, bbox=BOX)
    return path


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four pictures from 6 to 3 km."""
    folder = tmp_path_factory.mktemp("pictures")
    (folder / "small.toml").write_text(CAMERA)
    scenario = Descent(
        camera=MainCamera(str(folder / "small.toml")),
        dem=(DemSettings(str(resource("data/tycho_gld100_256ppd.tif"))),),
        globe=GlobeSettings(str(resource("data/moon_gld100_4ppd.tif"))),
        detail=DetailSettings(seeds=(5,), smallest_m=25.0),
        descent=DescentSettings(
            from_km=6.0, to_km=3.0, duration_s=30.0, speed_m_s=(500.0, 300.0),
            tilt_deg=(10.0, 0.0), spacing_s=10.0,
        ),
        sun=SunSettings((15.0, 15.0)),
        inertial=InertialSettings(),
        altimeter=AltimeterSection(sigma_m=1.0),
    )  # fmt: skip
    simulate(scenario, folder / "pictures", workers=1)
    return folder / "pictures"


@pytest.fixture
def flown(
    pictures: Path, catalog: Path, tmp_path: Path
) -> Callable[[Callable[[Path], None]], Path]:
    """Fly the pictures, their folder changed before."""

    def fly(change: Callable[[Path], None]) -> Path:
        folder = tmp_path / "pictures"
        shutil.copytree(pictures, folder)
        change(folder)
        navigate_folder(folder, [catalog], tmp_path / "run")
        return tmp_path / "run"

    return fly


@pytest.fixture(scope="module")
def undisturbed(pictures: Path, catalog: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of the pictures as they are."""
    run = tmp_path_factory.mktemp("undisturbed") / "run"
    navigate_folder(pictures, [catalog], run)
    return run


def change_rows(folder: Path, change: Callable[[int, dict[str, str]], None]) -> None:
    """Rewrite frames.csv, each row changed."""
    path = folder / "frames.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for number, row in enumerate(rows):
        change(number, row)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)


def test_a_descent_is_flown_by_windows_inside_its_sigmas(undisturbed: Path, pictures: Path) -> None:
    run = undisturbed
    solutions = read_run(run).solutions
    assert [row.method for row in solutions] == [Method.DESCENT] * 4
    assert all(row.n_windows is not None and row.n_windows >= 4 for row in solutions)
    kinds = {row.kind for row in read_matches(run / "matches.csv")}
    assert kinds == {MatchKind.WINDOW, MatchKind.LANDMARK}
    assert sum(row.n_landmarks or 0 for row in solutions) >= 2
    with (run / "landmarks.csv").open(newline="") as file:
        landmarks = list(csv.DictReader(file))
    assert max(int(row["n_seen"]) for row in landmarks) >= 2
    assert all(row["reason"] for row in landmarks if row["status"] == "retired")
    assert all(float(row["cov_uu_m2"]) > 0.0 for row in landmarks)
    truths = read_truth(pictures / "truth.csv", read_folder(pictures).attitude)
    for row, truth in zip(solutions, truths, strict=True):
        assert row.fix is not None
        off = row.fix.position_m - truth.position_m
        assert np.linalg.norm(off) < 40.0
        assert squared_distance(off, row.fix.covariance_m2) < 16.0


def test_ranges_narrow_the_height_and_are_not_refused(
    undisturbed: Path, pictures: Path, flown: Callable[[Callable[[Path], None]], Path]
) -> None:
    def bare(number: int, row: dict[str, str]) -> None:
        row["range_m"] = row["range_sigma_m"] = ""

    def sigma_up(run: Path) -> float:
        fix = read_run(run).solutions[0].fix
        assert fix is not None
        up = fix.position_m / np.linalg.norm(fix.position_m)
        return float(np.sqrt(up @ fix.covariance_m2 @ up))

    with_ranges = read_run(undisturbed).solutions
    assert not any("range" in row.reason for row in with_ranges)
    assert sigma_up(undisturbed) < 0.95 * sigma_up(flown(lambda folder: change_rows(folder, bare)))


def test_a_range_that_contradicts_the_picture_is_refused_with_both(
    flown: Callable[[Callable[[Path], None]], Path],
) -> None:
    def wrong(number: int, row: dict[str, str]) -> None:
        if number == 2:
            row["range_m"] = str(float(row["range_m"]) + 300.0)

    solutions = read_run(flown(lambda folder: change_rows(folder, wrong))).solutions
    assert all(row.solved for row in solutions)
    said = re.search(r"range of (\S+) m is not used.* say (\S+) m with a", solutions[2].reason)
    assert said is not None
    assert float(said[1]) - float(said[2]) == pytest.approx(300.0, abs=40.0)
    assert not any("range" in row.reason for row in (solutions[0], solutions[1], solutions[3]))


@pytest.mark.parametrize(
    ("measured", "sigma", "what"),
    [
        ("5000", "", "range_sigma_m is empty"),
        ("-3", "1", "range_m is -3"),
        ("5000", "0", "range_sigma_m is 0"),
        ("5000", "6000", "range_sigma_m is 6000"),
    ],
)
def test_a_range_that_is_none_is_its_rows_problem(
    pictures: Path, tmp_path: Path, measured: str, sigma: str, what: str
) -> None:
    folder = tmp_path / "pictures"
    shutil.copytree(pictures, folder)

    def wrong(number: int, row: dict[str, str]) -> None:
        if number == 1:
            row["range_m"], row["range_sigma_m"] = measured, sigma

    change_rows(folder, wrong)
    frames = read_folder(folder).frames
    assert what in (frames[1].problem or "")
    assert frames[0].problem is None


def test_a_beam_that_points_back_is_refused(pictures: Path, tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    shutil.copytree(pictures, folder)
    text = (folder / "run.toml").read_text().replace("beam = [0.0, 0.0, 1.0]", "beam = [0, 0, -1]")
    (folder / "run.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"\[altimeter\] beam"):
        read_folder(folder)


def test_a_track_that_jumps_by_5_km_is_said(
    flown: Callable[[Callable[[Path], None]], Path],
) -> None:
    def jump(folder: Path) -> None:
        def by_five_km(number: int, row: dict[str, str]) -> None:
            if number >= 2:
                row["z_m"] = str(float(row["z_m"]) + 5e3)

        change_rows(folder, by_five_km)

    solutions = read_run(flown(jump)).solutions
    assert [row.solved for row in solutions[:2]] == [True, True]
    assert re.search(r"jumps by (4\.9|5\.\d) km in 10 s", solutions[2].reason)


def test_landmarks_outvote_a_few_wrong_windows(
    pictures: Path, catalog: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """5 of 11 windows and all 9 landmarks go with the track: it has not jumped."""
    windows = [SimpleNamespace(window=SimpleNamespace(key=k), match=FOUND) for k in range(11)]
    landmarks = [SimpleNamespace(match=FOUND) for _ in range(9)]

    def joined(*args: Any) -> SimpleNamespace:
        used = {k: k < 5 for k in range(11)} | {100 + k: True for k in range(len(args[4]))}
        return SimpleNamespace(used=used)

    monkeypatch.setattr(descent, "join_sightings", joined)
    with closing(FrameWorker(RunInputs(pictures, [catalog]))) as worker:
        navigator = worker.make_descent(InertialSettings())
        assert navigator is not None
        monkeypatch.setattr(navigator, "_solved", True)
        monkeypatch.setattr(navigator, "_update_after_jump", lambda *_: "jumped")
        found: Any = navigator._update
        assert found(None, None, windows, landmarks).used[0]
        assert found(None, None, windows, []) == "jumped"


@pytest.mark.parametrize(("count", "jumps"), [(7, False), (8, True)])
def test_a_few_windows_against_the_track_are_no_jump_of_it(
    pictures: Path, catalog: Path, monkeypatch: pytest.MonkeyPatch, count: int, jumps: bool
) -> None:
    """Near the ground six have agreed on a place 77 m off."""
    match = SimpleNamespace(reason=NO_REASON, pixel=np.array([5.0, 0.0]))
    place_m = np.array([1.737e6, 0.0, 0.0])
    windows: Any = [
        SimpleNamespace(
            window=SimpleNamespace(key=k, place_m=place_m), match=match, expected_px=np.zeros(2)
        )
        for k in range(count)
    ]
    frame: Any = SimpleNamespace(camera=SimpleNamespace(coarse_focal_px=1000.0))
    stated = Pose(place_m + [2e3, 0.0, 0.0], Rotation.identity())
    used = dict.fromkeys(range(count), True)
    monkeypatch.setattr(descent, "join_sightings", lambda state, *_: descent.Updated(state, used))
    with closing(FrameWorker(RunInputs(pictures, [catalog]))) as worker:
        navigator = worker.make_descent(InertialSettings())
        assert navigator is not None
        if jumps:
            made = navigator._update_after_jump(frame, stated, windows)
            assert made.remark.code == ReasonCode.TRACK_JUMP
            assert "the ground lies 10 m from where" in made.remark.text
        else:
            with pytest.raises(NoSolutionError, match="7 of 7 windows agree"):
                navigator._update_after_jump(frame, stated, windows)


def test_rows_that_run_back_are_refused(
    flown: Callable[[Callable[[Path], None]], Path],
) -> None:
    def back(folder: Path) -> None:
        text = (folder / "frames.csv").read_text().splitlines()
        (folder / "frames.csv").write_text("\n".join([text[0], text[2], text[1], *text[3:]]) + "\n")

    with pytest.raises(DataError, match="in order of time"):
        flown(back)


def test_a_row_without_a_position_or_picture_is_unsolved_and_the_others_go_on(
    flown: Callable[[Callable[[Path], None]], Path],
) -> None:
    def holes(folder: Path) -> None:
        (folder / "frame_0001.png").unlink()

        def bare(number: int, row: dict[str, str]) -> None:
            if number == 2:
                row["x_m"] = row["y_m"] = row["z_m"] = row["position_sigma_m"] = ""

        change_rows(folder, bare)

    solutions = read_run(flown(holes)).solutions
    assert [row.solved for row in solutions] == [True, False, False, True]
    assert [row.reason_code for row in solutions[1:3]] == [
        ReasonCode.BAD_PICTURE,
        ReasonCode.NO_PRIOR,
    ]


def test_the_study_counts_a_wholly_dark_picture_as_unsolved_and_goes_on(
    pictures: Path, catalog: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "pictures"
    shutil.copytree(pictures, folder)
    dark = folder / "frame_0001.png"
    cv2.imwrite(str(dark), np.full_like(cv2.imread(str(dark), cv2.IMREAD_UNCHANGED), 3))
    found = descent_flights.fly(folder, catalog, 1, [])
    assert [each.error_m is not None for each in found] == [True, False, True, True]
    assert found[1].solution.reason.startswith("frame_0001.png: all pixels")


def test_a_gap_in_the_track_is_bridged(
    flown: Callable[[Callable[[Path], None]], Path],
) -> None:
    """Two pictures left out: the last one is found from a track carried on over 20 s more."""

    def gap(folder: Path) -> None:
        text = (folder / "frames.csv").read_text().splitlines()
        (folder / "frames.csv").write_text("\n".join([text[0], text[1], text[4]]) + "\n")

    assert [row.solved for row in read_run(flown(gap)).solutions] == [True, True]


def test_a_gap_of_60_s_is_bridged_inside_wider_sigmas(
    flown: Callable[[Callable[[Path], None]], Path], pictures: Path
) -> None:
    """The last picture a minute later: its place is searched by as much more."""

    def later(folder: Path) -> None:
        def by_a_minute(number: int, row: dict[str, str]) -> None:
            if number == 3:
                time = datetime.fromisoformat(row["utc"]) + timedelta(seconds=60.0)
                row["utc"] = time.isoformat().replace("+00:00", "Z")

        change_rows(folder, by_a_minute)

    solutions = read_run(flown(later)).solutions
    assert [row.solved for row in solutions] == [True] * 4
    truth = read_truth(pictures / "truth.csv", read_folder(pictures).attitude)[-1]
    assert solutions[3].fix is not None
    off = solutions[3].fix.position_m - truth.position_m
    assert squared_distance(off, solutions[3].fix.covariance_m2) < 16.0


def test_a_frame_that_shows_nothing_is_carried_by_the_track_and_says_so(
    flown: Callable[[Callable[[Path], None]], Path], pictures: Path
) -> None:
    def dark(folder: Path) -> None:
        noise = np.random.default_rng(1).integers(0, 30, (300, 300))
        cv2.imwrite(str(folder / "frame_0002.png"), noise.astype(np.uint8))

    solutions = read_run(flown(dark)).solutions
    carried = solutions[2]
    assert [row.method for row in solutions] == [
        Method.DESCENT, Method.DESCENT, Method.RELATIVE_LANDMARKS, Method.DESCENT,
    ]  # fmt: skip
    assert (carried.n_windows, carried.n_landmarks) == (0, 0)
    assert carried.reason_code is ReasonCode.CARRIED
    truth = read_truth(pictures / "truth.csv", read_folder(pictures).attitude)[2]
    assert carried.fix is not None
    off = carried.fix.position_m - truth.position_m
    assert squared_distance(off, carried.fix.covariance_m2) < 16.0


def test_a_descent_that_was_stopped_goes_on_to_the_same_bytes(
    pictures: Path,
    catalog: Path,
    undisturbed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole, again = undisturbed, tmp_path / "again"
    finish, finished = FrameWorker.finish, []

    def counted(worker: FrameWorker, frame: Frame, *rest: Any) -> Any:
        finished.append(frame.file)
        if len(finished) == 3:
            raise KeyboardInterrupt
        return finish(worker, frame, *rest)

    monkeypatch.setattr(FrameWorker, "finish", counted)
    with pytest.raises(KeyboardInterrupt):
        navigate_folder(pictures, [catalog], again)
    navigate_folder(pictures, [catalog], again)
    # the third one twice, as it was not done, and none of the others
    assert finished == [f"frame_000{k}.png" for k in (0, 1, 2, 2, 3)]
    for name in ("solution.csv", "matches.csv", "landmarks.csv", RECORDING):
        assert (again / name).read_bytes() == (whole / name).read_bytes()
    for path in (whole / "overlays").iterdir():
        assert (again / "overlays" / path.name).read_bytes() == path.read_bytes()


def test_a_descent_without_a_catalog_says_so(pictures: Path, tmp_path: Path) -> None:
    with pytest.raises(NothingToDoError, match="no catalog"):
        navigate_folder(pictures, [], tmp_path / "run")


def test_a_camera_that_looks_at_the_sky_is_unsolved(
    flown: Callable[[Callable[[Path], None]], Path],
) -> None:
    def away(folder: Path) -> None:
        def up(number: int, row: dict[str, str]) -> None:
            if number == 2:
                row["qw"], row["qx"], row["qy"], row["qz"] = (
                    f"{-float(row['qx']):.12f}", row["qw"], row["qz"], f"{-float(row['qy']):.12f}",
                )  # fmt: skip

        change_rows(folder, up)

    solutions = read_run(flown(away)).solutions
    assert [row.solved for row in solutions] == [True, True, False, True]


def test_a_report_shows_a_descent_over_its_height(
    undisturbed: Path, pictures: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(undisturbed, run)
    report(run, tmp_path / "stated.html")
    assert "Stated sigmas over the height" in (tmp_path / "stated.html").read_text()
    write_evaluation(evaluate(run, pictures / "truth.csv"), run)
    report(run, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "Solution minus truth over the height" in page
    assert "Windows and landmarks over the height" in page
