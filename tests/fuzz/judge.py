"""Runs one case in this process and says what was wrong with what came of it."""

import contextlib
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from catalog.bodies.kernels import KernelSet
from catalog.errors import OptnavError
from catalog.store.reader import Catalog
from optnav_cli.main import run
from tests.fuzz.cases import Case, make_case
from tests.fuzz.guard import CASE_BYTES, Guard, Trap, largest_bytes

LONGEST_LINE = 4000  # of a message: a longer one repeats its input
WORK = ".work"  # a build keeps what is done beside its output
SIDECARS = (".prj", ".csvt")
PROCESS_S = 55.0

Snapshot = dict[str, tuple[int, ...]]


@dataclass
class Verdict:
    """What came of a case; `failures` is empty where all was right."""

    kind: str
    seed: int
    args: list[str] = field(default_factory=list)
    note: str = ""
    wanted: list[int] = field(default_factory=list)
    code: int = 0
    seconds: float = 0.0  # of the processor
    failures: list[str] = field(default_factory=list)
    said: str = ""

    def line(self) -> bytes:
        """As it travels between processes."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def of_line(cls, line: bytes) -> "Verdict":
        """Read back what `line` gave."""
        return cls(**json.loads(line))


class Judge:
    """Runs cases in folders of their own below `area`, one after the other.

    streams  a file that both stdout and stderr of this process go to
    """

    def __init__(self, area: Path, materials: Path, streams: Path) -> None:
        self.area, self.materials, self.streams = area, materials, streams
        self.temporary = area / "tmp"
        self.trap, self.guard = Trap(), Guard(self.temporary)
        self.home = area / "home"
        for folder in (self.temporary, self.home):
            folder.mkdir(parents=True, exist_ok=True)
        os.environ["TMPDIR"] = str(self.temporary)
        os.environ["HOME"] = str(self.home)

    def judge(self, kind: str, seed: int, announce: Callable[[Verdict], object]) -> Verdict:
        """Make a case, run it and look at what it left.

        announce  is told of the case before it runs, which it may not survive
        """
        outcome = Verdict(kind, seed)
        folder = self.area / f"{kind}-{seed}"
        folder.mkdir()
        os.chdir(folder)
        try:
            case = make_case(kind, seed, folder, self.materials, self.trap.url)
            outcome.args, outcome.wanted = list(map(repr_arg, case.args)), sorted(case.codes)
            outcome.note = case.note
            announce(outcome)
            self._run(case, folder, outcome)
        finally:
            os.chdir(self.area)
            _remove(folder)
        return outcome

    def _run(self, case: Case, folder: Path, outcome: Verdict) -> None:
        before, largest, calls = snapshot(folder), largest_bytes(), self.trap.count
        os.truncate(self.streams, 0)
        self.guard.start(folder)
        started = time.process_time()
        try:
            outcome.code, crash = _as_process(case) if case.streams else _in_process(case)
        finally:
            outcome.seconds = time.process_time() - started
            seen = self.guard.stop()
        outcome.said = _tail(self.streams)
        _forget_kernels()
        failures = outcome.failures
        if crash:
            failures.append(f"traceback: {crash}")
        elif outcome.code not in case.codes:
            failures.append(f"code {outcome.code}; wanted {sorted(case.codes)}")
        failures += (
            fault
            for fault in dict.fromkeys(seen)
            if not (case.network and fault.startswith("network:"))
        )
        if self.trap.count != calls:
            failures.append(f"network: {self.trap.count - calls} connections")
        if largest_bytes() - largest > CASE_BYTES:
            failures.append(f"memory: {(largest_bytes() - largest) / 1e6:.0f} MB")
        if not crash:
            failures += _in_words(outcome)
            failures += _litter(case, outcome.code, before, snapshot(folder))
            failures += _output(case, outcome.code, folder)
        for place in (self.temporary, self.home):
            if left := sorted(path.name for path in place.iterdir()):
                failures.append(f"litter: {place.name} holds {left[:3]}")
                _remove(place)
                place.mkdir()


def repr_arg(arg: str) -> str:
    """An argument that can be printed; undecodable bytes as escapes."""
    short = arg if len(arg) < 400 else f"{arg[:100]}...({len(arg)} characters)"
    return short.encode("utf-8", "backslashreplace").decode()


def snapshot(folder: Path) -> Snapshot:
    """Kind, size, time and number of all that lies in a folder, by its path."""
    found: Snapshot = {}
    todo = [str(folder)]
    while todo:
        with os.scandir(todo.pop()) as entries:
            for entry in entries:
                status = entry.stat(follow_symlinks=False)
                about = (status.st_mode, status.st_ino)
                if entry.is_dir(follow_symlinks=False):
                    todo.append(entry.path)
                else:
                    about += (status.st_size, status.st_mtime_ns)
                found[os.path.relpath(entry.path, folder)] = about
    return found


def _forget_kernels() -> None:
    """Let the SPICE toolkit, which holds files of a case that will be gone, hold none."""
    spice = sys.modules.get("spiceypy")
    if spice is not None and KernelSet._in_use:
        spice.kclear()
        spice.reset()
        KernelSet._in_use = ()


def _in_process(case: Case) -> tuple[int, str]:
    try:
        code = case.action() if case.action is not None else run(list(case.args))
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        return code, ""
    except SystemExit as end:
        return 1, f"SystemExit({end.code})"
    except BaseException as error:  # noqa: BLE001 -- looked for
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        return 1, _where(error)


def _as_process(case: Case) -> tuple[int, str]:
    """Run with a stdout that is closed or full."""
    command = [sys.executable, "-m", "optnav_cli.main", *case.args]
    closed = (lambda: os.close(1)) if case.streams == "closed" else None
    with open("/dev/full" if case.streams == "full" else "/dev/null", "w") as out:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=out, preexec_fn=closed,
            timeout=PROCESS_S, check=False,
        )  # fmt: skip
    return done.returncode, f"signal {-done.returncode}" if done.returncode < 0 else ""


def _where(error: BaseException) -> str:
    """The error and the innermost lines of ours."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "/catalog/" in f.filename or "/optnav_cli/" in f.filename]
    last = [f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in [*ours[-3:], frames[-1]]]
    return f"{type(error).__name__}: {str(error)[:300]} at {' > '.join(dict.fromkeys(last))}"


def _tail(streams: Path, most: int = 20_000) -> str:
    with streams.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - most))
        return file.read().decode("utf-8", "backslashreplace")


def _in_words(outcome: Verdict) -> list[str]:
    """A failure is told in lines of optnav's, without a traceback, and not at any length."""
    found = []
    if "Traceback (most recent call last)" in outcome.said:
        found.append("traceback: in what was printed")
    lines = outcome.said.splitlines()
    told = any(line.startswith(("optnav: ", "Error: ", "Usage: ")) for line in lines)
    if outcome.code not in (0, 1) and not told:
        found.append("silent: no line says why")
    longest = max(lines, key=len, default="")
    if len(longest) > LONGEST_LINE and longest.startswith("optnav: "):
        found.append(f"long: a message of {len(longest)} characters")
    return found


def _litter(case: Case, code: int, before: Snapshot, after: Snapshot) -> list[str]:
    """What is new, gone or changed and must not be."""
    allowed = [os.path.normpath(name) for name in case.leaves]
    parents: set[str] = set()
    if case.output is not None and code in case.writes:
        output = os.path.normpath(case.output)
        allowed += [output, *(str(Path(output).with_suffix(end)) for end in SIDECARS)]
        parents = {str(path) for path in Path(output).parents}
    found = []
    for name in sorted(before.keys() | after.keys()):
        if before.get(name) == after.get(name) or name in parents:
            continue
        if any(name == one or name.startswith(f"{one}/") for one in allowed):
            continue
        what = "new" if name not in before else "gone" if name not in after else "changed"
        found.append(f"litter: {name} is {what}")
    return found[:5]


def _output(case: Case, code: int, folder: Path) -> list[str]:
    if case.output is None or code not in case.writes or code not in case.codes:
        return []
    path = folder / os.path.normpath(case.output)
    if not path.exists():
        return [f"output: {case.output} is not there"]
    if os.fsencode(path).decode("utf-8", "replace") != str(path):
        return []  # it is there; nothing of ours reads such a name
    check = case.check or CHECKS.get("" if path.is_dir() else path.suffix.lower())
    try:
        wrong = check(path) if check else ""
    except (OptnavError, OSError, ValueError, sqlite3.Error) as error:
        wrong = f"cannot be read: {error}"
    return [f"output: {case.output} {wrong}"] if wrong else []


def whole_catalog(path: Path) -> str:
    """Whether a catalog opens, or a layer is a database."""
    name = quote(os.fsencode(path))
    with contextlib.closing(sqlite3.connect(f"file:{name}?mode=ro", uri=True)) as db:
        tables = {name for (name,) in db.execute("SELECT name FROM sqlite_master")}
    if "optnav_meta" in tables:
        with Catalog.open(path):
            pass
    return "" if "control_points" in tables or "gpkg_contents" in tables else "holds no points"


def _ends_with(*endings: bytes) -> Callable[[Path], str]:
    def check(path: Path) -> str:
        return "" if path.read_bytes().rstrip().endswith(endings) else "is cut short"

    return check


def _json(path: Path) -> str:
    json.loads(path.read_text(encoding="utf-8"), parse_constant=_refused)
    return ""


def _refused(name: str) -> Any:
    raise ValueError(f"holds {name}")


def whole_folder(path: Path) -> str:
    """Whether a folder has its manifest, or is one of the work of a build."""
    if any(path.glob("*.mark")) or (path / "workspace.json").exists():
        return ""
    if not (path / "manifest.json").is_file():
        return "" if path.name.endswith(WORK) or path.name == "w" else "has no manifest"
    return _json(path / "manifest.json")


CHECKS: dict[str, Callable[[Path], str]] = {
    "": whole_folder,
    ".gpkg": whole_catalog,
    ".html": _ends_with(b"</html>"),
    ".svg": _ends_with(b"</svg>"),
    ".png": _ends_with(b"IEND\xaeB`\x82"),
    ".json": _json,
    ".geojson": _json,
}


def _remove(folder: Path) -> None:
    def unlocked(function: Any, path: str, _: Any) -> None:
        os.chmod(os.path.dirname(path), 0o700)
        function(path)

    shutil.rmtree(os.fsencode(folder), onerror=unlocked)
