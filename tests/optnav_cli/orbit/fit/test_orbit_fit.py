"""Orbits through fixes of known flights: errors and sigmas, outliers, breaks, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from catalog.errors import NoSolutionError
from optnav_cli.orbit.fit.fit import fit_orbit
from optnav_cli.orbit.fit.settings import NoiseSettings
from tests.optnav_cli.orbit.fit.flights import flight, moved, problem


@pytest.fixture(scope="module")
def lunar():
    return flight()


def fitted(fixes, **how):
    return fit_orbit(problem(fixes, **how), "white", 1e-5)


def normalised(found, states):
    errors = found.trajectory.states - states
    pairs = zip(errors, found.covariances, strict=True)
    return np.array([e @ np.linalg.solve(p, e) / 6.0 for e, p in pairs])


def test_an_orbit_is_better_than_its_fixes_and_says_how_good_it_is(lunar):
    found = fitted(lunar.fixes)
    errors = (found.trajectory.states - lunar.states)[:, :3]
    assert np.sqrt(np.mean(errors**2)) < 8.0  # of fixes 15 m
    assert normalised(found, lunar.states).mean() < 2.0
    assert found.used == len(lunar.fixes)


def test_the_noise_in_the_weights_gives_the_same_orbit(lunar):
    one, other = (fit_orbit(problem(lunar.fixes), m, 1e-5) for m in ("white", "nuisance"))
    assert np.abs(one.trajectory.states - other.trajectory.states)[:, :3].max() < 0.01


def test_a_whole_arc_of_which_nothing_is_doubted_takes_three_steps_at_most(lunar):
    assert fitted(lunar.fixes).steps <= 3
    assert fitted(lunar.fixes, noise=NoiseSettings("none")).steps <= 3


def test_wrong_fixes_are_left_out_and_right_ones_stay(lunar):
    fixes = list(lunar.fixes)
    fixes[3], fixes[12] = moved(fixes[3], [3000.0, 0.0, 0.0]), moved(fixes[12], [0.0, -150.0, 0.0])
    found = fitted(fixes)
    assert [k for k, r in enumerate(found.residuals) if not r.used] == [3, 12]
    assert normalised(found, lunar.states).mean() < 2.0


def test_a_wrong_first_fix_does_not_spoil_the_first_orbit(lunar):
    fixes = list(lunar.fixes)
    fixes[0] = moved(fixes[0], [0.0, 40_000.0, 0.0])
    found = fitted(fixes)
    assert [k for k, r in enumerate(found.residuals) if not r.used] == [0]


def test_a_manoeuvre_is_found_and_named():
    kicked = flight(kick_s=2850.0, kick_m_s=(0.0, 0.0, 2.0))
    with pytest.raises(NoSolutionError, match=r"a manoeuvre between 2022-03-08T09:10.*by 1.[89]"):
        fitted(kicked.fixes)


def test_fixes_of_two_flights_do_not_close(lunar):
    other = flight(height_m=140e3)
    with pytest.raises(NoSolutionError, match="arc does not close: between 2022-03-08T09:10"):
        fitted([*lunar.fixes[:10], *other.fixes[10:]])


def test_places_at_random_are_no_orbit(lunar):
    rng = np.random.default_rng(1)
    wrong = [replace(f, position_m=2e6 * rng.normal(size=3)) for f in lunar.fixes]
    with pytest.raises(NoSolutionError, match=r"the fixes from 2022.* fit no one orbit"):
        fitted(wrong)


def test_two_fixes_leave_an_orbit_open(lunar):
    with pytest.raises(NoSolutionError, match="too few fixes: 2 leave the orbit open"):
        fitted(lunar.fixes[:2])


def test_a_fix_years_after_the_others_is_named_at_once(lunar):
    """Found by hostile inputs: the motion was followed over four years, for minutes."""
    fixes = list(lunar.fixes)
    fixes[5] = replace(fixes[5], tdb_s=fixes[5].tdb_s + 1395.0 * 86400.0)
    with pytest.raises(
        NoSolutionError, match=rf"{fixes[5].file} is of .*, 139\d days after"
    ) as said:
        fitted(fixes)
    assert "gaps of up to 30" in str(said.value)


def test_sigmas_a_thousand_times_too_small_are_refuted(lunar):
    wrong = [replace(f, covariance_m2=f.covariance_m2 * 1e-6) for f in lunar.fixes]
    with pytest.raises(NoSolutionError, match="covariances are too small"):
        fitted(wrong)
