"""Numbers read as people say them."""

import pytest

from optnav_cli.output.wording import amount, duration, plural, speed


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (9.94, "9.9 s"), (9.96, "10 s"), (59.6, "1 min 00 s"), (125, "2 min 05 s"),
     (7800, "2 h 10 min")],
)  # fmt: skip
def test_durations_read_as_people_say_them(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_a_slow_rate_is_told_the_other_way_round() -> None:
    assert speed(0.25, "frame") == "4.0 s a frame"
    assert speed(12.34, "frame") == "12.3 frames/s"


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (12_345_678, "12.3 MB"),
     (999_960_000, "1.00 GB"), (1_040_000_000, "1.04 GB")],
)  # fmt: skip
def test_bytes_read_as_people_say_them(count: int, text: str) -> None:
    assert amount(count) == text


def test_a_symbol_of_a_unit_has_no_plural() -> None:
    assert (plural("cell", 2), plural("cell", 1), plural("MB", 2)) == ("cells", "cell", "MB")
