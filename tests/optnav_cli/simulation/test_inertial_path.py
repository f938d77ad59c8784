"""Real paths: two-body truths, dates and kernels, several cameras, what is stated and what not."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.config import resource
from catalog.errors import ConfigError
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.truth import read_truth
from optnav_cli.orbit.fit.settings import OrbitFitSettings
from optnav_cli.simulation.inertial_path import InertialPath, flight_states, transfer_states
from optnav_cli.simulation.scenario import load_scenario, scenario_motion
from optnav_cli.simulation.scenario_base import Exposure
from tests.optnav_cli.simulation.simulated import simulate

ROOT = Path(__file__).resolve().parents[3]
MOON = load_body("moon")
R_KM, GM = 1737.4, 4902.8001184575496  # km, km^3/s^2
FLIGHT = """
seed = 5
dem = []
camera = { name = "small.toml" }
prior = { given = false }
attitude = { sigma_arcsec = 10.0, relative_to = "inertial" }

[[beside]]
name = "side.toml"
forward_deg = 60.0
roll_deg = 20.0

[flight]
lowest_km = 100.0
highest_km = 300.0
inclination_deg = 80.0
node_deg = 30.0
lowest_at_deg = 40.0
start_at_deg = 40.0
start_utc = "2005-03-01T12:00:00Z"
frames = 3
spacing_s = 600.0
"""
CAMERA = """
name = "{}"
model = "equidistant"
width_px = 100
height_px = 80
focal_length_px = 40.0
principal_point_px = [49.5, 39.5]
"""
KERNELS = ("naif0012.tls", "pck00011.tpc", "moon_080317.tf", "moon_pa_de421_1900-2050.bpc",
           "de405s_littleendian.bsp", "moon_assoc_me.tf")  # fmt: skip


@pytest.fixture
def flight_file(tmp_path: Path) -> Path:
    for name in ("small", "side"):
        (tmp_path / f"{name}.toml").write_text(CAMERA.format(name))
    (tmp_path / "flight.toml").write_text(FLIGHT)
    return tmp_path / "flight.toml"


def voyage(path: Path) -> InertialPath:
    scenario = load_scenario(path)
    assert isinstance(scenario, InertialPath)
    return scenario


def test_a_flight_is_the_conic_of_its_heights(flight_file: Path):
    """Energy and angular momentum of the two-body orbit; J2 and tides move them by parts in 1e4."""
    scenario = voyage(flight_file)
    flight = msgspec.structs.replace(scenario.flight, rough_gravity=False, frames=12)
    motion = AnalyticEphemeris(MOON)
    times, states = flight_states(flight, motion, 1)
    assert times[0] == utc_to_tdb_s("2005-03-01T12:00:00Z")
    np.testing.assert_allclose(np.diff(times), 600.0)
    r, v = np.linalg.norm(states[:, :3], axis=1), np.linalg.norm(states[:, 3:], axis=1)
    a = (R_KM + 200.0) * 1e3
    np.testing.assert_allclose(0.5 * v**2 - GM * 1e9 / r, -GM * 1e9 / (2 * a), rtol=2e-3)
    assert r[0] == pytest.approx((R_KM + 100.0) * 1e3, abs=1.0)
    assert r.max() < (R_KM + 305.0) * 1e3
    # inclination, node and lowest point at the start, on the body of the start
    turn = motion.body_from_inertial(times[0])
    place, pole = turn @ states[0, :3], turn @ np.cross(states[0, :3], states[0, 3:])
    assert np.degrees(np.arccos(pole[2] / np.linalg.norm(pole))) == pytest.approx(80.0, abs=1e-6)
    node = np.cross([0.0, 0.0, 1.0], pole)
    assert np.degrees(np.arctan2(node[1], node[0])) == pytest.approx(30.0, abs=1e-6)
    along = np.degrees(np.arccos(place @ node / np.linalg.norm(place) / np.linalg.norm(node)))
    assert along == pytest.approx(40.0, abs=1e-6)


def test_rough_gravity_moves_a_flight_by_its_known_size(flight_file: Path):
    flight = msgspec.structs.replace(voyage(flight_file).flight, frames=6)
    motion = AnalyticEphemeris(MOON)
    smooth = msgspec.structs.replace(flight, rough_gravity=False)
    _, exact = flight_states(smooth, motion, 1)
    drift = [
        np.linalg.norm(flight_states(flight, motion, seed)[1][-1, :3] - exact[-1, :3])
        for seed in (1, 2, 3, 4)
    ]
    # the size after 3000 s is hundreds of metres; it differs by the seed
    assert 30.0 < np.mean(drift) < 3000.0
    assert np.std(drift) > 1.0
    again = flight_states(flight, motion, 2)[1]
    np.testing.assert_array_equal(again, flight_states(flight, motion, 2)[1])


def test_a_flight_of_more_degrees_is_moved_by_the_field_of_orbit_fits(flight_file: Path):
    """Half an hour with J2 and C22 alone ends hundreds of metres beside."""
    flight = msgspec.structs.replace(
        voyage(flight_file).flight, rough_gravity=False, frames=4, degree=50
    )
    motion = AnalyticEphemeris(MOON)
    times, states = flight_states(flight, motion, 1)
    fitted = OrbitMotion(Forces(motion, OrbitFitSettings().forces))
    ahead = fitted.propagate(states[0], times[0], times[-1:])[0][0]
    assert np.linalg.norm(ahead[:3] - states[-1, :3]) < 0.01
    coarse = flight_states(msgspec.structs.replace(flight, degree=2), motion, 1)[1]
    assert np.linalg.norm(coarse[-1, :3] - states[-1, :3]) > 100.0


def test_a_transfer_comes_from_afar_to_the_lowest_point():
    path = ROOT / "configs" / "scenarios" / "transfer.toml"
    transfer = msgspec.structs.replace(voyage(path).transfer, frames=12)
    times, states = transfer_states(transfer, AnalyticEphemeris(MOON))
    r = np.linalg.norm(states[:, :3], axis=1)
    wanted = np.geomspace(transfer.from_km + R_KM, transfer.to_km + R_KM, 12) * 1e3
    # times are found between steps of the path
    np.testing.assert_allclose(r, wanted, rtol=2e-3)
    assert (np.diff(times) > 0.0).all()
    # no speed towards or away from the body at the lowest point
    assert states[-1, :3] @ states[-1, 3:] == pytest.approx(0.0, abs=1e-3 * r[-1])
    speed = np.linalg.norm(states[-1, 3:])
    excess = transfer.excess_speed_km_s * 1e3
    assert speed == pytest.approx(np.sqrt(excess**2 + 2 * GM * 1e9 / r[-1]), rel=1e-6)


def test_a_transfer_that_cannot_come_from_so_far_is_refused(flight_file: Path):
    text = FLIGHT[: FLIGHT.index("[flight]")]
    flight_file.write_text(text + "[transfer]\nfrom_km = 9e6\n")
    with pytest.raises(ConfigError, match="km at most"):
        load_scenario(flight_file).exposures(AnalyticEphemeris(MOON))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("highest_km = 300.0", "highest_km = 90.0", "exchange them"),
        ("[flight]", "[transfer]\n[flight]", r"\[flight\] and \[transfer\]"),
        ("[flight]", "[sun]\n[flight]", r"no section \[sun\]"),
        ("spacing_s", "spacing_min", "did you mean 'spacing_s'"),
        ("lowest_km = 100.0", "lowest_km = 8.0", "where mountains are"),
        ('"side.toml"', '"small.toml"', "'small' again"),
    ],
)
def test_impossible_voyages_are_named(
    flight_file: Path, tmp_path: Path, old: str, new: str, message: str
):
    flight_file.write_text(FLIGHT.replace(old, new))
    with pytest.raises(ConfigError, match=message):
        simulate(flight_file, tmp_path / "out")


def test_cameras_of_one_ship_share_place_time_and_attitude_error(flight_file: Path):
    pictures = load_scenario(flight_file).exposures(AnalyticEphemeris(MOON))
    assert [s.file for s in pictures[:2]] == ["frame_0000_small.png", "frame_0000_side.png"]
    assert len(pictures) == 6
    sides = []
    for one, two in zip(pictures[::2], pictures[1::2], strict=True):
        assert one.utc == two.utc
        np.testing.assert_array_equal(one.position_m, two.position_m)
        mounted = two.camera_from_body * one.camera_from_body.inv()
        stated = two.reported_camera_from_body * one.reported_camera_from_body.inv()
        assert (stated * mounted.inv()).magnitude() < 1e-12
        sides.append(mounted.as_matrix())
        error = (one.reported_camera_from_body * one.camera_from_body.inv()).magnitude()
        assert 1.0 < np.degrees(error) * 3600.0 < 60.0
    np.testing.assert_allclose(sides[0], sides[1], atol=1e-12)
    boresight = pictures[1].camera_from_body.inv().apply([0.0, 0.0, 1.0])
    down = -pictures[1].position_m / np.linalg.norm(pictures[1].position_m)
    assert np.degrees(np.arccos(boresight @ down)) == pytest.approx(60.0, abs=1e-6)


def _simulated(flight_file: Path, tmp_path: Path) -> tuple[list[Exposure], Path]:
    simulate(flight_file, tmp_path / "out")
    scenario = load_scenario(flight_file)
    return scenario.exposures(scenario_motion(scenario, MOON)), tmp_path / "out"


def test_inertial_attitudes_are_written_without_prior_and_sun(flight_file: Path, tmp_path: Path):
    flight_file.write_text(FLIGHT.replace("frames = 3", "frames = 1"))
    truth, out = _simulated(flight_file, tmp_path)
    folder = read_folder(out)
    assert folder.settings.attitude == "camera_from_inertial"
    assert [frame.camera for frame in folder.frames] == ["small", "side"]
    for frame, shot in zip(folder.frames, truth, strict=True):
        assert frame.problem is None
        assert frame.position_m is None
        assert (frame.camera_from_body * shot.reported_camera_from_body.inv()).magnitude() < 1e-10
        np.testing.assert_allclose(frame.sun_body, shot.sun_body, atol=1e-12)
    assert ",,,,,,\n" in (out / "frames.csv").read_text()
    for row, shot in zip(read_truth(out / "truth.csv", folder.attitude), truth, strict=True):
        np.testing.assert_allclose(row.position_m, shot.position_m, atol=1e-3)
        assert (row.camera_from_body * shot.camera_from_body.inv()).magnitude() < 1e-10


def test_with_kernels_the_truth_turns_by_them_and_files_hold_the_stars_attitude(
    flight_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shared_data
):
    """A reader without kernels believes an attitude that is off by the theory's error only."""
    pytest.importorskip("spiceypy")
    kernels = [str(shared_data(f"spice/{name}")) for name in KERNELS]
    flight_file.write_text(
        FLIGHT.replace("frames = 3", "frames = 1") + f"\n[spice]\nkernels = {kernels}\n"
    )
    truth, out = _simulated(flight_file, tmp_path)
    theory = AnalyticEphemeris(MOON)
    frame = read_folder(out).frames[0]
    shot = truth[0]
    assert frame.camera_from_body is not None
    off = (frame.camera_from_body * shot.reported_camera_from_body.inv()).magnitude()
    assert 0.0 < off * 1_737_400.0 < 5.0
    again = read_folder(out, [Path(kernel) for kernel in kernels]).frames[0].camera_from_body
    assert again is not None
    assert (again * shot.reported_camera_from_body.inv()).magnitude() < 1e-11
    true = scenario_motion(load_scenario(flight_file), MOON)
    stated = shot.reported_camera_from_body * Rotation.from_matrix(
        true.body_from_inertial(shot.tdb_s)
    )
    read = frame.camera_from_body * Rotation.from_matrix(theory.body_from_inertial(shot.tdb_s))
    assert (stated * read.inv()).magnitude() < 1e-10


def test_fewer_pictures_of_any_scenario(flight_file: Path):
    assert len(load_scenario(flight_file).shortened(2).exposures(AnalyticEphemeris(MOON))) == 4
    passes = load_scenario(ROOT / "configs" / "scenarios" / "shnk_200km.toml")
    assert len(passes.shortened(5).exposures(AnalyticEphemeris(MOON))) == 5
    approach = load_scenario(ROOT / "configs" / "scenarios" / "transfer.toml")
    assert len({s.utc for s in approach.shortened(3).exposures(AnalyticEphemeris(MOON))}) == 3


def test_the_template_shows_voyages_too(tmp_path: Path):
    """Its commented sections, without the comment signs and what they stand in for, are valid."""
    template = (ROOT / "configs" / "templates" / "scenario.toml").read_text()
    for section in ("flight", "transfer"):
        kept, inside, skip = [], False, False
        for line in template.splitlines():
            if line.lstrip("# ").startswith("["):
                inside = line.startswith(f"# [{section}]")
                skip = line.startswith(("[orbit]", "[sun]"))
            bare = line[2:] if inside and line.startswith("# ") else line
            kept += [] if skip and not bare.startswith("[") else [bare]
        text = "\n".join(line for line in kept if not line.startswith(("[orbit]", "[sun]")))
        (tmp_path / "s.toml").write_text(text)
        scenario = voyage(tmp_path / "s.toml")
        kind = type(getattr(scenario, section))
        shown = msgspec.to_builtins(getattr(scenario, section))
        lowest = {"lowest_km": 100.0, "highest_km": 100.0} if section == "flight" else {}
        assert shown == msgspec.to_builtins(kind(**lowest))
        assert all(f"# {name} = " in template for name in shown)


def test_a_time_that_is_none_is_named_with_file_and_setting(tmp_path: Path) -> None:
    lines = resource("configs/scenarios/limb_8300km.toml").read_text("utf-8").splitlines()
    changed = [
        'start_utc = "2026-400T00:00:00Z"' if line.startswith("start_utc") else line
        for line in lines
    ]
    assert changed != lines
    path = tmp_path / "s.toml"
    path.write_text("\n".join(changed))
    with pytest.raises(ConfigError, match=r"s\.toml: \[\w+\] start_utc: time .* has no day 400"):
        load_scenario(path)
