"""CSV tables that are read, written and documented from one declaration of their columns."""

import math
import os
from pathlib import Path

import numpy as np
import pytest

from catalog.errors import DataError
from catalog.tables import CsvColumn, CsvRow, CsvTable

TABLE = CsvTable(
    (
        CsvColumn("file", "name of the picture", "text"),
        CsvColumn("x_m", "place along x", unit="m", form="z.2f", empty=True),
        CsvColumn("n", "points", "count", empty=True),
        CsvColumn("used", "whether it is used", "flag"),
    )
)


def _values(row: CsvRow) -> tuple[object, ...]:
    return row["file"], row.number("x_m"), row.count("n"), row.flag("used")


def test_rows_come_back_as_they_were_written(tmp_path: Path) -> None:
    rows = [
        {"file": 'a,"b".png', "x_m": np.float64(-0.001), "n": 3, "used": True},
        {"file": "c.png", "x_m": math.nan, "used": False},
    ]
    assert TABLE.write(tmp_path / "t.csv", rows) == 2
    text = (tmp_path / "t.csv").read_bytes().decode()
    assert text == 'file,x_m,n,used\n"a,""b"".png",0.00,3,1\nc.png,,,0\n'
    assert TABLE.read(tmp_path / "t.csv", _values) == [
        ('a,"b".png', 0.0, 3, True),
        ("c.png", None, None, False),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty; wanted the header file,x_m,n,used"),
        ("file,x_m,n\n", "has no column 'used'; wanted file"),
        ("file,x_m,n,usd\n", "has no column 'used'; is 'usd' meant"),
        ("file,x_m,n,used,n\n", "has the column 'n' twice"),
        ("file,x_m,n,used\n\na,1,2,1\nb,1,2\n", "line 4: the row has 3 values; wanted 4"),
        ("file,x_m,n,used\na,1,2,1,\n", "line 2: the row has 5 values; wanted 4"),
        ("file,x_m,n,used\na,one,2,1\n", "line 2: x_m is 'one'; wanted a number"),
        ("file,x_m,n,used\na,inf,2,1\n", "x_m is inf; wanted a finite number"),
        ("file,x_m,n,used\na,1,2.5,1\n", "n is '2.5'; wanted a count"),
        ("file,x_m,n,used\na,1,1e308,1\n", "n is '1e308'; wanted a count"),
        ("file,x_m,n,used\na,1,2,yes\n", "used is 'yes'; wanted 0 or 1"),
    ],
)
def test_a_damaged_table_names_line_column_and_what_is_wanted(
    tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(DataError, match=message) as caught:
        TABLE.read(tmp_path / "t.csv", _values)
    assert str(caught.value).startswith(str(tmp_path / "t.csv"))


def test_the_columns_are_documented_from_their_declaration() -> None:
    lines = TABLE.format_markdown().splitlines()
    assert lines[0] == "| column | unit | holds | may be empty |"
    assert lines[3:5] == [
        "| `x_m` | m | place along x | yes |",
        "| `n` |  | points (count) | yes |",
    ]


def test_tables_beyond_any_use_are_refused_before_memory_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "t.csv"
    path.write_text("file,x_m,n,used\n" + "a.png,1,2,1\n" * 20)
    monkeypatch.setattr("catalog.tables.MAX_ROWS", 10)
    with pytest.raises(DataError, match="more than 10 rows"):
        TABLE.rows(path)
    path.write_text(",".join(f"c{n}" for n in range(2000)))
    with pytest.raises(DataError, match="1,000 columns"):
        TABLE.rows(path)
    path.write_text("file,x_m,n,used\n" + "a" * 1_000_000 + ",1,2,1\n")
    with pytest.raises(DataError, match="field larger than field limit"):
        TABLE.rows(path)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(DataError, match="pipe or a device"):
        TABLE.rows(path)
