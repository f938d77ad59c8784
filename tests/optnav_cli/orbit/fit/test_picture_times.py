"""Times of pictures from a known orbit: right within their sigmas, all passes, what is refused."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from catalog.bodies.epochs import utc_to_tdb_s
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from optnav_cli.main import run as optnav
from optnav_cli.orbit.fit.folder import read_orbit
from optnav_cli.orbit.fit.job import fit_runs
from optnav_cli.orbit.fit.known_orbit import picture_times
from optnav_cli.orbit.fit.predict import OrbitPath
from optnav_cli.orbit.fit.settings import OrbitFitSettings
from tests.optnav_cli.orbit.fit.flights import QUIET, START_S, fixes_of, flight, truth, write_run

SETTINGS = OrbitFitSettings(forces=ForcesSettings(degree=2), noise=QUIET)
SPEED_M_S = 1633.0


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("orbit")
    run = write_run(folder / "run", flight(minutes=150.0).fixes)
    fit_runs([run], folder / "orbit", SETTINGS)
    return folder / "orbit"


@pytest.fixture(scope="module")
def other():
    """Pictures of another camera between those, and their true times; its clock is 40 s late."""
    times = START_S + 137.0 + 700.0 * np.arange(12.0)
    states = truth(np.append(START_S, times))[1:]
    return times, fixes_of(times, states, seed=5, camera="kam", clock_s=40.0)


def rows_of(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_clock_that_is_late_is_found_by_the_orbit(stored, other, tmp_path, capsys):
    times, fixes = other
    run = write_run(tmp_path / "run", fixes)
    output = tmp_path / "times.csv"
    assert optnav(["orbit", "time", str(run), "--orbit", str(stored), "-o", str(output)]) == 0
    assert "12 of 12 pictures lie on the orbit; 0 at several times" in capsys.readouterr().err
    rows = rows_of(output)
    assert list(rows[0]) == ["file", "utc_stamp", "utc", "sigma_s", "candidates"]
    found = np.array([utc_to_tdb_s(row["utc"]) for row in rows])
    sigmas = np.array([float(row["sigma_s"]) for row in rows])
    # 15 m of a fix along the path, little of the orbit
    assert 15.0 / SPEED_M_S < sigmas.min() < sigmas.max() < 1.5 * 15.0 / SPEED_M_S
    assert 0.2 < np.mean(((found - times) / sigmas) ** 2) < 2.5
    assert all(row["candidates"] == row["utc"] for row in rows)


def test_a_wide_fix_lists_the_pass_of_the_next_revolution(stored, other):
    """A revolution moves the track by 32 km at the equator; a fix of 20 km fits both."""
    path = OrbitPath(read_orbit(stored))
    _, fixes = other
    wide = replace(fixes[1], covariance_m2=np.eye(3) * 2e4**2)
    (timed,) = picture_times(path, [wide], 600.0)
    assert len(timed.passes) == 2
    first, second = timed.passes
    assert second.tdb_s - first.tdb_s == pytest.approx(7070.0, abs=60.0)
    assert timed.best is first
    assert picture_times(path, [fixes[1]], 600.0)[0].passes[0].chi_square < 9.0


def test_positions_off_the_orbit_have_no_time(stored, other, tmp_path, capsys):
    _, fixes = other
    aside = [replace(fix, position_m=1.02 * fix.position_m) for fix in fixes]
    run = write_run(tmp_path / "run", aside)
    words = ["orbit", "time", str(run), "--orbit", str(stored), "-o", str(tmp_path / "t.csv")]
    assert optnav(words) == 4
    assert "passes none of its 12 positions within 3 sigmas" in capsys.readouterr().err
    rows = rows_of(tmp_path / "t.csv")
    assert {row["utc"] + row["sigma_s"] + row["candidates"] for row in rows} == {""}


def test_runs_that_cannot_be_timed_are_refused(stored, other, tmp_path, capsys):
    _, fixes = other
    mars = write_run(tmp_path / "mars", [replace(fixes[0], position_m=2.0 * fixes[0].position_m)],
                     body="mars")  # fmt: skip
    words = ["--orbit", str(stored), "-o", str(tmp_path / "t.csv")]
    assert optnav(["orbit", "time", str(mars), *words]) == 3
    assert "are about mars, the orbit about moon" in capsys.readouterr().err
    years = replace(fixes[0], tdb_s=START_S - 5e8, utc="2006-05-03T05:00:00.000000Z")
    run = write_run(tmp_path / "run", [years])
    assert optnav(["orbit", "time", str(run), *words]) == 3
    assert "too much to search" in capsys.readouterr().err
