"""The study of descents: its rows, its wrong model and its tables, without flying."""

from pathlib import Path

import numpy as np
import pytest
import rasterio

from catalog.config import resource
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.fix import Fix, Method, NoFix, Solution
from optnav_cli.reasons import Reason, ReasonCode
from tests.studies.descent import CASES, DescentResult, filter_ms, report
from tests.studies.descent_flights import (
    MODEL,
    WRONG_M,
    FlownFrame,
    Way,
    binned_camera,
    scenario_of,
    write_wrong_model,
)
from tests.studies.descent_measurements import Errors, Formulation
from tests.studies.flights import rows_named

UTC = "2026-01-01T00:00:00Z"


def frame(height_m: float, error: float | None, last: bool = False) -> FlownFrame:
    """One with an error of the same size east, north and up."""
    if error is None:
        reason = Reason(ReasonCode.FEW_POINTS, "none found")
        return FlownFrame(height_m, None, None, Solution("a.png", UTC, NoFix(reason)), last)
    fix = Fix(Method.DESCENT, np.array([1.8e6, 0.0, 0.0]), np.eye(3))
    return FlownFrame(height_m, np.full(3, error), 1.5, Solution("a.png", UTC, fix), last)


def test_rows_are_chosen_by_one_text_or_several() -> None:
    assert [row.name for row in rows_named(CASES, "12 m")] == ["12 m, 20-2 km"]
    both = [row.name for row in rows_named(CASES, "no windows|12 m")]
    assert both == ["12 m, 20-2 km", "no windows below 6.5 km"]
    assert len(rows_named(CASES, "")) == len(CASES)


def test_each_ground_is_another_one() -> None:
    first, second, low = scenario_of(0), scenario_of(1), scenario_of(0, Way.LOW)
    fine = scenario_of(0, Way.FINE)
    assert len({each.seed for each in (first, second, low, fine)}) == 4
    assert len({each.detail.seeds for each in (first, second, low, fine)}) == 4
    assert low.descent.from_km < first.descent.from_km
    moon = scenario_of(0, Way.MOON)
    assert moon.world.model_error == "gld100"
    assert moon.descent == first.descent
    south = scenario_of(0, Way.SOUTH)
    assert south.altimeter is not None
    assert south.dem[0].path.startswith("shared:")
    assert south.descent.end_deg[1] == -71.0


def test_a_binned_camera_sees_the_same_rays() -> None:
    wide, binned = preset_camera("tsnn2_wide"), binned_camera()
    corner = np.array([[-0.5, -0.5]])
    assert binned.unproject(corner) == pytest.approx(wide.unproject(corner), abs=1e-12)


def test_the_wrong_model_is_wrong_by_as_much_as_it_says(tmp_path: Path) -> None:
    path = write_wrong_model(tmp_path / "wrong.tif", 3)
    with rasterio.open(path) as wrong, rasterio.open(resource(f"data/{MODEL}")) as right:
        off = wrong.read(1) - right.read(1)
        assert wrong.transform == right.transform
    assert off.std() == pytest.approx(WRONG_M, rel=0.01)
    along = np.mean(off[:, 1:] * off[:, :-1]) / WRONG_M**2
    farther = np.mean(off[:, 4:] * off[:, :-4]) / WRONG_M**2
    assert along > 0.3
    assert abs(farther) < 0.05


def test_the_tables_hold_errors_by_height_and_why_frames_failed() -> None:
    case = CASES[1]
    frames = [frame(5e3, 3.0), frame(3e3, None), frame(2e3, 4.0, last=True)]
    runs = [Errors(np.array([2e3]), np.array([[6.0, 2.0, 1.0]]), np.array([1.2]))]
    made = report(DescentResult({case.name: frames}, {Formulation.JOINT: runs}, 120.0, 8.0))
    table, measured, times = made.tables
    assert table.column("solved") == [2]
    assert table.column("horizontal_a_component_m") == [pytest.approx(np.sqrt(12.5), rel=1e-5)]
    assert table.column("at_the_end_horizontal_m") == [pytest.approx(4.0 * np.sqrt(2.0), rel=1e-5)]
    assert measured.column("along_at_2_km_m") == [6.0]
    assert times.column("time_ms") == [120.0, 8.0]
    assert made.notes == (f"{case.name}: 1 not solved: none found",)
    assert report(DescentResult({case.name: []}, {}, 0.0, 0.0)).tables[0].column("solved") == [0]


def test_an_update_with_sixty_landmarks_takes_milliseconds() -> None:
    """A bound far from what is asked for, so that a busy machine does not fail it."""
    assert filter_ms() < 500.0
