"""Times of files (UTC, ISO-8601) and times inside (TDB seconds past J2000).

The time scales are SOFA's, through pyerfa, with the leap seconds that pyerfa carries. 0.6 ms of
timing error is 1 m along a low lunar orbit; 0.2 s is 1 m of lunar rotation at the equator.
Between 1960 and 1972, when UTC drifted, SOFA's fractions are used; SPICE rounds them to 9 s.
"""

import re
import warnings

import erfa
import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.errors import DataError

J2000_JD = 2451545.0
DAY_S = 86400.0
FIRST_YEAR = 1960  # UTC is not defined before
MAX_AFTER_S = 3e11  # more than from the first year to the last, 9999

_PATTERN = re.compile(
    r"(\d{4})-(\d{2})-(\d{2})[T ](\d{2}):(\d{2})(?::(\d{2}(?:\.\d*)?))?\s*(.*)", re.IGNORECASE
)
_UTC_WORDS = ("", "z", "utc", "+00:00", "+0000", "+00")
_EXAMPLE = "a UTC time such as 2023-08-17T05:23:10.250Z"


def utc_to_tdb_s(utc: str) -> float:
    """TDB seconds past J2000 of an ISO-8601 UTC time; a leap second is written 23:59:60.

    Raises DataError for what is not a time, not a possible time, or not UTC.
    """
    return _tdb_s(*_tai(utc))


def tdb_s_after(utc: str, seconds: ArrayLike) -> FloatArray:
    """TDB seconds past J2000 of times so many SI seconds (n,) after a UTC time.

    Each is a UTC time of whole milliseconds, the nearest: a count of TDB seconds would drift from
    the clock by some microseconds in hours, by 3 ms in half a year. Raises DataError for times
    before 1960 or after 9999.
    """
    day, part = _tai(utc)
    found = []
    for after in np.atleast_1d(np.asarray(seconds, np.float64)).tolist():
        if not abs(after) < MAX_AFTER_S:
            raise DataError(f"{after:g} s after {utc}: wanted a time before the year 10000")
        found.append(utc_to_tdb_s(_iso(day, part + after / DAY_S, 3)))
    return np.array(found)


def utc_from_tdb_s(tdb_s: float, digits: int = 6) -> str:
    """ISO-8601 UTC time, ending in Z, of TDB seconds past J2000; `digits` decimals of a second."""
    day = tdb_s / DAY_S
    tt1, tt2 = erfa.tdbtt(J2000_JD, day, _tdb_minus_tt_s(J2000_JD, day))
    tai1, tai2 = erfa.tttai(tt1, tt2)
    return _iso(tai1, tai2, digits)


def _iso(tai1: float, tai2: float, digits: int) -> str:
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


def _tai(utc: str) -> tuple[float, float]:
    """Both parts of the Julian date, TAI, of a UTC time. Raises DataError."""
    match = _PATTERN.fullmatch(utc.strip())
    if match is None:
        raise DataError(f"time '{utc}' is not understood; wanted {_EXAMPLE}")
    *fields, zone = match.groups()
    if zone.lower() not in _UTC_WORDS:
        raise DataError(f"time '{utc}' is not UTC (it ends in '{zone}'); wanted {_EXAMPLE}")
    year, month, day, hour, minute = (int(text) for text in fields[:5])
    second = float(fields[5] or 0.0)
    if year < FIRST_YEAR:
        raise DataError(f"time '{utc}' lies before {FIRST_YEAR}, when UTC begins")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            utc1, utc2 = erfa.dtf2d("UTC", year, month, day, hour, minute, second)
            tai1, tai2 = erfa.utctai(utc1, utc2)
        except erfa.ErfaError:
            raise DataError(f"time '{utc}' does not exist; wanted {_EXAMPLE}") from None
    # The other warning, of years beyond the leap-second table, needs no action: none are announced.
    if any("end of day" in str(warning.message) for warning in caught):
        raise DataError(f"time '{utc}': that minute has no second {fields[5]}; wanted {_EXAMPLE}")
    return float(tai1), float(tai2)


def _tdb_s(tai1: float, tai2: float) -> float:
    tt1, tt2 = erfa.taitt(tai1, tai2)
    tdb1, tdb2 = erfa.tttdb(tt1, tt2, _tdb_minus_tt_s(tt1, tt2))
    return float(((tdb1 - J2000_JD) + tdb2) * DAY_S)


def _tdb_minus_tt_s(jd1: float, jd2: float) -> float:
    # At the geocentre: the observer's place changes it by 2 microseconds at most on the Earth,
    # by a few tens at the Moon's distance, which is nothing here.
    return float(erfa.dtdb(jd1, jd2, 0.0, 0.0, 0.0, 0.0))
