"""[truth] of a scenario: how the world differs from what a navigator knows of it."""

import cv2
import msgspec
import numpy as np
import pytest
import rasterio

from catalog.bodies.body import load_body
from catalog.errors import ConfigError, DataError
from catalog.geometry.latlon import xyz_from_latlon
from optnav_cli.simulation.albedo import Albedo
from optnav_cli.simulation.run import Simulation
from optnav_cli.simulation.scenario import load_scenario, scenario_copy
from optnav_cli.simulation.sections import AlbedoMapSettings, TruthSettings

HEAD = """
dem = [{ path = "farside_gld100_64ppd.tif" }]
detail = { seeds = [] }
camera = { name = "small.toml" }
[orbit]
altitude_km = 200.0
box_deg = [140.0, -20.0, 142.0, -18.0]
"""
SMALL = """
name = "small"
model = "pinhole"
width_px = 64
height_px = 64
focal_length_px = 1000.0
principal_point_px = [31.5, 31.5]
psf_sigma_px = 0.7
psf_error_px = 0.2
"""
EXTENT = (-180.0, -90.0, 180.0, 90.0)


def scenario(folder, truth="", head=HEAD):
    (folder / "small.toml").write_text(SMALL)
    path = folder / "scenario.toml"
    path.write_text(head + truth)
    return load_scenario(path)


def radiance(folder, truth="", head=HEAD):
    simulation = Simulation(scenario(folder, truth, head))
    return simulation._ground.radiance(simulation.cameras[0], simulation.flight[0])


GLOBE = """
dem = []
detail = { seeds = [] }
camera = { name = "small.toml" }
[orbit]
altitude_km = 2000.0
box_deg = [-12.0, -44.0, -10.0, -42.0]
"""


@pytest.mark.parametrize("head", [HEAD, GLOBE])
def test_each_setting_of_the_truth_changes_what_pictures_show(tmp_path, head):
    plain = radiance(tmp_path, head=head)
    error = "model_error = { box_km = [30.0], rms_m = [500.0] }"
    lines = [error, 'albedo = "fractal"', 'phase_law = "other"']
    for line in lines if head == GLOBE else lines[:2]:
        changed = radiance(tmp_path, f"[truth]\n{line}\n", head)
        assert np.abs(changed - plain).max() > 0.01 * plain.max()
    if head == GLOBE:
        assert np.array_equal(plain, radiance(tmp_path, "[truth]\n", head))
        assert np.array_equal(changed, radiance(tmp_path, f"[truth]\n{lines[-1]}\n", head))


def test_a_scenario_without_truth_keeps_its_copy(tmp_path):
    assert b"truth" not in scenario_copy(scenario(tmp_path))


def test_the_blur_is_off_by_what_the_camera_states_and_the_folder_states_the_nominal_one(tmp_path):
    blurs = []
    for seed in range(40):
        head = f"seed = {seed}\n{HEAD}"
        drawn = Simulation(scenario(tmp_path, '[truth]\ncamera = "drawn"\n', head))
        blurs.append(drawn._sensors[0].psf_sigma_px)
        assert drawn.scenario.sensor.psf_sigma_px == 0.7
    assert np.mean(blurs) == pytest.approx(0.7, abs=0.1)
    assert np.std(blurs) == pytest.approx(0.2, rel=0.35)


def test_a_camera_is_mounted_off_by_what_its_file_states_the_same_in_all_pictures(tmp_path):
    truth = '[truth]\ncamera = "drawn"\n'
    scenario(tmp_path)
    known = SMALL + "boresight_sigma_arcsec = 20.0\n"
    (tmp_path / "known.toml").write_text(known)
    head = HEAD.replace("small.toml", "known.toml") + "frames = 3\n"
    turns = []
    for seed in range(30):
        flight = Simulation(scenario(tmp_path, truth, f"seed = {seed}\n{head}")).flight
        off = [e.reported_camera_from_body * e.camera_from_body.inv() for e in flight]
        np.testing.assert_allclose(off[0].as_rotvec(), off[2].as_rotvec(), atol=1e-12)
        turns.append(off[0].as_rotvec())
    assert np.degrees(np.std(turns)) * 3600.0 == pytest.approx(20.0, rel=0.3)


def test_fractal_albedo_varies_by_5_percent_an_octave_and_finer_than_pixels_not_at_all():
    albedo = Albedo(TruthSettings(albedo="fractal"), load_body("moon"))
    rng = np.random.default_rng(3)
    directions = xyz_from_latlon(rng.uniform(-1.2, 1.2, 20000), rng.uniform(-3, 3, 20000), 1.0)
    sigma = [
        np.log(albedo.factors(1, directions, np.full(20000, size))).std()
        for size in (1000.0, 2000.0, 4000.0)
    ]
    assert sigma[0] ** 2 - sigma[1] ** 2 == pytest.approx(0.05**2, rel=0.3)
    assert sigma[1] ** 2 - sigma[2] ** 2 == pytest.approx(0.05**2, rel=0.3)
    other = albedo.factors(2, directions, np.full(20000, 1000.0))
    assert not np.allclose(other, albedo.factors(1, directions, np.full(20000, 1000.0)))


def test_a_map_is_decoded_and_read_where_its_edges_say(tmp_path):
    half = np.full((90, 180), 188, np.uint8)  # sRGB of a linear half
    half[:, 90:] = 255
    cv2.imwrite(str(tmp_path / "map.png"), half)
    settings = AlbedoMapSettings(path=str(tmp_path / "map.png"), extent_deg=EXTENT)
    albedo = Albedo(TruthSettings(albedo="real", albedo_map=settings), load_body("moon"))
    west, east = (xyz_from_latlon(0.1, lon, 1.0)[None] for lon in (-1.0, 1.0))
    size = np.array([1e6])  # no noise of its own is so coarse
    ratio = albedo.factors(1, east, size) / albedo.factors(1, west, size)
    assert ratio[0] == pytest.approx(2.0, rel=0.02)


def test_below_a_map_albedo_goes_on_as_strong_as_the_map_is_there(tmp_path):
    # white noise leaves the root of 3/4 of itself over means of 2 x 2 pixels
    wanted = {-1.0: 0.02, 1.0: 0.08}
    rms = np.where(np.arange(720) < 360, *wanted.values()) / np.sqrt(0.75)
    noise = np.random.default_rng(5).normal(0.0, 1.0, (360, 720)) * rms
    cv2.imwrite(str(tmp_path / "map.tif"), np.exp(noise).astype(np.float32))
    settings = AlbedoMapSettings(path=str(tmp_path / "map.tif"), extent_deg=EXTENT, coding="linear")
    albedo = Albedo(TruthSettings(albedo="real", albedo_map=settings), load_body("moon"))
    pixel_m = 0.5 * 1737.4e3 * np.pi / 180.0
    for lon, share in wanted.items():
        spots = xyz_from_latlon(np.linspace(-0.5, 0.5, 4000), lon, 1.0)
        coarse, fine = (
            np.log(albedo.factors(1, spots, np.full(4000, size))).var()
            for size in (pixel_m / 2.0, pixel_m / 8.0)
        )
        assert fine - coarse == pytest.approx(2.0 * share**2, rel=0.3)


def test_a_map_with_a_coordinate_system_needs_no_edges(tmp_path):
    values = np.ones((1, 60, 60), np.float32)
    values[:, :, 30:] = 3.0
    values[:, :5] = -1.0
    moon = "+proj=longlat +R=1737400 +no_defs"
    place = {"crs": moon, "transform": rasterio.Affine(0.5, 0.0, 0.0, 0.0, -0.5, 30.0)}
    shape = {"width": 60, "height": 60, "count": 1, "dtype": "float32", "nodata": -1.0}
    with rasterio.open(tmp_path / "map.tif", "w", "GTiff", **shape, **place) as file:
        file.write(values)
    settings = AlbedoMapSettings(path=str(tmp_path / "map.tif"), coding="linear")
    albedo = Albedo(TruthSettings(albedo="real", albedo_map=settings), load_body("moon"))
    lon = np.radians([7.5, 22.5, 22.5, 200.0])
    places = xyz_from_latlon(np.radians([15.0, 15.0, 29.0, 15.0]), lon, 1.0)
    # holes and what lies outside are as bright as the mean
    np.testing.assert_allclose(albedo.factors(1, places, np.full(4, 1e6)), [0.5, 1.5, 1.0, 1.0])
    damaged = (tmp_path / "map.tif").read_bytes()
    (tmp_path / "map.tif").write_bytes(damaged[: len(damaged) - 8000])
    with pytest.raises(DataError, match="get it again"):
        Albedo(TruthSettings(albedo="real", albedo_map=settings), load_body("moon"))


def test_an_albedo_map_without_a_place_or_that_is_missing_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "map.png"), np.full((90, 180), 100, np.uint8))
    moon = load_body("moon")
    nowhere = AlbedoMapSettings(path=str(tmp_path / "map.png"))
    with pytest.raises(DataError, match="neither its coordinate system nor its edges; state"):
        Albedo(TruthSettings(albedo="real", albedo_map=nowhere), moon)
    crossed = AlbedoMapSettings(path=str(tmp_path / "map.png"), extent_deg=(10.0, 0.0, -10.0, 5.0))
    with pytest.raises(ConfigError, match="west below east"):
        Albedo(TruthSettings(albedo="real", albedo_map=crossed), moon)
    missing = AlbedoMapSettings(path=str(tmp_path / "none.png"), extent_deg=EXTENT)
    with pytest.raises(DataError, match="no such file"):
        Albedo(TruthSettings(albedo="real", albedo_map=missing), moon)
    black = AlbedoMapSettings(path=str(tmp_path / "black.png"), extent_deg=EXTENT)
    cv2.imwrite(black.path, np.zeros((90, 180), np.uint8))
    with pytest.raises(DataError, match="no brightness above 0"):
        Albedo(TruthSettings(albedo="real", albedo_map=black), moon)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('model_error = "lola"', "model_error"),
        ("model_error = { box_km = [2.0] }", "rms_m"),
        ("model_error = { box_km = [2.0], rms_m = [28.0], box = 3 }", "box"),
        ("model_error = { box_km = [2.0, 4.0], rms_m = [28.0] }", "2 box_km and 1 rms_m"),
        ("model_error = { box_km = [4.0, 2.0], rms_m = [1.0, 2.0] }", "not rising"),
        ("model_error = { box_km = [2.0], rms_m = [-28.0] }", "rms_m"),
        ("model_error = { box_km = [2.0], rms_m = [nan] }", "rms_m"),
        ("model_error = { box_km = [2.0], rms_m = [9.0], slope = [0.1] }", "1 slope and 0"),
        ('albedo = "real"', "there is no albedo_map"),
        ('albedo_map = { path = "a.png" }', "albedo_map"),
    ],
)
def test_bad_settings_of_the_truth_are_refused_by_name(tmp_path, line, message):
    with pytest.raises(ConfigError, match=message):
        scenario(tmp_path, f"[truth]\n{line}\n")


def test_a_table_scales_the_error_by_slope():
    table = {"box_km": [1.0, 2.0], "rms_m": [10.0, 6.0], "slope": [0.0, 0.1]}
    truth = msgspec.convert(
        {"model_error": {**table, "slope_rms_m": [5.0, 15.0]}}, TruthSettings, strict=False
    )
    spectrum = truth.spectrum()
    np.testing.assert_allclose(spectrum.factor([0.0, 0.05, 0.2]), [0.5, 1.0, 1.5])
