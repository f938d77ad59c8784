"""CSV tables: frames.csv, truth.csv, and those of a run that people or programs hand on."""

import csv
import io
import random
from collections.abc import Sequence

from tests.fuzz.cases import DATA, NOTHING, OK, OPEN, Case, Place, kind
from tests.fuzz.damage import damaged

Rows = list[list[str]]
CELLS = [
    "", " ", "nan", "NaN", "inf", "-inf", "Infinity", "1e200", "-1e200", "1e308", "1e-320", "1e400", "0", "-0.0", "-1",
    "x", "1,5", "1_000", "0x10", "1" * 5000, "9" * 400, "é", "\x00", "\u202e", "'", '"', '""', "line\nbreak", "\t", "\x1b[31m",
    "a" * 200_000, "=1+1", "../secret.png", "/etc/passwd", "C:\\x.png", "a/../b.png", "..\\..\\x", ".", "/", "a" * 252 + ".png",
    "2026-01-01T00:00:00Z", "2026-01-01", "2026-13-41T25:61:61Z", "0001-01-01T00:00:00Z", "9999-12-31T23:59:60.999999999999Z",
    "2016-12-31T23:59:60Z", "2026-01-01T00:00:00+99:99", "1e9-01-01T00:00:00Z", "-2026-01-01T00:00:00Z", "solved", "unsolved",
    "control_points", "horizon", "no_such_method", "cam", "Cam", "1", "2", "0.5", "1.5", "-5", "3.0", "1737400", "1e7", "4e8",
    "<script>", "{{7*7}}", "http://127.0.0.1:9/x.png", "/vsicurl/http://127.0.0.1:9/x.png", "frame_0001.png",
]  # fmt: skip


def changed(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """A table with a change that knows of rows and columns, or damage to its bytes."""
    if rng.random() < 0.2:
        return damaged(data, rng)
    rows = list(csv.reader(io.StringIO(data.decode(), newline="")))
    ways = (
        _cell, _cell, _cell, _cell, _cell, _cells, _column_gone, _column_twice, _columns_mixed, _renamed, _short,
        _long, _row_twice, _row_gone, _rows_mixed, _no_rows, _no_header, _separator, _coded, _many,
    )  # fmt: skip
    return rng.choice(ways)(rows, rng)


def _written(rows: Sequence[Sequence[str]], separator: str = ",") -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, delimiter=separator, lineterminator="\n").writerows(rows)
    return text.getvalue().encode("utf-8", "surrogateescape")


def _cell(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    row = rng.randrange(1, len(rows)) if len(rows) > 1 else 0
    column, value = rng.randrange(len(rows[0])), rng.choice(CELLS)
    rows[row][column] = value
    return _written(rows), f"row {row}, {rows[0][column]!r}: {value[:40]!r}"


def _cells(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    column, value = rng.randrange(len(rows[0])), rng.choice(CELLS)
    for row in rows[1:]:
        row[column] = value
    return _written(rows), f"{rows[0][column]!r} of all rows: {value[:40]!r}"


def _column_gone(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    column = rng.randrange(len(rows[0]))
    name = rows[0][column]
    return _written([row[:column] + row[column + 1 :] for row in rows]), f"without column {name}"


def _column_twice(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    column = rng.randrange(len(rows[0]))
    return _written([[*row, row[column]] for row in rows]), f"column {rows[0][column]} twice"


def _columns_mixed(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    order = rng.sample(range(len(rows[0])), len(rows[0]))
    return _written([[row[i] for i in order] for row in rows]), "columns in another order"


def _renamed(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    column = rng.randrange(len(rows[0]))
    old, rows[0][column] = rows[0][column], rng.choice(["", "x", "FILE", "é", "a" * 9000, "x_m"])
    return _written(rows), f"column {old} called {rows[0][column][:20]!r}"


def _short(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    row = rng.randrange(len(rows))
    rows[row] = rows[row][: rng.randrange(len(rows[row]) + 1)]
    return _written(rows), f"row {row} cut short"


def _long(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    row = rng.randrange(len(rows))
    rows[row] += [rng.choice(CELLS)] * rng.choice((1, 3, 2000))
    return _written(rows), f"row {row} too long"


def _row_twice(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    return _written([*rows, rows[-1]]), "the last row twice"


def _row_gone(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    return _written(rows[:-1]), "the last row gone"


def _rows_mixed(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    return _written([rows[0], *reversed(rows[1:])]), "rows in another order"


def _no_rows(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    return _written(rows[:1]), "no rows"


def _no_header(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    return _written(rows[1:]), "no header"


def _separator(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    sign = rng.choice(";\t|:")
    return _written(rows, sign), f"columns apart by {sign!r}"


def _coded(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    data = _written(rows)
    ways = {
        "a byte-order mark": b"\xef\xbb\xbf" + data,
        "CRLF": data.replace(b"\n", b"\r\n"),
        "CR alone": data.replace(b"\n", b"\r"),
        "UTF-16": data.decode().encode("utf-16"),
        "Latin-1": data + "é,é\n".encode("latin-1"),
        "blanks about commas": data.replace(b",", b" , "),
        "blank lines": data.replace(b"\n", b"\n\n ,,,\n"),
        "an open quote": data + b'"' + data,
        "comments": b"# a table\n" + data,
        "NUL bytes": data.replace(b",", b",\x00"),
    }
    name = rng.choice(sorted(ways))
    return ways[name], name


def _many(rows: Rows, rng: random.Random) -> tuple[bytes, str]:
    more = [[f"{number}{rows[-1][0]}", *rows[-1][1:]] for number in range(30)]
    return _written([*rows, *more]), "30 more rows"


@kind("table-frames", 3.0)
def frames(place: Place) -> Case:
    """Navigation with a changed frames.csv."""
    folder = place.rng.choice(("pictures",) * 7 + ("near",) * 2 + ("limb",))
    catalog = "relief.gpkg" if folder == "limb" else "moon.gpkg"
    place.take(folder, catalog)
    place.write("secret.png", place.material("pictures/frame_0000.png"))
    data, note = changed(place.material(f"{folder}/frames.csv"), place.rng)
    place.write(f"{folder}/frames.csv", data)
    args = ("-q", "navigate", folder, "--catalog", catalog, "-o", "new")
    return Case(args, OPEN, "new", frozenset({OK, NOTHING}), note=note)


def _of_run(place: Place, name: str) -> Case:
    run, pictures = place.rng.choice(
        (("run", "pictures"), ("near.run", "near"), ("limb.run", "limb"))
    )
    name = name.replace("run/", f"{run}/")
    if not (place.materials / name).exists():  # no frame of that run is solved
        run, pictures, name = "run", "pictures", f"run/{name.rpartition('/')[2]}"
    place.take(run, f"{pictures}/truth.csv")
    data, note = changed(place.material(name), place.rng)
    place.write(name, data)
    if place.rng.random() < 0.5:
        evaluation = (f"{run}/evaluation.json", f"{run}/evaluation.csv")
        args = ("-q", "evaluate", run, "--truth", f"{pictures}/truth.csv")
        return Case(args, OPEN, leaves=evaluation, note=note)
    ending = place.rng.choice(("html", "html", "svg"))
    # an unsolved run has no errors to draw
    args = ("-q", "report", run, "-o", f"new.{ending}")
    return Case(args, OPEN, f"new.{ending}", note=note)


@kind("table-truth", 3.0)
def truth(place: Place) -> Case:
    """An evaluation by a changed truth.csv."""
    place.take("run")
    data, note = changed(place.material("pictures/truth.csv"), place.rng)
    place.write("truth.csv", data)
    args = ("-q", "evaluate", "run", "--truth", "truth.csv")
    evaluation = ("run/evaluation.json", "run/evaluation.csv")
    return Case(args, frozenset({OK, DATA, NOTHING}), leaves=evaluation, note=note)


@kind("table-solution", 3.0)
def solution(place: Place) -> Case:
    """A report or an evaluation of a run with a changed solution.csv."""
    return _of_run(place, "run/solution.csv")


@kind("table-matches", 1.5)
def matches(place: Place) -> Case:
    """A report or an evaluation of a run with a changed matches.csv."""
    return _of_run(place, "run/matches.csv")


@kind("table-run-frames", 1.5)
def run_frames(place: Place) -> Case:
    """A report or an evaluation of a run with a changed frames.csv."""
    return _of_run(place, "run/frames.csv")


@kind("table-evaluation", 2.0)
def evaluation(place: Place) -> Case:
    """A report of a run with changed evaluation files."""
    return _of_run(place, place.rng.choice(("run/evaluation.csv", "run/evaluation.json")))
