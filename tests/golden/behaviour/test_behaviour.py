"""Catalogs and navigated positions are what they were; see parts.py."""

import csv
import shutil
from pathlib import Path

import pytest

from tests.golden.behaviour.parts import (
    HERE,
    MERGED_ITERATIONS,
    PARTS,
    TABLES,
    Tolerance,
    carry_out,
    differences,
)

NEEDED = {"transfer": ("moon/moon_gld100_32ppd.tif", "spice/naif0012.tls")}


@pytest.mark.slow
@pytest.mark.parametrize("name", PARTS)
def test_a_part_is_as_it_was(name, tmp_path, shared_data):
    for file in NEEDED.get(name, ()):
        shared_data(file)
    if name in NEEDED:
        pytest.importorskip("spiceypy", reason="needs spiceypy")
    carry_out(name, tmp_path)
    lines = differences(HERE / name, tmp_path / "result", Tolerance())
    anew = f"if it is meant: python -m tests.golden.behaviour --freeze {name}"
    assert not lines, "\n".join([*lines, anew])


@pytest.fixture
def copied(tmp_path) -> Path:
    """A copy of a reference, to be changed."""
    shutil.copytree(HERE / "demo", tmp_path / "demo")
    return tmp_path / "demo"


def change(path: Path, column: str, made) -> None:
    """Change a column of a table's first row; add it at the end where there is none."""
    with path.open(newline="") as file:
        names, *rows = csv.reader(file)
    if column not in names:
        names.append(column)
        rows = [[*row, ""] for row in rows]
    at = names.index(column)
    rows[0][at] = made(rows[0][at])
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([names, *rows])


def moved(by: float):
    return lambda text: f"{float(text) + by:.4f}"


def test_a_reference_is_equal_to_itself_and_holds_all_that_is_compared():
    for name in PARTS:
        assert differences(HERE / name, HERE / name, Tolerance()) == []
        for table in TABLES:
            with (HERE / name / table).open(newline="") as file:
                assert len(list(csv.reader(file))) > 1


@pytest.mark.parametrize(
    ("table", "column", "made"),
    [
        ("solution.csv", "x_m", moved(1e-3)),
        ("solution.csv", "z_m", moved(1e-4)),
        ("solution.csv", "status", lambda _: "unsolved"),
        ("solution.csv", "method", lambda _: "horizon"),
        ("solution.csv", "reason", lambda _: "some reason"),
        ("solution.csv", "n_used", lambda text: str(int(text) - 1)),
        ("solution.csv", "y_m", lambda _: ""),
        ("matches.csv", "id", lambda text: str(int(text) + 1)),
        ("matches.csv", "measured_x_px", moved(2e-3)),
    ],
)
def test_a_tiny_change_is_noticed(copied, table, column, made):
    change(copied / table, column, made)
    (line,) = differences(HERE / "demo", copied, Tolerance())
    assert table in line
    assert column in line or column == "id"


def test_a_millimetre_is_allowed_where_iterations_merged(copied):
    change(copied / "solution.csv", "x_m", moved(9e-4))
    assert differences(HERE / "demo", copied, MERGED_ITERATIONS) == []
    change(copied / "solution.csv", "x_m", moved(9e-4))
    assert len(differences(HERE / "demo", copied, MERGED_ITERATIONS)) == 1


def test_another_digest_is_noticed(copied):
    path = copied / "digests.json"
    path.write_text(path.read_text().replace("a", "b"))
    assert "digest" in differences(HERE / "demo", copied, Tolerance())[0]


def test_columns_may_come_at_the_end_and_none_may_go(copied):
    change(copied / "solution.csv", "a_new_column", lambda _: "ok")
    assert differences(HERE / "demo", copied, Tolerance()) == []
    (line,) = differences(copied, HERE / "demo", Tolerance())
    assert "columns" in line
