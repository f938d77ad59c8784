"""Builds killed at random moments, and their workers: nothing is lost, nothing is done twice."""

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import msgspec
import pytest

from catalog.jobs.usage import Account
from tests.catalog.pipeline.coarse_tycho import CONFIG
from tests.catalog.pipeline.killing import wait_for_the_end_of

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="builds are forked")

HERE = Path(__file__).parent
CHECKOUT = HERE.parents[2]
CELLS = 11
STAGES = ("overviews", "render", "select", "check", "write", "digest")
ENDS = ("digest", "refused")  # refused: workers died again and again, all is kept
# Who is killed in a round, and in which stage; about when in it is drawn.
PLAN = (
    ("build", "overviews"), ("worker", "render"), ("build", "render"), ("build", "select"),
    ("worker", "check"), ("build", "check"), ("worker", "write"), ("build", "write"),
    ("build", "write"),
)  # fmt: skip


class Builds:
    """Forked builds, one after the other; see killing.py."""

    def __init__(self, folder):
        (folder / "tycho.toml").write_text(CONFIG)
        self.program = subprocess.Popen(
            [sys.executable, str(HERE / "killing.py"), str(folder / "tycho.toml"), str(folder)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        )  # fmt: skip
        self.digest = self.until("digest")[1]

    def line(self):
        words = self.program.stdout.readline().split()
        assert words, "the program that forks builds has ended"
        return words

    def until(self, word):
        while (words := self.line())[0] != word:
            pass
        return words

    def start(self, folder):
        """The process of a new build."""
        print(folder, file=self.program.stdin, flush=True)
        return int(self.until("process")[1])

    def close(self):
        self.program.kill()
        self.program.wait()
        for pipe in (self.program.stdin, self.program.stdout):
            pipe.close()


@pytest.fixture(scope="module")
def builds(tmp_path_factory):
    builds = Builds(tmp_path_factory.mktemp("undisturbed"))
    yield builds
    builds.close()


def results(folder):
    """Files of finished work: one that is made again has another number or date."""
    found = {}
    for path in (folder / "c.gpkg.work").glob("*-*/*"):
        if path.suffix != ".partial" and not path.parent.name.endswith(".partial"):
            state = path.stat()
            found[path] = (state.st_ino, state.st_mtime_ns)
    return found


class Killer:
    """Kills a build, or one of its workers, a random while after a random step of a stage."""

    def __init__(self, builds, folder, rng):
        self.builds, self.folder, self.rng = builds, folder, rng
        self.killed = Counter()
        self.known = {}  # results that were there at a kill

    def look(self):
        """No result that was seen before may have been made anew."""
        found = results(self.folder)
        for path, state in self.known.items():
            assert found.get(path, state) == state, f"{path} was made twice"
        self.known.update(found)

    def wait_for(self, victim, stage):
        """Listen until the moment has come; returns what was said last."""
        steps = 1 if stage == "select" else self.rng.randrange(1, 4)
        while steps > 0:
            words = self.builds.line()
            if words[0] in ENDS:
                return words
            if words[0].startswith(STAGES[STAGES.index(stage) :]):
                steps -= victim == "build" or len(words) > 2
        time.sleep(self.rng.uniform(0.0, 0.05))
        return words

    def kill(self, victim, process):
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
            self.killed[victim] += 1

    def after(self, session, words):
        """Look around when a build has ended."""
        self.builds.until("ended")
        wait_for_the_end_of(session, 10.0)
        self.look()
        if words[0] == "digest":  # prepared patches are not kept beside the catalog
            self.compare_account()
            self.known = {path: state for path, state in self.known.items() if path.exists()}

    def start(self):
        """The process of a new build; remembers how many results it finds."""
        self.found = Counter(
            path.parent.name.partition("-")[0]
            for path in results(self.folder)
            if path.name.startswith("chunk-")
        )
        return self.builds.start(self.folder)

    def compare_account(self):
        """What a build says that it kept is what it found."""
        data = (self.folder / "c.gpkg.work" / "account.json").read_bytes()
        stages = {stage.name: stage for stage in msgspec.json.decode(data, type=Account).stages}
        for name, pieces in (("render", CELLS), ("check", CELLS)):
            stage = stages[name]
            assert (stage.kept, stage.done) == (self.found[name], pieces - self.found[name]), name
        assert stages["write"].kept >= self.found["write"]

    def round(self):
        """One kill after the other, then the end of the build; returns what it said last."""
        session = None
        for victim, stage in PLAN:
            session = session or self.start()
            words = self.wait_for(victim, stage)
            if victim == "worker" and words[0] not in ENDS:
                self.kill(victim, int(self.rng.choice(words[2:])))
                continue
            if words[0] not in ENDS:
                self.kill(victim, session)
            self.after(session, words)
            session = None
        words = []
        while words[:1] != ["digest"]:
            session = session or self.start()
            words = self.wait_for("nobody", "digest")
            self.after(session, words)
            session = None
        return words


def test_builds_killed_at_random_moments_lose_nothing_and_repeat_nothing(builds, tmp_path):
    rng = random.Random(5)
    killed = Counter()
    while killed.total() < 9:
        folder = tmp_path / f"after-{killed.total()}"
        folder.mkdir()
        killer = Killer(builds, folder, rng)
        assert killer.round() == ["digest", builds.digest]
        assert sorted(path.name for path in folder.iterdir()) == ["c.gpkg", "c.gpkg.work"]
        assert not list(folder.glob("**/*.partial"))
        killed.update(killer.killed)
    assert killed["worker"] >= 2
