"""Whoever reads what a command says, or nobody: its verdict and its files are the same."""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from optnav_cli.simulation.job import write_template_folder
from tests.catalog.made_catalogs import make_world
from tests.optnav_cli.made_runs import write_run

CHECKOUT = Path(__file__).resolve().parents[2]
OPTNAV = f"{shlex.quote(sys.executable)} -m optnav_cli.main"
# How a shell reads the command in the braces, whose exit code it hands on.
READERS = {
    "left": "{ } | true; exit ${PIPESTATUS[0]}",
    "left early": "{ } 2>&1 | head -1 > said; exit ${PIPESTATUS[0]}",
    "closed": "{ } >&-",
    "full": "{ } > /dev/full",
    "no stderr": "{ } 2>&-",
    "full stderr": "{ } 2> /dev/full",
    "none": "{ } <&- >&- 2>&-",
}

pytestmark = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
Call = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a catalog, another one, a damaged one, a run and pictures."""
    folder = tmp_path_factory.mktemp("made")
    whole = make_world().write(folder / "c.gpkg").path.read_bytes()
    make_world(seed=8).write(folder / "d.gpkg")
    half = len(whole) // 2
    flipped = bytes(byte ^ 0xFF for byte in whole[half : half + 40])
    (folder / "bad.gpkg").write_bytes(whole[:half] + flipped + whole[half + 40 :])
    write_run(folder / "run", count=6)
    write_template_folder(folder / "pictures")
    return folder


@pytest.fixture
def call(made: Path) -> Call:
    """Runs a command line in that folder, read in one of the ways above."""

    def called(words: str, reader: str = "") -> "subprocess.CompletedProcess[str]":
        line = READERS[reader] if reader else "{ }"
        done = subprocess.run(
            ["bash", "-c", line.replace("{ }", f"{OPTNAV} {words}")],
            cwd=made, capture_output=True, text=True, check=False,
            env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        )  # fmt: skip
        for trace in ("Traceback", "Logging error", "Exception ignored"):
            assert trace not in done.stdout + done.stderr
        return done

    return called


@pytest.mark.parametrize("reader", READERS)
def test_a_damaged_catalog_is_damaged_whoever_reads(reader: str, call: Call) -> None:
    assert call("catalog verify bad.gpkg", reader).returncode == 3


@pytest.mark.parametrize(
    ("words", "code"),
    [
        ("catalog compare c.gpkg d.gpkg", 5),
        ("evaluate run --truth run/truth.csv --max-horizontal-m 1", 5),
        ("catalog info missing.gpkg", 3),
        ("catalog nearest c.gpkg", 2),
    ],
)
def test_a_verdict_stays_when_its_words_are_not_read(words: str, code: int, call: Call) -> None:
    assert call(words, "left").returncode == code


@pytest.mark.parametrize("reader", ["left early", "full"])
def test_files_are_made_when_nobody_reads(reader: str, call: Call, made: Path) -> None:
    for words, output in (
        ("report run -o r.html", "r.html"),
        ("navigate pictures --catalog c.gpkg -o new", "new/solution.csv"),
    ):
        shutil.rmtree(made / "new", ignore_errors=True)
        assert call(words, reader).returncode == 0
        assert (made / output).exists()


@pytest.mark.parametrize(
    ("reader", "code"), [("full", 3), ("left", 0), ("closed", 0), ("full stderr", 0)]
)
def test_a_result_that_a_full_disk_does_not_take_is_missing(
    reader: str, code: int, call: Call
) -> None:
    done = call("catalog info c.gpkg", reader)
    assert done.returncode == code
    said = ["optnav: no space left on device: stdout did not take the result; send it elsewhere"]
    assert done.stderr.splitlines() == (said if code else [])


def test_a_log_that_cannot_be_written_is_told_once_and_loses_nothing(
    call: Call, made: Path
) -> None:
    done = call("catalog verify c.gpkg --log-file /dev/full")
    assert done.returncode == 0
    warnings = [line for line in done.stderr.splitlines() if "warning" in line]
    assert warnings == [
        "optnav: warning: /dev/full: cannot write the log: No space left on device; "
        "going on without it"
    ]
    assert "digest: " in done.stdout
    assert call("catalog verify bad.gpkg --log-file /dev/full").returncode == 3


def test_a_log_goes_to_a_file_of_ours_or_a_stream_and_to_nothing_else(
    call: Call, made: Path
) -> None:
    (made / "letter").write_text("Dear")
    os.mkfifo(made / "pipe")
    for place, said in (
        ("letter", "letter: is there and no log of optnav"),
        ("pipe", "pipe: cannot write the log: nobody reads this pipe"),
        ("run", "run: cannot write the log: Is a directory"),
    ):
        done = call(f"catalog info c.gpkg --log-file {place}")
        assert (done.returncode, done.stderr.startswith(f"optnav: {said}")) == (3, True)
    assert (made / "letter").read_text() == "Dear"
    for _ in range(2):
        assert call("--log-file log catalog verify c.gpkg").returncode == 0
    assert (made / "log").read_text().count("verify: 12 points in") == 2
    assert '{"time": "' in call("-q catalog verify c.gpkg --log-file /dev/stdout").stdout
