"""Wrong force models: the pattern of the residuals refutes the fit, and the force is named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.config import resource
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.dynamics.left_out import forces_left_out, gravity_remark, unknown_j2
from optnav_cli.dynamics.orbit_settings import ForcesSettings, SunlightSettings
from optnav_cli.main import run
from optnav_cli.orbit.fit.fit import densify, fit_orbit
from optnav_cli.orbit.fit.missing_forces import _solve, check_pattern
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.problem import Trajectory
from optnav_cli.orbit.fit.settings import NoiseSettings, ParameterSettings
from optnav_cli.orbit.fit.zenith_job import fit_zenith, zenith_problem
from tests.optnav_cli.orbit.fit.flights import (
    EPHEMERIS,
    MOON,
    START_S,
    fixes_of,
    problem,
    write_run,
)
from tests.optnav_cli.orbit.fit.test_zenith import GATE, sights_of

SIGMA = 0.2 * ARCSEC
STRENGTH = 0.026  # m^2/kg
SUNLIT = ForcesSettings(degree=2, sunlight=SunlightSettings(area_over_mass_m2_kg=0.02))
QUIET = NoiseSettings("white", 1e-18)
TIMES = START_S + np.arange(0.0, 12.0 * 3600.0, 60.0)
DARK = ArcMotion(Forces(EPHEMERIS, ForcesSettings(degree=2)), QUIET)


def flown(settings, height_m=1000e3):
    """States (n, 6) of a flight with these forces."""
    forces = Forces(EPHEMERIS, settings)
    radius = MOON.radius_m + height_m
    speed = np.sqrt(forces.gm / radius)
    state = np.array([radius, 0.0, 0.0, 0.0, 0.3 * speed, np.sqrt(1 - 0.09) * speed])
    return OrbitMotion(forces).states(state, START_S, TIMES)


def exact(states, seed, noise=SIGMA):
    return replace(
        sights_of(TIMES, states, noise=noise, seed=seed), sigmas_rad=np.full(len(TIMES), SIGMA)
    )


@pytest.fixture(scope="module")
def sunlit():
    return exact(flown(SUNLIT), seed=1)


def test_sunlight_left_out_refutes_a_fit_that_its_size_does_not(sunlit):
    """The orbit would be 5 m off at a stated 0.5 m, with residuals 1.4 times their sigmas."""
    with pytest.raises(NoSolutionError, match="follow a pattern along the arc") as refused:
        fit_zenith(DARK, sunlit, [], [], GATE)
    text = str(refused.value)
    assert "solve for it by --solve srp" in text
    value = float(text.partition("sunlight pressure of ")[2].split()[0])
    assert value == pytest.approx(STRENGTH, rel=0.05)


def test_with_the_force_that_was_named_the_fit_is_right(sunlit):
    fit = fit_zenith(DARK, sunlit, [], [ParameterSettings("srp")], GATE)
    assert fit.trajectory.parameters[0] == pytest.approx(STRENGTH, rel=0.05)
    assert fit.chi_square / fit.degrees_of_freedom == pytest.approx(1.0, abs=0.15)


def chances(count):
    """Of patterns in right fits: one step from the truth, with errors drawn each time."""
    states = flown(ForcesSettings(degree=2))
    zenith = zenith_problem(DARK, exact(states, seed=0), [], [], states[0])
    nodes = OrbitMotion(DARK.forces).states(states[0], START_S, zenith.times)
    used, found = np.ones(len(TIMES), bool), []
    for seed in range(1, count + 1):
        drawn = replace(zenith, sights=exact(states, seed))
        found.append(_solve(drawn, Trajectory(nodes, np.empty(0)), used, 1).probability)
    return np.array(found)


def test_right_fits_pass():
    found = chances(12)
    assert found.min() > 1e-3


@pytest.mark.slow
def test_of_200_right_fits_none_is_refused_and_one_in_twenty_is_below_a_twentieth():
    found = chances(200)
    assert found.min() > 1e-5
    assert np.count_nonzero(found < 0.05) <= 22  # 10 and 4 sigmas; fits take some of it away


def test_fixes_in_a_field_of_too_low_a_degree_name_the_higher_one():
    states = flown(ForcesSettings(degree=8), height_m=300e3)
    fixes = fixes_of(TIMES[::5], states[::5], sigma_m=15.0)
    forces = Forces(EPHEMERIS, ForcesSettings(degree=2))
    low = problem(fixes, noise=NoiseSettings("white", 1e-14))
    low = replace(low, motion=ArcMotion(forces, NoiseSettings("white", 1e-14)))
    with pytest.raises(NoSolutionError, match=r"leave \[forces\] degree out") as refused:
        fit_orbit(low, "white", GATE)
    assert "left out are the field beyond degree 2" in str(refused.value)


def test_right_fixes_get_no_remark():
    states = flown(ForcesSettings(degree=2))
    right = problem(fixes_of(TIMES[::5], states[::5]))
    at = Trajectory(states[::5], np.empty(0))
    assert check_pattern(right, at, np.ones(len(right.fixes), bool), alone=False) == (1.0, [])


def alike(times, states, seed, after_s=700.0, sigma_m=15.0):
    """Fixes whose errors, of the stated size, go together over some minutes."""
    rng, kept = np.random.default_rng(seed), np.exp(-(times[1] - times[0]) / after_s)
    errors = rng.normal(size=(len(times), 3))
    for k in range(1, len(times)):
        errors[k] = kept * errors[k - 1] + np.sqrt(1.0 - kept**2) * errors[k]
    fixes = fixes_of(times, states, sigma_m=0.0)
    covariance = np.eye(3) * sigma_m**2
    return [
        replace(fix, position_m=fix.position_m + sigma_m * error, covariance_m2=covariance)
        for fix, error in zip(fixes, errors, strict=True)
    ]


def test_a_pattern_that_no_force_mends_inflates_the_covariance():
    """Without it the NEES a number would be 3.2."""
    states, inflations, nees = flown(ForcesSettings(degree=2)), [], []
    for seed in range(1, 6):
        fit = fit_orbit(problem(alike(TIMES[::5], states[::5], seed)), "white", GATE)
        off = fit.trajectory.states - states[::5]
        pairs = zip(off[::10], fit.covariances[::10], strict=True)
        nees.append(np.mean([d @ np.linalg.solve(c, d) for d, c in pairs]) / 6.0)
        inflations.append(fit.inflation)
        said = f"the orbit's sigmas are {np.sqrt(fit.inflation):.3g} times those of errors"
        assert any(said in remark for remark in fit.remarks) == (fit.inflation > 1.0)
        dense = densify(fit, 600.0)
        np.testing.assert_allclose(dense.covariances[-1], fit.covariances[-1], rtol=0.02)
    assert np.median(inflations) > 2.0
    assert np.mean(np.array(nees) * inflations) > 2.0
    assert 0.4 < np.mean(nees) < 2.0


@pytest.mark.slow
def test_of_200_right_fits_to_fixes_none_is_inflated():
    states = flown(ForcesSettings(degree=2))[::5]
    at, used = Trajectory(states, np.empty(0)), np.ones(len(states), bool)
    for seed in range(200):
        right = problem(fixes_of(TIMES[::5], states, seed=seed))
        assert check_pattern(right, at, used, alone=False) == (1.0, [])


def test_a_body_without_a_known_field_says_so_and_how_large_it_may_be():
    earth = load_body("earth")
    bare = replace(earth, gravity=None)
    assert gravity_remark(earth) == ""
    assert "no field of it is known; it is taken for a point mass" in gravity_remark(bare)
    assert "ellipsoid at even density" in gravity_remark(bare, ForcesSettings())
    assert gravity_remark(bare, ForcesSettings(field="x.gfc")) == ""
    assert unknown_j2(bare) == pytest.approx(1.08e-3, rel=0.4)
    assert unknown_j2(replace(bare, radii_m=(bare.radius_m,) * 3)) == pytest.approx(
        1.08e-3, rel=0.2
    )
    forces = Forces(AnalyticEphemeris(bare))
    state = np.array([7.0e6, 0.0, 0.0, 0.0, 7.5e3, 0.0])
    first, *others = forces_left_out(forces, state, START_S, 6000.0)
    assert first.startswith("J2 of earth, of which no field is known, 0.01 m/s2 or")
    assert any("air" in words for words in others)
    assert any(words.startswith("sunlight") for words in others)


def test_orbit_commands_say_that_no_field_is_known(tmp_path, capsys):
    states = flown(ForcesSettings(degree=2))[:100:10]
    fixes = fixes_of(TIMES[:100:10], states)
    write_run(tmp_path / "run", fixes)
    text = (Path(resource("configs/bodies/moon.toml"))).read_text(encoding="utf-8")
    head, _, rest = text.partition("[gravity]")
    bare = head + "[" + rest.partition("\n[")[2]
    (tmp_path / "bare.toml").write_text(bare.replace('name = "moon"', 'name = "bare"'))
    (tmp_path / "run" / "run.toml").write_text(
        f'body = "{tmp_path / "bare.toml"}"\nattitude = "camera_from_body"\n'
    )
    config = tmp_path / "orbit.toml"
    config.write_text("[noise]\ndensity_m2_s3 = 1e-6\n")
    command = ["orbit", "fit", str(tmp_path / "run"), "--config", str(config)]
    assert run([*command, "-o", str(tmp_path / "orbit")]) == 0
    assert "has no [gravity], so no field of it is known" in capsys.readouterr().err
    command = ["orbit", "time", str(tmp_path / "run"), "--orbit", str(tmp_path / "orbit")]
    assert run([*command, "-o", str(tmp_path / "times.csv")]) == 0
    assert "its J2 may be wrong by as much as 0.0002" in capsys.readouterr().err
