"""What people see of a run, and what the log file keeps."""

import io
import json
import logging
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from catalog.errors import OutputError
from optnav_cli import console
from optnav_cli.console import ConsoleProgress, set_up_logging

_log = logging.getLogger("catalog.test")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture(autouse=True)
def _logging_is_put_back() -> Iterator[None]:
    root = logging.getLogger()
    handlers, levels = root.handlers[:], {n: logging.getLogger(n).level for n in console.PACKAGES}
    yield
    for handler in set(root.handlers) - set(handlers):
        root.removeHandler(handler)
        handler.close()
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)
    logging.captureWarnings(False)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time in seconds that the console reads; a test sets it forward."""
    now = [0.0]
    monkeypatch.setattr("optnav_cli.console.time.monotonic", lambda: now[0])
    return now


def test_people_read_messages_on_stderr_and_results_stay_alone_on_stdout(
    capsys: pytest.CaptureFixture[str],
) -> None:
    set_up_logging(quiet=False, verbose=False, log_file=None)
    _log.debug("a detail")
    _log.info("a message")
    _log.warning("a frame was skipped")
    out, err = capsys.readouterr()
    assert out == ""
    assert err == "optnav: a message\noptnav: warning: a frame was skipped\n"


@pytest.mark.parametrize(
    ("quiet", "verbose", "seen"), [(True, False, ["c"]), (False, True, ["a", "b", "c"])]
)
def test_quiet_and_verbose_choose_what_people_see(
    quiet: bool, verbose: bool, seen: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    set_up_logging(quiet=quiet, verbose=verbose, log_file=None)
    _log.debug("a")
    _log.info("b")
    _log.error("c")
    assert [line.split()[-1] for line in capsys.readouterr().err.splitlines()] == seen


def test_a_very_long_line_is_shown_without_its_middle(capsys: pytest.CaptureFixture[str]) -> None:
    set_up_logging(quiet=False, verbose=False, log_file=None)
    _log.warning("%s: no name of a file\nand more", "1" * 5000)
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("optnav: warning: 111")
    assert first.endswith("1: no name of a file")
    assert len(first) < 2100
    assert second == "and more"


def test_the_log_file_has_every_detail_as_json_lines_even_when_quiet(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    set_up_logging(quiet=True, verbose=False, log_file=path)
    _log.debug("detail %d of a crater: 10°", 3)
    entry = json.loads(path.read_text(encoding="utf-8"))
    assert entry["message"] == "detail 3 of a crater: 10°"
    assert entry["level"] == "debug"
    assert entry["logger"] == "catalog.test"
    assert entry["time"].endswith("+00:00")


def test_a_log_file_that_cannot_be_written_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot write the log"):
        set_up_logging(quiet=False, verbose=False, log_file=tmp_path / "no" / "log.jsonl")


def test_plain_lines_come_first_now_and_then_and_last_with_rate_and_time_left(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    set_up_logging(quiet=False, verbose=False, log_file=None)
    with ConsoleProgress(io.StringIO()).stage("render", total=100, unit="cell") as stage:
        for _ in range(100):
            clock[0] += 1.5
            stage.advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "optnav: render: 100 cells",
        "optnav: render: 40 of 100 cells (40 %), 1.5 s a cell, 1 min 30 s left",
        "optnav: render: 80 of 100 cells (80 %), 1.5 s a cell, 30 s left",
        "optnav: render: 100 cells in 2 min 30 s (1.5 s a cell)",
    ]


def test_a_stage_of_hours_tells_one_line_a_minute(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    set_up_logging(quiet=False, verbose=False, log_file=None)
    with ConsoleProgress(io.StringIO()).stage("check", total=36_000, unit="cell") as stage:
        for _ in range(36_000):
            clock[0] += 0.5
            stage.advance()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 + 5 * 60 - 1 + 1
    assert lines[60] == ("optnav: check: 7200 of 36000 cells (20 %), 2.0 cells/s, 4 h 00 min left")


def test_what_was_done_in_an_earlier_run_does_not_count_as_speed(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    set_up_logging(quiet=False, verbose=False, log_file=None)
    with ConsoleProgress(io.StringIO()).stage("check", total=1000, unit="cell") as stage:
        stage.keep(900)
        for _ in range(100):
            clock[0] += 1.0
            stage.advance()
    lines = capsys.readouterr().err.splitlines()
    assert lines[1:] == [
        "optnav: check: 960 of 1000 cells (96 %), 1.0 cells/s, 40 s left",
        "optnav: check: 100 cells in 1 min 40 s (1.0 cells/s); 900 done before",
    ]


def test_a_bar_begins_where_an_earlier_run_ended() -> None:
    terminal = Terminal()
    with ConsoleProgress(terminal).stage("render", total=400, unit="cell") as stage:
        stage.keep(100)
        assert "25%" in terminal.getvalue()
        assert "100/400" in terminal.getvalue()
        # what was kept is no speed: nothing is known of the time left
        assert "?cell/s" in terminal.getvalue().rpartition("\r")[2]
        time.sleep(0.2)
        stage.advance()
        shown = terminal.getvalue().rpartition("\r")[2]
        assert "101/400" in shown
        assert float(re.search(r"([\d.]+)cell/s", shown).group(1)) <= 5.0


def test_a_terminal_gets_a_bar_and_a_last_line(capsys: pytest.CaptureFixture[str]) -> None:
    set_up_logging(quiet=False, verbose=False, log_file=None)
    terminal = Terminal()
    with ConsoleProgress(terminal).stage("render", total=4, unit="cell") as stage:
        for _ in range(4):
            stage.advance(note="at the pole")
    assert "render:   0%" in terminal.getvalue()
    assert "render: 4 cells in" in capsys.readouterr().err


def test_a_stage_that_fails_has_no_last_line(capsys: pytest.CaptureFixture[str]) -> None:
    set_up_logging(quiet=False, verbose=False, log_file=None)
    progress = ConsoleProgress(io.StringIO())
    with pytest.raises(OutputError), progress.stage("write", total=2, unit="point"):
        raise OutputError("disk full")
    assert capsys.readouterr().err == "optnav: write: 2 points\n"


def test_only_a_run_that_compiles_says_so(tmp_path: Path) -> None:
    module = tmp_path / "some_kernel.py"
    module.write_text(
        "from catalog.geometry.kernel import kernel\n@kernel\ndef twice(x):\n    return 2.0 * x\n"
    )
    script = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from optnav_cli.console import report_compilation, set_up_logging\n"
        "set_up_logging(quiet=False, verbose=False, log_file=None)\n"
        "report_compilation()\n"
        "from some_kernel import twice\n"
        "print(twice(2.0))\n"
    )

    def messages() -> int:
        result = subprocess.run(
            [sys.executable, "-c", script, str(tmp_path)],
            capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2],
            env={"PATH": "", "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
        )  # fmt: skip
        assert result.stdout == "4.0\n"
        return result.stderr.count("compiling numerical kernels")

    assert [messages(), messages(), messages()] == [1, 0, 0]
