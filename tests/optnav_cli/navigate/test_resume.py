"""A run that is stopped, in whatever way, goes on; workers and clusters change no byte."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import OutputError
from catalog.geometry.latlon import latlon_from_xyz
from catalog.progress import SilentProgress
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.frames.folder import write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.navigate import worker as frame_worker
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import FrameWorker, RunInputs
from tests.catalog.jobs.dask_cluster import cluster_of, needs_distributed
from tests.catalog.pipeline.killing import wait_for_the_end_of
from tests.optnav_cli.navigate.test_job import write_rough

MOON = load_body("moon")
MOTION = AnalyticEphemeris(MOON)
START_S = utc_to_tdb_s("2024-05-01T12:00:00Z")
# by file: seconds since the start, and where the prior comes from
FRAMES = {
    "a.png": (0.0, "frames.csv"),
    "a2.png": (0.0, "cam camera, a.png"),
    "b.png": (5.0, "frames.csv"),
    "c.png": (10.0, "arc of 2 fixes"),
    "dark.png": (12.0, ""),
    "d.png": (15.0, "arc of 3 fixes"),
    "wrong.png": (18.0, "frames.csv"),
    "e.png": (20.0, "frames.csv"),
}


def flown(world, seconds):
    """The pose on a circular orbit over the ground, looking down."""
    begun = world.pose(100e3)
    inertial = MOTION.body_from_inertial(START_S).T @ begun.position_m
    east = np.cross([0.0, 0.0, 1.0], inertial)
    speed = np.sqrt(MOON.gm_m3_s2 / np.linalg.norm(inertial))
    state = np.concatenate([inertial, speed * east / np.linalg.norm(east)])
    time_s = START_S + seconds
    states, _ = OrbitMotion(Forces(MOTION)).propagate(state, START_S, np.array([time_s]))
    lat, lon, radius = latlon_from_xyz(MOTION.body_from_inertial(time_s) @ states[0, :3])
    return world.pose(float(radius) - world.radius_m, lat=float(lat), lon=float(lon))


@pytest.fixture(scope="module")
def flight(rough_world, tmp_path_factory):
    """A folder with priors, without them, with two cameras at one time, and a bad picture."""
    place = tmp_path_factory.mktemp("flight")
    sun = rough_world.sun(30.0, 200.0)
    tele = replace(rough_world.camera, name="tele", focal_length_px=1300.0)
    narrow = replace(rough_world, camera=tele)
    narrow.__dict__["heights"] = rough_world.heights
    frames = []
    (place / "pictures").mkdir()
    for seed, (name, (seconds, prior)) in enumerate(FRAMES.items()):
        world = narrow if name == "a2.png" else rough_world
        pose = flown(world, seconds)
        picture = world.picture(pose, sun, noise_seed=seed).astype(np.uint8)
        known = {}
        if prior == "frames.csv":
            off = [9e3, -8e3, 9e3] if name == "wrong.png" else [400.0, -700.0, 500.0]
            known = {"position_m": pose.position_m + off, "position_sigma_m": 1000.0}
        cv2.imwrite(str(place / "pictures" / name), picture * (name != "dark.png"))
        time_s = START_S + seconds
        frame = Frame(
            name, utc_from_tdb_s(time_s, 3), world.camera.name, time_s, pose.camera_from_body, 0.0,
            sun_body=sun, **known,
        )  # fmt: skip
        frames.append(frame)
    cameras = [rough_world.camera, tele]
    # the order of the file is not that of time
    write_folder(place / "pictures", RunSettings("moon", "camera_from_body"), cameras, frames[::-1])
    write_rough(rough_world, place / "rough.gpkg", "moon")
    return RunInputs(place / "pictures", [place / "rough.gpkg"])


@pytest.fixture(scope="module")
def undisturbed(flight, tmp_path_factory):
    """The bytes of a run by one process that nobody stops."""
    run = tmp_path_factory.mktemp("undisturbed") / "run"
    solutions = navigate_folder(flight, run, SilentProgress())
    assert {row.file: row.prior for row in solutions} == {k: v[1] for k, v in FRAMES.items()}
    assert {row.file for row in solutions if not row.solved} == {"dark.png", "wrong.png"}
    assert [path.name for path in run.parent.iterdir()] == ["run"]
    return files_of(run)


def files_of(run):
    """The bytes of each file of a run, but for the times and paths of its manifest."""
    paths = sorted(path for path in run.rglob("*") if path.is_file())
    found = {str(path.relative_to(run)): path.read_bytes() for path in paths}
    found.pop("manifest.json")
    assert {"solution.csv", "matches.csv", "run.mcap", "overlays/a.png.png"} < set(found)
    return found


class Stopping:
    """Progress that interrupts the command once so many frames are done."""

    def __init__(self, after):
        self.after, self.done, self.kept = after, 0, 0

    @contextmanager
    def stage(self, *_):
        yield self

    def keep(self, n):
        self.kept += n

    def advance(self, n=1, note=""):
        self.done += n
        if self.done == self.after:
            raise KeyboardInterrupt


def test_a_run_stopped_after_each_frame_gives_the_same_bytes(flight, undisturbed, tmp_path):
    run, kept = tmp_path / "run", 0
    while not run.exists():
        progress = Stopping(1)
        try:
            navigate_folder(flight, run, progress)
        except KeyboardInterrupt:
            assert [path.name for path in tmp_path.iterdir()] == ["run.work"]
        assert progress.kept == kept
        kept += progress.done
    assert kept == len(FRAMES)
    assert files_of(run) == undisturbed
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_two_workers_give_the_same_bytes(flight, undisturbed, tmp_path):
    navigate_folder(flight, tmp_path / "run", SilentProgress(), workers=2)
    assert files_of(tmp_path / "run") == undisturbed


@needs_distributed
def test_a_cluster_gives_the_same_bytes(flight, undisturbed, tmp_path):
    (tmp_path / "cluster").mkdir()
    with cluster_of(tmp_path / "cluster", os.pathsep.join(sys.path), 1) as cluster:
        run = tmp_path / "run"
        navigate_folder(flight, run, SilentProgress(), scheduler=cluster.address)
    assert files_of(tmp_path / "run") == undisturbed


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_a_killed_command_goes_on_where_it_was(flight, undisturbed, tmp_path):
    command = [
        sys.executable, "-m", "optnav_cli.main", "navigate", str(flight.pictures),
        "--catalog", str(flight.catalogs[0]), "-o", "run", "--workers", "2",
    ]  # fmt: skip
    with subprocess.Popen(
        command, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        while not list(tmp_path.glob("run.work/*/*.bin")) and process.poll() is None:
            time.sleep(0.01)
        process.kill()
        process.communicate(timeout=20)
    wait_for_the_end_of(process.pid, 10.0)
    assert process.returncode == -signal.SIGKILL
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "done before" in done.stderr
    assert files_of(tmp_path / "run") == undisturbed


@pytest.mark.parametrize("change", ["picture", "frames.csv", "camera", "catalog", "settings"])
def test_a_changed_input_starts_anew(change, flight, tmp_path):
    pictures = tmp_path / "pictures"
    catalog = tmp_path / "rough.gpkg"
    subprocess.run(["cp", "-r", str(flight.pictures), str(pictures)], check=True)
    subprocess.run(["cp", str(flight.catalogs[0]), str(catalog)], check=True)
    given, run = RunInputs(pictures, [catalog]), tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        navigate_folder(given, run, Stopping(2))
    paths = {
        "picture": pictures / "e.png",
        "frames.csv": pictures / "frames.csv",
        "camera": pictures / "cameras" / "cam.toml",
    }
    if change == "settings":
        given = replace(given, matcher="surf")
    elif change == "catalog":
        os.utime(catalog, ns=(0, 0))
    else:
        path = paths[change]
        path.write_bytes(path.read_bytes() + b"\n")
    progress = Stopping(1)
    with pytest.raises(KeyboardInterrupt):
        navigate_folder(given, run, progress)
    assert progress.kept == 0


def test_a_finished_run_is_left_alone_until_a_file_of_it_is_damaged(flight, tmp_path, monkeypatch):
    run = tmp_path / "run"
    first = navigate_folder(flight, run, SilentProgress())
    before = (run / "manifest.json").stat()
    monkeypatch.setattr(FrameWorker, "look", lambda *_: pytest.fail("worked"))
    again = navigate_folder(flight, run, SilentProgress())
    assert [row.file for row in again] == [row.file for row in first]
    assert os.path.samestat((run / "manifest.json").stat(), before)
    (run / "overlays" / "a.png.png").write_bytes(b"")
    with pytest.raises(pytest.fail.Exception):
        navigate_folder(flight, run, SilentProgress())


def test_a_damaged_piece_is_done_again(flight, undisturbed, tmp_path):
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        navigate_folder(flight, run, Stopping(4))
    piece = sorted(tmp_path.glob("run.work/navigate-*/*.bin"))[1]
    data = bytearray(piece.read_bytes())
    data[len(data) // 2] ^= 1
    piece.write_bytes(data)
    progress = Stopping(99)
    navigate_folder(flight, run, progress)
    assert files_of(run) == undisturbed
    assert progress.kept < 4


def test_a_foreign_folder_in_the_place_of_the_output_is_refused_before_any_work(flight, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match="not empty"):
        navigate_folder(flight, tmp_path / "run", SilentProgress())
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_what_workers_say_ahead_of_time_is_mostly_final(flight, monkeypatch, tmp_path):
    """Frames with priors are never solved twice; those from the arc once, after the others."""
    asked = []
    navigate = frame_worker.Navigator.solve

    def noted(self, frame, *others):
        asked.append(frame.file)
        return navigate(self, frame, *others)

    solved = []
    points = frame_worker.FrameWorker._record

    def drawn(self, frame, answers, row, **how):
        solved.append((frame.file, row is not None))
        return points(self, frame, answers, row, **how)

    monkeypatch.setattr(frame_worker.Navigator, "solve", noted)
    monkeypatch.setattr(frame_worker.FrameWorker, "_record", drawn)
    navigate_folder(flight, tmp_path / "run", SilentProgress())
    assert solved == [
        ("a.png", True), ("a2.png", False), ("a2.png", True), ("b.png", True), ("c.png", False),
        ("c.png", True), ("dark.png", True), ("d.png", False), ("d.png", True), ("wrong.png", True),
        ("e.png", True),
    ]  # fmt: skip
