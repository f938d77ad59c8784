"""`optnav adjust`: runs in, what is common out, in files that `navigate` reads."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.epochs import utc_from_tdb_s
from catalog.geometry.rotations import ARCSEC
from optnav_cli import main
from optnav_cli.calibration import adjusted_folder
from optnav_cli.calibration.adjustment import FrameResult
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera
from optnav_cli.estimation.models.points import Pose
from optnav_cli.estimation.resection import resect_robustly
from optnav_cli.fix import Evidence, Fix, MatchRow, Method, NoFix, Solution
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.output.run_folder import read_run
from optnav_cli.output.tables import write_matches, write_solutions
from optnav_cli.pages import write_report
from optnav_cli.reasons import Reason, ReasonCode
from tests.optnav_cli.calibration.test_adjustment import (
    ATTITUDE,
    CAMERA,
    POSITION_M,
    TRUTH,
    simulated,
)


def write_run(
    place: Path,
    count: int = 12,
    *,
    seed: int = 1,
    body: str = "67p",
    catalog: str = "67p.gpkg",
    camera: Camera = CAMERA,
    unsolved: bool = False,
    sigmas: tuple[float, float] = (POSITION_M, ATTITUDE),
) -> Path:
    """A run folder about a body whose catalog, origin and boresight are off as TRUTH says."""
    made, _, _ = simulated(np.random.default_rng(seed), frames=count, stated=sigmas)
    frames, solutions, matches = [], [], []
    for number, one in enumerate(made):
        utc = utc_from_tdb_s(4.6e8 + 3600.0 * number)
        file = f"{number:03d}.png"
        found = resect_robustly(CAMERA, one.sightings, one.start, sigmas[1])
        stated = one.attitude, sigmas[1], one.position_m, sigmas[0]
        sun = np.array([0.6, 0.0, 0.8])
        frames.append(Frame(file, utc, camera.name, 4.6e8 + 3600.0 * number, *stated, sun))
        pose, evidence = found.pose, Evidence(12, 12, 12, 0.4)
        fix = Fix(
            Method.CONTROL_POINTS,
            pose.position_m,
            found.position_covariance_m2,
            pose.camera_from_body,
            found.attitude_sigma_rad,
            evidence,
        )
        no_fix = NoFix(Reason(ReasonCode.NO_POINTS_IN_VIEW, "none in view"))
        solutions.append(Solution(file, utc, no_fix if unsolved else fix, "frames.csv"))
        rows = zip(one.points, one.sightings.points_body_m, one.sightings.pixels, strict=True)
        for point, xyz_m, pixel in rows:
            seen = MatchRow(file, int(point), 0, xyz_m, pixel, pixel, 0.8, 0.1, True)
            matches.append(replace(seen, catalog=catalog, residual_px=np.zeros(2)))
    write_folder(place, RunSettings(body, "camera_from_body"), [camera], frames)
    write_solutions(place / "solution.csv", solutions, read_folder(place).attitude)
    write_matches(place / "matches.csv", [] if unsolved else matches)
    return place


def adjusted(*args: object) -> int:
    return main.run(["adjust", *map(str, args)])


def numbers(folder: Path) -> dict[tuple[str, str], dict[str, str]]:
    with (folder / "common.csv").open() as file:
        return {(row["name"], row["axis"]): row for row in csv.DictReader(file)}


def test_an_adjusted_run_holds_what_is_common(tmp_path: Path) -> None:
    run, out = write_run(tmp_path / "run", 40), tmp_path / "out"
    assert adjusted(run, "-o", out) == 0
    found = numbers(out)
    per = [np.degrees(1.0)] * 3 + [1.0] * 4 + [1.0 / ARCSEC] * 2
    expected = TRUTH * per + np.array([0.0] * 6 + [1.0] + [0.0] * 2)
    for row, true in zip(found.values(), expected, strict=True):
        assert abs(float(row["value"]) - true) < 3.5 * float(row["sigma"]), row
        assert row["observed"] == "1"
    document = json.loads((out / "common.json").read_text())
    stages = document["residual_rms_px"]
    assert stages["as stated"] > 3.0 * stages["adjusted"]
    assert stages["adjusted"] == pytest.approx(0.4, rel=0.15)
    before, after = read_run(run), read_run(out)
    assert [s.file for s in after.solutions] == [s.file for s in before.solutions]
    assert all(m.residual_px is not None for m in after.matches)
    write_report(out, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "Common to the frames" in page
    assert f"{float(found['scale', '']['value']):.6g}" in page
    (out / "common.json").write_text("{}")
    write_report(out, tmp_path / "page.html")
    assert "run `optnav adjust` again" in (tmp_path / "page.html").read_text()


def test_navigate_reads_what_was_found(tmp_path: Path) -> None:
    """With body and camera as found, the stated poses see the points where they are."""
    run, out = write_run(tmp_path / "run", 40, sigmas=(5.0, 5.0 * ARCSEC)), tmp_path / "out"
    assert adjusted(run, "-o", out) == 0
    pictures = tmp_path / "pictures"
    shutil.copytree(run, pictures)
    raw = rms_of_stated(pictures)
    shutil.copy(out / "run.toml", pictures)
    shutil.copy(out / "67p.toml", pictures)
    shutil.copy(out / "cameras/narrow.toml", pictures / "cameras")
    camera = load_camera(pictures / "cameras/narrow.toml")
    assert camera.boresight_arcsec is not None
    assert camera.boresight_sigma_arcsec > 0.0
    # what is left is the noise of 0.4 px and 5 arcsec and 5 m of each frame, 0.4 px
    assert raw > 2.5
    assert rms_of_stated(pictures) < 0.7
    # and adjusting again, from there, finds little more
    shutil.copytree(run, tmp_path / "again")
    for name in ("run.toml", "67p.toml"):
        shutil.copy(out / name, tmp_path / "again")
    shutil.copy(out / "cameras/narrow.toml", tmp_path / "again/cameras")
    attitude = read_folder(tmp_path / "again").attitude
    write_solutions(tmp_path / "again/solution.csv", read_run(out).solutions, attitude)
    assert adjusted(tmp_path / "again", "-o", tmp_path / "twice") == 0
    for (name, _), row in numbers(tmp_path / "twice").items():
        change = float(row["value"]) - (1.0 if name == "scale" else 0.0)
        assert abs(change) < 1.5 * float(row["sigma"]), row
    first, second = (load_toml_frame(place) for place in (out, tmp_path / "twice"))
    np.testing.assert_allclose(second, first, rtol=0.05, atol=2e-3)


def load_toml_frame(folder: Path) -> list[float]:
    frame = read_run(folder).attitude.body.catalog_frame
    return [*np.radians(frame.turn_deg), frame.scale]


def rms_of_stated(folder: Path) -> float:
    """Residuals of the matches from the poses of frames.csv, px."""
    read = read_folder(folder)
    camera = read.cameras["narrow"]
    frames = {frame.file: frame for frame in read.frames}
    off = []
    for match in read_run(folder).matches:
        frame = frames[match.file]
        assert frame.camera_from_body is not None
        seen = frame.camera_from_body.apply(match.cp_position_m - frame.position_m)
        off.append(camera.project(seen) - match.measured_px)
    return float(np.sqrt(np.mean(np.square(off))))


def test_what_labels_scatter_by_counts_in_place_of_the_sigmas_of_a_search(tmp_path: Path) -> None:
    """Sigmas of frames.csv are for the search and hold what all frames have in common."""
    run = write_run(tmp_path / "run", 20)
    scatter = ("--position-sigma-m", 30, "--attitude-sigma-arcsec", 20)
    assert adjusted(run, "-o", tmp_path / "wide") == 0
    assert adjusted(run, *scatter, "-o", tmp_path / "tight") == 0
    wide, tight = (numbers(tmp_path / name) for name in ("wide", "tight"))
    for key in wide:
        assert float(tight[key]["sigma"]) < float(wide[key]["sigma"])
    assert float(tight["origin", "x"]["sigma"]) < 0.3 * float(wide["origin", "x"]["sigma"])


def test_one_frame_is_adjusted_and_says_what_it_cannot_tell(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", 1)
    assert adjusted(run, "-o", tmp_path / "out") == 0
    said = json.loads((tmp_path / "out/common.json").read_text())["not_observed"]
    assert (
        "one frame: what is common is told from its own errors by the stated sigmas alone" in said
    )


def test_focal_length_and_scale_from_afar_are_named(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    assert adjusted(run, "--solve", "scale,focal", "-o", tmp_path / "out") == 0
    (said,) = json.loads((tmp_path / "out/common.json").read_text())["not_observed"]
    words = "the scale and the focal length of narrow are not separable with these frames"
    assert said == words


def test_two_runs_of_one_name_keep_their_frames_apart(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / name, 6, seed=n) for n, name in enumerate("ab")]
    assert adjusted(*runs, "-o", tmp_path / "out") == 0
    files = [solution.file for solution in read_run(tmp_path / "out").solutions]
    assert files[0] == "a/000.png"
    assert files[-1] == "b/005.png"
    assert len(set(files)) == 12


OTHER = replace(CAMERA, name="other")


@pytest.mark.parametrize(
    ("second", "options", "code", "words"),
    [
        ({"body": "eros"}, (), 3, "its body (eros) is not that of"),
        ({"catalog": "b.gpkg", "camera": OTHER}, (), 3, "share neither a catalog nor a camera"),
        ({"catalog": "b.gpkg"}, (), 3, "can be common to runs of one catalog only"),
        ({"camera": replace(CAMERA, focal_length_px=5000.0)}, (), 3, "is another than that of"),
        ({}, ("--solve", "roll"), 2, "'roll' is none of body_rotation, origin"),
    ],
)
def test_runs_that_do_not_belong_together_are_refused(
    tmp_path: Path,
    second: dict[str, object],
    options: tuple[str, ...],
    code: int,
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    runs = write_run(tmp_path / "a", 3), write_run(tmp_path / "b", 3, **second)  # type: ignore[arg-type]
    assert adjusted(*runs, *options, "-o", tmp_path / "out") == code
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_runs_of_two_catalogs_share_a_boresight(tmp_path: Path) -> None:
    runs = write_run(tmp_path / "a", 6), write_run(tmp_path / "b", 6, catalog="b.gpkg")
    assert adjusted(*runs, "--solve", "boresight", "-o", tmp_path / "out") == 0


def test_a_run_without_matches_or_twice_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run", 2, unsolved=True)
    assert adjusted(run, "-o", tmp_path / "out") == 4
    assert "no frame is solved by 3 or more control points" in capsys.readouterr().err
    assert adjusted(run, run, "-o", tmp_path / "out") == 3
    assert "is named twice" in capsys.readouterr().err
    assert adjusted(run, "-o", run) == 3


def test_a_frame_whose_matches_disagree_with_the_others_is_unsolved(tmp_path: Path) -> None:
    before = read_run(write_run(tmp_path / "run", 1)).solutions[0]
    assert before.fix is not None
    pose = Pose(before.fix.position_m, before.fix.camera_from_body)
    for kept in (2, 3):
        weights = np.array([1.0] * kept + [0.0] * (12 - kept))
        found = FrameResult(pose, np.eye(6), np.ones((12, 2)), weights)
        outcome = adjusted_folder._make_outcome(before, found)
        assert isinstance(outcome, Fix) == (kept == 3)
        assert outcome.evidence.n_used == kept


def test_predicted_pixels_of_the_adjusted_matches_are_those_of_the_pose(tmp_path: Path) -> None:
    run, out = write_run(tmp_path / "run", 8), tmp_path / "out"
    assert adjusted(run, "--solve", "none", "-o", out) == 0
    found = read_run(out)
    poses = {s.file: s.fix for s in found.solutions}
    for match in found.matches:
        fix = poses[match.file]
        assert fix is not None
        assert fix.camera_from_body is not None
        camera = found.cameras[match.file]
        seen = fix.camera_from_body.apply(match.cp_position_m - fix.position_m)
        # to the part of the shared error that the statement takes off
        np.testing.assert_allclose(camera.project(seen), match.predicted_px, atol=1.0)
