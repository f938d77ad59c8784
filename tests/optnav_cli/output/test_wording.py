"""Numbers and accounts in words."""

import pytest

from catalog.control_point import Flag
from catalog.jobs.usage import Account, Peak, StageAccount
from optnav_cli.output.wording import (
    align_table,
    choose_length_unit,
    format_account,
    format_angle,
    format_bytes,
    format_duration,
    format_length,
    format_plural,
    format_speed,
)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (9.94, "9.9 s"), (9.96, "10 s"), (59.6, "1 min 00 s"), (125, "2 min 05 s"),
     (7800, "2 h 10 min")],
)  # fmt: skip
def test_durations_are_written_in_the_largest_units(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text


def test_a_slow_rate_is_written_as_time_a_unit() -> None:
    assert format_speed(0.25, "frame") == "4.0 s a frame"
    assert format_speed(12.34, "frame") == "12.3 frames/s"


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (12_345_678, "12.3 MB"),
     (999_960_000, "1.00 GB"), (1_040_000_000, "1.04 GB")],
)  # fmt: skip
def test_bytes_read_as_people_say_them(count: int, text: str) -> None:
    assert format_bytes(count) == text


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.0, "0.000 m"), (0.0424, "0.042 m"), (-12.34, "-12.3 m"), (999.94, "999.9 m"),
     (1e3, "1.000 km"), (34_260.0, "34.26 km"), (3_928_700.0, "3928.7 km"),
     (3.844e8, "384.4 thousand km"), (2.6e9, "2600.0 thousand km"), (float("nan"), "- m"),
     (float("inf"), "- m")],
)  # fmt: skip
def test_lengths_are_written_in_the_unit_of_their_size(metres: float, text: str) -> None:
    assert format_length(metres) == text


def test_what_rounds_to_zero_has_no_sign() -> None:
    assert choose_length_unit(500.0).text(-0.01) == "0.0"
    assert choose_length_unit(500.0).text(-0.01, "+") == "+0.0"


def test_angles_are_degrees_where_they_are_large() -> None:
    assert (format_angle(1e-5), format_angle(0.5)) == ('2.1"', "28.6 deg")


def test_columns_of_a_table_never_run_together() -> None:
    rows = [("name", "a", "b"), ("x", "1" * 30, "-2"), ("a longer name", "", "3")]
    assert align_table(rows) == [
        "name           " + "a".rjust(30) + "   b",
        "x              " + "1" * 30 + "  -2",
        "a longer name  " + " " * 30 + "   3",
    ]
    assert align_table(rows, left=(2,))[0].endswith("a  b")
    assert align_table([]) == []
    assert align_table([("one",), ("one", "two")]) == ["one", "one  two"]


def test_a_symbol_of_a_unit_has_no_plural() -> None:
    assert (format_plural("cell", 2), format_plural("cell", 1), format_plural("MB", 2)) == (
        "cells",
        "cell",
        "MB",
    )


def test_an_account_lists_outcome_reasons_and_stages_in_even_columns() -> None:
    account = Account("optnav", 2, cells=12)
    account.judge(
        [(True, Flag.NONE)] * 8 + [(False, Flag.FLAT | Flag.SHADOWED), (False, Flag.FLAT)]
    )
    account.stages = [
        StageAccount("ingest", 1, 0, 1.2, 0.9, 0.0, Peak(200_000_000, True), None, 10**7, 10**6),
        StageAccount(
            "render", 30, 2, 75.0, 140.0, 139.0, Peak(200_000_000, False), Peak(10**9, True),
            2 * 10**9, 4 * 10**6,
        ),
    ]  # fmt: skip
    assert format_account(account) == [
        "12 cells, 10 control points, 8 usable (80.0 %)",
        "without a point, for lack of ground: 2",
        "not usable: 2, for these reasons (a point can have several):",
        "  flat      2   20.0 % of all",
        "  shadowed  1   10.0 % of all",
        "stage   done  kept        time         CPU      memory  a worker     read  written",
        "ingest     1     0       1.2 s       0.9 s    200.0 MB         -  10.0 MB   1.0 MB",
        "render    30     2  1 min 15 s  2 min 20 s  ≤ 200.0 MB   1.00 GB  2.00 GB   4.0 MB",
        "total               1 min 16 s  2 min 21 s    200.0 MB   1.00 GB  2.01 GB   5.0 MB",
        "≤: reached before, in the process's life; the stage itself took no more",
    ]


def test_what_is_not_known_yet_is_not_told() -> None:
    account = Account("optnav", 1, cells=1)
    account.stages = [StageAccount("ingest", 1, read_bytes=None, written_bytes=None)]
    lines = format_account(account)
    assert lines[0] == "1 cell"
    assert len(lines) == 3
