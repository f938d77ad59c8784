"""Fixes with times of whole seconds: their errors are stated, or the refusal says what they are."""

from dataclasses import replace

import numpy as np
import pytest

from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import NoSolutionError
from optnav_cli.main import run
from optnav_cli.orbit.fit.fit import fit_orbit
from optnav_cli.orbit.fit.solver import are_whole_seconds, body_fixed_speeds
from tests.optnav_cli.orbit.fit.flights import START_S, fixes_of, problem, truth, write_run

GATE = 1e-5
CONFIG = "[forces]\ndegree = 2\n[noise]\ndensity_m2_s3 = 1e-12\n"


@pytest.fixture(scope="module")
def flown():
    """Fixes of 15 m at odd times over three hours, whose stamps are cut to whole seconds."""
    rng = np.random.default_rng(4)
    times = START_S + np.sort(rng.uniform(0.0, 3.0 * 3600.0, 60))
    states = truth(times)
    cut = []
    for fix in fixes_of(times, states):
        utc = utc_from_tdb_s(fix.tdb_s, 6)[:19] + "Z"
        cut.append(replace(fix, utc=utc, tdb_s=utc_to_tdb_s(utc)))
    return times, states, cut


def errors(fit, flown):
    """Squares of the errors of the places over their covariance, a component.

    Stamps cut are early by half a second all: another orbit, of the same places over the ground.
    """
    times, states, _ = flown
    later = fit.problem.motion.path(states[0], float(times[0]), fit.problem.times + 0.5)
    found = []
    for number, node in enumerate(fit.problem.node_of):
        there = fit.problem.turn(number, 0.5) @ later[node, :3]
        miss = fit.problem.turn(number) @ fit.trajectory.states[node, :3] - there
        turn = fit.problem.turn(number)
        spread = turn @ fit.covariances[node, :3, :3] @ turn.T
        found.append(miss @ np.linalg.solve(spread, miss) / 3.0)
    return np.array(found)


def test_a_refused_series_says_that_its_stamps_are_perhaps_whole_seconds(flown):
    with pytest.raises(NoSolutionError, match=r"perhaps whole seconds.*time_sigma_s = 0\.29"):
        fit_orbit(problem(flown[2]), "white", GATE)


def test_with_the_sigma_of_its_times_a_series_gives_an_orbit_as_good_as_it_says(flown):
    fixes = [replace(fix, time_sigma_s=0.29) for fix in flown[2]]
    fit = fit_orbit(problem(fixes), "white", GATE)
    assert fit.used >= 59
    assert 0.6 < fit.chi_square / fit.degrees_of_freedom < 1.4
    assert 0.1 < errors(fit, flown).mean() < 3.0


def test_the_error_of_a_time_lies_along_the_motion_over_the_ground(flown):
    fixes = [replace(fix, time_sigma_s=0.29) for fix in flown[2]]
    fit = fit_orbit(problem(fixes), "white", GATE)
    speeds = body_fixed_speeds(fit.problem, fit.trajectory)
    for fix, speed in zip(fit.problem.fixes, speeds, strict=True):
        assert fix.timing_m2 == pytest.approx(0.29**2 * np.outer(speed, speed), rel=0.02, abs=300.0)
        assert fix.sighted_m2 == pytest.approx(15.0**2 * np.eye(3), abs=1e-6)


def test_other_refusals_do_not_blame_whole_seconds(flown):
    times, states, _ = flown
    fixes = fixes_of(times, states)
    assert not are_whole_seconds(fixes)
    moved = [replace(f, covariance_m2=1e-4 * f.covariance_m2) for f in fixes]
    with pytest.raises(NoSolutionError) as refused:
        fit_orbit(problem(moved), "white", GATE)
    assert "whole seconds" not in str(refused.value)


def test_sigmas_of_times_are_read_from_the_config_and_from_the_tables(flown, tmp_path, capsys):
    write_run(tmp_path / "run", flown[2])
    config = tmp_path / "orbit.toml"
    command = ["orbit", "fit", str(tmp_path / "run"), "--config", str(config)]
    config.write_text(CONFIG)
    assert run([*command, "-o", str(tmp_path / "a")]) == 4
    assert "perhaps whole seconds" in capsys.readouterr().err
    config.write_text(CONFIG + "[fixes]\ntime_sigma_s = 0.29\n")
    assert run([*command, "-o", str(tmp_path / "a")]) == 0
    config.write_text(CONFIG)
    table = tmp_path / "run" / "solution.csv"
    head, *rows = table.read_text().splitlines()
    table.write_text("\n".join([head + ",utc_sigma_s", *(row + ",0.29" for row in rows)]) + "\n")
    assert run([*command, "-o", str(tmp_path / "b")]) == 0
    assert (tmp_path / "a" / "orbit.csv").read_text() == (tmp_path / "b" / "orbit.csv").read_text()
    table.write_text("\n".join([head + ",utc_sigma_s", *(row + ",-1" for row in rows)]) + "\n")
    assert run([*command, "-o", str(tmp_path / "b")]) == 3
    assert "utc_sigma_s is -1; wanted 0 to 3600" in capsys.readouterr().err
