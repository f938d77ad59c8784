"""The Phobos study's table, and that its rows name scenarios and cameras that are there."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.config import resource
from catalog.errors import NothingToDoError
from catalog.jobs.usage import Account, StageAccount
from catalog.progress import SilentProgress
from optnav_cli.evaluation.figures import FrameError
from optnav_cli.simulation.inertial_path import Approach
from optnav_cli.simulation.passes import Portraits
from optnav_cli.simulation.scenario import load_scenario
from tests.optnav_cli.rows import solved, unsolved
from tests.studies.phobos import ROWS, PhobosCase, PhobosResults, report, run

UTC = "2026-01-01T00:00:00Z"
ACCOUNT = Account(
    "optnav", 2, 412, 412, 266, stages=[StageAccount("render", done=412, seconds=90.0, cpu_s=150.0)]
)


def found(error_rnb_m: list[float], sigma_m: float, distance_m: float) -> FrameError:
    error = np.array(error_rnb_m)
    solution = solved("a.png", UTC, "horizon", error, np.eye(3), Rotation.identity(), 0.0)
    nees = float(error @ error) / sigma_m**2
    return FrameError(
        "a.png", UTC, solution, "motion", distance_m - 11e3, error, np.full(3, sigma_m), nees,
        distance_m=distance_m,
    )  # fmt: skip


def missed(reason: str) -> FrameError:
    return FrameError("b.png", UTC, unsolved("b.png", UTC, reason), "motion", 89e3)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_every_row_has_a_scenario_with_its_camera_and_prior(row: PhobosCase) -> None:
    scenario = load_scenario(resource(f"configs/scenarios/{row.scenario}.toml"))
    assert row.camera in [mount.name for mount in scenario.mounts()]
    assert scenario.prior.given or not row.prior
    assert row.flown == isinstance(scenario, Approach)
    if isinstance(scenario, Approach):
        assert scenario.attitude.sigma_arcsec == 10.0
        lowest, highest = row.distance_km
        assert lowest < scenario.approach.from_km
        assert highest > scenario.approach.to_km
        return
    assert isinstance(scenario, Portraits)
    assert scenario.portraits.frames >= 12
    assert scenario.portraits.phase_deg == (20.0, 70.0)


def test_the_table_says_what_is_found_asked_and_missed() -> None:
    frames = [
        found([-100.0, 6.0, 8.0], 50.0, 100e3),
        found([100.0, 0.0, 10.0], 50.0, 100e3),
        missed("no limb in view; and no frame before leads here"),
    ]
    found_report = report(PhobosResults(ACCOUNT, [(ROWS[3], frames)]))
    (table,) = found_report.tables
    shown = {c.name: c.shown(cell) for c, cell in zip(table.columns, table.rows[0], strict=True)}
    assert "266 of 412 points usable, 90 s (≤ 180)" in found_report.notes[0]
    assert "150 s of processors" in found_report.notes[0]
    assert (shown["case"], shown["solved"], shown["frames"]) == ("limb, 100 km", "2", "3")
    assert (shown["across_rms_m"], shown["across_limit_m"]) == ("10.0", "15")
    assert (shown["range_share"], shown["range_share_limit"]) == ("0.100", "0.1")
    assert shown["nees"] == "1.35"  # 10100 / 2500 / 3
    assert (shown["worst"], shown["methods"]) == ("2.0", "2 horizon")
    assert "limb, 100 km: 1 not solved: no limb in view" in found_report.notes


def test_a_row_without_solutions_says_so() -> None:
    text = report(PhobosResults(ACCOUNT, [(ROWS[-1], [missed("dark")])])).to_text()
    assert "none solved" in text
    assert "1 not solved: dark" in text


def test_a_row_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(NothingToDoError, match="no row of the study is called 'deimos'"):
        run(tmp_path / "out", SilentProgress(), rows="deimos")
