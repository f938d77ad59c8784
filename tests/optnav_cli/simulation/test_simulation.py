"""Scenarios, flights, detector and whole runs of the simulator."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import rasterio
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import ConfigError
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.truth import read_truth
from optnav_cli.simulation.job import CylinderScenario
from optnav_cli.simulation.passes import Scenario
from optnav_cli.simulation.region_ground import RegionGround, truth_terrain
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.scenario_base import Exposure
from optnav_cli.simulation.sections import SensorSettings
from optnav_cli.simulation.sensor import expose
from tests.optnav_cli.simulation.simulated import simulate

RADIUS_M = 1_737_400.0
SMALL = """
seed = 3
detail = { seeds = [1, 2], smallest_m = 60.0 }
camera = { name = "small.toml" }
attitude = { sigma_arcsec = 10.0 }

[[dem]]
path = "tycho_gld100_256ppd.tif"

[orbit]
altitude_km = 100.0
box_deg = [-11.5, -43.5, -10.5, -42.5]
passes = 2
frames = 2
spacing_s = 2.0
"""
CAMERA = """
name = "small"
model = "pinhole"
width_px = 120
height_px = 90
focal_length_px = 600.0
principal_point_px = [59.5, 44.5]
"""


@pytest.fixture
def scenario_file(tmp_path: Path) -> Path:
    (tmp_path / "small.toml").write_text(CAMERA)
    (tmp_path / "scenario.toml").write_text(SMALL)
    return tmp_path / "scenario.toml"


@pytest.fixture
def flight(scenario_file: Path) -> tuple[Scenario, list[Exposure]]:
    scenario = load_scenario(scenario_file)
    return scenario, scenario.exposures(AnalyticEphemeris(load_body("moon")))


def test_a_misspelt_key_is_refused_with_the_right_one(scenario_file: Path):
    scenario_file.write_text(SMALL.replace("altitude_km", "altitud_km"))
    with pytest.raises(ConfigError, match="did you mean 'altitude_km'"):
        load_scenario(scenario_file)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("-43.5, -10.5, -42.5", "-42.5, -10.5, -43.5", "south"),
        ("tycho_gld100_256ppd.tif", "nowhere.tif", "nowhere.tif"),
        ("[[dem]]", "[[dem]]\nfeather_km = 5.0", "feather_km is 5; wanted 0"),
        ("seed = 3", "seed = 3\nsun = { elevation_deg = [40.0, 10.0] }", "lower one first"),
    ],
)
def test_impossible_settings_are_named(scenario_file: Path, old: str, new: str, message: str):
    scenario_file.write_text(SMALL.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        load_scenario(scenario_file)


def test_pictures_of_a_pass_lie_on_one_great_circle_at_orbital_speed(
    flight: tuple[Scenario, list[Exposure]],
):
    _, pictures = flight
    first, second = pictures[0].position_m, pictures[1].position_m
    r = RADIUS_M + 100e3
    assert np.linalg.norm(first) == pytest.approx(r, abs=1e-3)
    # GM of the Moon 4902.8 km^3/s^2: 1633.5 m/s at 100 km
    assert np.linalg.norm(second - first) == pytest.approx(2.0 * 1633.5, rel=2e-4)
    assert pictures[1].tdb_s - pictures[0].tdb_s == pytest.approx(2.0, abs=1e-6)


def test_the_camera_looks_down_with_the_top_of_the_picture_forward(
    flight: tuple[Scenario, list[Exposure]],
):
    _, pictures = flight
    rotation = pictures[0].camera_from_body
    down = -pictures[0].position_m / np.linalg.norm(pictures[0].position_m)
    np.testing.assert_allclose(rotation.apply(down), [0.0, 0.0, 1.0], atol=1e-9)
    forward = rotation.apply(pictures[1].position_m - pictures[0].position_m)
    assert forward[1] < 0.0
    assert abs(forward[0]) < 1e-6 * abs(forward[1])


def test_the_boresight_turns_where_the_settings_say(scenario_file: Path):
    scenario_file.write_text(SMALL + "\n[pointing]\nforward_deg = 10.0\nroll_deg = 90.0\n")
    shot, after = load_scenario(scenario_file).exposures(AnalyticEphemeris(load_body("moon")))[:2]
    boresight = shot.camera_from_body.inv().apply([0.0, 0.0, 1.0])
    down = -shot.position_m / np.linalg.norm(shot.position_m)
    assert np.degrees(np.arccos(boresight @ down)) == pytest.approx(10.0, abs=1e-6)
    assert boresight @ (after.position_m - shot.position_m) > 0.0


@pytest.mark.parametrize("lat_deg", [-80.0, -43.0, 0.0, 60.0])
def test_the_sun_stands_as_high_as_wanted_where_the_latitude_allows(
    scenario_file: Path, lat_deg: float
):
    box = f"[170.0, {lat_deg}, -170.0, {lat_deg}]"
    text = SMALL.replace("[-11.5, -43.5, -10.5, -42.5]", box).replace("passes = 2", "passes = 9")
    scenario_file.write_text(text.replace("frames = 2", "frames = 1"))
    pictures = load_scenario(scenario_file).exposures(AnalyticEphemeris(load_body("moon")))
    up = [s.position_m / np.linalg.norm(s.position_m) for s in pictures]
    found = np.degrees(np.arcsin([s.sun_body @ u for s, u in zip(pictures, up)]))
    highest = min(45.0, 90.0 - abs(lat_deg) + 1.5)
    assert (found < highest + 1e-6).all()
    if highest == 45.0:
        assert found.min() < 14.0
        assert found.max() > 41.0
    subsolar, _, _ = latlon_from_xyz(np.array([s.sun_body for s in pictures]))
    assert (np.abs(np.degrees(subsolar)) <= 1.5 + 1e-9).all()


def test_prior_and_attitude_errors_have_the_stated_size(scenario_file: Path):
    scenario_file.write_text(SMALL.replace("frames = 2", "frames = 400"))
    pictures = load_scenario(scenario_file).exposures(AnalyticEphemeris(load_body("moon")))
    error = np.array([s.prior_m - s.position_m for s in pictures])
    # 2400 numbers: 1.4 % of scatter
    assert error.std() == pytest.approx(3000.0, rel=0.06)
    turns = [(s.reported_camera_from_body * s.camera_from_body.inv()).as_rotvec() for s in pictures]
    assert np.degrees(np.std(turns)) * 3600.0 == pytest.approx(10.0, rel=0.06)


def test_a_clock_that_is_off_moves_priors_along_the_motion_alone(scenario_file: Path) -> None:
    text = SMALL.replace("frames = 2", "frames = 400")
    motion = AnalyticEphemeris(load_body("moon"))
    scenario_file.write_text(text)
    without = load_scenario(scenario_file).exposures(motion)
    scenario_file.write_text(text + "\n[prior]\nalong_sigma_m = 1630.0\n")
    scenario = load_scenario(scenario_file)
    shifts = [
        after.prior_m - before.prior_m
        for before, after in zip(without, scenario.exposures(motion), strict=True)
    ]
    along = np.array([shift @ s.forward for shift, s in zip(shifts, without, strict=True)])
    np.testing.assert_allclose(np.linalg.norm(shifts, axis=1), np.abs(along), rtol=1e-6)
    # 800 numbers: 2.5 % of scatter
    assert along.std() == pytest.approx(1630.0, rel=0.1)
    # a covariance alike in all directions holds as much as both errors together
    total = 3.0 * scenario.prior.component_sigma_m**2
    assert total == pytest.approx(3.0 * 3000.0**2 + 1630.0**2)


@pytest.mark.parametrize("bits", [8, 12])
def test_the_detector_has_the_stated_signal_to_noise(bits: int):
    flat = np.full((400, 400), 0.04, np.float32)
    settings = SensorSettings(bits=bits, snr=50.0)
    counts = expose(flat, settings, np.random.default_rng(1)).astype(float)
    full = 2**bits - 1
    bias = 0.01 * full
    # rounding adds 1/12 of a count squared, 0.3 % at 8 bits
    assert (counts.mean() - bias) / counts.std() == pytest.approx(50.0, rel=0.03)
    assert counts.mean() - bias == pytest.approx(0.85 * full, rel=0.01)


def test_the_blur_is_the_stated_gaussian():
    point = np.zeros((61, 61), np.float32)
    point[30, 30] = 1.0
    settings = SensorSettings(psf_sigma_px=0.7, snr=5000.0, bits=16, exposure=0.5)
    # one pixel holds the light, so the exposure's bright level is far below the peak
    counts = expose(point + 1.0, settings, np.random.default_rng(1)).astype(float)
    counts -= np.median(counts)
    x = np.arange(61) - 30.0
    spread = (counts[27:34, 27:34] * x[27:34] ** 2).sum() / counts[27:34, 27:34].sum()
    assert np.sqrt(spread) == pytest.approx(0.7, abs=0.03)


def test_times_are_exact_on_the_clock(flight: tuple[Scenario, list[Exposure]]):
    _, exposures = flight
    clock = [exposure.utc.split("T")[1] for exposure in exposures]
    assert clock == ["00:00:00.000Z", "00:00:02.000Z", "02:00:00.000Z", "02:00:02.000Z"]
    assert [utc_to_tdb_s(exposure.utc) for exposure in exposures] == [e.tdb_s for e in exposures]


def test_a_black_picture_stays_a_picture():
    black = expose(np.zeros((8, 8), np.float32), SensorSettings(), np.random.default_rng(0))
    assert black.dtype == np.uint8
    assert black.max() <= 3


def test_a_run_writes_a_folder_that_reads_back_and_the_same_bytes_again(
    scenario_file: Path, tmp_path: Path
):
    first, second = tmp_path / "first", tmp_path / "second"
    simulate(scenario_file, first)
    simulate(load_scenario(scenario_file), second, workers=1)
    folder = read_folder(first)
    assert [f.problem for f in folder.frames] == [None] * 4
    truths = read_truth(first / "truth.csv", folder.attitude)
    for frame, truth in zip(folder.frames, truths, strict=True):
        picture = load_picture(folder.picture_path(frame), folder.cameras["small"]).values
        assert picture.std() > 3.0
        assert frame.position_sigma_m == 3000.0
        assert 0.0 < np.linalg.norm(frame.position_m - truth.position_m) < 15e3
    names = sorted(p.relative_to(first) for p in first.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(second) for p in second.rglob("*") if p.is_file())
    for name in names:
        if name.name != "manifest.json":  # with its times
            assert (first / name).read_bytes() == (second / name).read_bytes(), name


def test_passes_over_different_seeds_see_different_ground(scenario_file: Path):
    scenario = load_scenario(scenario_file)
    body = load_body("moon")
    terrain = truth_terrain(scenario, body, scenario.exposures(AnalyticEphemeris(body)))
    box = (np.radians(-11.1), np.radians(-43.1), np.radians(-11.0), np.radians(-43.0))
    one, two, bare = (terrain.window(seed, 2, box).heights for seed in (1, 2, None))
    assert 0.5 < np.std(one - bare) < 5.0
    assert abs(np.corrcoef((one - bare).ravel(), (two - bare).ravel())[0, 1]) < 0.2
    # at the model's own posting nothing is added: one ground for all seeds
    assert terrain.window(1, 1, box) is terrain.window(2, 1, box)


def test_ground_between_the_model_nodes_passes_through_them_and_joins_the_globe(
    scenario_file: Path,
):
    terrain = truth_terrain(load_scenario(scenario_file), load_body("moon"), [])
    with rasterio.open(terrain._sources[0].path) as dataset:
        heights = dataset.read(1).astype(float)
    source = terrain._sources[0]
    # in the middle, and within two kilometres of the edge
    for lat, lon in np.radians([[-43.0, -11.0], [-43.0, -16.98]]):
        ground = terrain.window(None, 4, (lon, lat - 0.001, lon + 0.001, lat))
        col, row = source.pixel_from_latlon(
            ground.north - np.arange(40)[:, None] * ground.step_lat,
            ground.west + np.arange(40)[None] * ground.step_lon,
        )
        near = (np.abs(row - np.rint(row)) < 0.02) & (np.abs(col - np.rint(col)) < 0.02)
        assert near.sum() > 3
        r, c = np.rint(row[near]).astype(int), np.rint(col[near]).astype(int)
        np.testing.assert_allclose(ground.heights[:40, :40][near], heights[r, c], atol=1.0)
    west, south, _, _ = terrain.box
    edge = terrain.window(None, 2, (west, south, west + 1e-3, south + 1e-3))
    wide = terrain.wide(None)
    row = (wide.north - edge.north + np.arange(len(edge.heights)) * edge.step_lat) / wide.step_lat
    col = np.mod(edge.west - wide.west, 2 * np.pi) / wide.step_lon
    from catalog.geometry.grid import sample_bicubic

    globe = sample_bicubic(wide.heights, row, np.full(row.size, col))
    np.testing.assert_allclose(edge.heights[:, 0], globe, atol=3.0)


@pytest.mark.parametrize("model", ["pinhole", "equidistant"])
def test_a_peak_appears_where_the_camera_projects_it(tmp_path: Path, model: str):
    """A hill under four Suns, seen from straight above, off the boresight: within 0.05 px.

    From there, what the hill changes in the sum of the four pictures is the same all round its top.
    """
    step = 180.0 / np.pi * 100.0 / RADIUS_M
    size, height, sigma = 200, 60.0, 2.5
    place = np.arange(size) - (size - 1) / 2.0
    hill = height * np.exp(-(place[:, None] ** 2 + place[None] ** 2) / (2.0 * sigma**2))
    for name, heights in (("peak", hill), ("flat", 0.0 * hill)):
        profile = {
            "driver": "GTiff", "width": size, "height": size, "count": 1, "dtype": "float32",
            "crs": "+proj=longlat +R=1737400 +no_defs",
            "transform": rasterio.Affine(step, 0, -size / 2 * step, 0, -step, size / 2 * step),
        }  # fmt: skip
        with rasterio.open(tmp_path / f"{name}.tif", "w", **profile) as out:
            out.write(heights.astype(np.float32), 1)
    with rasterio.open(
        tmp_path / "globe.tif", "w", driver="GTiff", width=360, height=180, count=1,
        dtype="float32", crs="+proj=longlat +R=1737400 +no_defs",
        transform=rasterio.Affine(1.0, 0, -180.0, 0, -1.0, 90.0),
    ) as out:  # fmt: skip
        out.write(np.zeros((180, 360), np.float32), 1)
    camera = Camera("c", model, 101, 91, 500.0, (47.3, 46.1))
    (tmp_path / "small.toml").write_text(CAMERA)
    position = np.array([RADIUS_M + 60e3, 0.0, 0.0])
    forward = np.cross(position, [0.1, 0.2, 1.0])
    forward /= np.linalg.norm(forward)
    boresight = np.array([RADIUS_M, 2500.0, -1800.0]) - position
    boresight /= np.linalg.norm(boresight)
    x = np.cross(forward, boresight)
    x /= np.linalg.norm(x)
    rotation = Rotation.from_matrix(np.stack([x, np.cross(boresight, x), boresight]))
    pictures: dict[str, list[np.ndarray]] = {"peak": [], "flat": []}
    for name in pictures:
        text = SMALL.replace("tycho_gld100_256ppd.tif", f"{name}.tif")
        text = text.replace("seeds = [1, 2]", "seeds = []") + '\n[globe]\npath = "globe.tif"\n'
        (tmp_path / "s.toml").write_text(text)
        scenario = load_scenario(tmp_path / "s.toml")
        body = load_body("moon")
        for k in range(4):
            sun = xyz_from_latlon(0.7 * np.cos(k * np.pi / 2), 0.7 * np.sin(k * np.pi / 2), 1.0)
            shot = replace(
                scenario.exposures(AnalyticEphemeris(body))[0],
                index=0, position_m=position, sun_body=sun,
                camera_from_body=rotation,
            )  # fmt: skip
            ground = RegionGround(truth_terrain(scenario, body, [shot]), [camera], [shot])
            pictures[name].append(ground.radiance(camera, shot).astype(float))
    change = np.abs(sum(pictures["peak"]) - sum(pictures["flat"]))
    rows, cols = np.mgrid[:91, :101]
    found = np.array([(change * cols).sum(), (change * rows).sum()]) / change.sum()
    body_point = np.array([RADIUS_M, 0.0, 0.0])
    expected = camera.project(rotation.apply(body_point - position))
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_every_shipped_scenario_loads_and_the_template_shows_the_defaults():
    root = Path(__file__).resolve().parents[3] / "configs"
    shipped = sorted((root / "scenarios").glob("*.toml"))
    assert len(shipped) >= 6
    for path in shipped:
        scenario = load_scenario(path)
        if isinstance(scenario, CylinderScenario):  # of no body
            continue
        assert len(scenario.exposures(AnalyticEphemeris(load_body(scenario.body)))) >= 12
    template = load_scenario(root / "templates" / "scenario.toml")
    plain = Scenario(camera=template.camera, orbit=template.orbit)
    shown = msgspec.to_builtins(msgspec.structs.replace(template, dem=plain.dem, globe=plain.globe))
    assert shown == msgspec.to_builtins(plain)
