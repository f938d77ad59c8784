"""A case: a command line with its inputs, and what may come of it. Kinds make cases from seeds."""

import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

OK, USAGE, DATA, NOTHING, DIFFERS = 0, 2, 3, 4, 5
REFUSED = frozenset({DATA})
# What a change may come to whose meaning is open, as that of a flipped bit.
OPEN = frozenset({OK, DATA, NOTHING})

Check = Callable[[Path], str]  # what is wrong with an output, or ""


@dataclass(frozen=True)
class Case:
    """What is run in the case's folder, and what is right for it.

    args     of optnav
    codes    the exit codes that are right
    output   the file or folder that the command may write, in the case's folder; None for none
    writes   the exit codes with which the output is there; with others nothing has changed
    leaves   further names that may be new or changed, whatever the exit code
    check    looks at the output; by default at its ending
    note     what was done to the input, for who reads a failure
    streams  "closed" or "full" runs the command as a process of its own with such a stdout
    action   what is called in place of optnav
    network  whether the command line asks for a connection, as --scheduler does
    """

    args: tuple[str, ...]
    codes: frozenset[int]
    output: str | None = None
    writes: frozenset[int] = frozenset({OK})
    leaves: tuple[str, ...] = ()
    check: Check | None = None
    note: str = ""
    streams: str = ""
    action: Callable[[], int] | None = None
    network: bool = False


@dataclass(frozen=True)
class Place:
    """What a kind makes its case with: random choices, the case's folder and the materials."""

    rng: random.Random
    folder: Path
    materials: Path
    url: str = field(default="http://127.0.0.1:9/")

    def take(self, *names: str) -> None:
        """Copy materials into the case's folder."""
        for name in names:
            source = self.materials / name
            if source.is_dir():
                shutil.copytree(source, self.folder / name, dirs_exist_ok=True)
            else:
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, self.folder / name)

    def material(self, name: str) -> bytes:
        """The bytes of a material."""
        return (self.materials / name).read_bytes()

    def write(self, name: str, data: bytes | str) -> None:
        """Write a file into the case's folder."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.encode("utf-8", "surrogateescape") if isinstance(data, str) else data)


Maker = Callable[[Place], Case]


@dataclass(frozen=True)
class Kind:
    """A family of cases; `weight` is its share of a run: more where cases are quick."""

    name: str
    weight: float
    make: Maker


KINDS: dict[str, Kind] = {}


def kind(name: str, weight: float = 1.0) -> Callable[[Maker], Maker]:
    """Register a maker of cases."""

    def register(make: Maker) -> Maker:
        if name in KINDS:
            raise ValueError(f"there are two kinds {name}")
        KINDS[name] = Kind(name, weight, make)
        return make

    return register


def chosen(number: int, seed: int, only: str = "") -> tuple[str, int]:
    """The kind and the seed of a run's case by its number.

    only  beginnings of the kinds' names, divided by commas
    """
    begins = tuple(only.split(","))
    kinds = [
        kind for name, kind in sorted(KINDS.items()) if name.startswith(begins) and kind.weight
    ]
    rng = random.Random(f"{seed}:{number}")
    (one,) = rng.choices(kinds, [kind.weight for kind in kinds])
    return one.name, seed * 10_000_000 + number


def make_case(name: str, seed: int, folder: Path, materials: Path, url: str) -> Case:
    """The case of a kind and a seed, its inputs written into the folder."""
    return KINDS[name].make(Place(random.Random(f"{name}:{seed}"), folder, materials, url))
