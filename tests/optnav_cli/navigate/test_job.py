"""A folder of good and bad pictures: one row each, in order, and nothing stops the others."""

import csv
import json
import logging
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris, SpiceEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError, NothingToDoError
from catalog.progress import SilentProgress
from catalog.store.manifest import CatalogMeta
from catalog.store.reader import Catalog
from optnav_cli.control_points import method as control_points
from optnav_cli.control_points.settings import MatchSettings, NavigateSettings, load_settings
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.navigate.inputs import open_field
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.orbit.fit.job import fit_runs
from optnav_cli.orbit.fit.settings import NoiseSettings, OrbitFitSettings
from optnav_cli.output import overlay
from optnav_cli.output.run_folder import read_run
from optnav_cli.output.tables import read_matches
from optnav_cli.reasons import ReasonCode
from tests.catalog.store.written import write_points
from tests.optnav_cli.orbit.fit.flights import fixes_of
from tests.optnav_cli.orbit.fit.flights import write_run as write_fixes

SETTINGS = NavigateSettings(match=MatchSettings(template_nodes=48))
UTC = "2024-05-01T12:00:00Z"
EARLIER = "2024-05-01T06:00:00Z"


@pytest.fixture(scope="session")
def catalog_path(rough_world, tmp_path_factory):
    path = tmp_path_factory.mktemp("catalog") / "rough.gpkg"
    write_rough(rough_world, path, "moon")
    return path


def write_rough(world, path, body):
    meta = CatalogMeta(
        body=body,
        radius_m=world.radius_m,
        cell_deg=world.cell_deg,
        levels=world.levels,
        size=world.nodes,
        posting_m=float(world.postings()[0]),
        height_step_m=0.5,
    )
    write_points(path, meta, world.control_points)


@pytest.fixture(scope="session")
def taken(rough_world):
    """A picture with its pose and Sun."""
    pose, sun = rough_world.pose(100e3, roll=0.1), rough_world.sun(30.0, 200.0)
    return rough_world.picture(pose, sun, noise_seed=7), pose, sun


def good_frame(name, taken, **changes):
    _, pose, sun = taken
    known = {
        "file": name,
        "utc": UTC,
        "camera": "cam",
        "tdb_s": 0.0,
        "camera_from_body": pose.camera_from_body,
        "attitude_sigma_rad": 0.0,
        "position_m": pose.position_m + [400.0, -700.0, 500.0],
        "position_sigma_m": 1000.0,
        "sun_body": sun,
    }
    return Frame(**(known | changes))


def folder_with(place, world, frames):
    place.mkdir(exist_ok=True)
    write_folder(place, RunSettings("moon", "camera_from_body"), [world.camera], frames)
    return place


def navigated(pictures, run, catalog, settings=SETTINGS, **how):
    return navigate_folder(RunInputs(pictures, [catalog], settings), run, SilentProgress(), **how)


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


BAD = {
    "missing.png": "there is no such picture",
    "short.png": "the picture is broken",
    "empty.png": "empty file",
    "small.png": "256 x 512",
    "black.png": "all black",
    "white.png": "all white",
    "turned.png": "quaternion",
    "unturned.png": "no attitude: the quaternion is empty",
    "nowhere.png": "no prior: no limb in view",
    "farside.png": "no control point of the catalog in the frame",
    "night.png": "lit well",
    "noise.png": "control points",
}


@pytest.fixture(scope="session")
def mixed(rough_world, taken, tmp_path_factory):
    """A folder whose first and last frames are good and all between them are not."""
    picture, pose, sun = taken
    changes = {
        "unturned.png": {"camera_from_body": None},
        "nowhere.png": {"position_m": None, "position_sigma_m": None, "utc": EARLIER},
        "farside.png": {"position_m": -pose.position_m},
        "night.png": {"sun_body": -sun},
    }
    frames = [good_frame("first.png", taken)]
    frames += [good_frame(name, taken, **changes.get(name, {})) for name in BAD]
    frames += [good_frame("last.png", taken)]
    place = folder_with(tmp_path_factory.mktemp("pictures"), rough_world, frames)
    counts = picture.astype(np.uint8)
    for name in ("first", "last", "short", "turned", "unturned", "nowhere", "farside", "night"):
        cv2.imwrite(str(place / f"{name}.png"), counts)
    whole = (place / "short.png").read_bytes()
    (place / "short.png").write_bytes(whole[: len(whole) // 2])
    (place / "empty.png").write_bytes(b"")
    cv2.imwrite(str(place / "small.png"), counts[:, :256])
    cv2.imwrite(str(place / "black.png"), np.zeros_like(counts))
    cv2.imwrite(str(place / "white.png"), np.full_like(counts, 255))
    noise = np.random.default_rng(8).integers(0, 256, counts.shape, dtype=np.uint8)
    cv2.imwrite(str(place / "noise.png"), noise)
    lines = (place / "frames.csv").read_text().splitlines()
    for k, line in enumerate(lines):
        if line.startswith("turned.png,"):
            cells = line.split(",")
            cells[3:7] = ["0", "0", "0", "0"]
            lines[k] = ",".join(cells)
    (place / "frames.csv").write_text("\n".join(lines) + "\n")
    return place


@pytest.fixture(scope="session")
def mixed_run(mixed, catalog_path, tmp_path_factory):
    run = tmp_path_factory.mktemp("runs") / "run"
    return navigated(mixed, run, catalog_path), run


def test_every_frame_has_its_row_in_the_order_of_the_folder(mixed_run):
    solutions, run = mixed_run
    wanted = ["first.png", *BAD, "last.png"]
    assert [solution.file for solution in solutions] == wanted
    assert [row["file"] for row in rows_of(run / "solution.csv")] == wanted


@pytest.mark.parametrize("name", list(BAD))
def test_a_frame_that_cannot_be_used_says_why(mixed_run, name):
    _, run = mixed_run
    (row,) = [row for row in rows_of(run / "solution.csv") if row["file"] == name]
    assert row["status"] == "unsolved"
    assert BAD[name] in row["reason"]
    assert "/" not in row["reason"]  # nor where the folder lies
    for column in ("x_m", "cov_xx_m2", "qw", "lat_deg", "residual_rms_px"):
        assert row[column] == ""


def test_the_frames_before_and_after_the_bad_ones_are_solved(mixed_run, taken):
    _, pose, _ = taken
    solutions, _ = mixed_run
    assert solutions[0].solved
    assert solutions[-1].solved
    for solution in (solutions[0], solutions[-1]):
        error = solution.position_m - pose.position_m
        assert error @ np.linalg.solve(solution.covariance_m2, error) < 16.0
        assert solution.residual_rms_px < 0.2
        assert solution.n_predicted >= solution.n_matched >= solution.n_used >= 10
    assert np.array_equal(solutions[0].position_m, solutions[-1].position_m)


def test_matches_are_written_for_the_frames_that_were_searched(mixed_run):
    solutions, run = mixed_run
    rows = rows_of(run / "matches.csv")
    used = [row for row in rows if row["file"] == "first.png" and row["used"] == "1"]
    assert len(used) == solutions[0].n_used
    noise = [row for row in rows if row["file"] == "noise.png"]
    assert noise
    assert all(row["used"] == "0" for row in noise)
    assert not [row for row in rows if row["file"] == "missing.png"]


def test_matches_say_where_the_prior_expected_them(mixed_run, rough_world, taken):
    (solution, *_), run = mixed_run
    turn = taken[1].camera_from_body.as_matrix()
    prior = taken[1].position_m + [400.0, -700.0, 500.0]
    np.testing.assert_allclose(solution.prior_m, prior)
    used = [m for m in read_matches(run / "matches.csv") if m.file == "first.png" and m.used]
    for match in used:
        expected = rough_world.camera.project_from_body(match.cp_position_m, prior, turn)
        np.testing.assert_allclose(match.prior_px, expected, atol=1e-3)
        # 1 km of prior error at 100 km of height are some ten pixels, and the solution's are not
        assert np.linalg.norm(match.measured_px - match.prior_px) > 3.0
        assert np.linalg.norm(match.measured_px - match.predicted_px) < 1.0


def test_the_recording_says_what_the_run_was_made_from(mixed_run):
    with (mixed_run[1] / "run.mcap").open("rb") as file:
        (record,) = make_reader(file).iter_metadata()
    assert record.metadata["command"] == "navigate"
    assert record.metadata["body"] == "moon"
    assert sum(key.startswith("catalog ") for key in record.metadata) == 1


def test_found_points_are_those_that_were_matched_also_in_a_refused_frame(mixed_run):
    _, run = mixed_run
    rows = rows_of(run / "matches.csv")
    for frame in rows_of(run / "solution.csv"):
        tried = [row for row in rows if row["file"] == frame["file"]]
        found = [row for row in tried if row["measured_x_px"]]
        used = [row for row in tried if row["used"] == "1"]
        if frame["n_predicted"]:
            counts = len(tried), len(found), len(used)
            assert counts == tuple(int(frame[f"n_{n}"]) for n in ("predicted", "matched", "used"))
        assert {row["reason_code"] for row in used} <= {""}
        lost = {row["reason_code"] for row in tried if not row["measured_x_px"]}
        assert lost <= {"low_score", "rival", "search_border", "in_shadow", "outside_frame"}
    assert [row for row in rows if row["file"] == "noise.png" and row["reason_code"] == "low_score"]


def test_the_run_folder_is_whole(mixed_run):
    _, run = mixed_run
    for name in ("run.toml", "frames.csv", "manifest.json", "run.mcap", "cameras/cam.toml"):
        assert (run / name).is_file()
    assert (run / "overlays").is_dir()


def test_the_same_folder_gives_the_same_bytes(mixed, mixed_run, catalog_path, tmp_path):
    _, run = mixed_run
    again = tmp_path / "again"
    navigated(mixed, again, catalog_path)
    for name in ("solution.csv", "matches.csv", "run.mcap"):
        assert (again / name).read_bytes() == (run / name).read_bytes()


FAULTS = {
    "linalg.png": np.linalg.LinAlgError("Singular matrix"),
    "overflow.png": OverflowError("cannot convert float infinity to integer"),
    "value.png": ValueError("array must not contain infs or NaNs"),
    "cv.png": cv2.error("Insufficient memory"),
    "memory.png": MemoryError(),
    "disk.png": OSError("Input/output error"),
}


def test_whatever_fails_in_a_frame_is_its_row_alone(
    mixed, rough_world, taken, catalog_path, tmp_path, monkeypatch, caplog
):
    hostile = [
        good_frame("huge.png", taken, position_m=np.full(3, 1e200)),
        good_frame("late.png", taken, utc="9999-12-31T23:59:59Z", tdb_s=2.5e11),
        good_frame("n" * 248 + ".png", taken),
        good_frame("n" * 300 + ".png", taken),
    ]
    frames = [*hostile, *(good_frame(name, taken) for name in (*FAULTS, "last.png"))]
    pictures = folder_with(tmp_path / "pictures", rough_world, frames)
    for frame in frames:
        if len(frame.file) < 256:
            shutil.copy(mixed / "first.png", pictures / frame.file)
    navigate = control_points.navigate

    def failing(observation, *others):
        if observation.file in FAULTS:
            raise FAULTS[observation.file]
        return navigate(observation, *others)

    monkeypatch.setattr(control_points, "navigate", failing)
    with caplog.at_level(logging.DEBUG):
        solutions = navigate_folder(
            RunInputs(pictures, [catalog_path], SETTINGS), tmp_path / "run", SilentProgress()
        )
    rows = {row.file: row for row in solutions}
    assert rows["last.png"].solved
    assert rows["n" * 248 + ".png"].solved
    assert rows["huge.png"].reason_code == ReasonCode.BAD_FRAME
    assert rows["n" * 300 + ".png"].reason_code == ReasonCode.BAD_FRAME
    for name, error in FAULTS.items():
        assert (rows[name].status, rows[name].reason_code) == ("unsolved", "numerical_failure")
        assert f"({type(error).__name__}" in rows[name].reason
    assert "raise FAULTS" in caplog.text  # the traceback, among the details
    shown = [path.name for path in (tmp_path / "run" / "overlays").iterdir()]
    assert len(shown) == len(frames) - 2


def test_a_frame_that_cannot_be_drawn_is_solved_all_the_same(
    mixed, rough_world, taken, catalog_path, tmp_path, monkeypatch, caplog
):
    names = ("first.png", "last.png")
    frames = [good_frame(name, taken) for name in names]
    pictures = folder_with(tmp_path / "pictures", rough_world, frames)
    for name in names:
        shutil.copy(mixed / "first.png", pictures / name)
    draw = overlay.draw_overlay

    def failing(picture, solution, *others, **more):
        if solution.file == "first.png":
            raise cv2.error("no such colour")
        return draw(picture, solution, *others, **more)

    monkeypatch.setattr(overlay, "draw_overlay", failing)
    solutions = navigate_folder(
        RunInputs(pictures, [catalog_path], SETTINGS), tmp_path / "run", SilentProgress()
    )
    assert [row.solved for row in solutions] == [True, True]
    assert "first.png: cannot be drawn (error: no such colour)" in caplog.text
    shown = [path.name for path in (tmp_path / "run" / "overlays").iterdir()]
    assert shown == ["last.png.png"]


def test_when_no_frame_is_solved_the_folder_is_written_and_then_said(
    rough_world, taken, catalog_path, tmp_path
):
    frames = [good_frame("a.png", taken), good_frame("b.png", taken)]
    pictures = folder_with(tmp_path / "pictures", rough_world, frames)
    run = tmp_path / "run"
    with pytest.raises(NothingToDoError, match=r"none of 2 frames was solved.*no such picture"):
        navigated(pictures, run, catalog_path)
    rows = rows_of(tmp_path / "run" / "solution.csv")
    assert [row["status"] for row in rows] == ["unsolved", "unsolved"]


def test_a_damaged_control_point_is_skipped_with_a_warning(
    mixed, rough_world, taken, catalog_path, tmp_path, monkeypatch, caplog
):
    pictures = folder_with(tmp_path / "pictures", rough_world, [good_frame("first.png", taken)])
    shutil.copy(mixed / "first.png", pictures / "first.png")
    bad = rough_world.control_points[len(rough_world.control_points) // 2][0].id
    whole = Catalog.patches

    def patches(self, point_id):
        if point_id == bad:
            raise DataError(f"control point {point_id} is damaged")
        return whole(self, point_id)

    monkeypatch.setattr(Catalog, "patches", patches)
    with caplog.at_level(logging.WARNING):
        (solution,) = navigate_folder(
            RunInputs(pictures, [catalog_path], SETTINGS), tmp_path / "run", SilentProgress()
        )
    assert solution.solved
    assert f"control point {bad} is left out" in caplog.text
    rows = rows_of(tmp_path / "run" / "matches.csv")
    (row,) = [row for row in rows if row["id"] == str(bad)]
    assert "damaged" in row["reason"]


def test_a_catalog_of_another_body_is_refused(mixed, rough_world, tmp_path):
    path = tmp_path / "phobos.gpkg"
    write_rough(rough_world, path, "phobos")
    with Catalog.open(path) as catalog, pytest.raises(DataError, match="is a catalog of phobos"):
        open_field([catalog], read_folder(mixed).body)
    with pytest.raises(DataError):
        navigated(mixed, tmp_path / "run", path)
    assert not (tmp_path / "run").exists()


def test_a_catalog_without_usable_points_is_refused(mixed, rough_world, tmp_path):
    path = tmp_path / "unusable.gpkg"
    world = replace(rough_world)
    world.control_points = [
        (replace(point, usable=False), patches) for point, patches in rough_world.control_points
    ]
    write_rough(world, path, "moon")
    with Catalog.open(path) as catalog, pytest.raises(DataError, match=r"none of its .* usable"):
        open_field([catalog], read_folder(mixed).body)


def star_folder(place, world, taken, kernels):
    """One good picture whose attitude is written against the stars as kernels have it."""
    _, pose, _ = taken
    moon, utc = load_body("moon"), "2004-05-01T12:00:00Z"
    tdb_s = utc_to_tdb_s(utc)
    by_kernels, by_theory = (
        motion.body_from_inertial(tdb_s)
        for motion in (SpiceEphemeris(moon, kernels), AnalyticEphemeris(moon))
    )
    turned = pose.camera_from_body * Rotation.from_matrix(by_kernels @ by_theory.T)
    frame = good_frame("a.png", taken, utc=utc, tdb_s=tdb_s, camera_from_body=turned)
    write_folder(place, RunSettings("moon", "camera_from_inertial"), [world.camera], [frame])
    cv2.imwrite(str(place / "a.png"), taken[0])
    return place


def test_the_kernels_of_the_config_turn_the_body_and_the_log_says_so(
    rough_world, taken, catalog_path, kernels, tmp_path, caplog
):
    """The camera's own attitude comes back through the kernels; by theory it is metres off."""
    pictures = star_folder(tmp_path / "pictures", rough_world, taken, kernels)
    (tmp_path / "kernels").symlink_to(kernels[0].parent)
    config = tmp_path / "navigate.toml"
    names = ", ".join(f'"kernels/{kernel.name}"' for kernel in kernels)
    config.write_text(f"[match]\ntemplate_nodes = 48\n[spice]\nkernels = [{names}]\n")
    for settings, word, apart_m in (
        (load_settings(config), "SPICE", 0.0),
        (SETTINGS, "theory", 0.2),
    ):
        run = tmp_path / word
        caplog.clear()
        with caplog.at_level(logging.INFO):
            (solution,) = navigate_folder(
                RunInputs(pictures, [catalog_path], settings), run, SilentProgress()
            )
        assert f"rotation of the moon and its Sun by {word}" in caplog.text.replace("analytic ", "")
        assert word in json.loads((run / "manifest.json").read_text())["inputs"]["motion"]
        turned = (solution.camera_from_body * taken[1].camera_from_body.inv()).magnitude()
        assert apart_m <= turned * rough_world.radius_m
        assert turned < 4.0 * solution.attitude_sigma_rad + 1e-12
        error = solution.position_m - taken[1].position_m
        assert error @ np.linalg.solve(solution.covariance_m2, error) < 16.0


def test_a_kernel_that_is_not_there_ends_the_run_before_it_begins(mixed, catalog_path, tmp_path):
    config = tmp_path / "navigate.toml"
    config.write_text('[spice]\nkernels = ["nothing.bsp"]\n')
    with pytest.raises(DataError, match=r"nothing\.bsp: there is no such SPICE kernel"):
        navigate_folder(
            RunInputs(mixed, [catalog_path], load_settings(config)),
            tmp_path / "run",
            SilentProgress(),
        )
    assert not (tmp_path / "run").exists()


@pytest.fixture(scope="session")
def passing_orbit(taken, tmp_path_factory):
    """An orbit that passes the picture's place at its time, fitted to half an hour of fixes."""
    _, pose, _ = taken
    motion, middle = AnalyticEphemeris(load_body("moon")), utc_to_tdb_s(UTC)
    place = motion.body_from_inertial(middle).T @ pose.position_m
    forward = np.cross([0.0, 0.0, 1.0], place)
    speed = np.sqrt(motion.body.gm_m3_s2 / np.linalg.norm(place))
    state = np.concatenate([place, speed * forward / np.linalg.norm(forward)])
    times = middle + np.linspace(-900.0, 900.0, 10)
    states, _ = OrbitMotion(Forces(motion)).propagate(state, middle, times)
    folder = tmp_path_factory.mktemp("orbit")
    run = write_fixes(folder / "run", fixes_of(times, states))
    settings = OrbitFitSettings(
        forces=ForcesSettings(degree=2), noise=NoiseSettings("white", 1e-12)
    )
    fit_runs([run], folder / "orbit", settings)
    return folder / "orbit"


def test_an_orbit_is_the_prior_of_a_frame_without_one(
    passing_orbit, rough_world, taken, catalog_path, tmp_path
):
    picture, pose, _ = taken
    open_frame = {"position_m": None, "position_sigma_m": None}
    frames = [good_frame("open.png", taken, **open_frame), good_frame("stated.png", taken)]
    pictures = folder_with(tmp_path / "pictures", rough_world, frames)
    for frame in frames:
        cv2.imwrite(str(pictures / frame.file), picture.astype(np.uint8))
    (alone, _) = navigated(pictures, tmp_path / "alone", catalog_path)
    given = RunInputs(pictures, [catalog_path], SETTINGS, orbit=passing_orbit)
    led, stated = navigate_folder(given, tmp_path / "led", SilentProgress())
    # without it this picture, full of ground, has no prior: the twin's comes after it
    assert alone.prior != "orbit"
    assert (led.prior, stated.prior) == ("orbit", "frames.csv")
    assert led.solved
    assert np.linalg.norm(led.position_m - pose.position_m) < 100.0
    inputs = json.loads((tmp_path / "led" / "manifest.json").read_text())["inputs"]
    assert set(inputs["orbit"]) == {"path", "files_sha256"}
    assert read_run(tmp_path / "led").solutions[0].prior == "orbit"


def test_an_orbit_that_leads_elsewhere_leaves_a_frame_to_the_other_ways(
    passing_orbit, rough_world, taken, catalog_path, tmp_path
):
    picture, _, _ = taken
    frame = good_frame("open.png", taken, position_m=None, position_sigma_m=None, utc=EARLIER)
    pictures = folder_with(tmp_path / "pictures", rough_world, [frame])
    cv2.imwrite(str(pictures / "open.png"), picture.astype(np.uint8))
    given = RunInputs(pictures, [catalog_path], SETTINGS, orbit=passing_orbit)
    with pytest.raises(NothingToDoError, match="no prior: no limb in view"):
        navigate_folder(given, tmp_path / "run", SilentProgress())


def test_an_orbit_about_another_body_is_refused(passing_orbit, mixed, catalog_path, tmp_path):
    other = tmp_path / "orbit"
    shutil.copytree(passing_orbit, other)
    text = (other / "run.toml").read_text().replace('"moon"', '"mars"')
    (other / "run.toml").write_text(text)
    given = RunInputs(mixed, [catalog_path], SETTINGS, orbit=other)
    with pytest.raises(DataError, match="is an orbit about mars; the pictures show moon"):
        navigate_folder(given, tmp_path / "run", SilentProgress())
