"""How long a command takes, by the clock and of the processors."""

import resource
import subprocess
import time
from collections.abc import Sequence
from typing import NamedTuple

from tests.bench.global_moon.place import CHECKOUT


class Used(NamedTuple):
    """Seconds by the clock, and of all processors, the command's own children included."""

    wall_s: float
    cpu_s: float


def run(words: Sequence[str], stdout: int | None = None) -> Used:
    """Run a command in the checkout. Raises SystemExit when it fails."""
    before, started = _children_s(), time.monotonic()
    done = subprocess.run(words, cwd=CHECKOUT, stdout=stdout)
    used = Used(time.monotonic() - started, _children_s() - before)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)}: ended with exit code {done.returncode}")
    return used


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
