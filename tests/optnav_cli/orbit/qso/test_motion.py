"""Motion beside a moon against the landed forces, finite differences and the mesh's field."""

from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.rotation import body_from_inertial
from catalog.config import resource
from catalog.errors import ConfigError
from catalog.terrain.mesh.shape import load_shape
from optnav_cli.dynamics import gravity_kernel as harmonics
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.dynamics.gravity_field import oblate_field
from optnav_cli.orbit.qso.motion import MoonMotion, split
from optnav_cli.orbit.qso.settings import BUNDLED_MESH, mesh_field

PHOBOS = load_body("phobos")
BEGIN = utc_to_tdb_s("2026-01-01T00:00:00Z")
STATE = np.array([6e4, 0.0, 1e3, 0.0, -12.0, 0.0])
HOUR = np.array([BEGIN, BEGIN + 3600.0])


def test_without_the_planets_flattening_it_is_the_motion_of_the_landed_forces() -> None:
    """The landed forces add the Sun's tide, 4 mm in an hour, and integrate adaptively."""
    ours = MoonMotion(PHOBOS, planet_flattening=False).propagate(STATE, HOUR * 1.0, 300.0)[-1]
    landed = OrbitMotion(Forces(AnalyticEphemeris(PHOBOS)))
    theirs = landed.propagate(STATE, BEGIN, HOUR[1:])[0][0]
    assert np.abs(ours - theirs)[:3].max() < 8e-3
    assert np.abs(ours - theirs)[3:].max() < 5e-6


def test_the_planets_flattening_pulls_as_the_textbook_says() -> None:
    """-3/2 GM J2 R^2/r^5 ((1 - 5 (z/r)^2) d + 2 z k), of craft less of moon."""
    motion, flat = MoonMotion(PHOBOS), MoonMotion(PHOBOS, planet_flattening=False)
    mars = motion.planet
    assert mars.gravity is not None
    pole = body_from_inertial(mars, BEGIN)[2]
    strength = 1.5 * mars.gm_m3_s2 * mars.gravity.j2 * (mars.gravity.radius_km * 1e3) ** 2

    def pull(d: np.ndarray) -> np.ndarray:
        r, z = float(np.linalg.norm(d)), float(d @ pole)
        found: np.ndarray = -strength / r**5 * ((1.0 - 5.0 * z**2 / r**2) * d + 2.0 * z * pole)
        return found

    planet = motion.planet_m(np.array([BEGIN]))[0]
    wanted = pull(STATE[:3] - planet) - pull(-planet)
    short = np.array([BEGIN, BEGIN + 10.0])
    speed = motion.propagate(STATE, short, 10.0)[1, 3:] - flat.propagate(STATE, short, 10.0)[1, 3:]
    assert speed / 10.0 == pytest.approx(wanted, rel=1e-2, abs=1e-9)


def test_transitions_agree_with_finite_differences() -> None:
    motion = MoonMotion(PHOBOS)
    _, transitions = split(motion.propagate(STATE, HOUR, 300.0, transition=True))
    numeric = np.empty((6, 6))
    for axis, step in enumerate([10.0] * 3 + [0.01] * 3):
        aside = step * np.eye(6)[axis]
        ends = [motion.propagate(STATE + way * aside, HOUR, 300.0)[1] for way in (1.0, -1.0)]
        numeric[:, axis] = (ends[0] - ends[1]) / (2.0 * step)
    scale = np.abs(numeric).max(axis=1, keepdims=True)
    assert np.abs((numeric - transitions[1]) / scale).max() < 1e-7


def test_a_flight_there_and_back_ends_where_it_began() -> None:
    motion = MoonMotion(PHOBOS)
    end = motion.propagate(STATE, HOUR, 300.0)[1]
    assert motion.propagate(end, HOUR[::-1].copy(), 300.0)[1] == pytest.approx(STATE, abs=1e-6)


def test_coefficients_of_degree_two_pull_as_the_body_files() -> None:
    gravity = PHOBOS.gravity
    assert gravity is not None
    field = oblate_field(gravity, "as the body file")
    one, other = (MoonMotion(PHOBOS, field=f) for f in ("body", field))  # type: ignore[arg-type]
    ends = [motion.propagate(STATE, HOUR, 300.0)[1] for motion in (one, other)]
    assert ends[0] == pytest.approx(ends[1], abs=1e-8)


def test_the_field_of_the_mesh_has_the_published_flattening_and_pulls_as_its_mass() -> None:
    """J2 and C22 of the body file are sums over the same model; the pull is that of small cells."""
    shape = load_shape(BUNDLED_MESH, resource("configs/orbits/qso_55km.toml").parent, PHOBOS)
    field = mesh_field(shape, PHOBOS.radius_m, 8)
    gravity = PHOBOS.gravity
    assert gravity is not None
    stated = oblate_field(gravity, "as the body file")
    assert field.c[2, 0] == pytest.approx(stated.c[2, 0], abs=1e-4)
    assert field.c[2, 2] == pytest.approx(stated.c[2, 2], abs=2e-4)
    # cones to the faces as points of mass three quarters of the way out
    corners = shape.vertices[shape.faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    shells = [(r - 0.5) / 20.0 for r in range(1, 21)]
    place = np.array([30e3, -20e3, 15e3])
    pull = np.zeros(3)
    for r in shells:
        away = place - r * corners.mean(axis=1)
        mass = 3.0 * r * r / 20.0 * volume / volume.sum()
        pull -= (mass[:, None] * away / np.linalg.norm(away, axis=1)[:, None] ** 3).sum(axis=0)
    centre = sum(3.0 * r * r / 20.0 * r for r in shells) * np.einsum(
        "i,ij->j", volume / volume.sum(), corners.mean(axis=1)
    )
    distance = float(np.linalg.norm(place))
    # degree 1 is left out of the field: the ephemeris is that of the centre of mass
    dipole = centre / distance**3 - 3.0 * (centre @ place) * place / distance**5
    ours = np.empty(3)
    harmonics.pull(place, (1.0, field.radius_m), harmonics.harmonic_tables(field, 8)[0], ours)
    ours = ours - place / distance**3 + dipole
    assert ours == pytest.approx(pull, rel=2e-3)


def test_the_field_of_the_mesh_pulls_as_the_polyhedron() -> None:
    """By the closed form of polyhedral-gravity, which says all degrees: from 20 km what degrees
    above 8 pull is left, 1e-3 of it."""
    outside = pytest.importorskip(
        "polyhedral_gravity", reason="polyhedral-gravity (extra outside) is not there"
    )
    shape = load_shape(BUNDLED_MESH, resource("configs/orbits/qso_55km.toml").parent, PHOBOS)
    corners = shape.vertices[shape.faces]
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    # the field is about the centre of the model's coordinates without its dipole
    middle = (volumes[:, None] * corners.sum(axis=1)).sum(axis=0) / 4.0 / volumes.sum()
    solid = outside.Polyhedron(
        polyhedral_source=(shape.vertices, shape.faces),
        density=1.0 / 6.6743e-11 / float(volumes.sum()),
        integrity_check=outside.PolyhedronIntegrity.DISABLE,
    )
    table = harmonics.harmonic_tables(mesh_field(shape, PHOBOS.radius_m, 8), 8)[0]
    for place in ([16e3, -10e3, 8e3], [5e3, 18e3, -7e3], [-3e3, 4e3, 19.5e3]):
        at = np.array(place)
        distance, ours = float(np.linalg.norm(at)), np.empty(3)
        harmonics.pull(at, (1.0, PHOBOS.radius_m), table, ours)
        dipole = middle / distance**3 - 3.0 * (middle @ at) * at / distance**5
        wanted = np.array(outside.evaluate(solid, at, parallel=False)[1])
        found = ours - at / distance**3 + dipole
        assert np.linalg.norm(found - wanted) < 1e-3 * np.linalg.norm(wanted)


def test_the_turning_frame_turns_with_the_moon() -> None:
    motion = MoonMotion(PHOBOS)
    turning = motion.turning_from_inertial(np.array([BEGIN]))[0]
    planet = turning @ motion.planet_m(np.array([BEGIN]))[0]
    assert planet[0] < -9e6
    assert planet[1:] == pytest.approx([0.0, 0.0], abs=1e-6)
    rate, recession = motion.turning_rates(BEGIN)
    assert rate == pytest.approx(motion.mean_motion, rel=0.035)  # the eccentricity twice
    assert abs(recession) < 35.0


def test_a_body_without_a_planet_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"moon: its body file has no .orbit. about a planet"):
        MoonMotion(load_body("moon"))


def test_a_mesh_of_another_place_is_named(tmp_path: Path) -> None:
    from optnav_cli.orbit.qso.settings import MoonForces, motion_of_moon

    mesh = type(BUNDLED_MESH)(path="none.obj", units="km")
    with pytest.raises(Exception, match=r"none\.obj"):
        motion_of_moon(MoonForces(field="mesh", mesh=mesh), PHOBOS, tmp_path)
