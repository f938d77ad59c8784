"""Whole bodies: limb and disc against exact spheres, turned frames, poles, seeded relief."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rasterio.transform import Affine
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.errors import ConfigError, DataError
from catalog.geometry.latlon import Lattice, latlon_from_xyz, xyz_from_latlon
from catalog.photometry.laws import LUNAR_HAPKE
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.globe_ground import (
    GlobeGround,
    GlobeTerrain,
    GroundView,
    facing_frame,
    fixed_centre,
    level_frame,
)
from optnav_cli.simulation.globe_heights import GlobeHeights, read_globe
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.scenario_base import Exposure
from tests.catalog.conftest import write_dem
from tests.optnav_cli.simulation.simulated import simulate

RADIUS_M = 1_737_400.0
ROOT = Path(__file__).resolve().parents[3]
NARROW = Camera("narrow", "pinhole", 400, 320, 1000.0, (199.5, 159.5))
WIDE = Camera("wide", "equidistant", 440, 440, 115.0, (219.5, 219.5))


def shot_at(position: np.ndarray, target: np.ndarray, sun: np.ndarray) -> Exposure:
    """A shot whose boresight points at a body-fixed place."""
    scenario = load_scenario(ROOT / "configs" / "scenarios" / "far_010000km.toml")
    boresight = (target - position) / np.linalg.norm(target - position)
    x = np.cross(boresight, [0.3, -0.5, 0.8])
    x /= np.linalg.norm(x)
    rotation = Rotation.from_matrix(np.stack([x, np.cross(boresight, x), boresight]))
    first = scenario.exposures(AnalyticEphemeris(load_body("moon")))[0]
    return replace(
        first, position_m=position, camera_from_body=rotation, sun_body=sun / np.linalg.norm(sun),
        ground_seed=None,
    )  # fmt: skip


def ground(heights: np.ndarray | None = None) -> GlobeGround:
    model = np.zeros((180, 360), np.float32) if heights is None else heights
    globe = GlobeHeights(model, RADIUS_M)
    return GlobeGround(globe, {None: GlobeTerrain(globe, None)})


def exact_sphere(camera: Camera, shot: Exposure, samples: int, inside: np.ndarray) -> np.ndarray:
    """Radiance of a smooth sphere: means over samples x samples exact rays of the marked pixels."""
    rows, cols = np.nonzero(inside)
    offset = (np.arange(samples) + 0.5) / samples - 0.5
    dy, dx = np.meshgrid(offset, offset, indexing="ij")
    pixels = np.stack([cols[:, None] + dx.ravel()[None], rows[:, None] + dy.ravel()[None]], axis=-1)
    rays = shot.camera_from_body.inv().apply(camera.unproject(pixels).reshape(-1, 3))
    origin = shot.position_m
    along = rays @ origin
    length = np.linalg.norm(origin)
    square = along**2 - (length - RADIUS_M) * (length + RADIUS_M)
    hit = (square > 0.0) & (along < 0.0)
    point = origin + (-along - np.sqrt(np.maximum(square, 0.0)))[:, None] * rays
    normal = point / RADIUS_M
    value = np.zeros(len(rays))
    mu0 = normal[hit] @ shot.sun_body
    seen = LUNAR_HAPKE(
        np.maximum(mu0, 0.0), -(normal[hit] * rays[hit]).sum(1), -rays[hit] @ shot.sun_body
    )
    value[hit] = np.where(mu0 > 0.0, seen, 0.0)
    out = np.zeros(camera.shape)
    out[rows, cols] = value.reshape(len(rows), -1).mean(axis=1)
    return out


def limb_pixels(camera: Camera, shot: Exposure, within_px: float) -> np.ndarray:
    """Pixels near the sphere's outline."""
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = shot.camera_from_body.inv().apply(
        camera.unproject(np.stack([x, y], -1)).reshape(-1, 3)
    ).reshape(*camera.shape, 3)  # fmt: skip
    centre = -shot.position_m / np.linalg.norm(shot.position_m)
    half = np.arcsin(RADIUS_M / np.linalg.norm(shot.position_m))
    off = np.arccos(np.clip(rays @ centre, -1.0, 1.0)) - half
    return np.abs(off) < within_px / camera.focal_length_px * 1.5


@pytest.mark.parametrize(
    ("camera", "distance_km", "off_deg"),
    [(NARROW, 10_000, 0.0), (NARROW, 20_000, 7.0), (NARROW, 50_000, 3.0), (NARROW, 100_000, 5.0),
     (WIDE, 12_000, 97.0), (WIDE, 900, 20.0), (WIDE, 60, 0.0)],
)  # fmt: skip
def test_the_limb_of_a_smooth_sphere_is_right_to_a_hundredth_of_a_pixel(
    camera: Camera, distance_km: float, off_deg: float
):
    """The outline all round and the lit disc's centre, against exact rays, 24 a pixel's side.

    Light that is missing at the limb, over the limb's brightness, is how far it lies too far in.
    """
    position = xyz_from_latlon(0.5, 2.0, RADIUS_M + distance_km * 1e3)
    target = Rotation.from_rotvec(np.radians(off_deg) * np.array([0.6, 0.64, -0.48])).apply(
        -position
    ) + position  # fmt: skip
    shot = shot_at(
        position, target, position + 0.2 * np.linalg.norm(position) * np.array([1, 0, 0])
    )
    found = ground().radiance(camera, shot).astype(float)
    near = limb_pixels(camera, shot, 2.0)
    expected = exact_sphere(camera, shot, 24, near)
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    centre = camera.project(shot.camera_from_body.apply(-position))
    around = np.arctan2(y - centre[1], x - centre[0])
    bright = np.quantile(expected[near & (expected > 0)], 0.8)
    for sector in np.arange(-np.pi, np.pi, np.pi / 4.0):
        part = near & (around >= sector) & (around < sector + np.pi / 4.0)
        if np.count_nonzero(expected[part]) < 12:
            continue
        length = np.count_nonzero(part) / (2.0 * 2.0 * 1.5)
        outward_px = (found[part] - expected[part]).sum() / bright / length
        assert abs(outward_px) < 0.01
    assert np.abs(found - expected)[near].max() < 0.06 * bright


def test_the_whole_disc_far_away_has_the_light_and_centre_of_the_exact_one():
    position = xyz_from_latlon(-0.3, -3.1, RADIUS_M + 1e8)
    camera = Camera("unk", "pinhole", 240, 240, 4183.87, (119.5, 119.5))
    shot = shot_at(position, np.array([9e5, 2e6, -1e6]), np.array([-0.5, -0.6, 0.3]))
    found = ground().radiance(camera, shot).astype(float)
    x, y = np.meshgrid(np.arange(240.0), np.arange(240.0))
    centre = camera.project(shot.camera_from_body.apply(-position))
    disc = np.hypot(x - centre[0], y - centre[1]) < 75.0  # its radius is 71.5 px
    expected = exact_sphere(camera, shot, 10, disc)
    assert found.sum() == pytest.approx(expected.sum(), rel=1e-3)
    for axis in (x, y):
        assert (found * axis).sum() / found.sum() == pytest.approx(
            (expected * axis).sum() / expected.sum(), abs=0.01
        )


def bumps(directions: np.ndarray) -> np.ndarray:
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    return 2500.0 * np.sin(17.0 * x + 3.0) * np.sin(14.0 * y - 1.0) * np.cos(15.0 * z + 0.5)


def globe_of(turn: Rotation) -> np.ndarray:
    """Heights of the bumpy body after it is turned."""
    rows = 360
    lat = 0.5 * np.pi - (np.arange(rows) + 0.5) * np.pi / rows
    lon = (np.arange(2 * rows) + 0.5) * np.pi / rows
    directions = xyz_from_latlon(lat[:, None], lon[None, :], 1.0)
    return bumps(directions.reshape(-1, 3) @ turn.as_matrix()).reshape(rows, -1).astype(np.float32)


@pytest.mark.parametrize(("camera", "height_km"), [(WIDE, 120.0), (NARROW, 9000.0)])
@pytest.mark.parametrize("place", [[0.02, 0.01, 1.0], [0.1, 0.05, -1.0], [-1.0, 1e-4, 0.1]])
def test_the_poles_and_180_degrees_look_like_any_other_place(
    camera: Camera, height_km: float, place: list[float]
):
    """The same body seen from the same side, once at a pole or on the 180° line, once at 20° N."""
    here = np.array(place) / np.linalg.norm(place)
    there = xyz_from_latlon(0.35, 0.7, 1.0)
    turn, _ = Rotation.align_vectors(
        [there, np.cross(there, [0.0, 0.0, 1.0])], [here, np.cross(here, [0.3, 1.0, 0.0])]
    )
    target, sun = here * RADIUS_M + [1e5, -5e4, 2e4], here + [0.9, 0.5, -0.6]
    pictures = []
    for rotation in (Rotation.identity(), turn):
        shot = shot_at(here * (RADIUS_M + height_km * 1e3), target, sun)
        shot = replace(
            shot, position_m=rotation.apply(shot.position_m),
            sun_body=rotation.apply(shot.sun_body),
            camera_from_body=shot.camera_from_body * rotation.inv(),
        )  # fmt: skip
        pictures.append(ground(globe_of(rotation)).radiance(camera, shot).astype(float))
    one, other = pictures
    assert one.std() > 0.2 * one.max() / 5.0
    difference = np.abs(one - other)
    # grids differ, so single pixels at shadow edges and along the limb do
    assert np.sqrt((difference**2).mean()) < 0.004 * one.max()
    assert np.count_nonzero(difference > 0.05 * one.max()) < 2e-3 * one.size


def test_turned_frames_put_the_view_where_the_grid_is_even():
    rng = np.random.default_rng(5)
    for direction in [*rng.normal(size=(300, 3)), [0, 0, 1], [0, 0, -1], [-1, -1e-9, 0]]:
        unit = np.asarray(direction, float) / np.linalg.norm(direction)
        centre = fixed_centre(unit)
        assert np.degrees(np.arccos(min(centre @ unit, 1.0))) < 3.0
        level, sun = level_frame(centre), rng.normal(size=3)
        facing = facing_frame(centre, sun)
        np.testing.assert_allclose(level @ centre, [1.0, 0.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(facing @ centre, [0.0, 0.0, 1.0], atol=1e-12)
        for frame in (level, facing):
            np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(frame) == pytest.approx(1.0)
        # the grid's seam, longitude 180°, is away from the Sun
        assert (facing @ sun)[1] == pytest.approx(0.0, abs=1e-9)
        assert (facing @ sun)[0] > 0.0


def test_relief_in_a_turned_frame_is_that_of_the_body():
    """Against single points of the relief: the grid holds means over its cells, 300 m across."""
    detail = SyntheticRelief(4, 4000.0, RADIUS_M, smallest_m=2000.0, saturation=0.05)
    step = 300.0 / RADIUS_M
    for centre in ([0.1, -0.2, 1.0], [-1.0, 1e-3, 0.05]):
        turned = level_frame(np.array(centre) / np.linalg.norm(centre))
        grid = Lattice(0.02, -0.03, step, 150, 200)
        heights = detail.turned_window(turned.T, grid)
        directions = xyz_from_latlon(grid.lat[:, None], grid.lon[None, :], 1.0) @ turned
        body_lat, body_lon, _ = latlon_from_xyz(directions)
        points = detail.heights(body_lat, body_lon)
        assert points.std() > 20.0
        assert np.sqrt(((heights - points) ** 2).mean()) < 0.1 * points.std()


def test_neighbouring_windows_hold_the_same_ground():
    globe = GlobeHeights(globe_of(Rotation.identity())[::2, ::2].copy(), RADIUS_M)
    terrain = GlobeTerrain(
        globe, SyntheticRelief(2, globe.posting_m, RADIUS_M, smallest_m=globe.posting_m)
    )
    posting = float(terrain.postings()[0])
    found = []
    place = xyz_from_latlon(1.35, 1.3, 1.0)
    for direction in ([0.1, 0.1, 1.0], [0.3, 0.05, 0.9]):
        centre = fixed_centre(np.array(direction))
        view = GroundView(tuple(centre.tolist()), (-0.4, -0.4, 0.4, 0.4), posting)
        turned, fine, wide = terrain.window(view, np.array([1.0, 0.0, 0.0]))
        own = turned @ place
        row = (fine.north - np.arcsin(own[2])) / fine.step_lat
        col = (np.arctan2(own[1], own[0]) - fine.west) / fine.step_lon
        r, c = int(row), int(col)
        y, x = row - r, col - c
        h = fine.heights[r : r + 2, c : c + 2]
        found.append(np.array([1 - y, y]) @ h @ np.array([1 - x, x]))
        assert np.isfinite(wide.heights).all()
    # bilinear between nodes 7.6 km apart
    assert found[0] == pytest.approx(found[1], abs=150.0)
    assert abs(found[0]) > 200.0


def test_grounds_far_away_keep_the_crests_of_their_limb():
    """Coarse means lower a limb; the whole ring must stand as high as that of the finest grid."""
    rng = np.random.default_rng(3)
    rough = rng.normal(0.0, 400.0, (360, 720)).astype(np.float32)
    globe = GlobeHeights(rough, RADIUS_M)
    terrain = GlobeTerrain(
        globe, SyntheticRelief(2, globe.posting_m, RADIUS_M, smallest_m=globe.posting_m)
    )
    sun = np.array([1.0, 0.0, 0.0])
    centre = tuple(fixed_centre(np.array([0.2, -0.9, 0.3])).tolist())
    skylines = []
    for posting in terrain.postings()[:3]:
        _, ring, _ = terrain.window(GroundView(centre, None, float(posting)), sun)
        lat = ring.north - ring.step_lat * np.arange(len(ring.heights))
        across = (RADIUS_M + ring.heights) * np.cos(lat)[:, None]
        skylines.append(float(across.max(axis=0).mean()) - RADIUS_M)
    finest, *coarser = skylines
    assert finest > 400.0
    # without what they are raised by they would be a third and nine tenths lower
    assert coarser == pytest.approx([finest, finest], abs=0.1 * finest)


def test_a_shared_model_is_asked_for_when_it_is_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    scenario = load_scenario(ROOT / "configs" / "scenarios" / "far_100000km.toml")
    monkeypatch.delenv("OPTNAV_SHARED_DATA", raising=False)
    with pytest.raises(ConfigError, match="OPTNAV_SHARED_DATA names, which is not set"):
        simulate(scenario, tmp_path / "a")
    monkeypatch.setenv("OPTNAV_SHARED_DATA", str(tmp_path))
    with pytest.raises(ConfigError, match=r"moon_gld100_32ppd\.tif' is not there"):
        simulate(scenario, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("value", [1e30, -1e30, np.nan])
def test_a_model_with_heights_that_no_body_has_is_refused(tmp_path: Path, value: float) -> None:
    heights = np.full((30, 60), value, np.float32)
    if np.isfinite(value):
        heights[1:] = 100.0
    path = write_dem(tmp_path / "globe.tif", heights)
    with pytest.raises(DataError, match=r"globe\.tif: (heights run from|holds no height)"):
        read_globe(DemSettings(str(path)), load_body("moon"))


def test_a_region_with_heights_that_no_body_has_is_refused(tmp_path: Path) -> None:
    heights = np.zeros((64, 64), np.float32)
    heights[32, 32] = 1e30
    affine = Affine(1 / 32, 0.0, 10.0, 0.0, -1 / 32, 21.0)
    write_dem(tmp_path / "dem.tif", heights, affine=affine)
    (tmp_path / "flight.toml").write_text(
        'camera = {name = "unk"}\ndem = [{path = "dem.tif"}]\ndetail = {seeds = []}\n[orbit]\n'
        "altitude_km = 30.0\nbox_deg = [10.9, 19.9, 11.1, 20.1]\n"
    )
    with pytest.raises(DataError, match=r"dem\.tif: heights run from 0 to 1e\+30 m"):
        simulate(tmp_path / "flight.toml", tmp_path / "pictures")
