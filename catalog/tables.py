"""CSV tables: columns declared once, from which a table is read, written and documented."""

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from catalog.arrays import FloatArray
from catalog.config import nearest_name
from catalog.errors import DataError
from catalog.inputs import read_input

T = TypeVar("T")
MAX_COUNT = 2**53  # beyond it a number is no whole one to the last digit
# A row takes some kB in memory: a picture a second fills these in six days.
MAX_ROWS, MAX_COLUMNS = 500_000, 1000


@dataclass(frozen=True)
class CsvColumn:
    """One column of a table.

    kind     what its cells hold; a flag is 0 or 1
    unit     of a number, as people write it
    form     how a number is written, as a format specification; "" as Python prints it
    empty    whether a cell may be empty: unknown, or not applicable
    newer    whether files of former versions lack the column; its cells are empty then
    """

    name: str
    meaning: str
    kind: Literal["text", "number", "count", "flag"] = "number"
    unit: str = ""
    form: str = ""
    empty: bool = False
    newer: bool = False

    def format_cell(self, value: object) -> str:
        """A value as it is written; None and numbers that are not finite are empty."""
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return ""
        return format(int(bool(value)) if self.kind == "flag" else value, self.form)


@dataclass(frozen=True)
class CsvRow:
    """A row of a table that was read. Messages of its errors name the column, not the place.

    where    "FILE, line N"
    problem  why the row as a whole cannot be used, or ""
    """

    where: str
    cells: Mapping[str, str]
    columns: Mapping[str, CsvColumn] = field(repr=False)
    problem: str = ""

    def __getitem__(self, column: str) -> str:
        return self.cells[column]

    def number(self, column: str) -> float | None:
        """The finite number of a cell, None for an empty one. Raises DataError for all else."""
        text = self.cells[column]
        if not text and self.columns[column].empty:
            return None
        try:
            value = float(text)
        except ValueError:
            raise DataError(f"{column} is '{text}'; wanted a number") from None
        if not math.isfinite(value):
            raise DataError(f"{column} is {text}; wanted a finite number")
        return value

    def count(self, column: str) -> int | None:
        """The whole number, 0 or more, of a cell, None for an empty one. Raises DataError."""
        value = self.number(column)
        if value is not None and not (0 <= value <= MAX_COUNT and value == int(value)):
            raise DataError(f"{column} is '{self.cells[column]}'; wanted a count")
        return None if value is None else int(value)

    def flag(self, column: str) -> bool:
        """Whether a cell holds 1 and not 0. Raises DataError for anything else."""
        if self.cells[column] not in ("0", "1"):
            raise DataError(f"{column} is '{self.cells[column]}'; wanted 0 or 1")
        return self.cells[column] == "1"

    def vector(self, columns: Sequence[str]) -> FloatArray | None:
        """Numbers (n,) of cells that belong together; None when all are empty.

        Raises DataError for a cell that is no finite number or empty alone.
        """
        empty = [column for column in columns if not self.cells[column]]
        if len(empty) == len(columns):
            return None
        if empty:
            raise DataError(f"{empty[0]} is empty, but {', '.join(columns)} belong together")
        return np.array([self.number(column) for column in columns], np.float64)


@dataclass(frozen=True)
class CsvTable:
    """The columns of a CSV file, in their order.

    by_hand  people make it, a row for each picture: there must be rows, the empty cells that a
             spreadsheet leaves at the end of a line do not count, and columns whose cells may be
             empty may be left out
    together  names of columns that are all there or all left out
    """

    columns: tuple[CsvColumn, ...]
    by_hand: bool = False
    together: tuple[tuple[str, ...], ...] = ()

    @property
    def names(self) -> list[str]:
        """The names of the columns."""
        return [column.name for column in self.columns]

    def write(self, path: Path, rows: Iterable[Mapping[str, object]]) -> int:
        """Write a file (UTF-8, line feeds) and return how many rows it has.

        rows  values by column; what is missing stays empty
        """
        count = 0
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(self.names)
            for row in rows:
                writer.writerow(
                    [column.format_cell(row.get(column.name)) for column in self.columns]
                )
                count += 1
        return count

    def read(self, path: Path, parse: Callable[[CsvRow], T]) -> list[T]:
        """Parse each row of a file with `parse`.

        Raises DataError as `rows` does, and with the row's place for what it or `parse` refuses.
        """
        parsed = []
        for row in self.rows(path):
            try:
                if row.problem:
                    raise DataError(row.problem)
                parsed.append(parse(row))
            except (DataError, ValueError) as error:
                raise DataError(f"{row.where}: {error}") from error
        return parsed

    def rows(self, path: Path) -> list[CsvRow]:
        """The rows of a file, cells without surrounding blanks; blank lines are skipped.

        A byte-order mark, CRLF line ends, blanks around names and further columns are accepted.
        Raises DataError for a file that cannot be read, lacks a column or has one twice, and for
        one without rows where people make it.
        """
        header, *lines = _read_lines(path) or [(0, [])]
        if not header[1]:
            raise DataError(f"{path}: is empty; wanted the header {','.join(self.names)}")
        self._check_header(path, header[1])
        if self.by_hand and not lines:
            raise DataError(f"{path}: has a header but no rows; add a row for each picture")
        return [
            self._make_row(f"{path}, line {number}", header[1], cells) for number, cells in lines
        ]

    def format_markdown(self) -> str:
        """The columns as a Markdown table."""
        lines = ["| column | unit | holds | may be empty |", "|---|---|---|---|"]
        for column in self.columns:
            kind = "" if column.kind == "number" else f" ({column.kind})"
            empty = "yes" if column.empty else ""
            lines.append(f"| `{column.name}` | {column.unit} | {column.meaning}{kind} | {empty} |")
        return "\n".join(lines) + "\n"

    def _make_row(self, where: str, header: list[str], cells: list[str]) -> CsvRow:
        while self.by_hand and len(cells) > len(header) and not cells[-1]:
            cells = cells[:-1]
        problem = ""
        if len(cells) != len(header):
            problem = f"the row has {len(cells)} values; wanted {len(header)}"
        named = dict.fromkeys([*self.names, *header], "") | dict(zip(header, cells, strict=False))
        return CsvRow(where, named, {column.name: column for column in self.columns}, problem)

    def _check_header(self, path: Path, header: list[str]) -> None:
        extra = [name for name in header if name not in self.names]
        for column in self.columns:
            if column.name in header or column.newer:
                continue
            near = nearest_name(column.name, extra)
            others = [name for group in self.together if column.name in group for name in group]
            if self.by_hand and column.empty and not near and set(others).isdisjoint(header):
                continue
            hint = f"is '{near}' meant?" if near else f"wanted {','.join(self.names)}"
            if len(header) == 1:
                hint = f"columns are to be set apart by commas: {','.join(self.names)}"
            raise DataError(f"{path}: has no column '{column.name}'; {hint}")
        twice = sorted({name for name in header if name and header.count(name) > 1})
        if twice:
            raise DataError(f"{path}: has the column '{twice[0]}' twice; remove one")


def _read_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Line number and cells of each line that is not blank. Raises DataError."""
    raw = read_input(path, remedy="make it, or check the path")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DataError(f"{path}: is not UTF-8 text; save it as CSV in UTF-8") from None
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    lines = []
    try:
        for line in reader:
            cells = [cell.strip() for cell in line]
            if any(cells):
                lines.append((reader.line_num, cells))
            if len(lines) > MAX_ROWS or len(cells) > MAX_COLUMNS:
                raise DataError(
                    f"{path}: has more than {MAX_ROWS:,} rows or {MAX_COLUMNS:,} columns; split it"
                )
    except csv.Error as error:
        raise DataError(f"{path}: is not a CSV file: {error}") from None
    return lines
