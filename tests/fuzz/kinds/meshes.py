"""Shape models: every format with wrong numbers, indices, headers and structures."""

import json
import random
import re
import struct
from collections.abc import Callable
from typing import Any

from tests.fuzz.cases import DATA, NOTHING, OK, REFUSED, Case, Place, kind
from tests.fuzz.damage import damaged

READ = frozenset({OK, DATA})
FORMATS = (
    "body.obj",
    "body.ply",
    "body_text.ply",
    "body.stl",
    "body_text.stl",
    "body.glb",
    "body.tab",
    "body.plt",
)
NUMBERS = [
    "nan",
    "inf",
    "-inf",
    "1e999",
    "-1e308",
    "1e308",
    "0",
    "1e-320",
    "x",
    "",
    "--1",
    "1,5",
    "1" * 500,
    "\xe9",
    "0x10",
    "1e",
    "9" * 5000,
]
INDICES = [
    "0",
    "-1",
    "-999999",
    "999999999",
    "99999999999999999999",
    "1.5",
    "nan",
    "x",
    "",
    "2147483648",
    "4294967295",
    "1//",
    "//1",
    "1/1/1/1",
]


@kind("mesh-damaged", 0.8)
def damaged_mesh(place: Place) -> Case:
    """A shape model with damaged bytes."""
    name = place.rng.choice(FORMATS)
    data, note = damaged(place.material(name), place.rng)
    return _read(place, name, data, READ, note)


@kind("mesh-text", 1.0)
def text_mesh(place: Place) -> Case:
    """A text format with one word or line changed."""
    rng = place.rng
    name = rng.choice(
        [name for name in FORMATS if name not in ("body.ply", "body.stl", "body.glb")]
    )
    lines = place.material(name).decode().splitlines()
    at = rng.randrange(len(lines))
    way = rng.choice(
        (
            "number",
            "number",
            "number",
            "index",
            "index",
            "gone",
            "twice",
            "swapped",
            "word",
            "longer",
            "shorter",
            "cut",
            "odd",
        )
    )
    words = lines[at].split()
    if way in ("number", "index") and words:
        spot = rng.randrange(len(words))
        words[spot] = rng.choice(NUMBERS if way == "number" else INDICES)
        lines[at] = " ".join(words)
    elif way == "gone":
        del lines[at : at + rng.choice((1, 1, 5))]
    elif way == "twice":
        lines.insert(at, lines[at])
    elif way == "swapped" and len(words) > 2:
        words[-1], words[-2] = words[-2], words[-1]
        lines[at] = " ".join(words)
    elif way == "word":
        lines[at] = rng.choice(
            (
                "mtllib ../../../etc/passwd",
                "usemtl x",
                "call x.obj",
                "curv 0 1",
                "o \xe9",
                "# \x00",
                "vp 1",
                "csh ls",
                "g",
                "s off",
                "l 1 2",
                "f",
                "v",
                "f 1",
                "f 1 2",
                "f 1 1 1",
                "f 1 2 3 4 5 6 7 8",
                "v 1 2 3 4 5 6 7",
                "end",
                "solid",
                "endsolid",
                "outer loop",
            )
        )
    elif way == "longer":
        lines[at] += " 1" * rng.choice((1, 3, 20_000))
    elif way == "shorter" and words:
        lines[at] = " ".join(words[:-1])
    elif way == "cut":
        lines = lines[:at]
    else:
        lines[at] = rng.choice(
            ("\ufeff", "\x00" * 10, "\u2028", "\\", "(" * 3000, "\xe9" * 10, "\t", "#" * 50_000)
        )
    coding = "latin-1" if rng.random() < 0.2 else "utf-8"
    ends = rng.choice(("\n", "\n", "\n", "\r\n", "\r"))
    data = ends.join(lines).encode(coding, "replace") + ends.encode()
    return _read(
        place,
        name,
        data,
        READ,
        f"{name} line {at + 1}: {way}, {lines[at][:60] if at < len(lines) else ''!r}",
    )


@kind("mesh-known", 0.4)
def known(place: Place) -> Case:
    """Damage to an OBJ whose meaning is sure."""
    rng = place.rng
    lines = place.material("body.obj").decode().splitlines()
    faces = [i for i, line in enumerate(lines) if line.startswith("f ")]
    vertices = [i for i, line in enumerate(lines) if line.startswith("v ")]
    count = len(vertices)

    def shifted(line: str) -> str:
        return "f " + " ".join(str(int(word.split("/")[0]) - 1) for word in line.split()[1:])

    def relative(line: str) -> str:
        return "f " + " ".join(
            str(int(word.split("/")[0]) - 1 - count) for word in line.split()[1:]
        )

    ways: dict[str, tuple[Callable[[], list[str]], frozenset[int]]] = {
        "whole": (lambda: lines, frozenset({OK})),
        "a hole": (lambda: lines[: faces[5]] + lines[faces[6] :], REFUSED),
        "counted from 0": (lambda: [shifted(x) if i in set(faces) else x for i, x in enumerate(lines)], REFUSED),
        "counted from the end": (lambda: [relative(x) if i in set(faces) else x for i, x in enumerate(lines)], READ),
        "an index beyond": (lambda: [*lines, f"f 1 2 {count + 1}"], REFUSED),
        "a vertex that is no number": (lambda: [*lines[: vertices[0]], "v nan 1 2", *lines[vertices[1] :]], REFUSED),
        "a spike through itself": (lambda: [*lines[: vertices[3]], "v -40 -40 -40", *lines[vertices[4] :]], REFUSED),
        "no faces": (lambda: [x for x in lines if not x.startswith("f ")], REFUSED),
        "no vertices": (lambda: [x for x in lines if not x.startswith("v ")], REFUSED),
        "in metres": (lambda: [_scaled(x, 1e3) for x in lines], REFUSED),
        "aside": (lambda: [_moved(x, 30.0) for x in lines], REFUSED),
        "flat": (lambda: [_flat(x) for x in lines], REFUSED),
        "two bodies": (lambda: lines + [_moved(x, 100.0) for x in lines if x.startswith("v ")]
                       + ["f " + " ".join(str(int(w.split("/")[0]) + count) for w in lines[i].split()[1:]) for i in faces], REFUSED),
        "inside out": (lambda: [_reversed(x) for x in lines], frozenset({OK})),
        "one face inside out": (lambda: [_reversed(x) if i == faces[4] else x for i, x in enumerate(lines)], frozenset({OK})),
    }  # fmt: skip
    name = rng.choice(sorted(ways))
    make, codes = ways[name]
    return _read(place, "body.obj", "\n".join(make()).encode() + b"\n", codes, name)


def _of_vertex(line: str, change: Callable[[list[float]], list[float]]) -> str:
    if not line.startswith("v "):
        return line
    return "v " + " ".join(f"{x:.8g}" for x in change([float(word) for word in line.split()[1:4]]))


def _scaled(line: str, factor: float) -> str:
    return _of_vertex(line, lambda v: [x * factor for x in v])


def _moved(line: str, by: float) -> str:
    return _of_vertex(line, lambda v: [v[0] + by, v[1], v[2]])


def _flat(line: str) -> str:
    return _of_vertex(line, lambda v: [v[0], v[1], 0.0])


def _reversed(line: str) -> str:
    return "f " + " ".join(reversed(line.split()[1:])) if line.startswith("f ") else line


@kind("mesh-header", 0.7)
def headers(place: Place) -> Case:
    """A PLY, STL, plate or ICQ file whose header counts wrongly."""
    rng = place.rng
    name = rng.choice(("body.ply", "body_text.ply", "body.stl", "body.plt"))
    data = place.material(name)
    number = rng.choice(
        [
            "0",
            "1",
            "-1",
            "161",
            "10000000",
            "4000000000",
            "99999999999999999999",
            "1e999",
            "nan",
            "x",
            "",
            "9" * 5000,
        ]
    )
    if name.endswith("ply"):
        word = rng.choice(
            (
                b"element vertex (\\S+)",
                b"element face (\\S+)",
                b"property list (\\S+)",
                b"property (\\S+)",
                b"format (\\S+)",
                b"format \\S+ (\\S+)",
                b"property list \\S+ (\\S+)",
                b"end_(\\S+)",
            )
        )
        others = [
            number,
            "uchar",
            "double",
            "float",
            "list",
            "int8",
            "string",
            "binary_big_endian",
            "ascii",
            "char",
            "uint64",
            "../x",
        ]
        new = rng.choice(others).encode()
        changed = re.sub(word, lambda m: m[0].replace(m[1], new), data, count=1)
        note = f"{name}: {word.decode()} is {new[:20]!r}"
    elif name.endswith("stl"):
        count = rng.choice((0, 1, 319, 321, 10**7, 2**31, 2**32 - 1))
        changed, note = data[:80] + struct.pack("<I", count) + data[84:], f"{count} facets"
    else:
        changed = f"{number} {rng.choice([number, '320'])}\n".encode() + data.partition(b"\n")[2]
        note = f"counts {number[:20]}"
    return _read(place, name, changed, READ, note)


@kind("mesh-glb", 0.8)
def glb(place: Place) -> Case:
    """A GLB whose JSON says something else."""
    rng = place.rng
    data = place.material("body.glb")
    (length,) = struct.unpack_from("<I", data, 12)
    scene, rest = json.loads(data[20 : 20 + length]), data[20 + length :]
    if rng.random() < 0.15:
        text, note = rng.choice((
            (b"[" * 100_000, "deep lists"), (b'{"a":' * 50_000 + b"1" + b"}" * 50_000, "deep objects"), (b"{}", "empty"), (b"[]", "a list"),
            (b"null", "null"), (b'{"asset": {"version": "2.0"}}', "an asset alone"), (b"\xff\xfe", "not UTF-8"), (b"1" * 6000, "digits"),
        ))  # fmt: skip
    else:
        note = changed_json(scene, rng)
        text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    total = 20 + len(text) + len(rest)
    header = struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON")
    return _read(place, "body.glb", header + text + rest, READ, f"GLB: {note}")


JSON_VALUES: list[Any] = [
    None, True, 0, -1, 1, 5121, 5125, 5126, 10**9, 2**63, 10**30, 1.5, float("nan"), float("inf"), 1e308, "", "x", "VEC3", "SCALAR", "MAT4",
    [], {}, [0], [[]], {"a": {}}, "data:application/octet-stream;base64,AAAA", "../../../etc/passwd", "http://127.0.0.1:9/x.bin",
]  # fmt: skip


def changed_json(data: Any, rng: random.Random) -> str:
    """Change one value, or remove or add one, somewhere in a JSON document; says what."""
    spots: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        items = (
            value.items()
            if isinstance(value, dict)
            else enumerate(value)
            if isinstance(value, list)
            else ()
        )
        for key, inner in list(items):
            spots.append((value, key))
            walk(inner)

    walk(data)
    if not spots:
        return "nothing to change"
    parent, key = rng.choice(spots)
    if rng.random() < 0.2:
        del parent[key]
        return f"without {key!r}"
    parent[key] = rng.choice(JSON_VALUES)
    return f"{key!r} is {parent[key]!r}"


@kind("mesh-name", 0.3)
def names(place: Place) -> Case:
    """A shape model under another format's name."""
    rng = place.rng
    name = rng.choice(FORMATS)
    other = rng.choice(
        (
            "body.obj",
            "body.ply",
            "body.stl",
            "body.glb",
            "body.tab",
            "body.plt",
            "body.icq",
            "body.txt",
            "body.off",
            "body.gltf",
            "body",
        )
    )
    return _read(place, other, place.material(name), READ, f"{name} as {other}")


def _read(place: Place, name: str, data: bytes, codes: frozenset[int], note: str) -> Case:
    place.take("body.toml")
    place.write(name, data)
    text = place.material("mesh.toml").decode().replace('path = "body.obj"', f'path = "{name}"')
    place.write("mesh.toml", text)
    common = ("--workers", "1", "--bbox", "0,0,15,14")
    if place.rng.random() < 0.85:
        return Case(
            ("-q", "ingest", "mesh.toml", "--work", "w", *common), codes, leaves=("w",), note=note
        )
    args = ("-q", "build", "mesh.toml", "-o", "new.gpkg", *common)
    codes = codes | ({NOTHING} if OK in codes else set())
    return Case(args, codes, "new.gpkg", frozenset({OK, NOTHING}), ("new.gpkg.work",), note=note)
