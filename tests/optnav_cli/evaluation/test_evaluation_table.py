"""Tables for people: units by magnitude, columns apart whatever the numbers."""

import re

import numpy as np
import pytest

from optnav_cli.evaluation.files import evaluate_run, format_table
from optnav_cli.output.run_folder import read_run, summarise_run
from tests.optnav_cli.output.approach import write_approach


def cells(line):
    """A line's cells: two blanks or more stand between them."""
    return re.split(r" {2,}", line.strip())


# of sigmas of 60, 20 and 15 m: from micrometres to 2.6e6 km and far beyond
@pytest.mark.parametrize("scale", [1e-6, 1e-2, 1.0, 1e2, 1e5, 4.4e7, 1e12])
def test_columns_stay_apart_and_numbers_short_at_any_size(tmp_path, make_run, scale):
    make_run(tmp_path, count=12, scale=scale)
    evaluation = evaluate_run(tmp_path, tmp_path / "truth.csv")
    table = format_table(evaluation).splitlines()
    header = ["error", "unit", "bias", "sigma", "rms", "max", "inside 3 sigma"]
    assert cells(table[2]) == header
    figures = evaluation.figures()
    for line, spread in zip(table[3:6], (figures.r, figures.n, figures.b)):
        axis, _, unit, *numbers, inside = cells(line)
        assert axis in "RNB"
        metres = {"m": 1.0, "km": 1e3, "thousand km": 1e6}[unit]
        # four digits are shown, of a metre a tenth, or a millimetre
        shown = [float(number) * metres for number in numbers]
        exact = [spread.bias, spread.sigma, spread.rms, spread.max]
        np.testing.assert_allclose(shown, exact, rtol=1e-3, atol=0.06 * metres)
        assert inside.endswith(" %")
        if scale < 1e9:
            assert max(map(len, numbers)) <= 9


def test_lines_of_methods_have_the_cells_of_their_header(tmp_path):
    write_approach(tmp_path / "run", count=48, scale=300.0)
    table = format_table(evaluate_run(tmp_path / "run", tmp_path / "run" / "truth.csv"))
    lines = table.splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("method, camera"))
    assert cells(lines[start]) == [
        "method, camera", "solved", "axis", "unit", "bias", "sigma", "max", "in 3 sigma", "NEES",
    ]  # fmt: skip
    rows = [cells(line) for line in lines[start + 1 :] if line.strip()]
    methods = [row for row in rows if len(row) == 9]
    assert [row[0] for row in methods] == [
        "brightness centre, shnk", "horizon of a smooth body, shnk", "horizon, unk",
        "control points, shnk", "control points, unk",
    ]  # fmt: skip
    assert {row[3] for row in methods} == {"thousand km", "km"}
    assert sum(row[0] in ("N", "B") for row in rows) == 10
    assert sum("direction to the centre" in row[0] for row in rows) == 5


def test_a_table_without_a_solved_frame_says_why(tmp_path, make_run):
    make_run(tmp_path, count=4, unsolved_from=0)
    assert format_table(evaluate_run(tmp_path, tmp_path / "truth.csv")).splitlines() == [
        "solved 0 of 4 frames (0.0 %)",
        "unsolved 4 times: no solution",
    ]


def test_a_lone_frame_has_a_dash_for_its_spread(tmp_path, make_run):
    make_run(tmp_path, count=1)
    table = format_table(evaluate_run(tmp_path, tmp_path / "truth.csv")).splitlines()
    assert [cells(line)[4] for line in table[3:6]] == ["-"] * 3


def test_a_run_ends_with_its_methods_and_reasons(tmp_path, make_run):
    write_approach(tmp_path / "run", count=48)
    solutions = read_run(tmp_path / "run").solutions
    first, header, *rows = summarise_run(solutions)
    solved = sum(s.solved for s in solutions)
    assert first == f"solved {solved} of 96 frames"
    names = ["brightness centre", "control points", "horizon", "horizon of a smooth body"]
    assert [cells(row)[0] for row in rows[:4]] == names
    assert sum(int(cells(row)[1]) for row in rows[:4]) == solved
    assert header.split("  ")[-2:] == ["median sigma an axis, km", "largest"]
    assert rows[4:] == ["unsolved, cut disc: 6", "unsolved, no limb: 2"]
    assert 96 - solved == 8
    make_run(tmp_path / "none", count=2, unsolved_from=0)
    none = summarise_run(read_run(tmp_path / "none").solutions)
    assert none == ["solved 0 of 2 frames", "unsolved, no solution: 2"]
    assert summarise_run([]) == ["solved 0 of 0 frames"]
