"""The account of a build as people read it."""

from catalog.control_point import Flag
from catalog.jobs.usage import Account, Peak, StageAccount
from optnav_cli.output.account_table import account_lines


def test_an_account_tells_outcome_reasons_and_stages_in_even_columns() -> None:
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
    assert account_lines(account) == [
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
    lines = account_lines(account)
    assert lines[0] == "1 cell"
    assert len(lines) == 3
