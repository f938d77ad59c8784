"""Where an output goes: free, taken, foreign, a device, a pipe, a link, nowhere."""

import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path

from tests.fuzz.cases import DATA, NOTHING, OK, REFUSED, USAGE, Case, Place, kind
from tests.fuzz.kinds.commands import COMMANDS, Command

DONE = frozenset({OK})
REFUSED_ANYHOW = frozenset({USAGE, DATA})


def _older(place: Place, command: Command, name: str) -> None:
    if command.older:
        place.take(command.older)
        os.rename(place.folder / command.older, place.folder / name)


def _foreign(place: Place, command: Command, name: str) -> None:
    if command.ending == "":
        place.write(f"{name}/diary.txt", "mine")
    else:
        place.write(name, b"precious")


def _other_shape(place: Place, command: Command, name: str) -> None:
    """A file where a folder goes, or a folder where a file goes."""
    if command.ending == "":
        place.write(name, b"precious")
    else:
        (place.folder / name).mkdir()


def _pipe(place: Place, command: Command, name: str) -> None:
    os.mkfifo(place.folder / name)


def _link_to_older(place: Place, command: Command, name: str) -> None:
    _older(place, command, f"real{command.ending}")
    (place.folder / name).symlink_to(f"real{command.ending}")


def _loop(place: Place, command: Command, name: str) -> None:
    (place.folder / name).symlink_to(name)


def _device(place: Place, command: Command, name: str) -> None:
    """A device of the case's own, where the system lets us make one: never one of the machine's."""
    try:
        os.mknod(place.folder / name, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    except OSError:  # not root
        os.mkfifo(place.folder / name)


def _link_to_device(place: Place, command: Command, name: str) -> None:
    _device(place, command, "device")
    (place.folder / name).symlink_to("device")


def _socket(place: Place, command: Command, name: str) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(name)


def _in_a_loop(place: Place, command: Command, name: str) -> None:
    (place.folder / "loop").symlink_to("loop")


def _file_as_parent(place: Place, command: Command, name: str) -> None:
    place.write("file", b"mine")


def _nothing(place: Place, command: Command, name: str) -> None:
    pass


def _empty(place: Place, command: Command, name: str) -> None:
    if command.ending == "":
        (place.folder / name).mkdir()
    else:
        place.write(name, b"")


Prepare = Callable[[Place, Command, str], None]
# what lies there, the name with {} for the ending, and the exit codes
WAYS: dict[str, tuple[Prepare, str, frozenset[int]]] = {
    "free": (_nothing, "new{}", DONE),
    "free, in new folders": (_nothing, "a/b/new{}", DONE),
    "free, a strange name": (_nothing, "nëw a#b?%20{}", DONE),
    "free, a long way": (_nothing, "./x/../new{}", frozenset({OK, DATA})),
    "an empty one": (_empty, "new{}", DONE),
    "an older output": (_older, "new{}", DONE),
    "a link to an older output": (_link_to_older, "new{}", DONE),
    "a foreign one": (_foreign, "new{}", REFUSED),
    "file for folder": (_other_shape, "new{}", REFUSED),
    "a pipe": (_pipe, "new{}", REFUSED),
    "a link to itself": (_loop, "new{}", REFUSED),
    "a device": (_device, "new{}", REFUSED),
    "a link to a device": (_link_to_device, "new{}", REFUSED),
    "a socket": (_socket, "new{}", REFUSED),
    "in a loop of links": (_in_a_loop, "loop/new{}", REFUSED),
    "in a file": (_file_as_parent, "file/new{}", REFUSED),
    "a name too long": (_nothing, "n" * 256 + "{}", REFUSED),
    "a name nearly too long": (_nothing, "n" * 230 + "{}", frozenset({OK, DATA})),
    "a path too long": (_nothing, "n/" * 2500 + "new{}", REFUSED),
    "the empty name": (_nothing, "", REFUSED_ANYHOW),
    "the folder itself": (_nothing, ".", REFUSED_ANYHOW),
    "above the root": (_nothing, "/", REFUSED_ANYHOW),
    "not UTF-8": (_nothing, os.fsdecode(b"n\xff\xe9") + "{}", frozenset({OK, DATA})),
}
WRITERS = {name: command for name, command in COMMANDS.items() if command.ending is not None}


@kind("place", 5.0)
def places(place: Place) -> Case:
    """A command that works, with its output somewhere."""
    rng = place.rng
    name, way = rng.choice(sorted(WRITERS)), rng.choice(sorted(WAYS))
    command, (prepare, target, codes) = WRITERS[name], WAYS[way]
    command.take(place)
    output = target.format(command.ending)
    prepare(place, command, output)
    leaves = tuple(output + ending for ending in command.leaves)
    if way == "free, a long way":
        leaves += ("x",)  # a folder that the name goes through may be made
    if way == "a link to an older output":
        leaves += (f"real{command.ending}", f"real{command.ending}.work")
    if name == "compare" and way == "an older output":
        codes = DONE  # there is none of a comparison: the place is free
    if name == "compare" and way == "a link to an older output":
        codes = REFUSED  # a link to nothing
    if command.ending == "" and way in ("a link to itself", "a link to a device"):
        codes = REFUSED
    args = ("-q", *command.with_output(output))
    inside = not output.startswith("/") and output not in ("", ".")
    return Case(
        args, codes, output if inside else None, command.writes, leaves, note=f"{name}: {way}"
    )


@kind("place-input", 2.0)
def over_inputs(place: Place) -> Case:
    """An output named like an input of the same command."""
    rng = place.rng
    name = rng.choice(("build", "simulate", "navigate", "report", "export-csv", "show"))
    command = COMMANDS[name]
    command.take(place)
    inputs = [entry for take in command.takes for entry in _below(place.folder, take)]
    output = rng.choice(inputs)
    args = ("-q", *command.with_output(output))
    return Case(args, frozenset({OK, USAGE, DATA, NOTHING}) - {OK}, note=f"{name} onto {output}")


def _below(folder: Path, name: str) -> list[str]:
    path = folder / name
    found = [name]
    if path.is_dir():
        found += [str(inner.relative_to(folder)) for inner in path.rglob("*") if inner.is_file()]
    return sorted(found)
