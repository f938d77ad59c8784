"""The globe around terrain models, smooth and with relief below its posting."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.config import resource
from catalog.errors import ConfigError
from catalog.geometry.grid import sample_bicubic
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from catalog.rendering.rays.ground import Ground, make_whole_sphere
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.simulation.globe_heights import WideGround, read_globe, seen_from
from optnav_cli.simulation.region_ground import truth_terrain
from optnav_cli.simulation.scenario import load_scenario, scenario_copy

RADIUS_M = 1_737_400.0
POSTING_M = np.pi * RADIUS_M / 720
SEAM = np.radians(169.0)
SCENARIO = """
seed = 3
detail = {{ seeds = [1, 2], smallest_m = 60.0 }}
camera = {{ name = "unk" }}
{globe}

[orbit]
altitude_km = 100.0
box_deg = [-11.5, -43.5, -10.5, -42.5]
passes = 2
"""
ROUGH = "globe.detail = { smallest_m = 3800.0, rms_slope_deg = 5.0 }"


@pytest.fixture(scope="module")
def heights() -> np.ndarray:
    path = str(resource("data/moon_gld100_4ppd.tif"))
    return read_globe(DemSettings(path), load_body("moon"))


@pytest.fixture(scope="module")
def details() -> dict[int | None, SyntheticRelief]:
    return {
        seed: SyntheticRelief(seed, POSTING_M, RADIUS_M, smallest_m=3800.0, rms_slope_deg=5.0)
        for seed in (1, 2)
    }


def places(ground: Ground, rows: np.ndarray, cols: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.meshgrid(
        ground.north - rows * ground.step_lat, ground.west + cols * ground.step_lon, indexing="ij"
    )


def test_without_detail_the_globe_is_shown_as_it_is(heights, details):
    plain = make_whole_sphere(heights, RADIUS_M, SEAM)
    for globe in (WideGround(heights, RADIUS_M, SEAM, {}), WideGround(heights, 1.0, SEAM, details)):
        assert globe.of(None).heights.tobytes() == plain.heights.tobytes()
        assert (globe.of(None).north, globe.of(None).west) == (plain.north, plain.west)
    np.testing.assert_array_equal(
        WideGround(heights, RADIUS_M, SEAM, {}).of(7).highest_64, plain.highest_64
    )


def test_a_rough_globe_is_the_smooth_one_with_the_relief_of_its_seed(heights, details):
    """Nodes against bicubic heights of the model and the mean of 36 points about each node.

    What is left is relief finer than the nodes, three tenths of that added; grids that are a fifth
    of a node apart differ by four tenths.
    """
    globe = WideGround(heights, RADIUS_M, SEAM, details)
    one = globe.of(1)
    rows, cols = np.arange(800, 860), np.arange(900, 980)
    lat, lon = places(one, rows, cols)
    assert one.posting_m == pytest.approx(POSTING_M / 2.0)
    step = np.pi / len(heights)
    wrapped = np.concatenate([heights[:, -4:], heights, heights[:, :4]], axis=1)
    smooth = map_coordinates(
        wrapped.astype(float),
        [(0.5 * np.pi - lat) / step - 0.5, np.mod(lon, 2.0 * np.pi) / step - 0.5 + 4.0], order=3,
    )  # fmt: skip
    added = one.heights[800:860, 900:980] - smooth
    within = (np.arange(6) - 2.5) / 6.0 * one.step_lat
    wanted = np.mean([details[1].heights(lat + y, lon + x) for y in within for x in within], axis=0)
    assert wanted.std() > 50.0
    assert (added - wanted).std() < 0.33 * wanted.std()
    other = globe.of(2).heights[800:860, 900:980] - smooth
    assert abs(np.corrcoef(added.ravel(), other.ravel())[0, 1]) < 0.1


def test_a_rough_globe_has_no_seam_and_goes_to_the_poles(heights, details):
    ground = WideGround(heights, RADIUS_M, SEAM, details).of(1).heights
    np.testing.assert_allclose(ground[2:-2, :4], ground[2:-2, -4:], atol=1e-2)
    assert abs(np.diff(ground[2:40], axis=1)).max() < 3000.0
    change = abs(ground - WideGround(heights, RADIUS_M, SEAM, details)._fine.heights)
    assert change[4:12].mean() > 5.0
    assert change[-12:-4].mean() > 5.0


@pytest.mark.parametrize("place", [(0.0, 0.0, 100.0), (-43.0, 179.9, 400.0), (-80.0, 20.0, 30.0)])
def test_relief_lies_wherever_a_line_of_sight_may_end(place: tuple[float, float, float]):
    """Rays that just clear the lowest ground reach the highest one within the cap."""
    lat, lon, height_km = np.radians(place[0]), np.radians(place[1]), place[2]
    lowest, highest = RADIUS_M - 9e3, RADIUS_M + 11e3
    camera = xyz_from_latlon(lat, lon, RADIUS_M + height_km * 1e3)
    cap = seen_from([camera], lowest, highest)
    down = -camera / np.linalg.norm(camera)
    east = np.cross(down, [0.0, 0.0, 1.0])
    east /= np.linalg.norm(east)
    angle = np.linspace(0.0, 2.0 * np.pi, 361)[:, None]
    grazing = np.arcsin(lowest / np.linalg.norm(camera))
    around = np.cos(angle) * east + np.sin(angle) * np.cross(down, east)
    rays = np.cos(grazing) * down + np.sin(grazing) * around
    # where they leave the shell, beyond the point nearest to the centre
    along = -(rays @ camera)
    end = camera + (along + np.sqrt(highest**2 - lowest**2))[:, None] * rays
    lats, lons, _ = latlon_from_xyz(end)
    assert (lats >= cap.south - 1e-9).all()
    assert (lats <= cap.north + 1e-9).all()
    middle = 0.5 * (cap.west + cap.east)
    off = np.abs(np.mod(lons - middle + np.pi, 2.0 * np.pi) - np.pi)
    assert (off <= 0.5 * (cap.east - cap.west) + 1e-9).all()
    if cap.east - cap.west < 6.28:
        assert off.max() == pytest.approx(0.5 * (cap.east - cap.west), abs=1e-3)


def test_what_a_flight_cannot_see_stays_smooth(heights, details):
    camera = xyz_from_latlon(np.radians(-43.0), np.radians(-11.0), RADIUS_M + 100e3)
    globe = WideGround(heights, RADIUS_M, SEAM, details, [camera])
    whole = WideGround(heights, RADIUS_M, SEAM, details).of(1)
    seen, smooth = globe.of(1), globe._fine
    lat, lon = places(seen, np.arange(len(seen.heights)), np.arange(seen.heights.shape[1]))
    away = np.arccos(
        np.clip(xyz_from_latlon(lat, lon, 1.0) @ camera / np.linalg.norm(camera), -1, 1)
    )
    np.testing.assert_allclose(
        seen.heights[away < np.radians(19.0)], whole.heights[away < np.radians(19.0)], atol=1e-2
    )
    np.testing.assert_array_equal(
        seen.heights[away > np.radians(60.0)], smooth.heights[away > np.radians(60.0)]
    )


def test_a_terrain_model_joins_the_rough_globe_at_its_border(tmp_path: Path):
    (tmp_path / "s.toml").write_text(SCENARIO.format(globe=ROUGH))
    scenario, body = load_scenario(tmp_path / "s.toml"), load_body("moon")
    terrain = truth_terrain(scenario, body, scenario.exposures(AnalyticEphemeris(body)))
    west, south, _, _ = terrain.box
    for seed in (1, 2):
        edge = terrain.window(seed, 2, (west, south, west + 1e-3, south + 2e-3))
        wide = terrain.wide(seed)
        lat, lon = places(edge, np.arange(len(edge.heights)), np.zeros(1))
        row = (wide.north - lat) / wide.step_lat
        col = np.mod(lon - wide.west, 2.0 * np.pi) / wide.step_lon
        globe = sample_bicubic(wide.heights, row, col)
        np.testing.assert_allclose(edge.heights[:, :1], globe, atol=1.0)
    one = sample_bicubic(terrain.wide(1).heights, row, col)
    assert abs(one - globe).max() > 20.0
    inside = (np.radians(-11.1), np.radians(-43.1), np.radians(-11.0), np.radians(-43.0))
    (tmp_path / "plain.toml").write_text(SCENARIO.format(globe=""))
    plain = load_scenario(tmp_path / "plain.toml")
    bare = truth_terrain(plain, body, plain.exposures(AnalyticEphemeris(body)))
    np.testing.assert_array_equal(
        terrain.window(1, 2, inside).heights, bare.window(1, 2, inside).heights
    )


def test_detail_of_the_globe_is_told_only_where_it_is_set(tmp_path: Path):
    (tmp_path / "s.toml").write_text(SCENARIO.format(globe=ROUGH))
    assert b'"rms_slope_deg": 5.0' in scenario_copy(load_scenario(tmp_path / "s.toml"))
    (tmp_path / "s.toml").write_text(SCENARIO.format(globe=""))
    copy = scenario_copy(load_scenario(tmp_path / "s.toml"))
    assert copy.count(b'"detail"') == 1


def test_detail_of_the_globe_without_a_model_in_it_is_refused(tmp_path: Path):
    (tmp_path / "s.toml").write_text(SCENARIO.format(globe=f"dem = []\n{ROUGH}"))
    with pytest.raises(ConfigError, match=r"\[globe\] has detail, and there is no \[\[dem\]\]"):
        load_scenario(tmp_path / "s.toml")
