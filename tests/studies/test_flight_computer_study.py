"""The cost of each way to navigate: a look at the quickest one, and that all have their inputs."""

import sys

import numpy as np
import pytest

from catalog.config import resource
from catalog.errors import NothingToDoError
from catalog.progress import SilentProgress
from tests.studies import flight_computer, flights
from tests.studies.flight_computer import MODES, Cost, Mode, measure, report, run
from tests.studies.stored import read_stored

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_every_mode_has_a_shipped_scenario_of_one_camera(mode: Mode) -> None:
    if mode.scenario:
        assert len(flights.shipped_scenario(mode.scenario).mounts()) == 1
    if mode.catalog:
        assert resource(f"configs/catalogs/{mode.catalog}.toml").is_file()


def test_a_mode_is_timed_in_a_process_of_its_own(tmp_path) -> None:
    (cost,) = run(tmp_path, SilentProgress(), "cylinder", 2)
    assert cost.mode == "cylinder"
    assert (len(cost.seconds), cost.size_px) == (2, (640, 480))
    assert all(0.0 < second < 60.0 for second in cost.seconds)
    # a picture of 640 x 480 floats at least, and less than the machine
    assert 640 * 480 * 4 < cost.memory_bytes < 4e9


def test_memory_counts_what_a_frame_holds_for_a_moment(monkeypatch, tmp_path) -> None:
    """50 MB that are let go of before the frame is done."""

    def frames():
        while True:
            yield bool(np.ones(50_000_000 // 8).sum())

    monkeypatch.setattr(flight_computer, "_prepare", lambda mode, folder: (frames(), (1, 1), []))
    monkeypatch.setattr(flight_computer.cv2, "setNumThreads", lambda count: None)
    monkeypatch.setattr(flight_computer.numba, "set_num_threads", lambda count: None)
    cost = measure(Mode("any"), tmp_path, 5)
    assert len(cost.seconds) == 5
    assert cost.memory_bytes > 40e6


def test_an_unknown_mode_is_refused(tmp_path) -> None:
    with pytest.raises(NothingToDoError, match="no row"):
        run(tmp_path, SilentProgress(), "sextant")


def test_the_table_has_medians_and_sizes() -> None:
    cost = Cost("stars", (0.1, 0.3, 0.2), 5e7, 2e6, (1024, 768))
    (row,) = report([cost]).tables[0].rows
    assert row == ("stars", "1024 x 768", 200.0, 300.0, 3, 50.0, 2.0)


def test_all_modes_are_stored_with_five_frames_and_more() -> None:
    table = read_stored("flight_computer").tables[0]
    assert table.column("mode") == [mode.name for mode in MODES]
    assert all(int(count) >= 5 for count in table.column("timed"))
