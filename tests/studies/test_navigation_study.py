"""The navigation study's tables, and that its rows name scenarios and catalogs that are there."""

import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.config import resource
from catalog.errors import ConfigError
from catalog.progress import SilentProgress
from catalog.terrain.error_model import StatedError
from optnav_cli.evaluation.evaluation import Evaluation
from optnav_cli.evaluation.figures import FrameError
from optnav_cli.simulation.scenario import load_scenario
from tests.optnav_cli.rows import solved, unsolved
from tests.studies import navigation
from tests.studies.flights import GROUNDS
from tests.studies.navigation import ROWS, FlightResult, report, run

UTC = "2026-01-01T00:00:00Z"
REAL = next(row for row in ROWS if row.scenarios == ("real_unk_200km",))
OWN = next(row for row in ROWS if row.scenarios == ("unk_200km",))


def evaluation(error_m: float | None, nees: float = 1.0) -> Evaluation:
    if error_m is None:
        return Evaluation((FrameError("a.png", UTC, unsolved("a.png", UTC, "x"), "motion", 4e5),))
    error = np.array([error_m, 0.0, 0.0])
    answer = solved("a.png", UTC, "control_points", error, np.eye(3), Rotation.identity(), 0.0)
    sigmas = np.full(3, error_m)
    return Evaluation((FrameError("a.png", UTC, answer, "motion", 4e5, error, sigmas, nees),))


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_every_row_flies_shipped_scenarios_over_a_shipped_catalog(row) -> None:
    assert resource(f"configs/catalogs/{row.catalog}.toml").is_file()
    for name in row.scenarios:
        scenario = load_scenario(resource(f"configs/scenarios/{name}.toml"))
        assert (scenario.world.model_error == "gld100") == (row.ground == GROUNDS[0])


def test_each_ground_has_a_table_and_that_of_real_scenarios_comes_first() -> None:
    results = [FlightResult(row, False, evaluation(5.0), 30.0) for row in (OWN, REAL)]
    tables = report(results).tables
    assert [table.title for table in tables] == list(GROUNDS)
    assert [table.column("case") for table in tables] == [[REAL.name], [OWN.name]]


def test_the_map_that_a_row_needs_is_asked_for_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.delenv("OPTNAV_SHARED_DATA", raising=False)
    with pytest.raises(ConfigError, match="OPTNAV_SHARED_DATA"):
        run(tmp_path / "out", SilentProgress(), rows="474 m")
    assert not (tmp_path / "out").exists()


def test_a_row_of_which_nothing_is_solved_has_a_line_of_dashes() -> None:
    table = report([FlightResult(REAL, False, evaluation(None), 30.0)]).tables[0]
    assert (table.column("solved"), table.column("frames")) == ([0], [1])
    assert table.column("horizontal_rms_m") == [None]


def test_the_worst_frame_and_the_share_of_solved_frames_are_told_beside_what_is_asked() -> None:
    frames = (evaluation(5.0, 4.0), evaluation(5.0, 25.0), evaluation(None))
    first, *others = (FlightResult(REAL, star, frame, 30.0) for star, frame in enumerate(frames))
    found = report([first, *others])
    assert found.tables[0].column("worst") == [2.0, 5.0, None]
    assert any("solved 2 of 3 frames (66.7 %)" in note for note in found.notes)
    assert any(f"worst frame 5.0 σ ({REAL.name}, 10″)" in note for note in found.notes)


def test_kept_runs_are_evaluated_without_a_catalog(tmp_path, monkeypatch) -> None:
    place = tmp_path / "runs" / "real_unk_200km-1deg"
    place.mkdir(parents=True)
    (place / "solution.csv").touch()
    asked = []
    monkeypatch.setattr(
        navigation.flights, "shipped_pictures", lambda *_: tmp_path / REAL.scenarios[0]
    )
    monkeypatch.setattr(navigation.flights, "with_star_sensor", lambda pictures: pictures)
    monkeypatch.setattr(
        navigation, "evaluate_run", lambda run, _: asked.append(run) or evaluation(5.0)
    )
    found = run(tmp_path, SilentProgress(), rows=REAL.name, kept=True)
    assert asked == [place, place]
    assert [result.evaluation.frames[0].file for result in found] == ["a.png", "a.png"]


def test_a_catalog_has_patches_of_the_posting_that_a_row_names(tmp_path, monkeypatch) -> None:
    written = {}

    def built(config, text, progress, bbox):
        written[config.name] = tomllib.loads(text)
        return config

    monkeypatch.setattr(navigation.flights, "built_catalog", built)
    for posting_m in (None, 236.9):
        given = "farside", 1.0, StatedError(), SilentProgress(), None, None, posting_m
        navigation.case_catalog(tmp_path, *given)
    plain, halved = written.values()
    assert halved == plain | {"pyramid": {"posting_m": 236.9}}
