"""Gravity of the shipped body files: published rates, and another integrator."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from catalog.bodies.body import GravityField, SunOrbit, load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.config import resource
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.dynamics.gravity_field import oblate_field

EARTH = load_body("earth")
NOON = 8.2e8  # TDB s, late in 2025
DAY_S = 86400.0
SHIPPED = [path.stem for path in resource("configs/bodies/moon.toml").parent.glob("*.toml")]
UNMEASURED = {
    *("67p", "bennu", "itokawa", "ryugu", "didymos", "dimorphos", "ida", "deimos", "hyperion"),
    *("mimas", "tethys", "iapetus", "miranda", "ariel", "umbriel", "titania", "oberon", "triton"),
    *("pluto", "charon"),
}


@dataclass
class Alone:
    """Turns as the body does; its neighbours are too far away to feel."""

    body: object

    def body_from_inertial(self, tdb_s):
        return AnalyticEphemeris(self.body).body_from_inertial(tdb_s)

    def position_m(self, of, tdb_s):
        return np.array([1e22, 0.0, 0.0])


def potential(gravity, gm, place):
    """V of the textbook (Vallado), by latitude and longitude, with Legendre's own polynomials."""
    r = np.linalg.norm(place)
    sine, lon = place[2] / r, np.arctan2(place[1], place[0])
    share = gravity.radius_km * 1e3 / r
    total = 1.0
    for n, zonal in enumerate(gravity.zonals, start=2):
        total -= zonal * share**n * np.polynomial.legendre.Legendre.basis(n)(sine)
    sector = gravity.c22 * np.cos(2.0 * lon) + gravity.s22 * np.sin(2.0 * lon)
    total += share**2 * 3.0 * (1.0 - sine**2) * sector
    return gm / r * total


def pull(gravity, gm, place):
    """Central differences of the potential's part beside the point mass, 1e-9 m/s^2."""
    step, out = 50.0, -gm * place / np.linalg.norm(place) ** 3
    for k in range(3):
        ahead, back = place + step * np.eye(3)[k], place - step * np.eye(3)[k]
        rise = potential(gravity, gm, ahead) - gm / np.linalg.norm(ahead)
        out[k] += (rise - potential(gravity, gm, back) + gm / np.linalg.norm(back)) / (2.0 * step)
    return out


def test_an_orbit_of_the_earth_is_that_of_another_integrator_to_a_metre():
    """500 km, 51.6 deg, four turns; without J3 and J4 it is 0.4 km off, without S22 as well."""
    motion, gm = Alone(EARTH), EARTH.gm_m3_s2
    a, tilt = 6.878e6, np.radians(51.6)
    speed = np.sqrt(gm / a)
    start = np.array([a, 0.0, 0.0, 0.0, speed * np.cos(tilt), speed * np.sin(tilt)])
    last = 4.0 * 2.0 * np.pi * a / speed

    def slope(t, state):
        turn = motion.body_from_inertial(NOON + t)
        return np.concatenate([state[3:], turn.T @ pull(EARTH.gravity, gm, turn @ state[:3])])

    wanted = solve_ivp(slope, (0.0, last), start, "DOP853", rtol=1e-10, atol=1e-4).y[:3, -1]
    orbit = OrbitMotion(Forces(motion))
    states, _ = orbit.propagate(start, NOON, np.array([NOON + last]))
    assert np.linalg.norm(states[0, :3] - wanted) < 1.0


def test_the_node_of_a_sun_synchronous_orbit_turns_once_a_year():
    """Landsat's 705 km at 98.2 deg: 0.9856 deg a day (Vallado, "Fundamentals of Astrodynamics")."""
    gm, a, tilt = EARTH.gm_m3_s2, 6371.0e3 + 7.05e5 + 7.1e3, np.radians(98.2)
    speed = np.sqrt(gm / a)
    start = np.array([a, 0.0, 0.0, 0.0, speed * np.cos(tilt), speed * np.sin(tilt)])
    orbit = OrbitMotion(Forces(AnalyticEphemeris(EARTH)))
    states, _ = orbit.propagate(start, NOON, np.array([NOON + DAY_S]))
    normal = np.cross(states[0, :3], states[0, 3:])
    node = np.degrees(np.arctan2(normal[0], -normal[1]))
    assert node == pytest.approx(0.9856, abs=0.01)


def test_terms_of_a_body_file_become_normalised_coefficients():
    field = oblate_field(EARTH.gravity, "earth")
    assert field.degree == 4
    # EGM2008
    assert field.c[2, 0] == pytest.approx(-4.84165143790815e-4, rel=1e-8)
    assert field.c[3, 0] == pytest.approx(9.57161207093473e-7, rel=1e-8)
    assert field.c[4, 0] == pytest.approx(5.39965866638991e-7, rel=1e-8)
    assert field.c[2, 2] == pytest.approx(2.43938357328313e-6, rel=1e-8)
    assert field.s[2, 2] == pytest.approx(-1.40027370385934e-6, rel=1e-8)
    assert oblate_field(GravityField(j2=1e-3, radius_km=1.0), "one").degree == 2


def test_zonal_terms_leave_the_other_orders_of_their_degree_out():
    """Degree 3 without its zonal term is known no better than by Kaula's rule: 6 of 7 are left."""
    plain = GravityField(j2=1e-3, radius_km=6378.0, kaula=1e-5)
    zonal = GravityField(j2=1e-3, j3=-2e-6, radius_km=6378.0, kaula=1e-5)
    place = np.array([4e7, 0.0, 0.0])  # where degree 3 is all that counts
    left = []
    for gravity in (plain, zonal):
        body = type(EARTH)(**{**EARTH.__dict__, "gravity": gravity})
        left.append(Forces(Alone(body)).unmodelled(place).sigma_m_s2)
    assert left[1] / left[0] == pytest.approx(np.sqrt(6.0 / 7.0), abs=0.01)


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_forces_work_about_every_shipped_body(name):
    """Some radii out the pull is that of the point mass to a share that the shape allows."""
    body = load_body(name)
    place = np.array([4.0, 2.0, 3.0]) * max(body.radii_m)
    year = body.sun.years[0] + 1.0 if isinstance(body.sun, SunOrbit) else 2010.0
    forces = Forces(Alone(body))
    found, _ = forces.acceleration((year - 2000.0) * 365.25 * DAY_S, place)
    point = -body.gm_m3_s2 * place / np.linalg.norm(place) ** 3
    share = np.linalg.norm(found - point) / np.linalg.norm(point)
    assert share < 0.02
    # of a field that no one has measured nothing is stated
    assert (body.gravity is None) == (name in UNMEASURED)
    assert forces.unmodelled(place).sigma_m_s2 > 0.0


@pytest.mark.parametrize(
    ("name", "j2", "c22"),
    [  # as the papers have them, unnormalised, for the radius of the file
        ("io", 1845.9e-6, 553.7e-6), ("europa", 435.5e-6, 131.0e-6),
        ("titan", 33.089e-6, 10.385e-6), ("dione", 1496e-6, 364.8e-6),
        ("jupiter", 14696.572e-6, 0.0), ("saturn", 16290.573e-6, 0.0),
    ],
)  # fmt: skip
def test_gravity_is_as_published(name, j2, c22):
    gravity = load_body(name).gravity
    assert (gravity.j2, gravity.c22) == pytest.approx((j2, c22), rel=1e-9)


def test_a_locked_moon_feels_its_planet():
    """Over Europa Jupiter's tide, 3 GM r / d^3 along the line, is what moves an orbit most."""
    europa, jupiter = load_body("europa"), load_body("jupiter")
    motion = AnalyticEphemeris(europa)
    line = motion.position_m("jupiter", NOON)
    place = line / np.linalg.norm(line) * 5.0 * europa.radius_m
    pull = [Forces(m).acceleration(NOON, place)[0] for m in (motion, Alone(europa))]
    tide = 2.0 * jupiter.gm_m3_s2 * np.linalg.norm(place) / np.linalg.norm(line) ** 3
    assert np.linalg.norm(pull[0] - pull[1]) == pytest.approx(tide, rel=0.05)
