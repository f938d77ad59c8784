"""A process that runs cases: `KIND SEED` a line on stdin, two lines on a handle of its own.

The first line says what the case is, before it runs, and the second what came of it.

Started by `tests.fuzz.runner`, which ends it when a case takes too long and starts another one when
it died; so a crash of a library is counted against its case, and the run goes on.
"""

import faulthandler
import os
import sys
from pathlib import Path

from tests.fuzz import all_kinds  # noqa: F401 -- registers them
from tests.fuzz.guard import limit_memory
from tests.fuzz.judge import Judge
from tests.fuzz.materials import make_materials

READY = b"ready\n"


def main(area: Path, materials: Path, answers: int) -> None:
    """Answer every line of stdin with the outcome of its case."""
    os.environ.setdefault("OPTNAV_SHARED_DATA", str(area / "shared"))
    area.mkdir(parents=True, exist_ok=True)
    streams = area / "streams.txt"
    handle = os.open(streams, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
    os.dup2(handle, 1)
    os.dup2(handle, 2)
    faulthandler.enable()
    make_materials(materials)
    judge = Judge(area, materials, streams)
    limit_memory()
    os.write(answers, READY)
    for line in sys.stdin:
        kind, seed = line.split()
        outcome = judge.judge(kind, int(seed), lambda case: os.write(answers, case.line()))
        os.write(answers, outcome.line())


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
