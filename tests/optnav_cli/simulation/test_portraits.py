"""Pictures of small bodies: where they are taken from, what they show, what is refused."""

import tomllib
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.errors import ConfigError
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.passes import Portraits, PortraitSettings
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.scenario_base import Exposure
from optnav_cli.simulation.surroundings import MeshGround
from tests.optnav_cli.simulation.simulated import simulate

ROOT = Path(__file__).resolve().parents[3]
CAMERA = Camera("small", "pinhole", 200, 160, 500.0, (99.5, 79.5))
CAMERA_TOML = """
name = "small"
model = "pinhole"
width_px = 120
height_px = 100
focal_length_mm = 3.0
pixel_pitch_um = 10.0
focal_length_px = 300.0
principal_point_px = [59.5, 49.5]
"""
SCENARIO = """
body = "phobos"
mesh = { path = "bundled:phobos_thomas.tab", units = "km", longitude = "west" }
detail = { smallest_m = 640.0, rms_slope_deg = 0.0 }
camera = { name = "small.toml" }

[portraits]
distance_km = [400.0, 100.0]
frames = 3

[pointing]
tilt_sigma_deg = 3.0
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "small.toml").write_text(CAMERA_TOML)
    found = tmp_path / "portraits.toml"
    found.write_text(SCENARIO)
    return found


def portraits(path: Path) -> Portraits:
    scenario = load_scenario(path)
    assert isinstance(scenario, Portraits)
    return scenario


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> MeshGround:
    """A ball of Phobos' size without relief."""
    folder = tmp_path_factory.mktemp("ball")
    trimesh.creation.icosphere(4, radius=13.0).export(folder / "ball.ply")
    text = SCENARIO.replace("bundled:phobos_thomas.tab", "ball.ply")
    text = text.replace(', longitude = "west"', "").replace("{ smallest", "{ seeds = [], smallest")
    (folder / "ball.toml").write_text(text.replace("small.toml", "tsnn_shtk"))
    scenario = portraits(folder / "ball.toml")
    return MeshGround(scenario.mesh, scenario.detail, load_body("phobos"))


def full(distance_m: float, aside_px: np.ndarray) -> Exposure:
    """The ball in full light, its centre beside the middle of the picture."""
    scenario = load_scenario(ROOT / "configs" / "scenarios" / "phobos_limb_1000km.toml")
    shot = scenario.shortened(1).exposures(AnalyticEphemeris(load_body("phobos")))[0]
    ahead = shot.camera_from_body.inv().apply([*(aside_px / CAMERA.focal_length_px), 1.0])
    ahead /= np.linalg.norm(ahead)
    return replace(shot, position_m=-distance_m * ahead, sun_body=-ahead, ground_seed=None)


def aslant(phase_deg: float) -> np.ndarray:
    """A Sun at about a phase angle from the middle of `full` pictures."""
    toward = full(1e6, np.zeros(2)).sun_body
    aside = np.cross(toward, [0.2, 0.5, 0.8])
    phase = np.radians(phase_deg)
    return np.cos(phase) * toward + np.sin(phase) * aside / np.linalg.norm(aside)


def light(image: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum of a picture and its middle (x, y), px."""
    total = float(image.sum(dtype=np.float64))
    rows, cols = np.indices(image.shape)
    return total, np.array([(image * cols).sum(), (image * rows).sum()]) / total


@pytest.mark.parametrize("across_px", [12.0, 30.0])
def test_a_ball_of_any_size_in_full_light_lies_about_its_centre(
    ball: MeshGround, across_px: float
) -> None:
    aside = np.array([3.37, -2.18])
    shot = full(26e3 * CAMERA.focal_length_px / across_px, aside)
    _, middle = light(ball.radiance(CAMERA, shot))
    np.testing.assert_allclose(middle, np.array([99.5, 79.5]) + aside, atol=0.01)


def test_a_small_disc_is_the_mean_of_a_finer_camera_s_picture(ball: MeshGround) -> None:
    coarse = Camera("coarse", "pinhole", 24, 20, 500.0, (11.5, 9.5))
    fine = Camera("fine", "pinhole", 384, 320, 8000.0, (191.5, 159.5))
    shot = replace(full(26e3 * 500.0 / 2.5, np.array([3.37, -2.18])), sun_body=aslant(40.0))
    found = ball.radiance(coarse, shot)
    wanted = ball.radiance(fine, shot).reshape(20, 16, 24, 16).mean(axis=(1, 3))
    assert 9 <= (found > 0.0).sum() <= 16
    # the finer camera sees the limb right to a hundredth of its pixels
    np.testing.assert_allclose(found, wanted, atol=0.01 * wanted.max())


def test_light_falls_with_the_square_of_the_distance(ball: MeshGround) -> None:
    sums = []
    for distance in (1e6, 5e6):
        shot = replace(full(distance, np.array([0.3, 0.4])), sun_body=aslant(40.0))
        sums.append(light(ball.radiance(CAMERA, shot))[0] * distance**2)
    assert sums[1] == pytest.approx(sums[0], rel=3e-3)


def test_a_body_beside_the_field_is_not_in_the_picture(ball: MeshGround) -> None:
    assert not ball.radiance(CAMERA, full(4e6, np.array([400.0, 0.0]))).any()
    half = ball.radiance(CAMERA, full(150e3, np.array([99.5 + 0.5, 0.0])))
    assert half[:, -1].any()
    assert not half[:, :40].any()


def test_portraits_are_taken_where_they_are_wanted(path: Path) -> None:
    text = SCENARIO.replace("frames = 3", "frames = 40\nphase_deg = [25.0, 60.0]")
    path.write_text(text)
    flight = portraits(path).exposures(AnalyticEphemeris(load_body("phobos")))
    distances = np.array([np.linalg.norm(s.position_m) for s in flight])
    assert distances[[0, -1]] == pytest.approx([400e3, 100e3])
    assert np.ptp(np.diff(np.log(distances))) < 1e-9
    ups = np.array([s.position_m for s in flight]) / distances[:, None]
    suns = np.array([s.sun_body for s in flight])
    phases = np.degrees(np.arccos(np.einsum("ij,ij->i", ups, suns)))
    assert 25.0 <= phases.min() < 27.0
    assert 58.0 < phases.max() <= 60.0
    assert np.abs(np.degrees(np.arcsin(suns[:, 2]))).max() <= 26.0
    # from all sides
    assert np.linalg.norm(ups.mean(axis=0)) < 0.4


def test_the_template_shows_the_defaults(tmp_path: Path) -> None:
    template = (ROOT / "configs" / "templates" / "scenario.toml").read_text()
    section = template.partition("# [portraits]\n")[2].partition("\n\n")[0]
    shown = tomllib.loads("\n".join(line.removeprefix("# ") for line in section.splitlines()))
    needed = PortraitSettings((shown["distance_km"][0], shown["distance_km"][1]))
    assert shown == msgspec.to_builtins(needed) | {"distance_km": shown["distance_km"]} | {
        "phase_deg": list(needed.phase_deg)
    }


def test_the_same_seed_gives_the_same_pictures(path: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        simulate(path, tmp_path / name)
    files = sorted(file.name for file in (tmp_path / "one").iterdir() if file.is_file())
    assert len([name for name in files if name.endswith(".png")]) == 3
    for name in set(files) - {"manifest.json"}:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    assert b'"path": "bundled:phobos_thomas.tab"' in (tmp_path / "one/scenario.json").read_bytes()


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ('[portraits]', '[[dem]]\npath = "moon_gld100_4ppd.tif"\n\n[portraits]', "dem"),
        ("frames = 3", "frames = 3\nphase_deg = [60.0, 30.0]", "phase_deg"),
        ("[400.0, 100.0]", "[400.0, 12.0]", "distance_km"),
        ("frames = 3", "phase_deg = [90.0, 90.0]\nsubsolar_latitude_deg = 0.0", "subsolar"),
        ("640.0", "5.0", "smallest_m"),
        ("phobos_thomas.tab", "phobos_thomas.obj", "phobos_thomas.obj"),
    ],
)  # fmt: skip
def test_what_cannot_be_portrayed_is_named(
    path: Path, tmp_path: Path, old: str, new: str, word: str
) -> None:
    assert old in SCENARIO
    path.write_text(SCENARIO.replace(old, new))
    with pytest.raises(ConfigError, match=word):
        simulate(path, tmp_path / "out")
