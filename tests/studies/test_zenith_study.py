"""The study of zenith distances: its truth is another model's, its tables are whole."""

import numpy as np
import pytest

from catalog.geometry.rotations import ARCSEC
from catalog.progress import SilentProgress
from optnav_cli.navigate.zenith_file import SightPlace, choose_zenith_pair, list_navigation_stars
from tests.studies import zenith
from tests.studies.zenith_flights import (
    SightErrors,
    ZenithFlight,
    fit_motion,
    judged,
    start_of,
)


@pytest.fixture(scope="module")
def flight():
    return ZenithFlight("1.1", 1.1, rows=60)


def test_the_craft_fly_the_orbits_of_the_table():
    for craft in ("1.1", "2.4", "3.6"):
        place, speed = np.split(start_of(craft), 2)
        across = np.cross(place, speed)
        assert np.degrees(np.arccos(across[2] / np.linalg.norm(across))) == pytest.approx(58.0)
    node = np.cross([0.0, 0.0, 1.0], np.cross(*np.split(start_of("2.1"), 2)))
    assert np.degrees(np.arctan2(node[1], node[0])) == pytest.approx(120.0)


def test_a_session_looks_at_a_star_near_the_pole_and_one_near_the_plane(flight):
    times = flight.sessions(0.0, 1.0, 60)
    sights = flight.sights(times, SightErrors(), np.random.default_rng(1))
    assert len(list_navigation_stars()) == 21
    assert set(sights.names) <= {"Vega", "Fomalhaut", "Rigil Kentaurus", "Capella", "Spica"}
    assert len(sights) == 120


def test_no_star_is_looked_at_behind_the_body_or_near_the_sun():
    up = np.array([1.0, 0.0, 0.0])
    place = SightPlace(2e6 * up, 1.7374e6, np.array([0.0, 1.0, 0.0]), np.array([[2e6, 0.0, 4e8]]))
    stars = np.array([[-1.0, 0.0, 0.0], [0.1, 0.99, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], up])
    stars /= np.linalg.norm(stars, axis=1, keepdims=True)
    assert place.find_visible(stars).tolist() == [False, False, False, True, False]
    assert choose_zenith_pair(place, np.array([0.0, 0.0, 1.0]), stars) == [3]


def test_a_fit_of_a_revolution_is_good_to_its_sigma(flight):
    rng = np.random.default_rng(1)
    sights = flight.sights(flight.sessions(0.0, 1.0, 100), SightErrors(), rng)
    one = judged(flight, sights, fit_motion(), (zenith.SUNLIGHT,), rng)
    assert one.sizes[0] < 3.0
    assert 0.2 < one.nees < 4.0
    assert one.fit.trajectory.parameters[0] == pytest.approx(0.02, abs=0.01)
    assert sights.sigmas_rad[0] == pytest.approx(0.1 * ARCSEC, rel=0.01)


def test_all_tables_and_the_picture_are_made(monkeypatch):
    monkeypatch.setattr(zenith, "TABLE_2", {60: (1.0, 0.5, 3.0)})
    monkeypatch.setattr(zenith, "TABLE_3", {"1.1": (0.34, 45.0, 0.123)})
    monkeypatch.setattr(zenith, "SESSIONS", 60)
    monkeypatch.setattr(zenith, "SENSORS_ARCSEC", (0.1,))
    monkeypatch.setattr(zenith, "CATALOGS_ARCSEC", (0.01,))
    monkeypatch.setattr(zenith, "MAX_SPEED_TRIALS", 1)
    monkeypatch.setattr(zenith, "AHEAD", 5)
    monkeypatch.setattr(zenith, "TABLE_4", {1: "1-2", 5: "5"})
    result = zenith.run(SilentProgress(), revolutions=1, trials=2)
    tables = zenith.report(result).tables
    assert [len(table.rows) for table in tables] == [1, 1, 2, 2, 9, 2]
    assert "<svg" in zenith.picture(result)
