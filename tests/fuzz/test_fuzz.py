"""Hostile input of every kind: each case ends with a right exit code and leaves nothing behind."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzz import all_kinds  # noqa: F401 -- registers them
from tests.fuzz.cases import chosen
from tests.fuzz.runner import Runner, Tally, Verdict, failure_lines

CASES, SEED = 200, 1
FAULTS = {
    "code": "code 3; wanted [0]",
    "traceback": "traceback: KeyError: 'a bug'",
    "signal": "signal",
    "hang": "hang",
    "network": "network",
    "litter": "litter: .input.optnav-new-1 is new",
    "changed": "litter: input is changed",
    "temporary": "litter: tmp holds",
    "escape": "escape: open ",
}


@pytest.fixture(scope="module")
def materials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz") / "materials"


@pytest.fixture
def runner(materials: Path, tmp_path: Path) -> Iterator[Runner]:
    return Runner(tmp_path / "area", materials, hang_s=3.0)


def test_200_hostile_cases_end_with_a_right_code_and_leave_nothing(
    materials: Path, tmp_path: Path
) -> None:
    tally = Tally()
    for outcome in Runner(tmp_path, materials).run(chosen(n, SEED) for n in range(CASES)):
        tally.add(outcome)
    report = "\n".join(line for outcome in tally.failures for line in failure_lines(outcome))
    assert not tally.failures, f"{report}\n" + "\n".join(tally.lines())


def test_the_harness_notices_each_fault_and_goes_on(runner: Runner) -> None:
    cases = [(f"fault-{name}", number) for number, name in enumerate([*FAULTS, "none"])]
    *outcomes, last = runner.run(cases)
    for outcome, expected in zip(outcomes, FAULTS.values(), strict=True):
        assert any(failure.startswith(expected) for failure in outcome.failures), outcome
        assert f"again: make fuzz CASE={outcome.kind}:{outcome.seed}" in failure_lines(outcome)[-1]
    assert last.failures == []


def test_a_case_is_the_same_when_it_is_made_again() -> None:
    assert [chosen(number, 7) for number in range(50)] == [
        chosen(number, 7) for number in range(50)
    ]


def test_an_outcome_goes_through_a_line_and_back() -> None:
    outcome = Verdict("place", 5, ["a\udcff"], "note", [0, 3], 3, 0.5, ["bad"], "said")
    assert Verdict.of_line(outcome.line()) == outcome
