"""`make fuzz`: hostile inputs and command lines, each with the exit codes that are right for it.

python -m tests.fuzz [-n 500] [--seed 1] [--kinds PREFIX,...] [--case KIND:SEED]
"""

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.fuzz import all_kinds  # noqa: F401 -- registers them
from tests.fuzz.cases import chosen
from tests.fuzz.runner import HANG_S, Runner, Tally, failure_lines

EVERY_S = 60.0  # between lines about how far the run is


def main() -> int:
    """Run the cases that the command line asks for; 1 where one failed."""
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__)
    parser.add_argument("-n", type=int, default=500, help="how many cases")
    parser.add_argument("--seed", type=int, default=1, help="which cases")
    parser.add_argument("--kinds", default="", help="only kinds whose names begin so: map,import")
    parser.add_argument("--case", default="", help="one case alone, KIND:SEED")
    parser.add_argument("--materials", type=Path, help="folder of inputs, kept for the next run")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--hang", type=float, default=HANG_S, help="seconds that a case may take")
    options = parser.parse_args()
    area = Path(tempfile.mkdtemp(prefix="optnav-fuzz-"))
    try:
        return _run(options, area)
    finally:
        shutil.rmtree(area, ignore_errors=True)


def _cases(options: argparse.Namespace) -> Iterator[tuple[str, int]]:
    if options.case:
        kind, _, seed = options.case.partition(":")
        yield kind, int(seed)
        return
    for number in range(options.first, options.n):
        yield chosen(number, options.seed, options.kinds)


def _run(options: argparse.Namespace, area: Path) -> int:
    tally, began = Tally(), time.monotonic()
    shown = began
    for done, outcome in enumerate(
        Runner(area, options.materials, options.hang).run(_cases(options)), options.first + 1
    ):
        tally.add(outcome)
        if outcome.failures or options.case:
            print("\n".join(failure_lines(outcome)), flush=True)
        if time.monotonic() - shown > EVERY_S:
            shown = time.monotonic()
            print(f"{done} cases, {len(tally.failures)} failed, {shown - began:.0f} s", flush=True)
    print("\n".join(tally.lines()))
    return 1 if tally.failures else 0


if __name__ == "__main__":
    sys.exit(main())
