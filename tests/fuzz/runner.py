"""Hands cases to a worker process, takes outcomes back, and counts them."""

import contextlib
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tests.fuzz.judge import Verdict
from tests.fuzz.worker import READY

HANG_S = 60.0
START_S = 600.0  # kernels may have to be compiled
CASES_A_WORKER = 3000  # then a new one, so that no leak grows for hours
CHECKOUT = Path(__file__).resolve().parents[2]


class Runner:
    """Runs cases in worker processes below a folder, one at a time.

    hang_s  seconds after which a case that has not ended is ended, those not counted in which it
            waited for a processor
    """

    def __init__(self, area: Path, materials: Path | None = None, hang_s: float = HANG_S) -> None:
        self.area, self.hang_s = area, hang_s
        self.materials = materials or area / "materials"
        self._process: subprocess.Popen[bytes] | None = None
        self._answers = -1
        self._rest = b""
        self._done = self._started = 0

    def run(self, cases: Iterable[tuple[str, int]]) -> Iterator[Verdict]:
        """The outcome of each case, in order."""
        try:
            for kind, seed in cases:
                if self._done >= CASES_A_WORKER:
                    self._stop()
                yield self._one(kind, seed)
        finally:
            self._stop()

    def _one(self, kind: str, seed: int) -> Verdict:
        process = self._process or self._start()
        self._done += 1
        began = time.monotonic()
        if process.stdin is None:
            raise RuntimeError("the worker has no stdin")
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(f"{kind} {seed}\n".encode())
            process.stdin.flush()
        outcome, line = Verdict(kind, seed), self._answer(self.hang_s)
        if line is not None and line.endswith(b"\n"):
            outcome, line = Verdict.of_line(line), self._answer(self.hang_s)
        if line is not None and line.endswith(b"\n"):
            return Verdict.of_line(line)
        if line is None:
            process.send_signal(signal.SIGABRT)  # faulthandler then prints where it hangs
            failure = f"hang: no end after {self.hang_s:.0f} s"
        else:
            failure = ""
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(10.0)
        code = process.poll()
        outcome.said, outcome.seconds = self._said(), time.monotonic() - began
        self._stop()
        outcome.code = 1 if code is None else code
        outcome.failures.append(failure or f"signal or end of the process: {outcome.code}")
        return outcome

    def _start(self) -> subprocess.Popen[bytes]:
        self._started += 1
        for name in ("home", "tmp"):
            shutil.rmtree(self.area / "work" / name, ignore_errors=True)
        shutil.rmtree(self.area / "work", ignore_errors=True)
        reading, writing = os.pipe()
        self._process = subprocess.Popen(
            [
                sys.executable, "-m", "tests.fuzz.worker", str(self.area / "work"),
                str(self.materials), str(writing),
            ],
            cwd=CHECKOUT, stdin=subprocess.PIPE, pass_fds=[writing],
            env=os.environ | {"PYTHONPATH": str(CHECKOUT), "NUMBA_NUM_THREADS": "1"},
        )  # fmt: skip
        os.close(writing)
        self._answers, self._rest, self._done = reading, b"", 0
        if self._answer(START_S) != READY:
            said = self._said()
            self._stop()
            raise RuntimeError(f"the worker did not start:\n{said}")
        return self._process

    def _answer(self, seconds: float) -> bytes | None:
        """A line; what there is of it where the process ended; None where none came in time."""
        until, waited = time.monotonic() + seconds, self._waited_s()
        while b"\n" not in self._rest:
            left = until + self._waited_s() - waited - time.monotonic()
            ready, _, _ = select.select([self._answers], [], [], max(0.0, left))
            if not ready:
                if left > 0.0:
                    continue
                return None
            data = os.read(self._answers, 1 << 16)
            if not data:
                return self._rest
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        return line + b"\n"

    def _waited_s(self) -> float:
        """How long the worker has waited for a processor; 0 where the system does not say."""
        if self._process is not None:
            with contextlib.suppress(OSError, ValueError, IndexError):
                text = Path(f"/proc/{self._process.pid}/schedstat").read_text()
                return 1e-9 * int(text.split()[1])
        return 0.0

    def _said(self) -> str:
        with contextlib.suppress(OSError):
            text = (self.area / "work" / "streams.txt").read_text("utf-8", "backslashreplace")
            return text[-6000:]
        return ""

    def _stop(self) -> None:
        if self._process is None:
            return
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
        self._process.kill()
        self._process.wait()
        os.close(self._answers)
        self._process = None
        self._done = 0


@dataclass
class Tally:
    """Counts by kind of what came."""

    codes: dict[str, Counter[int]] = field(default_factory=dict)
    slowest: dict[str, tuple[float, int]] = field(default_factory=dict)
    seconds: Counter[str] = field(default_factory=Counter)
    failures: list[Verdict] = field(default_factory=list)

    def add(self, outcome: Verdict) -> None:
        """Count an outcome."""
        name = outcome.kind
        self.codes.setdefault(name, Counter())[outcome.code] += 1
        self.slowest[name] = max(self.slowest.get(name, (0.0, 0)), (outcome.seconds, outcome.seed))
        self.seconds[name] += outcome.seconds
        if outcome.failures:
            self.failures.append(outcome)

    def lines(self) -> list[str]:
        """A table: cases, exit codes, time and the slowest case of each kind."""
        failed = Counter(outcome.kind for outcome in self.failures)
        lines = [f"{'kind':<24}{'cases':>7}{'failed':>7}{'mean ms':>9}{'max s':>7}  codes"]
        for name, codes in sorted(self.codes.items()):
            count = codes.total()
            slowest, _ = self.slowest[name]
            shown = ", ".join(f"{code}: {n}" for code, n in sorted(codes.items()))
            mean = 1e3 * self.seconds[name] / count
            lines.append(
                f"{name:<24}{count:>7}{failed[name]:>7}{mean:>9.1f}{slowest:>7.2f}  {shown}"
            )
        total = sum(codes.total() for codes in self.codes.values())
        lines.append(f"{'all':<24}{total:>7}{len(self.failures):>7}")
        return lines


def failure_lines(outcome: Verdict) -> list[str]:
    """A case for who mends it: what ran, what came, what was wanted, how to run it again."""
    said = [line for line in outcome.said.splitlines() if line.strip()]
    came = "FAILED" if outcome.failures else "right"
    return [
        f"{came} {outcome.kind}:{outcome.seed}  optnav {' '.join(outcome.args)}",
        f"  input: {outcome.note or 'untouched'}",
        f"  code {outcome.code}, wanted {outcome.wanted}",
        *(f"  {failure}" for failure in outcome.failures),
        *(f"  | {line[:300]}" for line in said[-6:]),
        f"  again: make fuzz CASE={outcome.kind}:{outcome.seed}",
    ]
