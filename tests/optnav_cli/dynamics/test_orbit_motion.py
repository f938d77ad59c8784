"""The compiled motion against scipy with rates written another way, and its derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import SUN_GM_M3_S2, AnalyticEphemeris
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import DataError, NoSolutionError
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.dynamics.orbit_integrator import AU_M, SUN_RADIUS_M, lit_share, path_axes
from optnav_cli.dynamics.orbit_settings import ForcesSettings, SunlightSettings, ThrustArc
from optnav_cli.dynamics.orbit_tables import ArcTables
from tests.studies.orbit_motion import exact_place, low_orbit, one_degree

MOON = load_body("moon")
MOTION = AnalyticEphemeris(MOON)
EPOCH = 8.2e8  # TDB s, late in 2025


def orbit(**settings):
    return OrbitMotion(Forces(MOTION, ForcesSettings(**settings)))


@pytest.mark.parametrize(("degree", "bound_m"), [(2, 1e-3), (50, 0.02)])
def test_two_hours_are_those_of_scipy_at_1e_13(degree, bound_m):
    """Another way to write the field, and no tables; 24 h: `make study-orbit_motion`."""
    forces = Forces(MOTION, ForcesSettings(degree=degree, field="bundled:moon_glgm3_50.tab"))
    to = EPOCH + 7200.0
    found, _ = OrbitMotion(forces).propagate(low_orbit(), EPOCH, np.array([to]))
    wanted = exact_place(forces, low_orbit(), EPOCH, to)
    assert np.linalg.norm(found[0, :3] - wanted) < bound_m


def test_a_day_of_a_low_orbit_is_that_of_taylor_series():
    """By heyoka, with the field of degree 2 as a formula and its gradient by symbols; rotation,
    Earth and Sun as polynomials over the day, good to 1e-12 of their sizes."""
    hy = pytest.importorskip("heyoka", reason="heyoka (extra outside) is not there")
    forces = Forces(MOTION, ForcesSettings(degree=2))
    day, field = 86_400.0, forces.field
    since = np.linspace(0.0, day, 60)

    def of_time(values):
        series = np.polynomial.Chebyshev.fit(since / day, values, 14)
        fit = series.convert(kind=np.polynomial.Polynomial)
        total = hy.expression(0.0)
        for coefficient in fit.coef[::-1]:
            total = total * (hy.time / day) + float(coefficient)
        return total

    turns = np.array([MOTION.body_from_inertial(EPOCH + t) for t in since])
    turn = [[of_time(turns[:, i, j]) for j in range(3)] for i in range(3)]
    x, y, z, *speeds = hy.make_vars("x", "y", "z", "u", "v", "w")
    square = x * x + y * y + z * z
    c, s = (values[2] * np.sqrt(5.0) for values in (field.c, field.s))
    shape = c[0] * (3.0 * z * z - square) / 2.0
    shape += np.sqrt(3.0) * (c[1] * x * z + s[1] * y * z)
    shape += np.sqrt(3.0) / 2.0 * (c[2] * (x * x - y * y) + 2.0 * s[2] * x * y)
    potential = forces.gm * (square**-0.5 + field.radius_m**2 * shape * square**-2.5)
    places = (x, y, z)
    fixed = [sum(turn[i][j] * places[j] for j in range(3)) for i in range(3)]
    of_body = dict(zip("xyz", fixed, strict=True))
    slope = [hy.subs(hy.diff(potential, one), of_body) for one in places]
    pull = [sum(turn[i][j] * slope[i] for i in range(3)) for j in range(3)]
    for name, gm in (("earth", load_body("earth").gm_m3_s2), ("sun", SUN_GM_M3_S2)):
        there = np.array([MOTION.position_m(name, EPOCH + t) for t in since])
        far = [of_time(there[:, j]) for j in range(3)]
        away = [far[j] - places[j] for j in range(3)]
        near_cube, far_cube = (sum(a * a for a in way) ** -1.5 for way in (away, far))
        pull = [pull[j] + gm * (away[j] * near_cube - far[j] * far_cube) for j in range(3)]
    system = [*zip(places, speeds, strict=True), *zip(speeds, pull, strict=True)]
    flight = hy.taylor_adaptive(system, low_orbit().tolist(), tol=1e-15, compact_mode=True)
    flight.propagate_until(day)
    found, _ = OrbitMotion(forces).propagate(low_orbit(), EPOCH, np.array([EPOCH + day]))
    assert np.linalg.norm(found[0, :3] - flight.state[:3]) < 0.01


def test_the_study_says_what_a_degree_costs_and_leaves_out():
    row = one_degree(20, 0.5)
    assert row.error_m < 0.01
    assert row.sigma_m_s2 == pytest.approx(7e-5, rel=0.05)
    assert row.lasting_s == pytest.approx(41.0, rel=0.05)


def test_stepping_on_more_times_changes_little_and_order_nothing():
    motion = orbit(degree=20)
    times = EPOCH + np.array([5400.0, -900.0, 60.0, 0.0, 5400.0])
    states, transitions = motion.propagate(low_orbit(), EPOCH, times)
    alone, _ = motion.propagate(low_orbit(), EPOCH, times[:1])
    assert np.linalg.norm(states[0, :3] - alone[0, :3]) < 0.01
    assert np.array_equal(states[0], states[4])
    assert np.array_equal(states[3], low_orbit())
    assert np.array_equal(transitions[3], np.eye(6))
    # another arc in between makes no other path
    motion.propagate(low_orbit(), EPOCH + 5e6, EPOCH + 5e6 + times[:1] - EPOCH)
    again, _ = orbit(degree=20).propagate(low_orbit(), EPOCH, times)
    assert np.array_equal(states, again)
    assert np.array_equal(motion.propagate(low_orbit(), EPOCH, times)[0], again)


def test_the_transition_is_the_derivative_of_a_flow_in_a_field_of_degree_50():
    """To the share of the gradient above degree 20, which is left out."""
    motion, to = orbit(), np.array([EPOCH + 5000.0])
    _, (transition,) = motion.propagate(low_orbit(), EPOCH, to)
    numeric = np.empty((6, 6))
    for k, size in enumerate([10.0] * 3 + [0.01] * 3):
        step = size * np.eye(6)[k]
        ahead, back = (motion.propagate(low_orbit() + s, EPOCH, to)[0][0] for s in (step, -step))
        numeric[:, k] = (ahead - back) / (2.0 * size)
    for block in (np.s_[:3, :3], np.s_[:3, 3:], np.s_[3:, :3], np.s_[3:, 3:]):
        bound = 5e-3 * np.abs(transition[block]).max()
        assert np.abs(numeric - transition)[block].max() < bound


@pytest.mark.parametrize("degree", [2, 20])
def test_the_transition_is_the_derivative_of_a_flow_whose_gradient_is_whole(degree):
    """Two hours, central differences: their own error is of the second order of the step."""
    motion, to = orbit(degree=degree), np.array([EPOCH + 7200.0])
    _, (transition,) = motion.propagate(low_orbit(), EPOCH, to)
    for k, size in enumerate([30.0] * 3 + [0.03] * 3):
        step = size * np.eye(6)[k]
        ends = [motion.states(low_orbit() + share * step, EPOCH, to)[0] for share in (2, 1, -1, -2)]
        numeric = (-ends[0] + 8.0 * ends[1] - 8.0 * ends[2] + ends[3]) / (12.0 * size)
        assert np.abs(numeric - transition[:, k])[:3].max() < 1e-5 * np.abs(numeric[:3]).max()


@pytest.mark.parametrize("burns", [(), (0,)])
def test_legs_are_paths_from_each_of_their_states(burns):
    motion = orbit(degree=4, field="bundled:moon_glgm3_50.tab", thrust=(BURN,) * len(burns))
    begins = EPOCH + np.array([0.0, 900.0, 2000.0])
    ends = EPOCH + np.array([400.0, 900.0 + 150.0, 1300.0, 1700.0, 2600.0])
    counts = np.array([1, 3, 1])
    states = low_orbit() + np.array([[0.0], [100.0], [-50.0]])
    found = motion.legs(states, begins, ends, counts, ["acceleration"])
    parts = np.split(ends, np.cumsum(counts)[:-1])
    alone = [
        motion.partials(*one, ["acceleration"]) for one in zip(states, begins, parts, strict=True)
    ]
    for got, wanted in zip(found, zip(*alone, strict=True), strict=True):
        wanted = np.concatenate(wanted)
        assert np.abs(got - wanted).max() < 1e-9 * np.abs(wanted).max()


BURN = ThrustArc(
    start_utc=utc_from_tdb_s(EPOCH + 1000.0),
    end_utc=utc_from_tdb_s(EPOCH + 1120.0),
    acceleration_m_s2=(0.1, 0.2, -0.05),
)


@pytest.mark.parametrize("name", ["acceleration", "srp", "thrust_1"])
@pytest.mark.parametrize("seconds", [4000.0, -4000.0])
def test_derivatives_by_force_parameters_are_those_of_the_flow(name, seconds):
    motion = orbit(degree=4, field="bundled:moon_glgm3_50.tab", thrust=(BURN,))
    motion = motion.with_values({"acceleration": np.array([1e-6, 2e-6, -1e-6])})
    epoch = EPOCH if seconds > 0.0 else EPOCH + 3000.0
    to = np.array([epoch + seconds])
    _, (transition,), (derivative,) = motion.partials(low_orbit(), epoch, to, [name])
    values = motion.values[name]
    size = {"acceleration": 1e-5, "srp": 10.0, "thrust_1": 1e-3}[name]
    assert derivative.shape == (6, len(values))
    for k, step in enumerate(size * np.eye(len(values))):
        ends = [
            motion.with_values({name: values + sign * step}).propagate(low_orbit(), epoch, to)[0][0]
            for sign in (1.0, -1.0)
        ]
        numeric = (ends[0] - ends[1]) / (2.0 * size)
        # steps are chosen by the state alone, so that light's derivative is rough at shadows
        bound = 2e-2 if name == "srp" else 1e-3
        assert np.abs(derivative[:3, k] - numeric[:3]).max() < bound * np.abs(numeric[:3]).max()
    # the thrust turns with the path, so that the state's derivative holds it as well
    step = np.array([20.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    ahead, back = (motion.propagate(low_orbit() + s, epoch, to)[0][0] for s in (step, -step))
    numeric = (ahead - back) / 40.0
    assert np.abs(numeric[:3] - transition[:3, 0]).max() < 1e-4 * np.abs(numeric[:3]).max()


def test_a_burn_adds_its_impulse_along_the_path():
    still, burning = orbit(degree=2), orbit(degree=2, thrust=(BURN,))
    times = EPOCH + np.array([1000.0, 1120.0])
    (before, after), _ = burning.propagate(low_orbit(), EPOCH, times)
    (same, _), _ = still.propagate(low_orbit(), EPOCH, times)
    assert np.allclose(before, same, atol=1e-6)
    (coasted,), _ = still.propagate(before, times[0], times[1:])
    axes = np.empty((3, 3))
    path_axes(coasted, axes)
    # 120 s, less by how far the path turns meanwhile (0.13 rad)
    assert axes @ (after - coasted)[3:] == pytest.approx(
        120.0 * np.array(BURN.acceleration_m_s2), abs=2.0
    )


def test_sunlight_pushes_away_from_the_sun_and_stops_in_shadow():
    """1361 W/m2 over c, strength 1: 4.54e-6 m/s^2 at 1 AU."""
    motion = Forces(MOTION, ForcesSettings(sunlight=SunlightSettings(area_over_mass_m2_kg=1.0)))
    plain = Forces(MOTION, ForcesSettings())
    to_sun = MOTION.position_m("sun", EPOCH)
    distance, sun = np.linalg.norm(to_sun), to_sun / np.linalg.norm(to_sun)
    for side, lit in ((1.0, 1.0), (-1.0, 0.0)):
        place = side * 1.9e6 * sun
        added = motion.acceleration(EPOCH, place)[0] - plain.acceleration(EPOCH, place)[0]
        wanted = -1.3 * 4.5398e-6 * (AU_M / distance) ** 2 * lit * sun
        assert added == pytest.approx(wanted, rel=1e-3, abs=1e-15)


def test_the_share_of_the_sun_in_view_falls_from_one_to_nothing():
    sun = np.array([AU_M, 0.0, 0.0])
    across = np.linspace(1.70e6, 1.78e6, 41)
    shares = []
    for y in across:
        craft = np.array([-2.0e6, y, 0.0])
        shares.append(lit_share(craft - sun, craft, SUN_RADIUS_M, MOON.radius_m))
    assert shares[0] == 0.0
    assert shares[-1] == 1.0
    assert np.all(np.diff(shares) >= 0.0)
    # the edge of the body halves the Sun, but for the curve of both
    assert 0.3 < np.interp(MOON.radius_m, across, shares) < 0.7


def test_a_path_into_the_body_is_no_orbit():
    falling = low_orbit()
    falling[3:] *= 0.1
    with pytest.raises(NoSolutionError, match=r"cannot be followed.*meets the body"):
        orbit().propagate(falling, EPOCH, np.array([EPOCH + 7200.0]))


def test_years_are_not_tabulated():
    with pytest.raises(NoSolutionError, match=r"wanted at most 2083"):
        orbit().propagate(low_orbit(), EPOCH, np.array([EPOCH + 1e9]))


class Ending:
    """An ephemeris that ends, as kernels do."""

    def __init__(self, last_s):
        self.body, self.name, self._last_s = MOON, "kernels", last_s

    def body_from_inertial(self, tdb_s):
        if tdb_s > self._last_s:
            raise DataError("the kernels end")
        return MOTION.body_from_inertial(tdb_s)

    def position_m(self, of, tdb_s):
        return MOTION.position_m(of, tdb_s)


def test_an_arc_up_to_the_end_of_the_kernels_is_followed_and_no_farther():
    last = EPOCH + 3000.0
    near = OrbitMotion(Forces(Ending(last)))
    found, _ = near.propagate(low_orbit(), EPOCH, np.array([last]))
    wanted, _ = OrbitMotion(Forces(MOTION)).propagate(low_orbit(), EPOCH, np.array([last]))
    assert np.linalg.norm(found - wanted) < 1e-3
    with pytest.raises(DataError, match="the kernels end"):
        near.propagate(low_orbit(), EPOCH, np.array([last + 7200.0]))


@pytest.mark.parametrize(
    ("name", "epoch_s"), [("moon", EPOCH), ("phobos", EPOCH), ("mars", EPOCH), ("eros", 1e7)]
)
def test_tables_are_as_good_as_the_theories(name, epoch_s):
    motion = AnalyticEphemeris(load_body(name))
    neighbours = ["mars", "sun"] if name == "phobos" else ["sun"]
    tables = ArcTables(motion, neighbours, np.eye(3))
    start, (rotations, turns, places) = tables.span(epoch_s, epoch_s + 20_000.0)
    for tdb_s in epoch_s + np.array([17.0, 9999.9, 19_999.0]):
        interval = int((tdb_s - start) // tables.spacing_s)
        powers = ((tdb_s - start) / tables.spacing_s - interval) ** np.arange(6)
        vector = powers @ turns[interval]
        turn = Rotation.from_rotvec(vector).as_matrix() @ rotations[interval]
        off = np.abs(turn - motion.body_from_inertial(tdb_s)).max()
        assert off * motion.body.radius_m < 1e-4
        for number, other in enumerate(neighbours):
            gap = powers @ places[interval][:, number] - motion.position_m(other, tdb_s)
            assert np.linalg.norm(gap) < (0.02 if other == "mars" else 1.0)


def test_a_field_with_stated_errors_leaves_those_out(tmp_path):
    forces = Forces(MOTION, ForcesSettings(degree=50))
    place = low_orbit()[:3]
    sure = Forces(MOTION, ForcesSettings(degree=50, field_error=0.0))
    assert sure.unmodelled(place).sigma_m_s2 == pytest.approx(9e-6, rel=0.1)
    assert forces.unmodelled(place).sigma_m_s2 > sure.unmodelled(place).sigma_m_s2
    stated = replace(forces.field, errors=np.full(51, 1e-7))
    forces.field = stated
    forces._left_out = forces._coefficients_left_out(known=True)
    assert forces.unmodelled(place).sigma_m_s2 > 2e-5
