"""The cases of the comet: what they state lies about the truth as they say."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.geometry.rotations import ARCSEC
from optnav_cli.fix import Fix, Method
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.truth import Truth
from tests.optnav_cli.calibration.test_adjust_job import write_run
from tests.studies.comet import (
    CASES,
    TURNED_DEG,
    CaseResult,
    report,
    seen_error_m,
    stated_folder,
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_what_is_stated_lies_about_the_truth(tmp_path: Path, case) -> None:
    pictures = write_run(tmp_path / "pictures", 30, sigmas=(20.0, 1e-5))
    truth = read_folder(pictures).frames
    for frame in truth:
        (pictures / frame.file).touch()
    stated = read_folder(stated_folder(pictures, tmp_path / "stated", case)).frames
    turns = [
        (a.camera_from_body * b.camera_from_body.inv()).magnitude()
        for a, b in zip(stated, truth, strict=True)
    ]
    if case.attitude_rad is None:
        assert np.degrees(turns) == pytest.approx(float(np.linalg.norm(TURNED_DEG)), abs=0.01)
    else:
        assert np.sqrt(np.mean(np.square(turns)) / 3.0) == pytest.approx(case.attitude_rad, rel=0.3)
    if case.position_m is None:
        assert all(frame.position_m is None for frame in stated)
    else:
        off = [a.position_m - b.position_m for a, b in zip(stated, truth, strict=True)]
        assert np.std(off) == pytest.approx(case.position_m, rel=0.3)
    assert (tmp_path / "stated" / "truth.csv").is_file()


def test_a_case_without_solutions_has_a_row() -> None:
    table = report([CaseResult(CASES[0], (), {}, frozenset())]).tables[0]
    assert table.column("methods") == ["none solved"]
    assert table.column("range_limit") == [None]


def test_a_turn_about_the_body_moves_nothing_that_the_camera_sees() -> None:
    place = np.array([0.0, 0.0, -1e5])
    truth = Truth("a.png", "", 0.0, place, Rotation.identity())
    turn = Rotation.from_rotvec([200.0 * ARCSEC, 0.0, 0.0])
    about = Fix(Method.SILHOUETTE, turn.apply(place, inverse=True), np.eye(3), turn)
    assert np.linalg.norm(about.position_m - place) == pytest.approx(97.0, abs=0.1)
    assert seen_error_m(about, truth) == pytest.approx(0.0, abs=1e-6)
    aside = Fix(Method.SILHOUETTE, place + np.array([30.0, 0.0, 500.0]), np.eye(3), None)
    assert seen_error_m(aside, truth) == pytest.approx(30.0, rel=1e-6)
