"""Times of files (UTC, ISO-8601) and times inside (TDB seconds past J2000).

The time scales are SOFA's, through pyerfa, with the leap seconds that pyerfa carries. 0.6 ms of
timing error is 1 m along a low lunar orbit; 0.2 s is 1 m of lunar rotation at the equator.
Between 1960 and 1972, when UTC drifted, SOFA's fractions are used; SPICE rounds them to 9 s.
"""

import re
import warnings
from typing import NamedTuple

import erfa
import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.errors import DataError

J2000_JD = 2451545.0
DAY_S = 86400.0
GPS_FROM_TAI_S = -19.0
TIME_SYSTEMS = ("UTC", "TDB", "TT", "TAI", "GPS")
FIRST_YEAR = 1960  # UTC is not defined before
MAX_AFTER_S = 3e11  # more than from the first year to the last, 9999

# ISO 8601-1:2019: dates of year, month and day or of year and day of year, with separators or
# without (basic format); a comma may stand for the decimal point.
_PATTERN = re.compile(
    r"(?P<year>[0-9]{4})(?P<dash>-?)"
    r"(?:(?P<month>[0-9]{2})(?P=dash)(?P<day>[0-9]{2})|(?P<day_of_year>[0-9]{3}))"
    r"(?:T|[ ]+)"
    r"(?P<hour>[0-9]{2})(?P<colon>:?)(?P<minute>[0-9]{2})"
    r"(?:(?P=colon)(?P<second>[0-9]{2}(?:[.,][0-9]*)?))?"
    r"\s*(?P<zone>.*)",
    re.IGNORECASE,
)
_UTC_WORDS = ("", "z", "utc", "+00:00", "+0000", "+00", "-00:00")
_EXAMPLE = "a UTC time such as 2023-08-17T05:23:10.250Z or, by day of year, 2023-229T05:23:10.250Z"


def utc_to_tdb_s(utc: str, name: str = "") -> float:
    """TDB seconds past J2000 of an ISO-8601 UTC time; a leap second is written 23:59:60.

    The date may be a day of year (2014-217T12:00:00), 24:00:00 is the end of a day, and Z may be
    left out. `name` is that of the column or setting, for messages. Raises DataError for what is
    not a time, not a possible time, or not UTC.
    """
    try:
        return _convert_to_tdb_s(*_parse_tai(utc))
    except DataError as error:
        raise DataError(f"{name}: {error}" if name else str(error)) from None


def compute_tdb_s_after(utc: str, seconds: ArrayLike) -> FloatArray:
    """TDB seconds past J2000 of times so many SI seconds (n,) after a UTC time.

    Each is a UTC time of whole milliseconds, the nearest: a count of TDB seconds would drift from
    the clock by some microseconds in hours, by 3 ms in half a year. Raises DataError for times
    before 1960 or after 9999.
    """
    day, part = _parse_tai(utc)
    seconds_tdb = []
    for after in np.atleast_1d(np.asarray(seconds, np.float64)).tolist():
        if not abs(after) < MAX_AFTER_S:
            raise DataError(f"{after:g} s after {utc}: wanted a time before the year 10000")
        seconds_tdb.append(utc_to_tdb_s(_format_iso(day, part + after / DAY_S, 3)))
    return np.array(seconds_tdb)


def utc_from_tdb_s(tdb_s: float, digits: int = 6) -> str:
    """ISO-8601 UTC time, ending in Z, of TDB seconds past J2000; `digits` decimals of a second."""
    tai1, tai2 = tai_from_tdb_s(np.array(tdb_s))
    return _format_iso(float(tai1), float(tai2), digits)


def tai_from_tdb_s(tdb_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both parts of the Julian dates, TAI, of TDB seconds past J2000, any shape."""
    day = tdb_s / DAY_S
    tt1, tt2 = erfa.tdbtt(J2000_JD, day, erfa.dtdb(J2000_JD, day, 0.0, 0.0, 0.0, 0.0))
    tai1, tai2 = erfa.tttai(tt1, tt2)
    return tai1, tai2


def _format_iso(tai1: float, tai2: float, digits: int) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # years beyond the leap-second table
        utc1, utc2 = erfa.taiutc(tai1, tai2)
        year, month, date, clock = erfa.d2dtf("UTC", digits, utc1, utc2)
    hour, minute, second, fraction = (int(np.asarray(clock)[name]) for name in "hmsf")
    decimals = f".{fraction:0{digits}d}" if digits else ""
    return (
        f"{int(year):04d}-{int(month):02d}-{int(date):02d}"
        f"T{hour:02d}:{minute:02d}:{second:02d}{decimals}Z"
    )


class _Calendar(NamedTuple):
    """Fields of a written time; `second` is 60 and more in a leap second, `zone` what follows."""

    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: float
    zone: str

    @property
    def is_end_of_day(self) -> bool:
        """Whether the time is 24:00:00, the next day's first moment (ISO 8601)."""
        return self[3:6] == (24, 0, 0.0)


def _read_calendar(text: str) -> _Calendar:
    """Read the fields of an ISO-8601 time. Raises DataError for another form or no such day."""
    match = _PATTERN.fullmatch(text.strip())
    if match is None:
        raise DataError(f"time '{text}' is not understood; wanted {_EXAMPLE}")
    year, month, day = int(match["year"]), int(match["month"] or 1), int(match["day"] or 1)
    if match["day_of_year"] is not None:
        days = int(match["day_of_year"])
        date = np.datetime64(f"{year:04d}-01-01") + np.timedelta64(days - 1, "D")
        found_year, month, day = (int(part) for part in str(date).split("-")[-3:])
        if days < 1 or found_year != year:
            raise DataError(f"time '{text}' does not exist: {year} has no day {days}")
    second = float((match["second"] or "0").replace(",", "."))
    clock = int(match["hour"]), int(match["minute"]), second
    return _Calendar(year, month, day, *clock, match["zone"])


def system_to_tdb_s(text: str, system: str) -> float:
    """TDB seconds past J2000 of an ISO-8601 time in a time system, as orbit messages have them.

    system  one of TIME_SYSTEMS; its name or Z may end the text
    Raises DataError for what is not a time, not a possible time, or has another zone.
    """
    if system == "UTC":
        return utc_to_tdb_s(text)
    time = _read_calendar(text)
    if time.zone.upper() not in ("", "Z", system):
        raise DataError(
            f"time '{text}' is not {system} (it ends in '{time.zone}'); leave the zone out"
        )
    try:
        date = np.datetime64(f"{time.year:04d}-{time.month:02d}-{time.day:02d}")
    except ValueError:
        date = np.datetime64("NaT")
    is_clock = time.hour < 24 and time.minute < 60 and time.second < 60.0
    if np.isnat(date) or not (is_clock or time.is_end_of_day):
        raise DataError(f"time '{text}' does not exist in {system}; wanted {_EXAMPLE}")
    days = float((date - np.datetime64("2000-01-01")).astype(int)) - 0.5
    seconds = 3600.0 * time.hour + 60.0 * time.minute + time.second
    if system == "TDB":
        return days * DAY_S + seconds
    if system == "TT":
        tt = J2000_JD + days, seconds / DAY_S
    else:
        tai_s = seconds - (GPS_FROM_TAI_S if system == "GPS" else 0.0)
        tt = erfa.taitt(J2000_JD + days, tai_s / DAY_S)
    return ((tt[0] - J2000_JD) + tt[1]) * DAY_S + _tdb_minus_tt_s(*tt)


def _parse_tai(utc: str) -> tuple[float, float]:
    """Both parts of the Julian date, TAI, of a UTC time. Raises DataError."""
    time = _read_calendar(utc)
    if time.zone.lower() not in _UTC_WORDS:
        raise DataError(f"time '{utc}' is not UTC (it ends in '{time.zone}'); wanted {_EXAMPLE}")
    if time.year < FIRST_YEAR:
        raise DataError(f"time '{utc}' lies before {FIRST_YEAR}, when UTC begins")
    after = 1 if time.is_end_of_day else 0  # days
    clock = (0, 0, 0.0) if after else time[3:6]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            utc1, utc2 = erfa.dtf2d("UTC", *time[:3], *clock)
            tai1, tai2 = erfa.utctai(utc1 + after, utc2)
        except erfa.ErfaError:
            raise DataError(f"time '{utc}' does not exist; wanted {_EXAMPLE}") from None
    # The other warning, of years beyond the leap-second table, needs no action: none are announced.
    if any("end of day" in str(warning.message) for warning in caught):
        raise DataError(
            f"time '{utc}': that minute has no second {time.second:g}; wanted {_EXAMPLE}"
        )
    return float(tai1), float(tai2)


def _convert_to_tdb_s(tai1: float, tai2: float) -> float:
    tt1, tt2 = erfa.taitt(tai1, tai2)
    tdb1, tdb2 = erfa.tttdb(tt1, tt2, _tdb_minus_tt_s(tt1, tt2))
    return float(((tdb1 - J2000_JD) + tdb2) * DAY_S)


def _tdb_minus_tt_s(jd1: float, jd2: float) -> float:
    # At the geocentre: the observer's place changes it by 2 microseconds at most on the Earth,
    # by a few tens at the Moon's distance, which is nothing here.
    return float(erfa.dtdb(jd1, jd2, 0.0, 0.0, 0.0, 0.0))
