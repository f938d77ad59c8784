"""The autonomous study's tables, and the arc of lit limb that a picture truly shows."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.config import resource
from optnav_cli.camera.camera import Camera
from optnav_cli.evaluation.figures import FrameError
from optnav_cli.frames.truth import Truth
from optnav_cli.simulation.scenario import load_scenario
from tests.optnav_cli.rows import solved, unsolved
from tests.studies.autonomous import (
    ROWS,
    SHARES,
    LoopResult,
    LoopResults,
    ShareResult,
    lit_arc_deg,
    report,
    write_figures,
)
from tests.studies.tables import StudyReport

RADIUS_M, HEIGHT_M, UTC = 1737400.0, 2e5, "2026-01-01T00:00:00Z"
SIGMA_M = 10.0


def found(error_rnb_m: list[float], height_m: float = 4e5) -> FrameError:
    error = np.array(error_rnb_m)
    answer = solved("a.png", UTC, "horizon", error, np.eye(3), Rotation.identity(), 0.0)
    nees = float(error @ error) / SIGMA_M**2
    return FrameError(
        "a.png", UTC, answer, "motion", height_m, error, np.full(3, SIGMA_M), nees
    )  # fmt: skip


def missed() -> FrameError:
    return FrameError("b.png", UTC, unsolved("b.png", UTC, "no limb in view"), "motion", 4e5)


def arc_deg(side_px: int, sun_body: list[float]) -> float:
    """Of a fisheye over the north pole that looks down."""
    middle = (side_px - 1) / 2.0
    camera = Camera("wide", "equidistant", side_px, side_px, 250.0, (middle, middle))
    nadir = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    truth = Truth("a.png", UTC, 0.0, np.array([0.0, 0.0, RADIUS_M + HEIGHT_M]), nadir)
    return lit_arc_deg(camera, truth, np.array(sun_body), RADIUS_M)


def test_of_a_limb_in_full_view_the_sun_s_side_counts() -> None:
    assert arc_deg(1001, [1.0, 0.0, 0.0]) == pytest.approx(180.0, abs=1.0)
    assert arc_deg(1001, [0.0, 0.0, 1.0]) == 360.0
    assert arc_deg(1001, [0.0, 0.0, -1.0]) == 0.0


def test_of_a_limb_that_the_frame_cuts_what_is_inside_counts() -> None:
    """A circle of more than half a square's side loses an arc of 2 acos(h / r) at each side."""
    circle_px = 250.0 * np.arcsin(RADIUS_M / (RADIUS_M + HEIGHT_M))
    lost = 4.0 * 2.0 * np.degrees(np.arccos(250.0 / circle_px))
    assert 100.0 < lost < 300.0
    assert arc_deg(500, [0.0, 0.0, 1.0]) == pytest.approx(360.0 - lost, abs=2.0)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_every_row_has_a_scenario_with_its_camera(row) -> None:
    scenario = load_scenario(resource(f"configs/scenarios/{row.scenario}.toml"))
    assert row.camera in [mount.name for mount in scenario.mounts()]


def test_the_star_sensor_adds_its_part_to_a_limit_in_quadrature() -> None:
    """20 m and 0.07 m a km at 400 km: 28 m."""
    exact, sensor = ROWS[2], ROWS[4]
    assert LoopResult(exact, (found([0.0, 0.0, 0.0]),)).limit_m == 40.0
    limit = LoopResult(sensor, (found([0.0, 0.0, 0.0]), missed())).limit_m
    assert limit == pytest.approx(np.hypot(20.0, 28.0))


def test_the_tables_say_what_is_solved_asked_and_wrong(tmp_path: Path) -> None:
    good, wrong = found([3.0, 6.0, 8.0]), found([0.0, 60.0, 0.0])
    row = LoopResult(ROWS[2], (good, wrong, missed()))
    shares = [
        ShareResult(SHARES[0], (good, missed()), (150.0, 160.0)),
        ShareResult(SHARES[1], (good, good), (139.0, 141.0)),
    ]
    results = LoopResults([row], shares)
    cases, arcs = (table for table in report(results).tables)
    assert cases.column("case") == ["wide camera, 400 km"]
    assert (cases.column("solved"), cases.column("frames")) == ([2], [3])
    horizontal = np.hypot(10.0, 60.0) / np.sqrt(2.0)
    assert cases.column("horizontal_rms_m") == pytest.approx([horizontal], rel=1e-5)
    assert cases.column("horizontal_limit_m") == [40.0]
    assert cases.column("height_rms_m") == pytest.approx([3.0 / np.sqrt(2.0)], rel=1e-5)
    assert cases.column("height_limit_m") == [30.0]
    assert cases.column("worst") == [6.0]
    assert arcs.column("scenario") == [SHARES[0], SHARES[1], "together"]
    assert [row[1:5] for row in arcs.rows] == [(1, 2, 0, 0), (1, 1, 1, 1), (2, 3, 1, 1)]
    assert arcs.column("methods")[-1] == "3 horizon"
    assert report(results).notes[-1] == "wrong by more than 5 of their own sigmas: 1 of 7"

    write_figures(tmp_path / "figures.json", results)
    text = (tmp_path / "figures.json").read_text(encoding="utf-8")
    *_, single, lit = StudyReport.from_json(text).tables
    sigmas = single.column("sigmas")[:3]
    assert sigmas == [pytest.approx(np.sqrt(1.09), rel=1e-5), 6.0, None]
    assert lit.column("arc_deg")[2:] == [139.0, 141.0]
