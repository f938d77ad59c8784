"""A build that is stopped: it ends at once, leaves nothing half, and goes on when given again."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from catalog.config import resource
from tests.catalog.pipeline.killing import wait_for_the_end_of

CHECKOUT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
# four cells of the bundled terrain, two workers
BUILD = (
    sys.executable, "-m", "optnav_cli.main", "build",
    str(resource("configs/catalogs/tycho.toml")), "-o", "new.gpkg",
    "--workers", "2", "--bbox", "-13,-45,-11,-43",
)  # fmt: skip
Start = Callable[[str], "subprocess.Popen[str]"]

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


@pytest.fixture
def started(tmp_path: Path) -> Start:
    """Starts a build and waits until its messages come to a stage."""

    def start(stage: str) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            BUILD, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, start_new_session=True,
        )  # fmt: skip
        assert process.stderr is not None
        for line in process.stderr:
            if stage in line:
                return process
        raise AssertionError(f"the build never came to {stage}")

    return start


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_build_ends_at_once_with_its_workers(
    number: signal.Signals, started: Start, tmp_path: Path
) -> None:
    with started("render: 4 cells") as process:
        process.send_signal(number)
        _, err = process.communicate(timeout=15)
    assert (process.returncode, "Traceback" in err) == (130, False)
    assert err.endswith("optnav: interrupted\n")
    assert not (tmp_path / "new.gpkg").exists()
    wait_for_the_end_of(process.pid, 5.0)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What a build says that nobody stops."""
    return _digest(tmp_path_factory.mktemp("undisturbed"))


def test_a_build_killed_again_and_again_goes_on_to_the_same_catalog(
    undisturbed: str, started: Start, tmp_path: Path
) -> None:
    """In two stages; a quicker test kills forked builds in all of them."""
    for stage in ("render: 4 cells", "write: 4"):
        with started(stage) as process:
            process.kill()
        wait_for_the_end_of(process.pid, 5.0)
        if (tmp_path / "new.gpkg").exists():  # the kill came too late for the last stage
            (tmp_path / "new.gpkg").unlink()
    assert _digest(tmp_path) == undisturbed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new.gpkg", "new.gpkg.work"]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds workers in /proc")
def test_builds_and_workers_killed_at_any_moment_end_with_the_same_catalog(
    undisturbed: str, tmp_path: Path
) -> None:
    """The command as people give it, killed by the clock; a quicker test kills forked builds."""
    rng = random.Random(20)
    kills = rounds = 0
    while kills < 25:
        folder = tmp_path / str(rounds)
        folder.mkdir(exist_ok=True)
        with subprocess.Popen(
            BUILD, cwd=folder, env=ENVIRONMENT, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL, start_new_session=True,
        ) as process:  # fmt: skip
            while process.poll() is None:
                time.sleep(rng.uniform(0.0, 6.0))
                victim = rng.choice([process.pid, *_children(process.pid)])
                with suppress(ProcessLookupError):
                    os.kill(victim, signal.SIGKILL)
                    kills += 1
        wait_for_the_end_of(process.pid, 5.0)
        if (folder / "new.gpkg").exists():
            assert _digest(folder) == undisturbed
            rounds += 1
    (tmp_path / str(rounds)).mkdir(exist_ok=True)
    assert _digest(tmp_path / str(rounds)) == undisturbed


def _children(parent: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            # the name, in brackets, may hold anything; state and parent follow it
            state, above = stat.read_text().rpartition(")")[2].split()[:2]
            if int(above) == parent and state != "Z":
                found.append(int(stat.parent.name))
    return found


def _digest(folder: Path) -> str:
    done = subprocess.run(
        BUILD, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=True
    )
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("digest: ")]
    return line
