"""What must stay as it is while the code is rebuilt: catalogs' contents and navigated positions.

Each part runs the command line alone, so it does not depend on where the code keeps what. Its
reference is the digests of the catalogs and the tables of the runs, as they were written. It holds
for the libraries of requirements.lock on one kind of processor: another one may round differently,
and only a reference made there proves anything.
"""

import csv
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
CHECKOUT = HERE.parents[2]
CONFIGS = CHECKOUT / "configs"
DIGESTS = "digests.json"
TABLES = ("solution.csv", "matches.csv")
# The words of a reason may change; whether there is one may not.
WORDS = "reason"


class Tolerance(NamedTuple):
    """What counts as equal.

    length_m     of columns in metres
    relative     of all other numbers, or
    last_digits  units of the last digit that the reference shows
    """

    length_m: float = 1e-6
    relative: float = 1e-6
    last_digits: float = 1.0


# Where two iterations became one, which end at slightly different places.
MERGED_ITERATIONS = Tolerance(length_m=1e-3, relative=1e-3, last_digits=20.0)


class Part(NamedTuple):
    """Command lines, run in an empty folder, and the catalogs and run folders that they leave.

    scenario, frames  a scenario of configs/scenarios that is flown with fewer frames, and how many
    """

    commands: tuple[tuple[str, ...], ...]
    catalogs: tuple[str, ...]
    run: str
    scenario: str = ""
    frames: int = 0


PHOBOS = str(CONFIGS / "catalogs" / "phobos.toml")
# Where the transfer ends, from the 948 m model.
LOW_POINT = """[body]
name = "moon"

[[dem]]
path = "shared:moon/moon_gld100_32ppd.tif"

[relief]
dem = {path = "bundled:moon_gld100_4ppd.tif"}
"""
FLY = (
    ("simulate", "scenario.toml", "-o", "pictures"),
    ("navigate", "pictures", "--catalog", "catalog.gpkg", "-o", "run"),
)
PARTS = {
    "demo": Part((("demo", "-o", "demo"),), ("demo/tycho.gpkg",), "demo/run"),
    "apollo": Part(
        (("study", "apollo", "-o", "apollo"),), ("apollo/farside.gpkg",), "apollo/run-ncc"
    ),
    "phobos_approach": Part(
        (("build", PHOBOS, "-o", "catalog.gpkg"), *FLY), ("catalog.gpkg",), "run",
        "phobos_approach", 8,
    ),
    "transfer": Part(
        (("build", "low_point.toml", "-o", "catalog.gpkg", "--bbox=-105,-62,-75,-46"), *FLY),
        ("catalog.gpkg",), "run", "transfer", 4,
    ),
}  # fmt: skip


def carry_out(name: str, folder: Path) -> None:
    """Run a part's commands in `folder`, and put what is compared into folder/result."""
    part = PARTS[name]
    folder.mkdir(parents=True, exist_ok=True)
    if part.scenario:
        text = (CONFIGS / "scenarios" / f"{part.scenario}.toml").read_text(encoding="utf-8")
        shorter = text.replace("\nframes = 60\n", f"\nframes = {part.frames}\n")
        if shorter == text:
            raise ValueError(f"{part.scenario}.toml does not fly 60 frames any more")
        (folder / "scenario.toml").write_text(shorter, encoding="utf-8")
    (folder / "low_point.toml").write_text(LOW_POINT, encoding="utf-8")
    for command in part.commands:
        optnav(folder, *command)
    digests = {}
    for catalog in part.catalogs:
        lines = optnav(folder, "catalog", "info", catalog).splitlines()
        (digests[catalog],) = (line[8:] for line in lines if line.startswith("digest: "))
    result = folder / "result"
    result.mkdir()
    (result / DIGESTS).write_text(json.dumps(digests, indent=2) + "\n", encoding="utf-8")
    for table in TABLES:
        shutil.copy(folder / part.run / table, result)


def optnav(folder: Path, *arguments: str) -> str:
    """Run `optnav ARGUMENTS` of this checkout, or a study, and give what it prints.

    Raises RuntimeError with its messages where it fails.
    """
    is_study = arguments[0] == "study"
    program, words = (
        ("tests.studies", arguments[1:]) if is_study else ("optnav_cli.main", arguments)
    )
    shared = os.environ.get("OPTNAV_SHARED_DATA", str(CHECKOUT.parent / "shared" / "data"))
    done = subprocess.run(
        [sys.executable, "-m", program, "-q", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT), "OPTNAV_SHARED_DATA": shared},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"optnav {' '.join(arguments)}: {done.returncode}\n{done.stderr}")
    return done.stdout


def differences(then: Path, now: Path, tolerance: Tolerance) -> list[str]:
    """What differs between a reference and the result of a part, a line each."""
    old, new = (json.loads((place / DIGESTS).read_text(encoding="utf-8")) for place in (then, now))
    lines = [f"{c}: digest {new.get(c)}, was {old[c]}" for c in old if new.get(c) != old[c]]
    for table in TABLES:
        lines += (f"{table}: {line}" for line in _of_table(then / table, now / table, tolerance))
    return lines


def _of_table(then: Path, now: Path, tolerance: Tolerance) -> Iterator[str]:
    (columns, *old), (new_columns, *new) = _rows(then), _rows(now)
    if new_columns[: len(columns)] != columns:
        yield f"columns {new_columns}, were {columns}; new ones may stand at the end alone"
        return
    key = [columns.index(name) for name in ("file", "catalog", "id") if name in columns]
    old_keys, new_keys = ([tuple(row[i] for i in key) for row in rows] for rows in (old, new))
    if old_keys != new_keys:
        gone = sorted(set(old_keys) - set(new_keys))
        more = sorted(set(new_keys) - set(old_keys))
        yield f"{len(new)} rows, were {len(old)}, or in another order; gone {gone}, new {more}"
        return
    for number, row in enumerate(old):
        for column, was, value in zip(columns, row, new[number], strict=False):
            if not _is_equal(column, was, value, tolerance):
                yield f"{' '.join(old_keys[number])}: {column} {value!r}, was {was!r}"


def _rows(path: Path) -> list[list[str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))


def _is_equal(column: str, was: str, value: str, tolerance: Tolerance) -> bool:
    if was == value:
        return True
    if column == WORDS:
        return bool(was) == bool(value)
    # whole numbers are ids and counts
    if "." not in was or "." not in value:
        return False
    try:
        before, after = float(was), float(value)
    except ValueError:
        return False
    if column.endswith("_m"):
        return abs(after - before) <= tolerance.length_m
    mantissa, _, exponent = was.partition("e")
    digit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    allowed = max(tolerance.relative * abs(before), 1.001 * tolerance.last_digits * digit)
    return abs(after - before) <= allowed
