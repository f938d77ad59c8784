"""The cases of the comet: what they state lies about the truth as they say."""

from pathlib import Path

import numpy as np
import pytest

from optnav_cli.frames.folder import read_folder
from optnav_cli.studies.comet import CASES, TURNED_DEG, report, stated_folder
from tests.optnav_cli.runs.test_adjust_runs import write_run


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
    table = report([(CASES[0], ())]).tables[0]
    assert table.column("methods") == ["none solved"]
