"""A study's figures as tables: one form for the screen, for documents and for stored JSON.

The JSON holds what a document needs to say where a figure comes from: the study, its arguments,
version, commit and day. The same arguments give the same tables but for times of processors.
"""

import json
import re
import subprocess
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import catalog
from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.files import make_prefix_test, write_output
from optnav_cli.output.wording import align_table

Cell = str | int | float | None

DIGITS = 6  # significant ones that a table keeps: more than it shows, fewer than machines differ in
BEGINNING = b'{\n "study": "'
INNERMOST = re.compile(r"[\[{]\n[^\[\]{}]*[\]}]")  # lists and objects that hold no further ones
COLUMN = re.compile(r"(?:([\w.]+) = )?(.+?)(?: \[(.+?)\])?(?: (g|\+?\.\d[fg]))?")
MAX_ACROSS = 10  # a table of one row and more columns than these is shown as a list


@dataclass(frozen=True)
class StudyColumn:
    """What stands in one column.

    name    for programs;  title, unit  for people
    format  how numbers are shown, as Python's format() takes it
    """

    name: str
    title: str
    unit: str = ""
    format: str = ""

    def shown(self, cell: Cell) -> str:
        """A cell as text; a number that does not exist is a dash."""
        return "-" if cell is None else format(cell, "" if isinstance(cell, str) else self.format)


def columns(text: str) -> tuple[StudyColumn, ...]:
    """Columns from "name = title [unit] .1f" each, with semicolons between them.

    Only the title is needed; without a name it is made of the words of title and unit.
    """
    found = []
    for part in text.split(";"):
        match = COLUMN.fullmatch(part.strip())
        if match is None:
            raise ValueError(f"{part!r} is no column")
        name, title, unit, shown = match.groups(default="")
        words = re.findall("[a-z0-9]+", f"{title} {unit}".lower())
        found.append(StudyColumn(name or "_".join(words), title, unit, shown))
    if len({column.name for column in found}) < len(found):
        raise ValueError(f"two columns of one name: {text}")
    return tuple(found)


@dataclass(frozen=True)
class StudyTable:
    """Rows of figures under a title; numbers are kept to DIGITS, those that are not finite as None.

    rows  as many cells each as there are columns
    """

    title: str
    columns: tuple[StudyColumn, ...]
    rows: tuple[tuple[Cell, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"{self.title}: {len(row)} cells for {len(self.columns)} columns")
        rows = tuple(tuple(_kept(cell) for cell in row) for row in self.rows)
        object.__setattr__(self, "rows", rows)

    def column(self, name: str) -> list[Cell]:
        """The cells of the column of this name."""
        place = [column.name for column in self.columns].index(name)
        return [row[place] for row in self.rows]

    def to_text(self) -> str:
        """The table for a terminal: titles above units above rows."""
        shown = [[c.shown(cell) for c, cell in zip(self.columns, r)] for r in self.rows]
        if len(shown) == 1 and len(self.columns) > MAX_ACROSS:
            pairs = zip(self.columns, shown[0])
            lines = align_table([(c.title, f"{cell} {c.unit}") for c, cell in pairs], left=(0, 1))
        else:
            heads = [[c.title for c in self.columns], [c.unit for c in self.columns]]
            grid = [head for head in heads if any(head)] + shown
            words = {number for number, text in enumerate(self._is_text()) if text}
            lines = align_table(grid, left=words)
        return "\n".join([self.title, *lines] if self.title else lines)

    def to_markdown(self) -> str:
        """The table for a document, without its title."""
        if len(self.rows) == 1 and len(self.columns) > MAX_ACROSS:
            pairs = zip(self.columns, self.rows[0])
            lines = [f"| {c.title} | {c.shown(cell)} {c.unit}".rstrip() + " |" for c, cell in pairs]
            return "\n".join(["| | |", "|---|---|", *lines])
        heads = [f"{c.title}, {c.unit}" if c.unit else c.title for c in self.columns]
        rules = ["---" if left else "---:" for left in self._is_text()]
        body = [[c.shown(cell) for c, cell in zip(self.columns, r)] for r in self.rows]
        return "\n".join(f"| {' | '.join(row)} |" for row in (heads, rules, *body))

    def _is_text(self) -> list[bool]:
        """Of each column whether it holds words."""
        cells = zip(*self.rows) if self.rows else [()] * len(self.columns)
        return [any(isinstance(cell, str) for cell in column) for column in cells]


@dataclass(frozen=True)
class StudyReport:
    """What a study found, and from what.

    notes      sentences below the tables
    arguments  of the command that change figures;  commit  None outside a checkout;  date  UTC day
    """

    tables: tuple[StudyTable, ...]
    notes: tuple[str, ...] = ()
    study: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    version: str = ""
    commit: str | None = None
    date: str = ""

    def signed(self, study: str, arguments: Mapping[str, Any]) -> "StudyReport":
        """The same with its origin: arguments, and the program and day of now."""
        given = {name: _plain(value) for name, value in arguments.items() if name != "output"}
        today = datetime.now(UTC).date().isoformat()
        return StudyReport(
            self.tables, self.notes, study, given, catalog.__version__, checkout_commit(), today
        )

    def write(self, path: Path) -> None:
        """Write the JSON; older figures there are replaced. Raises OutputError for all else."""
        write_output(path, self.to_json().encode(), make_prefix_test(BEGINNING))

    def to_text(self) -> str:
        """All tables and notes for a terminal."""
        parts = [*(table.to_text() for table in self.tables), "\n".join(self.notes)]
        return "\n\n".join(filter(None, parts))

    def to_markdown(self) -> str:
        """All tables and notes for a document."""
        parts = [f"{t.title}\n\n{t.to_markdown()}".strip() for t in self.tables]
        return "\n\n".join([*parts, *self.notes])

    def to_json(self) -> str:
        """The form that is stored; a study of one table has its columns and rows at the top."""
        content = asdict(self)
        tables, notes = content.pop("tables"), content.pop("notes")
        content |= tables[0] if len(tables) == 1 else {"tables": tables}
        content["notes"] = notes
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
        # a row a line, so that a change of figures reads well
        return INNERMOST.sub(lambda part: re.sub(r"\n\s*", " ", part[0]), text) + "\n"

    @classmethod
    def from_json(cls, text: str) -> "StudyReport":
        """What `to_json` wrote. Raises DataError for anything else."""
        try:
            content = json.loads(text)
            tables = content.pop("tables", None)
            if tables is None:
                tables = [{key: content.pop(key) for key in ("title", "columns", "rows")}]
            heads = (tuple(StudyColumn(**column) for column in t["columns"]) for t in tables)
            rows = (tuple(map(tuple, t["rows"])) for t in tables)
            made = tuple(map(StudyTable, (t["title"] for t in tables), heads, rows))
            return cls(made, tuple(content.pop("notes")), **content)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise DataError(f"not the stored figures of a study: {error}") from None


def checkout_commit() -> str | None:
    """The commit of the checkout that this package runs from, marked where files differ from it."""
    root = Path(catalog.__file__).parents[1]
    if not (root / ".git").exists():
        return None
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def _plain(value: Any) -> Any:
    """An argument without the folder of a file that it names."""
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    return value.name if isinstance(value, Path) else value


def tally(words: Sequence[str]) -> str:
    """How often each word occurs: "2 horizon, 1 control points"."""
    counts = sorted(Counter(words).items())
    return ", ".join(f"{count} {word.replace('_', ' ')}" for word, count in counts)


def rms(values: Sequence[float] | FloatArray) -> float:
    """Root of the mean square, NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _kept(cell: Cell) -> Cell:
    if isinstance(cell, float | np.floating):
        return float(f"{cell:.{DIGITS}g}") if np.isfinite(cell) else None
    return cell
