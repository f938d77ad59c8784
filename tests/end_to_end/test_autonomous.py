"""Pictures of a smooth Moon without priors through `navigate`: positions, and reasons for the rest.

The catalog's points lie elsewhere, so that the limb alone must tell; the sphere is drawn exactly.
"""

import csv

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.progress import SilentProgress
from catalog.store.manifest import CatalogMeta
from optnav_cli.camera.camera import Camera
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.frames.folder import write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from tests.catalog.store.written import write_points
from tests.optnav_cli.conftest import RoughWorld, pixel_grid

MOON = load_body("moon")
MOTION = AnalyticEphemeris(MOON)
WIDE = Camera("wide", "equidistant", 400, 400, 120.0, (199.5, 199.5))
START_S = utc_to_tdb_s("2026-02-01T00:00:00Z")
NIGHT = np.zeros((400, 400), dtype=np.float32)
ARCSEC = np.pi / 648000.0


def picture(position, turn, sun, seed):
    """The lit sphere by 3 x 3 exact rays a pixel, blurred, with noise; 8 bits."""
    offset = (np.arange(3) + 0.5) / 3.0 - 0.5
    total = np.zeros((400, 400))
    grid = pixel_grid(WIDE)
    for dx in offset:
        for dy in offset:
            rays = WIDE.unproject(grid + [dx, dy]) @ turn.as_matrix()
            along = rays @ position
            inside = along**2 - position @ position + MOON.radius_m**2
            hit = (inside > 0.0) & (along < 0.0)
            reach = -along - np.sqrt(np.where(hit, inside, 0.0))
            normal = (position + rays * reach[..., None]) / MOON.radius_m
            mu0 = np.maximum(normal @ sun, 0.0)
            mu = np.maximum(-np.einsum("ijk,ijk->ij", normal, rays), 1e-6)
            total += np.where(hit, mu0 / (mu0 + mu), 0.0) / 9.0
    return counts(total * 200.0, seed)


def counts(light, seed):
    blurred = cv2.GaussianBlur(np.asarray(light, dtype=np.float32), (0, 0), 0.7)
    noise = np.random.default_rng(seed).normal(0.0, 1.0, blurred.shape)
    return np.clip(np.rint(blurred + 8.0 + noise), 0, 255).astype(np.uint8)


def stars(seed):
    rng = np.random.default_rng(seed)
    light = NIGHT.copy()
    light[rng.integers(5, 395, 60), rng.integers(5, 395, 60)] = rng.uniform(100.0, 900.0, 60)
    return counts(light, seed)


def poses(times):
    """Body-fixed positions of an orbit at 200 km, by day, and attitudes about nadir."""
    radius = MOON.radius_m + 200e3
    sun = MOTION.sun_inertial(START_S)
    side = np.cross(sun, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    speed = np.sqrt(MOON.gm_m3_s2 / radius)
    start = np.concatenate([radius * sun, speed * side])
    # 20 degrees of arc past noon at the middle of the pictures
    states, _ = OrbitMotion(Forces(MOTION)).propagate(start, START_S - 430.0, START_S + times)
    for t, state in zip(START_S + times, states, strict=True):
        position = MOTION.body_from_inertial(t) @ state[:3]
        down = -position / np.linalg.norm(position)
        x = np.cross(down, [0.2, 0.9, 0.3])
        x /= np.linalg.norm(x)
        yield position, Rotation.from_matrix(np.stack([x, np.cross(down, x), down]))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Rows by file, and the true positions."""
    place = tmp_path_factory.mktemp("smooth")
    times = {"a.png": 0.0, "stars.png": 20.0, "b.png": 40.0, "dark.png": 60.0, "c.png": 80.0}
    times |= {"inverse.png": 100.0, "d.png": 120.0, "burnt.png": 140.0, "cut.png": 160.0}
    frames, truths = [], {}
    (place / "pictures").mkdir()
    found = poses(np.array(list(times.values())))
    for seed, ((name, after), (position, turn)) in enumerate(
        zip(times.items(), found, strict=True)
    ):
        sun = MOTION.sun_body(START_S + after)
        if name == "cut.png":  # half of the body leaves the picture
            turn = Rotation.from_rotvec([0.9, 0.2, 0.0]) * turn
        if name not in ("stars.png", "dark.png"):
            shown = picture(position, turn, sun, seed)
            if name == "burnt.png":
                shown = np.clip((shown.astype(np.int64) - 8) * 20 + 8, 0, 255).astype(np.uint8)
        else:
            shown = stars(seed) if name == "stars.png" else counts(NIGHT, seed)
        cv2.imwrite(str(place / "pictures" / name), shown)
        truths[name] = position
        told = turn
        if name == "inverse.png":
            space = Rotation.from_matrix(MOTION.body_from_inertial(START_S + after))
            told = (turn * space).inv() * space.inv()
        utc = utc_from_tdb_s(START_S + after)
        frames.append(Frame(name, utc, "wide", utc_to_tdb_s(utc), told, 10.0 * ARCSEC))
    # the order of the file is not that of time
    settings = RunSettings("moon", "camera_from_inertial")
    write_folder(place / "pictures", settings, [WIDE], frames[::-1])
    world = RoughWorld(seed=1, levels=5)
    meta = CatalogMeta("moon", MOON.radius_m, world.cell_deg, 5, world.nodes, 120.0, 0.5)
    write_points(place / "rough.gpkg", meta, world.control_points[:9])
    given = RunInputs(place / "pictures", [place / "rough.gpkg"])
    navigate_folder(given, place / "run", SilentProgress())
    with (place / "run" / "solution.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["file"] for row in rows] == list(times)[::-1]
    return {row["file"]: row for row in rows}, truths


def normalised_square(row, truth):
    """The error of a row, squared, over its covariance."""
    error = np.array([float(row[k]) for k in ("x_m", "y_m", "z_m")]) - truth
    xx, xy, xz, yy, yz, zz = (
        float(row[f"cov_{k}_m2"]) for k in ("xx", "xy", "xz", "yy", "yz", "zz")
    )
    return error @ np.linalg.solve([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], error)


@pytest.mark.parametrize("name", ["a.png", "b.png", "c.png", "d.png"])
def test_the_limb_gives_a_position_inside_its_covariance(run, name):
    rows, truths = run
    row = rows[name]
    assert (row["status"], row["method"]) == ("solved", "horizon_sphere"), row["reason"]
    assert normalised_square(row, truths[name]) < 16.0
    assert int(row["n_limb"]) > 100
    assert float(row["arc_deg"]) > 120.0
    assert "no control point of the catalog in the frame" in row["reason"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("stars.png", "stars"),
        ("dark.png", "no body in the picture"),
        ("inverse.png", "the picture fits the inverse rotation"),
        ("burnt.png", "saturated"),
    ],
)
def test_a_picture_without_a_limb_says_what_it_shows(run, name, words):
    row = run[0][name]
    assert row["status"] == "unsolved"
    assert words in row["reason"]
    assert row["x_m"] == row["cov_xx_m2"] == ""


def test_a_body_cut_by_the_frame_is_right_or_refused_with_its_reason(run):
    rows, truths = run
    row = rows["cut.png"]
    if row["status"] == "solved":
        assert normalised_square(row, truths["cut.png"]) < 25.0
    else:
        assert any(word in row["reason"] for word in ("limb", "cuts", "horizon")), row["reason"]
