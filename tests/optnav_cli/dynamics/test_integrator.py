"""Orbits against Kepler's closed form, known drifts, published sizes and finite differences."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from optnav_cli.dynamics.forces import Forces, OrbitMotion

MOON = load_body("moon")
GM = MOON.gm_m3_s2
NOON = 8.2e8  # TDB s, late in 2025


@dataclass
class Still:
    """A body that neither turns nor has neighbours near enough to feel."""

    body: object

    def body_from_inertial(self, tdb_s):
        return np.eye(3)

    def position_m(self, of, tdb_s):
        return np.array([1e22, 0.0, 0.0])


def still(j2=0.0, c22=0.0):
    gravity = replace_struct(MOON.gravity, j2=j2, c22=c22)
    return OrbitMotion(Forces(Still(replace(MOON, gravity=gravity))))


def replace_struct(gravity, **changes):
    return type(gravity)(
        **{**{f: getattr(gravity, f) for f in gravity.__struct_fields__}, **changes}
    )


def kepler(a, e, inclination, t):
    """State on an ellipse, t s after pericentre, line of nodes along x, pericentre on it."""
    mean = np.sqrt(GM / a**3) * t
    eccentric = mean
    for _ in range(50):
        eccentric = mean + e * np.sin(eccentric)
    b = a * np.sqrt(1 - e * e)
    rate = np.sqrt(GM / a**3) / (1 - e * np.cos(eccentric))
    plane = np.array([a * (np.cos(eccentric) - e), b * np.sin(eccentric), 0.0])
    speed = rate * np.array([-a * np.sin(eccentric), b * np.cos(eccentric), 0.0])
    c, s = np.cos(inclination), np.sin(inclination)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return np.concatenate([turn @ plane, turn @ speed])


@pytest.mark.parametrize(("a", "e"), [(1.84e6, 0.01), (2.6e6, 0.3), (4.0e7, 0.95)])
def test_without_perturbations_the_orbit_is_keplers_ellipse(a, e):
    period = 2 * np.pi * np.sqrt(a**3 / GM)
    start = kepler(a, e, 0.7, 0.1 * period)
    times = np.array([0.4, -0.3, 0.0, 0.9]) * period
    states, _ = still().propagate(start, NOON, NOON + times)
    wanted = np.array([kepler(a, e, 0.7, 0.1 * period + t) for t in times])
    # NOON's own digits are 1e-7 s
    assert np.abs(states[:, :3] - wanted[:, :3]).max() < 1e-7 * a * 0.1
    assert np.abs(states[:, 3:] - wanted[:, 3:]).max() < 1e-4


@pytest.mark.parametrize("seconds", [900.0, -900.0, 7000.0])
def test_the_transition_is_the_derivative_of_the_flow(seconds):
    orbit = OrbitMotion(Forces(AnalyticEphemeris(MOON)))
    start = kepler(1.85e6, 0.02, 1.2, 300.0)
    to = np.array([NOON + seconds])
    _, (transition,) = orbit.propagate(start, NOON, to)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 50.0 if k < 3 else 0.05
        ahead, _ = orbit.propagate(start + step, NOON, to)
        back, _ = orbit.propagate(start - step, NOON, to)
        numeric = (ahead[0] - back[0]) / (2.0 * step[k])
        scale = np.abs(transition[:, k]) + np.array([1.0] * 3 + [1e-3] * 3) * (
            1.0 if k < 3 else 1e3
        )
        assert np.abs((numeric - transition[:, k]) / scale).max() < 2e-5


def test_going_there_and_back_ends_where_it_began():
    orbit = OrbitMotion(Forces(AnalyticEphemeris(MOON)))
    start = kepler(1.85e6, 0.02, 1.2, 0.0)
    there, forth = orbit.propagate(start, NOON, np.array([NOON + 3000.0]))
    again, back = orbit.propagate(there[0], NOON + 3000.0, np.array([NOON]))
    assert np.linalg.norm(again[0, :3] - start[:3]) < 0.01
    assert np.abs(back[0] @ forth[0] - np.eye(6)).max() < 1e-3


def test_the_field_is_the_gradient_of_its_potential():
    """J2 and C22 as the textbooks write them, by latitude and longitude."""
    forces = Forces(Still(MOON))
    field = MOON.gravity
    reference = field.radius_km * 1e3

    def potential(p):
        r = np.linalg.norm(p)
        sine, lon = p[2] / r, np.arctan2(p[1], p[0])
        p22 = 3.0 * (1.0 - sine**2)
        shape = -field.j2 * 0.5 * (3 * sine**2 - 1) + field.c22 * p22 * np.cos(2 * lon)
        return GM / r * (1.0 + (reference / r) ** 2 * shape)

    for place in ([1.8e6, 2e5, 3e5], [-9e5, 1.2e6, -1.1e6], [1e5, -2e5, 1.9e6]):
        place = np.array(place)
        pull, gradient = forces.acceleration(0.0, place)
        for k in range(3):
            step = np.eye(3)[k] * 200.0
            slope = (potential(place + step) - potential(place - step)) / 400.0
            assert pull[k] == pytest.approx(slope, abs=2e-7)
            ahead, _ = forces.acceleration(0.0, place + step)
            back, _ = forces.acceleration(0.0, place - step)
            assert np.allclose((ahead - back) / 400.0, gradient[:, k], atol=1e-13)


def test_j2_turns_the_node_at_the_textbook_rate():
    """-3/2 n J2 (R/a)^2 cos i for a circular orbit (Vallado, "Fundamentals of Astrodynamics")."""
    a, inclination = 1.9e6, 0.9
    orbit = still(j2=MOON.gravity.j2)
    rate = np.sqrt(GM / a**3)
    turns = np.arange(1, 4) * 2 * np.pi / rate
    states, _ = orbit.propagate(kepler(a, 0.0, inclination, 0.0), 0.0, turns)
    normal = np.cross(states[:, :3], states[:, 3:])
    node = np.arctan2(normal[:, 0], -normal[:, 1])
    flattened = (MOON.gravity.radius_km * 1e3 / a) ** 2
    wanted = -1.5 * rate * MOON.gravity.j2 * flattened * np.cos(inclination) * turns
    assert np.allclose(node, wanted, rtol=0.01)


def test_the_earths_tide_is_that_of_two_point_masses():
    motion = AnalyticEphemeris(MOON)
    forces = Forces(motion)
    place = np.array([6e7, -3e7, 2e7])
    earth, sun = motion.position_m("earth", NOON), motion.position_m("sun", NOON)
    pull, _ = forces.acceleration(NOON, place)
    wanted = -GM * place / np.linalg.norm(place) ** 3
    for gm, there in ((load_body("earth").gm_m3_s2, earth), (1.32712e20, sun)):
        gap = there - place
        wanted = wanted + gm * (gap / np.linalg.norm(gap) ** 3 - there / np.linalg.norm(there) ** 3)
    assert np.allclose(pull, wanted, rtol=1e-5, atol=1e-9)
    alone = -GM * place / np.linalg.norm(place) ** 3
    assert np.linalg.norm(wanted - alone) > 0.1 * np.linalg.norm(alone)


def test_what_is_left_out_has_the_size_that_the_whole_field_shows():
    """GLGM-3's coefficients summed from degree 3 to 120: rms acceleration by height, m/s^2."""
    forces = Forces(AnalyticEphemeris(MOON))
    for height_m, rms in ((50e3, 7.6e-4), (100e3, 5.1e-4), (400e3, 1.45e-4)):
        left = forces.unmodelled(np.array([0.0, 0.0, MOON.radius_m + height_m]))
        assert rms < np.sqrt(3.0) * left.sigma_m_s2 < 2.0 * rms
    assert 60.0 < left.lasting_s < 600.0


def test_noise_grows_with_time_and_both_ways():
    orbit = OrbitMotion(Forces(AnalyticEphemeris(MOON)))
    state = kepler(1.84e6, 0.0, 0.5, 0.0)
    sigma = [np.sqrt(orbit.noise(state, t)[0, 0]) for t in (60.0, 600.0, -600.0)]
    assert 0.5 < sigma[0] < 5.0
    assert 20.0 < sigma[1] < 200.0
    assert sigma[2] == sigma[1]
    assert np.linalg.eigvalsh(orbit.noise(state, -600.0))[0] > 0.0
