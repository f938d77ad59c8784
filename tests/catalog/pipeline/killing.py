"""Builds to be killed, each forked from a process that has loaded and compiled everything.

Run as a program it builds once undisturbed and says the digest; then, for every folder named on
its stdin, it forks a build of the same region there. A build says where it is on stdout: its
process, then a line `stage count workers...` at each step. `ended STATUS` comes after its end.
"""

import multiprocessing
import os
import signal
import sys
import time
from contextlib import contextmanager
from pathlib import Path

BBOX = (-14.0, -45.0, -9.0, -42.0)
THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def say(*words):
    os.write(1, (" ".join(map(str, words)) + "\n").encode())  # whole, whoever else writes


def wait_for_the_end_of(session, seconds):
    """No process of a session may be left by then."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    os.killpg(session, signal.SIGKILL)
    raise AssertionError("workers outlived the build")


class Telling:
    """Progress that goes to stdout."""

    @contextmanager
    def stage(self, name, total, unit):
        self.name = name.split()[0]
        self.tell("opened")
        yield self

    def advance(self, n=1, note=""):
        self.tell("advanced")

    def keep(self, n):
        self.tell("kept")

    def tell(self, what):
        say(self.name, what, *(child.pid for child in multiprocessing.active_children()))


def build(config, folder, workers):
    from catalog.errors import OptnavError
    from catalog.pipeline.build import run

    output = folder / "c.gpkg"
    try:
        report = run(config, output=output, workers=workers, bbox=BBOX, progress=Telling())
    except OptnavError as error:
        say("refused", error)
    else:
        say("digest", report.digest)


def main():
    config, folder = Path(sys.argv[1]), Path(sys.argv[2])
    for name in THREADS:
        os.environ[name] = "1"
    import cv2

    cv2.setNumThreads(1)
    build(config, folder, 1)
    # workers have everything loaded too; what is tested is their death, not how they begin
    forking = multiprocessing.get_context("fork")
    multiprocessing.get_context = lambda method=None: forking
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            os.setsid()  # so that the test can ask whether anything is left of it
            say("process", os.getpid())
            build(config, Path(line.strip()), 2)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        say("ended", status)


if __name__ == "__main__":
    main()
