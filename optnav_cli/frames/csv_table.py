"""CSV files with a known header: read with a word for everything that can be wrong with them."""

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from catalog.config import nearest_name
from catalog.errors import DataError


def read_rows(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """Rows of a CSV file by column, values without surrounding blanks; blank lines are skipped.

    A byte-order mark, CRLF line ends, blanks around names and further columns are accepted. A row
    with too few or too many values is returned with the key "" saying so.
    Raises DataError for a file that cannot be read or lacks a column, and for one without rows.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise DataError(f"{path}: there is no such file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise DataError(f"{path}: is not UTF-8 text; save it as CSV in UTF-8") from None
    try:
        lines = list(csv.reader(io.StringIO(text, newline=""), skipinitialspace=True))
    except csv.Error as error:
        raise DataError(f"{path}: is not a CSV file: {error}") from None
    table = [[value.strip() for value in line] for line in lines]
    table = [line for line in table if any(line)]
    if not table:
        raise DataError(f"{path}: is empty; wanted the header {','.join(columns)}")
    header, *rows = table
    _check_header(path, header, columns)
    if not rows:
        raise DataError(f"{path}: has a header but no rows; add a row for each picture")
    return [_by_column(header, row) for row in rows]


def number(text: str, column: str, where: str) -> float:
    """The finite number that a cell holds. Raises DataError beginning with `where`."""
    try:
        value = float(text)
    except ValueError:
        raise DataError(f"{where}{column} is '{text}'; wanted a number") from None
    if not math.isfinite(value):
        raise DataError(f"{where}{column} is {text}; wanted a finite number")
    return value


def numbers(row: dict[str, str], columns: Sequence[str], where: str = "") -> list[float] | None:
    """Finite numbers of several cells that belong together; None when all are empty.

    Raises DataError, beginning with `where`, for a cell that is no finite number or empty alone.
    """
    empty = [column for column in columns if not row[column]]
    if len(empty) == len(columns):
        return None
    if empty:
        raise DataError(f"{where}{empty[0]} is empty, but {', '.join(columns)} belong together")
    return [number(row[column], column, where) for column in columns]


def write_rows(path: Path, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a CSV file with \\n line ends."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def _check_header(path: Path, header: list[str], columns: Sequence[str]) -> None:
    missing = [column for column in columns if column not in header]
    if missing:
        extra = [name for name in header if name not in columns]
        near = nearest_name(missing[0], extra)
        hint = f"is '{near}' meant?" if near else f"wanted {','.join(columns)}"
        if len(header) == 1:
            hint = f"columns are to be set apart by commas: {','.join(columns)}"
        raise DataError(f"{path}: has no column '{missing[0]}'; {hint}")
    twice = sorted({name for name in header if name and header.count(name) > 1})
    if twice:
        raise DataError(f"{path}: has the column '{twice[0]}' twice; remove one")


def _by_column(header: list[str], row: list[str]) -> dict[str, str]:
    # a spreadsheet may leave empty cells at the end of a line
    while len(row) > len(header) and not row[-1]:
        row = row[:-1]
    values = dict.fromkeys(header, "") | dict(zip(header, row, strict=False))
    values[""] = (
        "" if len(row) == len(header) else f"the row has {len(row)} values; wanted {len(header)}"
    )
    return values
