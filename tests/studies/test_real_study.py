"""The study of real pictures: sets that are not there, labels corrected, the table."""

from pathlib import Path

import numpy as np
import pytest

from catalog.errors import DataError
from catalog.geometry.rotations import ARCSEC
from catalog.progress import SilentProgress
from optnav_cli.calibration.adjust_job import adjust_runs
from optnav_cli.frames.folder import read_folder
from optnav_cli.output.run_folder import read_run
from tests.optnav_cli.calibration.test_adjust_job import write_run
from tests.studies import real
from tests.studies.real import KINDS, SETS, SetResult, report, run


def test_a_set_that_is_not_there_is_skipped_and_said(tmp_path: Path) -> None:
    for name in ("67P", "Eros"):
        (tmp_path / "sets").mkdir(exist_ok=True)
        results = run(tmp_path / "sets", tmp_path / "out", SilentProgress(), rows=name)
        (line,) = report(results).notes
        assert "skipped" in line
        assert "no such file" in line
        assert report(results).tables[0].column("solved") == [None]
    with pytest.raises(DataError, match="there is no such folder"):
        run(tmp_path / "elsewhere", tmp_path / "out", SilentProgress())


def test_each_set_can_be_named() -> None:
    assert len({one.name for one in SETS}) == len(SETS) == 3


def test_labels_corrected_by_what_is_common_agree_with_the_solutions(tmp_path: Path) -> None:
    place = tmp_path / "set"
    first = read_run(write_run(place / "run", 30, sigmas=(20.0, 10.0 * ARCSEC)))
    common = adjust_runs([first.path], place / "adjusted", KINDS)
    pictures = write_run(place / "pictures", 30, sigmas=(20.0, 10.0 * ARCSEC))
    corrected = real._corrected(pictures, place / "adjusted", place / "corrected")
    labels = read_folder(corrected)
    scale = labels.body.catalog_frame.scale
    assert labels.frames[0].position_sigma_m == pytest.approx(300.0, rel=1e-4)
    assert scale == pytest.approx(1.0056, abs=0.003)
    assert labels.frames[0].attitude_sigma_rad == pytest.approx(200.0 * ARCSEC)
    # in the frame of the catalog, in which the first run was navigated with raw labels
    again = read_run(place / "adjusted")
    nees = real._nees(again, labels.frames)
    assert len(nees) == 30
    # corrected labels are off by 20 m a component, raw ones by 500 m of scale besides
    assert np.mean(nees) > 0.1
    raw = real._nees(again, read_folder(pictures).frames)
    assert np.mean(nees) < 0.1 * np.mean(raw)
    result = SetResult("set", first, read_run(first.path), common, place / "adjusted", nees)
    made = report([result])
    assert made.tables[0].column("solved") == [30]
    assert made.tables[1].column("value")[6] == pytest.approx(1.0056, abs=0.003)
