"""An orbit, a lens and a clock from a folder of picked points, and the times of its pictures."""

import csv

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.geometry.latlon import latlon_from_xyz
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml, load_camera
from optnav_cli.main import run
from optnav_cli.orbit.fit.folder import read_orbit
from tests.optnav_cli.orbit.fit.flights import EPHEMERIS, MOON, START_S, truth

LENS, STATED = 0.006, 0.009
CAMERA = Camera("tele", "pinhole", 1200, 900, 9000.0, (599.5, 449.5), focal_length_error=STATED)
CONFIG = "step_s = 600.0\n[forces]\ndegree = 2\n[noise]\ndensity_m2_s3 = 1e-12\n"
PICK_PX = 0.4


def picked(position, rng):
    """Pixels (n, 2), latitudes, longitudes and heights of points 35 deg off the nadir."""
    up = position / np.linalg.norm(position)
    side = np.cross(up, rng.normal(size=3))
    axis = Rotation.from_rotvec(np.radians(35.0) * side / np.linalg.norm(side)).apply(-up)
    right = np.cross(axis, up) / np.linalg.norm(np.cross(axis, up))
    turn = np.array([right, np.cross(axis, right), axis])
    pixels = rng.uniform([30.0, 30.0], [1170.0, 870.0], (9, 2))
    # the true lens is shorter than the camera file's
    true = (pixels - CAMERA.principal_point_px) * (1.0 + LENS) / CAMERA.focal_length_px
    rays = np.column_stack([true, np.ones(9)]) @ turn
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    radii = MOON.radius_m + rng.uniform(-1500.0, 1500.0, 9)
    along = rays @ position
    places = position + rays * (
        -along - np.sqrt(along**2 - position @ position + radii**2)
    ).reshape(-1, 1)
    lat, lon, radius = latlon_from_xyz(places)
    noisy = pixels + rng.normal(0.0, PICK_PX, (9, 2))
    return noisy, np.degrees(lat), np.degrees(lon), radius - MOON.radius_m


@pytest.fixture(scope="module")
def series(tmp_path_factory):
    """A folder of 24 pictures over three hours, its run, and the truth."""
    folder = tmp_path_factory.mktemp("picked")
    times = START_S + np.arange(0.0, 3.0 * 3600.0, 450.0)
    states, rng = truth(times), np.random.default_rng(2)
    place = folder / "pictures"
    (place / "cameras").mkdir(parents=True)
    (place / "cameras/tele.toml").write_text(camera_toml(CAMERA))
    (place / "run.toml").write_text('body = "moon"\nattitude = "camera_from_body"\n')
    frames, points = (
        ["file,utc,camera"],
        ["file,x_px,y_px,lat_deg,lon_deg,height_m,sigma_px,sigma_m"],
    )
    for number, (time, state) in enumerate(zip(times, states, strict=True)):
        frames.append(f"{number}.jpg,{utc_from_tdb_s(time)},tele")
        position = EPHEMERIS.body_from_inertial(time) @ state[:3]
        for (x, y), *where in zip(*picked(position, rng), strict=True):
            line = ",".join(f"{v:.9g}" for v in (x, y, *where, PICK_PX, 5.0))
            points.append(f"{number}.jpg,{line}")
    (place / "frames.csv").write_text("\n".join(frames) + "\n")
    (place / "points.csv").write_text("\n".join(points) + "\n")
    assert run(["navigate", str(place), "-o", str(folder / "run")]) == 0
    (folder / "orbit.toml").write_text(CONFIG)
    return folder, times, states


def fit(series, where, *words):
    folder = series[0]
    config = ["--config", str(folder / "orbit.toml")]
    return run(["orbit", "fit", str(folder / "run"), *config, *words, "-o", str(where)])


@pytest.fixture(scope="module")
def orbit(series):
    assert fit(series, series[0] / "orbit", "--solve", "focal,clock") == 0
    return series[0] / "orbit"


def test_the_lens_is_found_and_written_with_its_error(orbit):
    found = load_camera(orbit / "cameras/tele.toml")
    true = CAMERA.focal_length_px / (1.0 + LENS)
    assert found.focal_length_error < 0.05 * STATED
    off = found.focal_length_px / true - 1.0
    assert abs(off) < 4.0 * found.focal_length_error
    assert abs(off) < 5e-4


def test_a_clock_of_one_series_is_said_not_to_be_observed(series, tmp_path, capsys):
    assert fit(series, tmp_path / "orbit", "--solve", "focal,clock") == 0
    said = capsys.readouterr().err
    assert "clock is not observed" in said
    clock = next(p for p in read_orbit(tmp_path / "orbit").parameters if p.name == "clock")
    assert not clock.observed
    assert clock.sigma[0] == pytest.approx(clock.prior_sigma, rel=0.05)


def test_the_orbit_over_the_ground_is_right_all_the_same(series, orbit):
    _, times, states = series
    found = read_orbit(orbit)
    rows = [int(np.argmin(np.abs(found.rows.times - t))) for t in times]
    places, wanted = [], []
    for row, time, state in zip(rows, times, states, strict=True):
        places.append(EPHEMERIS.body_from_inertial(time) @ found.rows.states[row, :3])
        wanted.append(EPHEMERIS.body_from_inertial(time) @ state[:3])
    off = np.linalg.norm(np.array(places) - np.array(wanted), axis=1)
    height = np.linalg.norm(places, axis=1) - np.linalg.norm(wanted, axis=1)
    assert np.abs(height).max() < 60.0
    assert off.max() < 300.0


def test_without_the_lens_as_a_parameter_there_is_no_camera_file(series, tmp_path):
    assert fit(series, tmp_path / "orbit") == 0
    assert not (tmp_path / "orbit/cameras").exists()


def test_times_of_the_pictures_follow_from_the_orbit_with_all_passes(series, orbit, tmp_path):
    folder = series[0]
    out = tmp_path / "times.csv"
    assert run(["orbit", "time", str(folder / "run"), "--orbit", str(orbit), "-o", str(out)]) == 0
    with out.open() as file:
        rows = [row for row in csv.DictReader(file) if row["utc"]]
    assert len(rows) > 20
    off = [utc_to_tdb_s(r["utc"]) - utc_to_tdb_s(r["utc_stamp"]) for r in rows]
    sigmas = np.array([float(r["sigma_s"]) for r in rows])
    assert np.mean(np.abs(off) < 3.0 * sigmas) > 0.9
    assert all(r["utc"] in r["candidates"].split(";") for r in rows)
