"""A path past a small body: where its pictures are taken, what pulls the ship, what is refused."""

import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import ConfigError
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.shape import Shape, load_shape
from optnav_cli.simulation import inertial_path
from optnav_cli.simulation.inertial_path import ApproachSettings, masses_of
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.scenario_base import Exposure

ROOT = Path(__file__).resolve().parents[3]
SHIPPED = ROOT / "configs" / "scenarios" / "phobos_approach.toml"
PHOBOS = load_body("phobos")
MARS_RADIUS_M = load_body("mars").radius_m


@pytest.fixture(scope="module")
def flight() -> list[Exposure]:
    """The shipped approach."""
    return load_scenario(SHIPPED).exposures(AnalyticEphemeris(PHOBOS))


def test_pictures_are_taken_at_even_ratios_down_to_the_lowest_point(flight: list[Exposure]) -> None:
    distances = np.array([np.linalg.norm(s.position_m) for s in flight])
    np.testing.assert_allclose(distances, 1e3 * np.geomspace(300.0, 20.0, 60), rtol=1e-4)
    times = np.array([s.tdb_s for s in flight])
    assert times[-1] == utc_to_tdb_s("2026-05-12T07:00:00Z")
    assert (np.diff(times) > 0.0).all()
    assert all(s.prior_m is None and not s.reported_sun for s in flight)
    motion = AnalyticEphemeris(PHOBOS)
    last = [motion.body_from_inertial(s.tdb_s).T @ s.position_m for s in flight[-2:]]
    speed = np.linalg.norm(last[1] - last[0]) / np.diff(times[-2:])[0]
    assert speed == pytest.approx(35.0, rel=0.02)


def test_mars_is_out_of_view_and_casts_no_shadow(flight: list[Exposure]) -> None:
    """As the scenario says; the half diagonal of the camera's field is 16.6 deg."""
    motion = AnalyticEphemeris(PHOBOS)
    for shot in flight:
        mars = motion.body_from_inertial(shot.tdb_s) @ motion.position_m("mars", shot.tdb_s)
        distance = float(np.linalg.norm(mars))
        size = np.degrees(np.arcsin(MARS_RADIUS_M / distance))
        boresight = shot.camera_from_body.as_matrix()[2]
        assert np.degrees(np.arccos(boresight @ mars / distance)) > size + 16.6
        assert np.degrees(np.arccos(shot.sun_body @ mars / distance)) > size + 1.0
        phase = shot.sun_body @ shot.position_m / np.linalg.norm(shot.position_m)
        assert 30.0 < np.degrees(np.arccos(phase)) < 70.0


def test_point_masses_pull_as_the_even_shape_does() -> None:
    """A ball like its centre; Phobos by the potential of the body file's J2 and C22."""
    mesh = trimesh.creation.icosphere(4, radius=11e3)
    ball = masses_of(Shape(mesh.vertices + 500.0, mesh.faces), PHOBOS)
    assert ball.gm_m3_s2.sum() == pytest.approx(PHOBOS.gm_m3_s2)
    place = np.array([9e3, -17e3, 12e3])

    def potential(masses: object, at: np.ndarray) -> float:
        away = np.linalg.norm(at - masses.places_m, axis=1)  # type: ignore[attr-defined]
        return float((masses.gm_m3_s2 / away).sum())  # type: ignore[attr-defined]

    central = PHOBOS.gm_m3_s2 / np.linalg.norm(place)
    assert potential(ball, place) == pytest.approx(central, rel=1e-4)
    model = MeshSettings("bundled:phobos_thomas.tab", units="km", longitude="west")
    phobos = masses_of(load_shape(model, ROOT, PHOBOS), PHOBOS)
    assert np.abs(phobos.gm_m3_s2 @ phobos.places_m).max() < 1e-3 * PHOBOS.gm_m3_s2
    field = PHOBOS.gravity
    assert field is not None
    # far off, where degree 3 is small; each axis another sum of the two
    r = 60e3
    for axis, factor in enumerate((0.5 * field.j2 + 3.0 * field.c22,
                                   0.5 * field.j2 - 3.0 * field.c22, -field.j2)):  # fmt: skip
        both = [potential(phobos, sign * r * np.eye(3)[axis]) for sign in (1.0, -1.0)]
        found = np.mean(both) * r / PHOBOS.gm_m3_s2 - 1.0
        assert found == pytest.approx(factor * (1e3 * field.radius_km / r) ** 2, abs=6e-5)


def test_fewer_pictures_fly_the_same_path(flight: list[Exposure]) -> None:
    few = load_scenario(SHIPPED).shortened(3).exposures(AnalyticEphemeris(PHOBOS))
    assert [round(float(np.linalg.norm(s.position_m)) / 1e3) for s in few] == [300, 77, 20]
    np.testing.assert_allclose(few[-1].position_m, flight[-1].position_m, atol=1e-3)


def test_the_template_shows_the_defaults() -> None:
    template = (ROOT / "configs" / "templates" / "scenario.toml").read_text()
    section = template.partition("# [approach]")[2].partition("\n")[2].partition("\n\n")[0]
    shown = tomllib.loads("\n".join(line.removeprefix("# ") for line in section.splitlines()))
    assert shown == msgspec.to_builtins(ApproachSettings())


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("from_km = 300.0", "from_km = 15.0", "to_km is 20, not below from_km 15"),
        ("from_km = 300.0", "from_km = 30000.0", "comes from .* within 6 hours"),
        ("to_km = 20.0", "to_km = 14.0", "where mountains are"),
        ("[approach]", '[[dem]]\npath = "moon_gld100_4ppd.tif"\n\n[approach]', "dem"),
    ],
)
def test_what_cannot_be_flown_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str, word: str
) -> None:
    monkeypatch.setattr(inertial_path, "MAX_S", 6 * 3600.0)  # five days take long to integrate
    text = SHIPPED.read_text()
    assert old in text
    (tmp_path / "s.toml").write_text(text.replace(old, new).replace("frames = 60", "frames = 2"))
    with pytest.raises(ConfigError, match=word):
        load_scenario(tmp_path / "s.toml").exposures(AnalyticEphemeris(PHOBOS))
