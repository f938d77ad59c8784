"""UTC and TDB."""

from collections.abc import Callable
from datetime import date
from itertools import product
from pathlib import Path

import pytest

from catalog.bodies.epochs import compute_tdb_s_after, system_to_tdb_s, utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import DataError

TIMES = [
    "1997-06-01T12:34:56.789000Z",
    "2005-12-31T23:59:60.500000Z",
    "2023-08-17T05:23:00.000000Z",
]


def test_j2000_is_known() -> None:
    # J2000 is 12:00:00 TT = 11:58:55.816 UTC (TAI - UTC = 32 s, TT - TAI = 32.184 s);
    # TDB - TT is below 2 ms at all times
    assert abs(utc_to_tdb_s("2000-01-01T11:58:55.816Z")) < 2e-3


def test_a_leap_second_counts() -> None:
    before = utc_to_tdb_s("2005-12-31T23:59:59Z")
    assert utc_to_tdb_s("2005-12-31T23:59:60Z") == pytest.approx(before + 1.0, abs=1e-6)
    assert utc_to_tdb_s("2006-01-01T00:00:00Z") == pytest.approx(before + 2.0, abs=1e-6)


@pytest.mark.parametrize("utc", TIMES)
def test_times_survive_the_round_trip(utc: str) -> None:
    assert utc_from_tdb_s(utc_to_tdb_s(utc)) == utc


def test_times_after_a_time_are_whole_milliseconds_of_the_clock() -> None:
    """Half a year on, a count of TDB seconds is 3 ms off the clock."""
    start = "2026-01-01T00:00:00Z"
    later = [0.0, 7200.0, 86400.0 * 182.0, -0.25, 1.0 / 3.0]
    found = [utc_from_tdb_s(time, 3) for time in compute_tdb_s_after(start, later)]
    assert found == [
        *("2026-01-01T00:00:00.000Z", "2026-01-01T02:00:00.000Z", "2026-07-02T00:00:00.000Z"),
        *("2025-12-31T23:59:59.750Z", "2026-01-01T00:00:00.333Z"),
    ]
    assert [utc_to_tdb_s(utc) for utc in found] == compute_tdb_s_after(start, later).tolist()
    leap = compute_tdb_s_after("2016-12-31T23:59:59Z", [1.0, 2.0])
    assert [utc_from_tdb_s(t, 0) for t in leap] == ["2016-12-31T23:59:60Z", "2017-01-01T00:00:00Z"]


@pytest.mark.parametrize("after", [float("nan"), 1e300, -1e12, 2.6e11])
def test_times_after_the_last_year_are_refused(after: float) -> None:
    with pytest.raises(DataError, match=r"wanted a (UTC )?time"):
        compute_tdb_s_after("2026-01-01T00:00:00Z", after)


@pytest.mark.parametrize("utc", TIMES)
def test_times_agree_with_spice(utc: str, shared_data: Callable[[str], Path]) -> None:
    """SPICE models TDB - TT with one sine term, good to 30 microseconds."""
    spice = pytest.importorskip("spiceypy", reason="needs spiceypy")
    kernel = str(shared_data("spice/naif0012.tls"))
    spice.furnsh(kernel)
    try:
        assert utc_to_tdb_s(utc) == pytest.approx(spice.utc2et(utc.rstrip("Z")), abs=5e-5)
    finally:
        spice.unload(kernel)


def test_ways_of_writing_utc_mean_the_same() -> None:
    expected = utc_to_tdb_s("2023-08-17T05:23:00Z")
    for text in (
        "2023-08-17T05:23:00",
        "2023-08-17 05:23:00.000",
        " 2023-08-17T05:23Z ",
        "2023-08-17T05:23:00+00:00",
        "2023-08-17t05:23:00 UTC",
        "2023-229T05:23:00",
        "2023-229T05:23:00.00Z",
        "20230817T052300Z",
        "2023229T052300",
        "2023-08-17T05:23:00,0",
    ):
        assert utc_to_tdb_s(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "2023-08-17T05:23:00+03:00",
        "2023-08-17T05:23:00 MSK",
        "2023-08-17T05:23:00 TDB",
        "2023-08-17T05:23:00-00:30",
        "2023-229T05:23:00-08:00",
    ],
)
def test_other_zones_and_scales_are_refused(text: str) -> None:
    with pytest.raises(DataError, match="is not UTC"):
        utc_to_tdb_s(text)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "yesterday",
        "2023-08-17",
        "17.08.2023 05:23",
        "745521849.18",
        "nan",
        "2023-8-7T05:23:00Z",
        "23-229T05:23:00",
        "2023-0817T05:23",
    ],
)
def test_what_is_not_a_time_is_refused(text: str) -> None:
    with pytest.raises(DataError, match="not understood"):
        utc_to_tdb_s(text)


@pytest.mark.parametrize(
    "text",
    [
        "2023-13-01T00:00:00Z",
        "2023-02-30T00:00:00Z",
        "2023-08-17T24:00:01Z",
        "2023-08-17T25:00:00Z",
        "2023-000T05:00:00Z",
        "2023-366T05:00:00Z",
        "2023-08-17T05:61:00Z",
        "2023-08-17T05:23:60Z",
        "2023-08-17T05:23:99Z",
        "1957-10-04T19:28:34Z",
    ],
)
def test_impossible_times_are_refused(text: str) -> None:
    with pytest.raises(DataError, match="time '"):
        utc_to_tdb_s(text)


@pytest.mark.parametrize("year", [1999, 2000, 2016, 2100])
def test_every_day_of_year_is_the_calendars(year: int) -> None:
    """Leap years have 366 days, centuries that 400 does not divide have 365."""
    for day in range(1, date(year, 12, 31).timetuple().tm_yday + 1):
        calendar = date.fromordinal(date(year, 1, 1).toordinal() + day - 1)
        assert utc_to_tdb_s(f"{year}-{day:03d}T06:00:00") == utc_to_tdb_s(f"{calendar}T06:00:00")


def test_the_end_of_a_day_is_the_beginning_of_the_next() -> None:
    """With a leap second between where the day has one."""
    assert utc_to_tdb_s("2023-08-17T24:00:00Z") == utc_to_tdb_s("2023-08-18T00:00:00Z")
    assert utc_to_tdb_s("2016-366T24:00:00Z") == utc_to_tdb_s("2017-01-01T00:00:00Z")
    assert utc_to_tdb_s("2016-366T23:59:60Z") == utc_to_tdb_s("2017-01-01T00:00:00Z") - 1.0


def test_times_that_count_tdb_are_read() -> None:
    assert system_to_tdb_s("2000-01-01T12:00:00", "TDB") == 0.0
    assert system_to_tdb_s("2000-001T12:00:01.5 TDB", "TDB") == 1.5
    assert system_to_tdb_s("1999-365T24:00:00", "TDB") == -43200.0
    assert system_to_tdb_s("2016-12-31T23:59:59Z", "TDB") == 536500799.0
    for text in ("2016-12-31T23:59:60", "2016-02-30T00:00:00", "2016-02-01T00:00:00+01:00", "0"):
        with pytest.raises(DataError, match="time '"):
            system_to_tdb_s(text, "TDB")


def test_times_may_count_the_day_of_the_year_in_every_system() -> None:
    wanted = utc_to_tdb_s("2014-08-05T12:00:00.5Z")
    assert system_to_tdb_s("2014-217T12:00:00.5Z", "UTC") == wanted
    assert system_to_tdb_s("2016-366T23:59:60.5", "UTC") == utc_to_tdb_s("2016-12-31T23:59:60.5Z")
    assert system_to_tdb_s("2000-001T12:00:00", "TDB") == 0.0
    # TAI - UTC is 35 s in 2014, TT - TAI 32.184 s
    assert system_to_tdb_s("2014-217T12:01:07.684", "TT") == pytest.approx(wanted, abs=1e-6)
    for text, system in product(
        ("2015-366T00:00:00", "2015-000T00:00:00", "2015-02-30T00:00:00"), ("TDB", "UTC", "GPS")
    ):
        with pytest.raises(DataError, match="does not exist"):
            system_to_tdb_s(text, system)
    with pytest.raises(DataError, match="does not exist in TAI"):
        system_to_tdb_s("2016-12-31T23:59:60", "TAI")
