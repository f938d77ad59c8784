"""The horizon study's figures and table, and that its rows name scenarios that are there."""

from dataclasses import replace

import numpy as np
import pytest

from catalog.config import resource
from catalog.errors import NothingToDoError
from catalog.progress import SilentProgress
from optnav_cli.simulation.scenario import load_scenario
from tests.studies import horizon_flights
from tests.studies.flights import GROUNDS
from tests.studies.horizon import ROWS, HorizonResult, LimbFix, figures_of, report, run


def frame(ssp_m, nees, **values):
    return LimbFix(
        True, False, ssp_m=ssp_m, height_m=-10.0, range_share=1e-4,
        direction_arcsec=3.0, nees=nees, seconds=0.2, **values,
    )  # fmt: skip


SHIPPED = [row for row in ROWS if row.scenario != horizon_flights.NAME]


@pytest.mark.parametrize("row", SHIPPED, ids=lambda row: row.name)
def test_every_row_has_a_scenario_with_enough_pictures(row):
    scenario = load_scenario(resource(f"configs/scenarios/{row.scenario}.toml"))
    orbit = scenario.orbit
    assert orbit.passes * orbit.frames >= (20 if row.range_share is None else 30)
    assert scenario.detail is not None
    assert all(seed is not None for seed in scenario.detail.seeds)


def test_flights_differ_in_height_sun_and_seed():
    drawn = {}
    for seed in (horizon_flights.FITTED_SEED, horizon_flights.SCORED_SEED):
        for number, (height, sun) in enumerate(horizon_flights.FLIGHTS):
            flight = horizon_flights.scenario(number, seed)
            assert flight.orbit.altitude_km == height
            assert flight.sun.elevation_deg == pytest.approx((sun, sun), abs=0.01)
            assert flight.truth.model_error == "gld100"
            drawn[flight.seed] = height, sun
    assert len(drawn) == 2 * len(horizon_flights.FLIGHTS)


def test_unsolved_frames_count_but_have_no_errors():
    frames = [frame(30.0, 1.0), frame(40.0, 3.0), LimbFix(True, False, reason="dark")]
    figures = figures_of(frames)
    assert (figures.frames, figures.solved) == (3, 2)
    assert figures.ssp_rms_m == pytest.approx(np.sqrt(1250.0))
    assert figures.ssp_max_m == 40.0
    assert figures.nees == pytest.approx(2.0)
    assert figures.worst_sigmas == pytest.approx(3.0)
    assert figures.reasons == ("dark",)


def test_the_table_names_what_is_asked_and_why_frames_failed():
    solved = figures_of([frame(30.0, 1.0)])
    poor = figures_of([frame(600.0, 1.0)])
    none = figures_of([LimbFix(True, False, reason="no lit limb")])
    near = HorizonResult(ROWS[0], poor, solved, poor, solved)
    far = HorizonResult(ROWS[-1], poor, solved, poor, solved)
    dark = replace(near, terrain=none)
    by_limb, far_away = report([near, far]).tables
    assert (by_limb.column("terrain_ssp_m"), by_limb.column("ssp_limit_m")) == ([30.0], [250.0])
    assert by_limb.column("better") == [20.0]
    assert (far_away.column("terrain_range"), far_away.column("range_limit")) == ([0.01], [0.2])
    assert any("1 not solved: no lit limb" in note for note in report([dark]).notes)


def test_each_ground_has_a_table_and_that_of_real_scenarios_comes_first():
    solved = figures_of([frame(30.0, 1.0)])
    own = next(row for row in ROWS if row.scenario == "horizon_100km")
    rows = [HorizonResult(row, *[solved] * 4) for row in (own, ROWS[0])]
    tables = report(rows).tables
    assert [table.title for table in tables] == list(GROUNDS)
    assert [table.column("case") for table in tables] == [["real nadir 50 km"], ["nadir 100 km"]]


def test_a_row_that_is_not_there_is_said(tmp_path, shared_data, monkeypatch):
    folder = shared_data("moon/moon_gld100_32ppd.tif").parents[1]
    monkeypatch.setenv("OPTNAV_SHARED_DATA", str(folder))
    with pytest.raises(NothingToDoError, match="no row of the study is called 'mars'"):
        run(tmp_path / "out", SilentProgress(), rows="mars")
    assert not (tmp_path / "out").exists()
