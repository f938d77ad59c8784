"""Numbers common to fixes or to the arc: found, or said not to be observed."""

import numpy as np
import pytest

from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import ConfigError, UsageError
from optnav_cli.dynamics.forces import Forces
from optnav_cli.dynamics.orbit_settings import ForcesSettings, ThrustArc
from optnav_cli.orbit.fit.fit import densify, fit_orbit
from optnav_cli.orbit.fit.job import with_solved
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.problem import OrbitPrior, OrbitProblem
from optnav_cli.orbit.fit.settings import NoiseSettings, OrbitFitSettings, ParameterSettings
from tests.optnav_cli.orbit.fit.flights import (
    EPHEMERIS,
    MOON,
    QUIET,
    START_S,
    fixes_of,
    flight,
    problem,
    truth,
)

FOCAL = ParameterSettings("focal")
MEAN = NoiseSettings("mean")


def fitted(fixes, *parameters, noise=QUIET, priors=()):
    return fit_orbit(problem(fixes, parameters, priors, noise), noise.model, 1e-5)


def value_and_sigma(found, number=0):
    return (
        float(found.trajectory.parameters[number]),
        float(np.sqrt(found.parameter_covariance[number, number])),
    )


@pytest.fixture(scope="module")
def lunar():
    return flight(minutes=240.0)


def test_a_wrong_focal_length_is_found_by_the_speed_of_the_orbit():
    wrong = flight(minutes=240.0, focal=8e-4)
    found = fitted(wrong.fixes, FOCAL)
    value, sigma = value_and_sigma(found)
    assert abs(value - 8e-4) < 4.0 * sigma
    assert sigma < 5e-5
    errors = (found.trajectory.states - wrong.states)[:, :3]
    assert np.sqrt(np.mean(errors**2)) < 10.0


def test_clocks_of_two_cameras_are_told_apart():
    times = START_S + np.arange(0.0, 14_401.0, 300.0)
    states = truth(times)
    late = fixes_of(times + 0.0, states, seed=2, camera="shnk", clock_s=1.5)
    found = fitted([*fixes_of(times, states), *late], ParameterSettings("clock", camera="shnk"))
    value, sigma = value_and_sigma(found)
    assert abs(value - 1.5) < 4.0 * sigma
    assert sigma < 0.005


def test_a_prior_orbit_makes_one_clock_of_all_fixes_known():
    times = START_S + np.arange(0.0, 7201.0, 300.0)
    states = truth(times)
    fixes = fixes_of(times, states, clock_s=4.0)
    prior = OrbitPrior(times[0], states[0], np.diag([100.0] * 3 + [1e-4] * 3), "another station")
    found = fitted(fixes, ParameterSettings("clock", prior_sigma=60.0), priors=[prior])
    value, sigma = value_and_sigma(found)
    assert abs(value - 4.0) < 4.0 * sigma
    assert sigma < 0.05
    assert not found.remarks


def test_what_the_fixes_do_not_tell_is_said_not_to_be_observed(lunar):
    found = fitted(lunar.fixes, ParameterSettings("srp", prior_sigma=1e-6))
    assert any("srp is not observed" in remark for remark in found.remarks)
    found = fitted(lunar.fixes, FOCAL)
    assert found.remarks == []


def test_a_considered_number_widens_the_covariance_and_moves_nothing(lunar):
    plain = fitted(lunar.fixes)
    considered = ParameterSettings("focal", prior_sigma=1e-4, mode="consider")
    wider = fitted(lunar.fixes, considered)
    assert np.allclose(plain.trajectory.states, wider.trajectory.states, atol=1e-2)
    more = np.trace(wider.covariances - plain.covariances, axis1=1, axis2=2)
    assert (more > 0.0).all()


def test_a_considered_number_adds_what_an_error_of_it_does(lunar):
    """Fixes of a focal length wrong by 1 sigma move the orbit by what the covariance grows."""
    sigma = 1e-4
    wrong = flight(minutes=240.0, focal=sigma)
    plain, moved = fitted(lunar.fixes), fitted(wrong.fixes)
    considered = ParameterSettings("focal", prior_sigma=sigma, mode="consider")
    wider = fitted(lunar.fixes, considered)
    grown = (wider.covariances - plain.covariances)[:, :3, :3]
    shift = (moved.trajectory.states - plain.trajectory.states)[:, :3]
    assert np.allclose(np.trace(grown, axis1=1, axis2=2), (shift**2).sum(axis=1), rtol=0.05)


def test_a_mean_acceleration_is_found_and_predicts():
    times = START_S + np.arange(0.0, 21_601.0, 600.0)
    acting = np.array([0.0, 2e-6, 0.0])
    motion = problem([], noise=MEAN).motion.with_added({"acceleration": acting})
    states = motion.path(truth(times[:1])[0], times[0], times)
    found = fitted(fixes_of(times, states), ParameterSettings("acceleration"), noise=MEAN)
    sigmas = np.sqrt(np.diag(found.parameter_covariance))
    assert (np.abs(found.trajectory.parameters - acting) < 4.0 * sigmas).all()
    assert sigmas[1] < 2e-7


def settings_with(*parameters):
    return OrbitFitSettings(parameter=parameters)


def test_one_clock_for_all_fixes_is_refused_with_the_reason(lunar):
    with pytest.raises(UsageError, match=r"not observable.*5e4 s.*prior"):
        with_solved(OrbitFitSettings(), ["clock"], lunar.fixes, [])
    both = [ParameterSettings("clock", camera=name) for name in ("unk", "shnk")]
    fixes = [*lunar.fixes, *fixes_of(lunar.times, lunar.states, camera="shnk")]
    with pytest.raises(UsageError, match="not observable"):
        with_solved(settings_with(*both), [], fixes, [])
    considered = ParameterSettings("clock", mode="consider")
    assert with_solved(settings_with(considered), [], fixes, []).parameter == (considered,)


def test_a_clock_in_short_is_that_of_the_second_camera_or_run(lunar):
    twice = [*lunar.fixes, *fixes_of(lunar.times, lunar.states, camera="shnk")]
    (clock,) = with_solved(OrbitFitSettings(), ["clock"], twice, []).parameter
    assert clock.label == "clock of shnk"
    runs = [*lunar.fixes, *fixes_of(lunar.times, lunar.states, run="run-2")]
    (clock,) = with_solved(OrbitFitSettings(), ["clock"], runs, []).parameter
    assert clock.label == "clock of run-2"


def test_a_camera_that_no_fix_has_is_named(lunar):
    wrong = settings_with(ParameterSettings("focal", camera="shnk"))
    with pytest.raises(ConfigError, match="no fix is of the camera 'shnk'; there are unk"):
        with_solved(wrong, [], lunar.fixes, [])


def test_rows_between_fixes_lie_on_the_orbit(lunar):
    found = fitted(lunar.fixes[:12])
    dense = densify(found, 60.0)
    times = dense.problem.times
    assert len(times) > 5 * 11
    assert (np.diff(times) > 0.0).all()
    true = truth(times)
    pairs = zip(dense.trajectory.states - true, dense.covariances, strict=True)
    squares = [e @ np.linalg.solve(p, e) / 6.0 for e, p in pairs]
    assert np.mean(squares) < 3.0


def test_a_thrust_arc_is_flown_and_its_size_found():
    """The engine gives 2 % more than stated; 5 % are its sigma."""
    times = START_S + np.arange(0.0, 7201.0, 300.0)
    ends = (utc_from_tdb_s(START_S + s) for s in (3000.0, 3120.0))
    start, end = ends
    found = []
    for size in (0.0102, 0.01):
        arc = ThrustArc(
            start_utc=start,
            end_utc=end,
            acceleration_m_s2=(0.0, size, 0.0),
            size_sigma=0.05,
            direction_sigma_deg=1.0,
        )
        forces = Forces(EPHEMERIS, ForcesSettings(degree=2, thrust=(arc,)))
        found.append(ArcMotion(forces, QUIET))
    flown, stated = found
    states = flown.path(truth(times[:1])[0], times[0], times)
    fixes = fixes_of(times, states)
    fit = fit_orbit(OrbitProblem(stated, fixes, [], [], MOON.radius_m), "white", 1e-5)
    added = fit.trajectory.parameters
    sigmas = np.sqrt(np.diag(fit.parameter_covariance))
    assert (np.abs(added - [0.0, 2e-4, 0.0]) < 4.0 * sigmas).all()
    assert sigmas[1] < 0.5 * 0.05 * 0.01
    assert fit.used == len(fixes)
