"""zenith.csv of a run: made of limbs with stars, and an orbit comes of it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.epochs import utc_from_tdb_s
from catalog.geometry.rotations import ARCSEC
from optnav_cli.fix import Fix, Method, NoFix, Solution
from optnav_cli.frames.folder import Folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.orbit_tables import ZENITH
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.navigate.zenith_file import make_zenith_rows
from optnav_cli.orbit.fit.zenith import read_zenith
from optnav_cli.orbit.fit.zenith_job import fit_zenith
from optnav_cli.reasons import NO_REASON
from tests.optnav_cli.orbit.fit.flights import EPHEMERIS, START_S, truth
from tests.optnav_cli.orbit.fit.test_zenith import GATE, MOTION

SIGMA = 20.0 * ARCSEC


@pytest.fixture(scope="module")
def flown():
    times = START_S + np.arange(0.0, 5.0 * 3600.0, 300.0)
    return times, truth(times, height_m=1000e3)


def row_of(time, state, number, rng, method=Method.HORIZON, source="stars"):
    """A fix from the limb: across the vertical by the limb, and by the body's rotation."""
    size = np.linalg.norm(state[:3])
    place = state[:3] + SIGMA * size * np.cross(state[:3] / size, rng.normal(size=3))
    turn = EPHEMERIS.body_from_inertial(time)
    across = size**2 * np.eye(3) - np.outer(state[:3], state[:3])
    rotation = EPHEMERIS.error_m(time) / EPHEMERIS.body.radius_m
    whole = (SIGMA**2 + rotation**2) * across + 100.0**2 * np.eye(3)
    fix = Fix(method, turn @ place, turn @ whole @ turn.T, Rotation.identity(), SIGMA)
    return Solution(f"{number}.png", utc_from_tdb_s(time), fix, attitude_source=source)


def folder_of(times, attitude="camera_from_body"):
    frames = [
        Frame(f"{n}.png", utc_from_tdb_s(time), "cam", float(time)) for n, time in enumerate(times)
    ]
    return Folder(Path(), RunSettings("moon", attitude), EPHEMERIS, {}, frames)


def test_limbs_and_stars_give_zenith_distances_and_these_an_orbit(flown, tmp_path):
    times, states = flown
    rng = np.random.default_rng(1)
    rows = [row_of(*both, n, rng) for n, both in enumerate(zip(times, states, strict=True))]
    made = make_zenith_rows(folder_of(times), rows)
    assert len(made) == 2 * len(times)
    assert {row["type"] for row in made} == {"star_zenith"}
    # the rotation of the body is 20" here and has no part in it; 100 m of height and relief has 8"
    sigmas = np.array([row["sigma_arcsec"] for row in made])
    assert ((sigmas > 19.0) & (sigmas < 25.0)).all()
    ZENITH.write(tmp_path / "zenith.csv", made)
    sights = read_zenith(tmp_path / "zenith.csv")
    fit = fit_zenith(MOTION, sights, [], [], GATE)
    assert 0.5 < fit.chi_square / fit.degrees_of_freedom < 1.5
    there = MOTION.path(fit.trajectory.states[0], float(fit.problem.times[0]), times)
    off = np.linalg.norm((there - states)[:, :3], axis=1)
    assert off.max() < 4.0 * np.sqrt(np.trace(fit.covariances[0, :3, :3]) + 1.0) < 800.0


def test_without_limb_stars_or_solution_there_is_no_row(flown):
    times, states = flown[0][:3], flown[1][:3]
    rng = np.random.default_rng(1)
    points = row_of(times[0], states[0], 0, rng, method=Method.CONTROL_POINTS)
    stated = row_of(times[1], states[1], 1, rng, source="frames.csv")
    unsolved = Solution("2.png", utc_from_tdb_s(times[2]), NoFix(NO_REASON))
    assert make_zenith_rows(folder_of(times), [points, stated, unsolved]) == []
    # stated against the stars, as a star sensor does
    made = make_zenith_rows(folder_of(times, "camera_from_inertial"), [points, stated, unsolved])
    assert len(made) == 2


def test_rows_stand_in_the_order_of_time_and_a_time_once(flown):
    times, states = flown[0][[5, 0, 0, 9]], flown[1][[5, 0, 0, 9]]
    rng = np.random.default_rng(1)
    rows = [row_of(*both, n, rng) for n, both in enumerate(zip(times, states, strict=True))]
    utc = [row["utc"] for row in make_zenith_rows(folder_of(times), rows)]
    assert utc == sorted(utc)
    assert len(utc) == 6
