"""Ranges and Doppler from stations, angles, altimeter: light time, derivatives, fits, bad files."""

import erfa
import numpy as np
import pytest

from catalog.bodies.epochs import utc_from_tdb_s
from catalog.bodies.rotation import EarthOrientation, rotate_earth
from catalog.errors import DataError
from optnav_cli.dynamics.forces import OrbitMotion
from optnav_cli.frames.orbit_tables import MEASUREMENT_RESIDUALS, MEASUREMENTS
from optnav_cli.main import run
from optnav_cli.orbit.fit.fit import fit_orbit
from optnav_cli.orbit.fit.folder import read_orbit
from optnav_cli.orbit.fit.measurements import read_measurements
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.problem import OrbitPrior, OrbitProblem, Trajectory
from optnav_cli.orbit.fit.settings import NoiseSettings, ParameterSettings
from optnav_cli.orbit.fit.stations import (
    LIGHT_M_S,
    AntennaSettings,
    SignalGeometry,
    StationNetwork,
    map_delay,
    zenith_delays_m,
)
from optnav_cli.orbit.fit.tracking import Passes, RangeRates, Ranges
from tests.optnav_cli.orbit.fit.flights import (
    EPHEMERIS,
    FORCES,
    MOON,
    START_S,
    fixes_of,
    write_run,
)

GATE = 1e-5
STATIONS = (
    AntennaSettings("Canberra", -35.4, 148.98, 690.0, (0.1, 0.1, 0.1)),
    AntennaSettings("Madrid", 40.4, -4.25, 830.0, (0.1, 0.1, 0.1)),
)
RANGE_M, RATE_M_S, COUNT_S = 5.0, 5e-4, 60.0
DAYS = 2.0
EPHEMERIS_M, BIAS_M = 1.0, 3.0
MOTION = ArcMotion(FORCES, NoiseSettings("none"))
FLOWN = OrbitMotion(FORCES)
PARAMETERS = [
    ParameterSettings("range_bias", prior_sigma=BIAS_M),
    ParameterSettings("station_place", mode="consider"),
    ParameterSettings("troposphere", mode="consider"),
    ParameterSettings("ephemeris", prior_sigma=EPHEMERIS_M, mode="consider"),
]


def orientation():
    """A table that knows UT1 and the pole exactly: UT1 = UTC, 37 s behind TAI."""
    mjd = 51544.5 + START_S / 86400.0 + np.arange(-3.0, 6.0)
    columns = np.zeros((len(mjd), 7))
    columns[:, 0] = -37.0
    return EarthOrientation("exact", mjd, columns)


def make_network():
    ends = START_S - 4e3, START_S + DAYS * 86400 + 4e3
    return StationNetwork(STATIONS, orientation(), EPHEMERIS, ends)


def first_state(height_m=100e3):
    radius = MOON.radius_m + height_m
    speed = np.sqrt(FORCES.gm / radius)
    return np.array([radius, 0.0, 0.0, 0.0, 0.3 * speed, np.sqrt(0.91) * speed])


@pytest.fixture(scope="module")
def network():
    return make_network()


def seen(network, every_s=600.0, days=DAYS, mask_deg=10.0):
    """Times and stations (n,) of receptions, the body above the mask."""
    times = START_S + np.arange(1200.0, 86400.0 * days, every_s)
    times, stations = np.repeat(times, 2), np.tile([0, 1], len(times))
    sines = SignalGeometry(network, times, stations, stations).elevation_sines()[:, 0]
    kept = sines > np.sin(np.radians(mask_deg))
    return times[kept], stations[kept]


def states_at(geometry, state):
    return FLOWN.states(state, START_S, geometry.bounced_s)


def sets_of(network, state, rng=None, days=DAYS):
    """Ranges and range rates of a flight, with errors drawn of all that is stated, or none."""
    times, stations = seen(network, days=days)
    _, pass_of = np.unique(
        np.round((times - START_S) / 43200.0) * 2 + stations, return_inverse=True
    )
    passes = Passes(network, stations, pass_of, int(pass_of.max()) + 1)
    geometry = SignalGeometry(network, times, stations, stations)
    ends = [SignalGeometry(network, times + d, stations, stations) for d in (-30.0, 30.0)]
    count, lines = len(times), np.arange(len(times))
    values = geometry.follow(states_at(geometry, state)).lengths_m
    start, end = (part.follow(states_at(part, state)).lengths_m for part in ends)
    ones = np.ones(count)
    ranges = Ranges(values, RANGE_M * ones, lines, passes, geometry)
    rates = (end - start) / COUNT_S
    doppler = RangeRates(rates, RATE_M_S * ones, lines, passes, COUNT_S * ones, *ends)
    if rng is None:
        return ranges, doppler
    problem = problem_of([ranges, doppler], state)
    nodes = FLOWN.states(state, START_S, problem.times)
    at = Trajectory(nodes, np.zeros(problem.width - 6))
    rows = problem.rows(at)
    drawn = rows.considered @ np.concatenate(
        [np.sqrt(np.diag(p.covariance)) * rng.normal(size=p.size) for p in problem.considered]
    )
    drawn = drawn + rows.design[:, 6:] @ (BIAS_M * rng.normal(size=problem.width - 6))
    drawn = drawn + problem.scalars.sigmas * rng.normal(size=2 * count)
    ranges.values[:] += drawn[:count]
    doppler.values[:] += drawn[count:]
    return ranges, doppler


def problem_of(sets, state, fixes=(), with_nodes=True, prior=None):
    between = np.linspace(START_S, START_S + 86400.0 * DAYS, int(86400 * DAYS / 1000.0) + 1)
    return OrbitProblem(
        MOTION,
        list(fixes),
        [] if prior is None else [prior],
        PARAMETERS,
        MOON.radius_m,
        between if with_nodes else np.empty(0),
        tracking=sets,
    )


def prior_of(state, rng):
    sigmas = np.array([1e3] * 3 + [1.0] * 3)
    return OrbitPrior(START_S, state + sigmas * rng.normal(size=6), np.diag(sigmas**2), "prior")


def test_signal_paths_are_those_of_direct_iteration_in_barycentric_axes(network):
    """The check is in doubles of seconds past J2000: 1e-7 s of the body's 30 km/s are 4 mm."""
    state = first_state()
    received = START_S + np.array([5000.0, 30000.0, 70000.0])
    receiver, sender = np.array([0, 0, 1]), np.array([0, 1, 1])
    geometry = SignalGeometry(network, received, receiver, sender)
    states = states_at(geometry, state)
    paths = geometry.follow(states)

    def sun_to_body(t):
        return -EPHEMERIS.position_m("sun", t)

    def station(k, t):
        settings = STATIONS[k]
        fixed = erfa.gd2gc(1, *np.radians([settings.lon_deg, settings.lat_deg]), settings.height_m)
        place = rotate_earth(t, None).T @ fixed
        centre = sun_to_body(t) + EPHEMERIS.position_m("earth", t)
        return centre + place * (1.0 - 2.47e-8)

    def craft(t):
        return sun_to_body(t) + FLOWN.states(state, START_S, np.array([t]))[0, :3]

    for k, end_s in enumerate(received):
        end, bounce = station(receiver[k], end_s), end_s
        for _ in range(20):
            bounce = end_s - np.linalg.norm(end - craft(bounce)) / LIGHT_M_S
        sent = bounce
        for _ in range(20):
            sent = bounce - np.linalg.norm(station(sender[k], sent) - craft(bounce)) / LIGHT_M_S
        down = np.linalg.norm(end - craft(bounce))
        up = np.linalg.norm(station(sender[k], sent) - craft(bounce))
        sines = paths.sines[k]
        delay = sum(
            zenith_delays_m(STATIONS[which[k]].height_m)[part]
            * map_delay(sines[side : side + 1], constants)[0]
            for side, which in enumerate((receiver, sender))
            for part, constants in enumerate(((0.00143, 0.0445), (0.00035, 0.017)))
        )
        sun = 2.0 * 1.32712440018e20 / LIGHT_M_S**2
        legs = [np.linalg.norm(sun_to_body(bounce) + EPHEMERIS.position_m("earth", bounce))]
        legs.append(np.linalg.norm(sun_to_body(bounce)))
        bent = sun * np.log((sum(legs) + down) / (sum(legs) - down))
        clock = erfa.dtdb(2451545.0, end_s / 86400, 0, 0, 0, 0) - erfa.dtdb(
            2451545.0, sent / 86400, 0, 0, 0, 0
        )
        wanted = 0.5 * (down + up + delay) + bent - 0.5 * LIGHT_M_S * clock
        # 0.04 m: the Earth's own delay and the contraction along its motion, left out here
        assert paths.lengths_m[k] == pytest.approx(wanted, abs=0.15)


def test_derivatives_of_signals_are_those_of_differences(network):
    state = first_state()
    sets = sets_of(network, state, days=0.5)
    problem = problem_of(sets, state)
    at = Trajectory(FLOWN.states(state, START_S, problem.times), np.zeros(problem.width - 6))
    rows = problem.rows(at)
    for k, step in enumerate([10.0] * 3 + [0.01] * 3):
        moved = []
        for side in (step, -step):
            states = at.states.copy()
            states[:, k] += side
            moved.append(problem.rows(Trajectory(states, at.parameters)).residuals)
        slope = -(moved[0] - moved[1]) / (2.0 * step)
        for here in problem.scalars.spans:
            scale = np.abs(rows.design[here, k]).max()
            assert np.allclose(slope[here], rows.design[here, k], atol=2e-4 * scale), k


def flown_fit(network, seed, fixes=(), sets=None):
    rng = np.random.default_rng(seed)
    state = first_state()
    sets = sets_of(network, state, rng) if sets is None else sets
    prior = None if fixes else prior_of(state, rng)
    problem = problem_of(sets, state, fixes, with_nodes=False, prior=prior)
    fit = fit_orbit(problem, "none", GATE)
    truth = FLOWN.states(state, START_S, fit.problem.times)
    return fit, fit.trajectory.states - truth


def nees(fit, errors):
    node = len(errors) // 2
    scale = np.sqrt(np.diag(fit.covariances[node]))
    matrix = fit.covariances[node] / np.outer(scale, scale)
    return float(errors[node] / scale @ np.linalg.solve(matrix, errors[node] / scale)) / 6.0


def test_an_orbit_by_ranges_and_doppler_is_good_to_its_sigma(network):
    fit, errors = flown_fit(network, 5)
    sigmas = np.sqrt(np.diagonal(fit.covariances, axis1=1, axis2=2))
    assert (np.abs(errors) < 4.0 * sigmas).all()
    assert 0.1 < nees(fit, errors) < 3.0
    assert fit.problem.measured == "ranges and range rates"


@pytest.mark.slow
def test_of_40_flights_errors_are_as_large_as_stated(network):
    values = [nees(*flown_fit(network, seed)) for seed in range(100, 140)]
    assert 0.7 < np.mean(values) < 1.4


def test_with_fixes_the_orbit_is_better_than_by_either(network):
    state = first_state()
    times = START_S + np.arange(600.0, 86400.0 * DAYS, 1500.0)
    flown = FLOWN.states(state, START_S, times)
    fixes = fixes_of(times, flown, sigma_m=15.0)
    sets = sets_of(network, state, np.random.default_rng(9))
    both, errors = flown_fit(network, 9, fixes, sets)
    alone = flown_fit(network, 9, (), sets)[0], flown_fit(network, 9, fixes, ())[0]
    sigma = [np.sqrt(np.trace(f.covariances[:, :3, :3], axis1=1, axis2=2).mean()) for f in alone]
    together = np.sqrt(np.trace(both.covariances[:, :3, :3], axis1=1, axis2=2).mean())
    assert together < min(sigma)
    assert nees(both, errors) < 3.0


def test_a_blunder_among_ranges_and_one_among_rates_are_left_out(network):
    sets = sets_of(network, first_state(), np.random.default_rng(3))
    sets[0].values[7] += 200.0
    sets[1].values[11] -= 0.05
    fit, _ = flown_fit(network, 3, (), sets)
    assert np.flatnonzero(~fit.is_used).tolist() == [7, len(sets[0]) + 11]


STATIONS_TOML = """
[[station]]
name = "Canberra"
lat_deg = -35.4
lon_deg = 148.98
height_m = 690.0
[[station]]
name = "Madrid"
lat_deg = 40.4
lon_deg = -4.25
height_m = 830.0
"""


def rows_of(network, state):
    ranges, doppler = sets_of(network, state, days=0.5)
    rows = []
    for k in range(len(ranges)):
        station = STATIONS[ranges.passes.receiver[k]].name
        utc = utc_from_tdb_s(float(ranges.geometry.received_s[k]))
        row = {"utc": utc, "station": station}
        value, rate = float(ranges.values[k]), float(doppler.values[k])
        rows.append({**row, "kind": "two_way_range_m", "value": value, "sigma": 5.0})
        rows.append(
            {**row, "kind": "range_rate_m_s", "value": rate, "sigma": RATE_M_S, "count_s": 60.0}
        )
    for time in START_S + np.arange(1000.0, 40000.0, 1000.0):
        here = FLOWN.states(state, START_S, np.array([time]))[0, :3]
        fixed = EPHEMERIS.body_from_inertial(time) @ here
        utc = utc_from_tdb_s(time)
        height = float(np.linalg.norm(fixed)) - MOON.radius_m
        rows.append({"utc": utc, "kind": "altimeter_m", "value": height, "sigma": 20.0})
        ra = float(np.degrees(np.arctan2(-here[1], -here[0]))) % 360.0
        dec = float(np.degrees(np.arcsin(-here[2] / np.linalg.norm(here))))
        rows.append({"utc": utc, "kind": "right_ascension_deg", "value": ra, "sigma": 0.05})
        rows.append({"utc": utc, "kind": "declination_deg", "value": dec, "sigma": 0.05})
    return rows


def write_files(folder, rows):
    (folder / "stations.toml").write_text(STATIONS_TOML)
    MEASUREMENTS.write(folder / "measurements.csv", rows)
    state = ", ".join(map(repr, map(float, first_state())))
    place, speed = state.split(", ")[:3], state.split(", ")[3:]
    (folder / "orbit.toml").write_text(
        f"""[forces]
degree = 2
[noise]
model = "none"
[[parameter]]
name = "ephemeris"
prior_sigma = 1.0
mode = "consider"
[[prior]]
utc = "{utc_from_tdb_s(START_S)}"
position_m = [{", ".join(place)}]
velocity_m_s = [{", ".join(speed)}]
position_sigma_m = 1000.0
velocity_sigma_m_s = 1.0
"""
    )
    names = ("measurements", "stations")
    files = [(f"--{name}", folder / name) for name in names]
    options = [text for option, path in files for text in (option, str(path))]
    options[1] += ".csv"
    options[3] += ".toml"
    return [*options, "--config", str(folder / "orbit.toml"), "-o", str(folder / "orbit")]


def test_the_command_fits_measurements_alone_and_with_a_run(network, tmp_path, capsys):
    state = first_state()
    options = write_files(tmp_path, rows_of(network, state))
    assert run(["orbit", "fit", *options, "--solve", "range_bias"]) == 0
    said = capsys.readouterr().err
    for words in ("two_way_range_m: ", "range_rate_m_s: ", "altimeter_m: ", "range_bias m"):
        assert words in said
    orbit = read_orbit(tmp_path / "orbit")
    truth = FLOWN.states(state, START_S, orbit.rows.times)
    assert np.abs(orbit.rows.states - truth)[:, :3].max() < 20.0
    table = tmp_path / "orbit" / "measurement_residuals.csv"
    rows = MEASUREMENT_RESIDUALS.read(table, lambda row: row.flag("used"))
    assert all(rows)
    assert run(["report", str(tmp_path / "orbit"), "-o", str(tmp_path / "orbit.html")]) == 0
    times = START_S + np.arange(600.0, 40000.0, 3600.0)
    write_run(tmp_path / "run", fixes_of(times, FLOWN.states(state, START_S, times)))
    assert run(["orbit", "fit", str(tmp_path / "run"), *options]) == 0
    assert "fixes and ranges and range rates" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"station": "Goldstone"}, "station is 'Goldstone'; .* Canberra, Madrid"),
        ({"value": 384000.0}, "it may be in km"),
        ({"value": 7.7e8}, "it may be of both ways"),
        ({"kind": "one_way_range_m"}, "kind is 'one_way_range_m'; wanted one of"),
        ({"station": "OTHER"}, "at an elevation of -"),
        ({"sigma": 0.0}, "sigma is '0'"),
        ({"transmitter": "Madrid,Canberra"}, "transmitter is"),
        ({"count_s": 60.0}, "count_s is"),
        ({"utc": "noon"}, "utc"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_with_its_line(network, tmp_path, change, words):
    rows = rows_of(network, first_state())[:1]
    if change.get("station") == "OTHER":
        names = [station.name for station in STATIONS]
        change = {"station": names[1 - names.index(rows[0]["station"])]}
    rows[0] |= change
    write_files(tmp_path, rows)
    with pytest.raises(DataError, match=words) as refused:
        read_measurements(tmp_path / "measurements.csv", tmp_path / "stations.toml", EPHEMERIS)
    assert "line 2" in str(refused.value)


@pytest.mark.parametrize(
    ("words", "code"), [("--stations", 2), ("RUNS", 2), ("min_elevation_deg", 3), ("days", 4)]
)
def test_bad_input_ends_with_its_code(network, tmp_path, capsys, words, code):
    rows = rows_of(network, first_state())[:40]
    options = write_files(tmp_path, rows)
    if words == "--stations":
        options = [*options[:2], *options[4:]]
    elif words == "RUNS":
        options = options[2:]
    elif words == "min_elevation_deg":
        text = STATIONS_TOML.replace("148.98", "-31.02").replace("-4.25", "175.75")
        (tmp_path / "stations.toml").write_text(text)
    else:
        text = (tmp_path / "orbit.toml").read_text()
        (tmp_path / "orbit.toml").write_text(text.replace('utc = "202', 'utc = "201'))
    assert run(["orbit", "fit", *options]) == code
    assert words in capsys.readouterr().err
