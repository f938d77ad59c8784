"""Zenith distances of stars: their derivatives, the file, the orbit through them, what is open."""

import json

import numpy as np
import pytest

from catalog.bodies.epochs import utc_from_tdb_s
from catalog.bodies.stars import load_bright_stars
from catalog.errors import DataError, NoSolutionError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.frames.orbit_tables import ZENITH
from optnav_cli.main import run
from optnav_cli.orbit.fit.folder import read_orbit
from optnav_cli.orbit.fit.motion import ArcMotion, rnb_of
from optnav_cli.orbit.fit.problem import OrbitPrior, Trajectory
from optnav_cli.orbit.fit.settings import ParameterSettings
from optnav_cli.orbit.fit.zenith import ZenithSights, read_zenith, zenith_distances, zenith_row
from optnav_cli.orbit.fit.zenith_job import fit_zenith, zenith_problem
from tests.optnav_cli.orbit.fit.flights import FORCES, QUIET, START_S, truth, write_truth_of

HEIGHT_M = 1000e3
STARS = (4, 46, 6)  # Vega, Polaris, Rigel
SIGMA = 2.0 * ARCSEC
GATE = 1e-5
MOTION = ArcMotion(FORCES, QUIET)
CONFIG = "[forces]\ndegree = 2\n[noise]\ndensity_m2_s3 = 1e-12\n"


def sights_of(times, states, stars=STARS, noise=SIGMA, seed=1):
    """A zenith distance at each time, of the stars in turn."""
    catalog = load_bright_stars()
    of = np.arange(len(times)) % len(stars)
    directions = catalog.propagate(times[0])[list(stars)][of]
    values = zenith_distances(states[:, :3], directions)[0]
    values = values + noise * np.random.default_rng(seed).normal(size=len(times))
    names = tuple(catalog.label(star) for star in stars)
    return ZenithSights(times, directions, values, np.full(len(times), SIGMA), of, names)


@pytest.fixture(scope="module")
def flown():
    """Nearly two revolutions, a place every two minutes."""
    times = START_S + np.arange(0.0, 6.5 * 3600.0, 120.0)
    return times, truth(times, height_m=HEIGHT_M)


@pytest.fixture(scope="module")
def fitted(flown):
    sights = sights_of(*flown)
    bias = ParameterSettings("vertical", prior_sigma=1.0, mode="consider")
    plain = fit_zenith(MOTION, sights, [], [], GATE)
    return plain, fit_zenith(MOTION, sights, [], [bias], GATE)


def write(path, sights):
    rows = [
        zenith_row(utc_from_tdb_s(float(t)), s, float(v), SIGMA)
        for t, s, v in zip(sights.tdb_s, sights.directions, sights.values_rad, strict=True)
    ]
    ZENITH.write(path, rows)
    return path


def errors_of(fit, flown):
    times, states = flown
    found = fit.problem.motion.path(fit.trajectory.states[0], float(fit.problem.times[0]), times)
    return np.linalg.norm((found - states)[:, :3], axis=1)


def test_derivatives_of_a_zenith_distance_are_those_of_differences():
    rng = np.random.default_rng(3)
    places, stars = 5e6 * rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    stars /= np.linalg.norm(stars, axis=1, keepdims=True)
    values, by_place, by_star = zenith_distances(places, stars)
    step, turn = 50.0 * rng.normal(size=(20, 3)), rng.normal(size=(20, 3)) * 1e-5
    turn -= (turn * stars).sum(axis=1, keepdims=True) * stars
    moved = zenith_distances(places + step, stars)[0] - zenith_distances(places - step, stars)[0]
    assert np.allclose(0.5 * moved, (by_place * step).sum(axis=1), rtol=1e-6, atol=1e-12)
    turned = zenith_distances(places, stars + turn)[0] - values
    assert np.allclose(turned, (by_star * turn).sum(axis=1), atol=1e-9)


def test_an_orbit_is_found_without_a_prior_and_to_its_sigma(flown, fitted):
    fit, _ = fitted
    size = errors_of(fit, flown)
    sigma = np.sqrt(np.trace(fit.covariances[:, :3, :3], axis1=1, axis2=2).mean())
    assert size.max() < 4.0 * sigma
    assert sigma < 10.0
    assert 0.7 < fit.chi_square / fit.degrees_of_freedom < 1.4


def test_a_bias_of_the_vertical_is_in_the_covariance_and_moves_the_orbit_along(flown, fitted):
    plain, considered = fitted
    radius = 1737.4e3 + HEIGHT_M
    added = considered.covariances[5, :3, :3] - plain.covariances[5, :3, :3]
    forward = rnb_of(plain.trajectory.states[5])[1]
    # a bias across adds to it, for the stars of the moment do not tell both apart
    assert 0.99 < np.sqrt(forward @ added @ forward) / (radius * ARCSEC) < 1.4
    assert np.allclose(plain.trajectory.states, considered.trajectory.states)


def test_a_bias_of_the_vertical_forward_moves_the_orbit_and_no_residual_shows_it(flown, fitted):
    times, states = flown
    sights = sights_of(times, states)
    bias = 10.0 * ARCSEC
    forward = np.stack([rnb_of(state)[1] for state in states])
    by_place = zenith_distances(states[:, :3], sights.directions)[1]
    size = np.linalg.norm(states[:, :3], axis=1)
    sights.values_rad[:] += bias * (by_place * forward).sum(axis=1) * size
    fit = fit_zenith(MOTION, sights, [], [], GATE)
    assert np.mean(errors_of(fit, flown)) == pytest.approx(bias * np.mean(size), rel=0.1)
    assert fit.chi_square == pytest.approx(fitted[0].chi_square, rel=0.05)


def test_derivatives_of_all_sights_are_those_of_differences(flown):
    times, states = flown
    sights = sights_of(times[:40], states[:40])
    parameters = [
        ParameterSettings("srp"),
        ParameterSettings("vertical", prior_sigma=1.0),
        ParameterSettings("star_catalog", prior_sigma=1.0),
    ]
    problem = zenith_problem(MOTION, sights, [], parameters, states[0])
    nodes = MOTION.path(states[0], float(times[0]), problem.times)
    at = Trajectory(nodes, np.zeros(problem.width - 6))
    rows = problem.rows(at)
    steps = np.concatenate([np.full(3, 10.0), np.full(3, 0.01), [1e-3], np.full(8, 1.0)])
    for k, step in enumerate(steps):
        moved = []
        for side in (step, -step):
            there, parameters_there = at.states.copy(), at.parameters.copy()
            if k < 6:
                there[:, k] += side
            else:
                parameters_there[k - 6] += side
            moved.append(problem.rows(Trajectory(there, parameters_there)).residuals)
        slope = -(moved[0] - moved[1]) / (2.0 * step)
        scale = np.abs(rows.design[:, k]).max()
        assert np.allclose(slope, rows.design[:, k], atol=1e-4 * scale), k


def test_a_vertical_solved_for_is_not_observed_along_the_motion(flown):
    fit = fit_zenith(MOTION, sights_of(*flown), [], [ParameterSettings("vertical")], GATE)
    assert any("vertical along N is not observed" in remark for remark in fit.remarks)


def test_blunders_are_left_out(flown, fitted):
    sights = sights_of(*flown)
    sights.values_rad[[10, 60, 61]] += np.array([1.0, -0.2, 0.02])
    fit = fit_zenith(MOTION, sights, [], [], GATE)
    assert np.flatnonzero(~fit.looks.used).tolist() == [10, 60, 61]
    assert errors_of(fit, flown).max() < 40.0


def test_sights_of_one_star_name_what_is_not_observed(flown):
    times, states = flown
    sights = sights_of(times, states, stars=(4,))
    with pytest.raises(NoSolutionError, match=r"one star, Vega: .* not observed"):
        fit_zenith(MOTION, sights, [], [], GATE)
    prior = OrbitPrior(float(times[0]), states[0], np.diag([1e6] * 3 + [1.0] * 3), "prior")
    fit = fit_zenith(MOTION, sights, [prior], [], GATE)
    assert any("one star, Vega" in remark for remark in fit.remarks)
    spread = np.sqrt(np.linalg.eigvalsh(fit.covariances[0, :3, :3]))
    assert spread[-1] > 20.0 * spread[0]


def test_of_two_stars_the_mirrored_orbit_is_refused_by_the_forces(flown):
    fit = fit_zenith(MOTION, sights_of(*flown, stars=(4, 17)), [], [], GATE)
    assert errors_of(fit, flown).max() < 40.0


def test_sights_of_no_orbit_are_refuted(flown):
    times, states = flown
    sights = sights_of(times[:60], states[:60], noise=60.0 * SIGMA)
    with pytest.raises(NoSolutionError, match=r"refute|fit no orbit|converge|better|run away"):
        fit_zenith(MOTION, sights, [], [], GATE)


def test_sights_of_two_flights_are_said_to_fit_no_one_orbit(flown):
    times, states = (part[::3] for part in flown)
    half = len(times) // 2
    sights = sights_of(times[: 2 * half], np.concatenate([states[:half], states[:half]]))
    with pytest.raises(NoSolutionError, match=r"zenith distances|refute") as caught:
        fit_zenith(MOTION, sights, [], [], GATE)
    assert "the fixes" not in str(caught.value)


def test_the_command_fits_a_file_and_others_read_the_folder(flown, tmp_path, capsys):
    file = write(tmp_path / "zenith.csv", sights_of(*flown))
    (tmp_path / "orbit.toml").write_text(CONFIG)
    where = ["--config", str(tmp_path / "orbit.toml"), "-o", str(tmp_path / "orbit")]
    assert run(["orbit", "fit", str(file), "--solve", "srp", *where]) == 0
    said = capsys.readouterr().err
    assert "zenith distances of Vega, Polaris, Rigel" in said
    assert "srp" in said
    names = {path.name for path in (tmp_path / "orbit").iterdir()}
    assert names == {
        "orbit.toml",
        "orbit.csv",
        "orbit.oem",
        "zenith_residuals.csv",
        "disturbances.csv",
        "run.toml",
        "manifest.json",
    }
    times, states = flown
    orbit = read_orbit(tmp_path / "orbit")
    near = int(np.argmin(np.abs(orbit.rows.times - times[50])))
    there = MOTION.path(states[50], float(times[50]), orbit.rows.times[near : near + 1])[0]
    assert np.linalg.norm(orbit.rows.states[near, :3] - there[:3]) < 40.0
    assert run(["report", str(tmp_path / "orbit"), "-o", str(tmp_path / "orbit.html")]) == 0
    page = (tmp_path / "orbit.html").read_text()
    assert "zenith distances used" in page
    assert run(["report", str(tmp_path / "orbit"), "-o", str(tmp_path / "orbit.svg")]) == 0
    write_truth_of(tmp_path / "truth.csv", times, states)
    truth_file = ["--truth", str(tmp_path / "truth.csv")]
    assert run(["evaluate", str(tmp_path / "orbit"), *truth_file]) == 0
    figures = json.loads((tmp_path / "orbit" / "evaluation.json").read_text())
    assert figures["velocity_normalised_error_squared"] < 10.0
    assert run(["report", str(tmp_path / "orbit"), "-o", str(tmp_path / "orbit.html")]) == 0
    ahead = ["--to", utc_from_tdb_s(float(times[-1]) + 3600.0, 0), "--step", "600"]
    assert run(["orbit", "predict", str(tmp_path / "orbit"), *ahead]) == 0


@pytest.mark.parametrize(
    ("solve", "code", "words"),
    [("clock", 2, "belongs to fixes"), ("", 0, "taken for those of the moon")],
)
def test_a_folder_with_zenith_distances_alone_is_an_input(
    flown, tmp_path, capsys, solve, code, words
):
    (tmp_path / "run").mkdir()
    write(tmp_path / "run" / "zenith.csv", sights_of(*flown))
    (tmp_path / "orbit.toml").write_text(CONFIG)
    where = ["--config", str(tmp_path / "orbit.toml"), "-o", str(tmp_path / "orbit")]
    assert run(["orbit", "fit", str(tmp_path / "run"), "--solve", solve, *where]) == code
    assert words in capsys.readouterr().err


def test_a_file_is_read_as_it_was_written(flown, tmp_path):
    sights = sights_of(*flown)
    found = read_zenith(write(tmp_path / "zenith.csv", sights))
    assert found.names == sights.names
    assert np.abs(found.values_rad - sights.values_rad).max() < 1e-4 * ARCSEC
    assert np.abs(found.directions - sights.directions).max() < 0.01 * ARCSEC
    assert np.abs(found.tdb_s - sights.tdb_s).max() < 2e-6


LINE = "2026-01-01T00:00:0{}Z,star_zenith,279.2355,38.7856,{},{}"


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([], "has a header but no rows"),
        (["2026-01-01T00:00:00Z,range,279.2355,38.7856,40,2"], "line 2: type is 'range'"),
        (["2026-01-01T00:00:00Z,star_zenith,279.2355,18.7856,40,2"], "no star brighter than"),
        ([LINE.format(1, 40, 2), LINE.format(0, 41, 2)], "line 3: .* before that of the row"),
        ([LINE.format(1, 40, 2), LINE.format(1, 41, 2)], "line 3: Vega stands twice"),
        ([LINE.format(1, 40, 0)], "sigma_arcsec is 0"),
        ([LINE.format(1, 40, "")], "sigma_arcsec is ''"),
        ([LINE.format(1, 190, 2)], "value_deg is '190'"),
        ([LINE.format(1, 0.01, 2)], "near to the vertical"),
        ([LINE.format(1, "nan", 2)], "value_deg is nan"),
        (["noon,star_zenith,279.2355,38.7856,40,2"], "line 2"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_with_its_line(tmp_path, lines, words):
    path = tmp_path / "zenith.csv"
    path.write_text("utc,type,ra_deg,dec_deg,value_deg,sigma_arcsec\n" + "\n".join(lines) + "\n")
    with pytest.raises(DataError, match=words):
        read_zenith(path)


def test_fixes_refuse_what_belongs_to_zenith_distances(tmp_path, capsys):
    path = tmp_path / "orbit.toml"
    path.write_text('[[parameter]]\nname = "vertical"\ncamera = "unk"\n')
    assert run(["orbit", "fit", "run", "--config", str(path), "-o", str(tmp_path / "o")]) == 3
    assert "common to all zenith distances" in capsys.readouterr().err
