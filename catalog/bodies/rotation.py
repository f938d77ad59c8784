"""Orientation of a body in inertial space from its series of pole and prime meridian.

Source: Archinal et al., reports of the IAU Working Group on Cartographic Coordinates and Rotational
Elements, 2009 and 2015; the numbers live in configs/bodies. The lunar series differs from the ME
frame of DE421 by 80 m on average and 155 m at most at the surface (1997-2010), so the Moon's file
adds a correction that is fitted to that frame; `make study-rotation` fits and checks it.

The Earth turns by IAU 2006/2000A: IERS Conventions 2010 (IERS Technical Note 36), ch. 5, CIO-based,
through SOFA. UT1, polar motion and the pole's offsets come from a table of the IERS. Not in it are
tides of less than a day: 1 cm at the surface.
"""

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import erfa
import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.bodies.body import (
    J2000_YEAR,
    JULIAN_YEAR_S,
    Axes,
    Body,
    RotationCorrection,
    RotationSeries,
)
from catalog.bodies.epochs import DAY_S, tai_from_tdb_s
from catalog.errors import DataError
from catalog.geometry.kernel import kernel
from catalog.geometry.rotations import ARCSEC
from catalog.inputs import read_input

Series = tuple[FloatArray, FloatArray, FloatArray]  # slow part, angles and amplitudes of terms

CENTURY_S = 36525.0 * DAY_S
_DEGREE = math.pi / 180.0


@kernel
def _evaluate_quadratic(coefficients: FloatArray, t: float) -> float:
    return float(coefficients[0] + t * (coefficients[1] + t * coefficients[2]))


@kernel
def _evaluate_pole(
    t_s: float, slow: FloatArray, angles: FloatArray, amplitudes: FloatArray
) -> Axes:
    """Right ascension and declination of the pole and prime meridian, rad.

    slow        (3, 3)  polynomials of the three, deg by centuries, centuries and days
    amplitudes  (n, 3)  deg, of sine, cosine and sine of the terms' angles
    """
    c, d = t_s / CENTURY_S, t_s / DAY_S
    ra = _evaluate_quadratic(slow[0], c)
    dec = _evaluate_quadratic(slow[1], c)
    # whole turns off before small terms are added: at 1e7 deg each sum would cost digits
    meridian = _evaluate_quadratic(slow[2], d)
    meridian -= 360.0 * math.floor(meridian / 360.0)
    for i in range(angles.shape[0]):
        angle = _evaluate_quadratic(angles[i], c)
        sine = math.sin(angle)
        ra += amplitudes[i, 0] * sine
        dec += amplitudes[i, 1] * math.cos(angle)
        meridian += amplitudes[i, 2] * sine
    return ra * _DEGREE, dec * _DEGREE, meridian * _DEGREE


@kernel
def _evaluate_turn(
    t_s: float, slow: FloatArray, angles: FloatArray, amplitudes: FloatArray
) -> Axes:
    """Rotation vector, rad, about body x, y, z.

    slow        (3, 3)     its slow part, axis by powers of centuries
    amplitudes  (n, 2, 3)  of sine and cosine of the terms' angles
    """
    c = t_s / CENTURY_S
    x = _evaluate_quadratic(slow[0], c)
    y = _evaluate_quadratic(slow[1], c)
    z = _evaluate_quadratic(slow[2], c)
    for i in range(angles.shape[0]):
        angle = _evaluate_quadratic(angles[i], c)
        sine, cosine = math.sin(angle), math.cos(angle)
        x += amplitudes[i, 0, 0] * sine + amplitudes[i, 1, 0] * cosine
        y += amplitudes[i, 0, 1] * sine + amplitudes[i, 1, 1] * cosine
        z += amplitudes[i, 0, 2] * sine + amplitudes[i, 1, 2] * cosine
    return x, y, z


@kernel
def rotate_by_series(times_s: FloatArray, series: Series, out: FloatArray) -> None:
    """Write rotations (n, 3, 3) from inertial to body axes of times (n,)."""
    for i in range(times_s.shape[0]):
        ra, dec, meridian = _evaluate_pole(times_s[i], *series)
        # about z by 90 deg + ra, about x by 90 deg - dec, about z by the meridian, multiplied out
        cn, sn = -math.sin(ra), math.cos(ra)
        ci, si = math.sin(dec), math.cos(dec)
        cw, sw = math.cos(meridian), math.sin(meridian)
        m = out[i]
        m[0, 0], m[0, 1], m[0, 2] = cw * cn - sw * ci * sn, cw * sn + sw * ci * cn, sw * si
        m[1, 0], m[1, 1], m[1, 2] = -sw * cn - cw * ci * sn, -sw * sn + cw * ci * cn, cw * si
        m[2, 0], m[2, 1], m[2, 2] = si * sn, -si * cn, ci


@kernel
def rotate_by_correction(
    times_s: FloatArray, years_s: tuple[float, float], series: Series, out: FloatArray
) -> None:
    """Turn rotations (n, 3, 3) on by the correction where a time lies from years_s[0] to [1]."""
    for i in range(times_s.shape[0]):
        if not (years_s[0] <= times_s[i] <= years_s[1]):
            continue
        x, y, z = _evaluate_turn(times_s[i], *series)
        # Rodrigues' formula with the series of its factors: exact to 1e-16 below 0.01 rad
        squared = x * x + y * y + z * z
        first = 1.0 - squared / 6.0 * (1.0 - squared / 20.0)
        second = 0.5 - squared / 24.0 * (1.0 - squared / 30.0)
        for column in range(3):
            a, b, c = out[i, 0, column], out[i, 1, column], out[i, 2, column]
            p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
            out[i, 0, column] = a + first * p + second * (y * r - z * q)
            out[i, 1, column] = b + first * q + second * (z * p - x * r)
            out[i, 2, column] = c + first * r + second * (x * q - y * p)


def body_from_inertial(body: Body, tdb_s: ArrayLike) -> FloatArray:
    """Rotation (..., 3, 3) taking inertial (ICRF) vectors to the body-fixed frame.

    tdb_s  (...)  TDB seconds past J2000
    """
    if body.rotation.theory == "iau2006":
        return rotate_earth(tdb_s, None)
    times = np.ascontiguousarray(tdb_s, dtype=np.float64).reshape(-1)
    rotations = np.empty((len(times), 3, 3))
    rotate_by_series(times, _make_series_table(body.rotation), rotations)
    if body.rotation_correction is not None:
        rotate_by_correction(times, *_make_correction_table(body.rotation_correction), rotations)
    return rotations.reshape(*np.shape(tdb_s), 3, 3)


@lru_cache
def _make_series_table(series: RotationSeries) -> Series:
    """Slow part (3, 3), angles (n, 3) and amplitudes (n, 3) as the kernel takes them."""
    slow = (
        series.pole_ra_deg_by_century,
        series.pole_dec_deg_by_century,
        series.meridian_deg_by_day,
    )
    angles = [term.angle_deg_by_century for term in series.terms]
    amplitudes = [(term.ra_deg, term.dec_deg, term.meridian_deg) for term in series.terms]
    return (
        np.array(slow),
        np.radians(np.reshape(angles, (-1, 3))),
        np.array(amplitudes, dtype=np.float64).reshape(-1, 3),
    )


@lru_cache
def _make_correction_table(correction: RotationCorrection) -> tuple[tuple[float, float], Series]:
    """First and last time, s, slow part (3, 3), angles (n, 3), amplitudes (n, 2, 3), rad."""
    slow = (
        correction.x_arcsec_by_century,
        correction.y_arcsec_by_century,
        correction.z_arcsec_by_century,
    )
    first, last = ((year - J2000_YEAR) * JULIAN_YEAR_S for year in correction.years)
    angles = [term.angle_deg_by_century for term in correction.terms]
    amplitudes = [(term.sin_arcsec, term.cos_arcsec) for term in correction.terms]
    return (first, last), (
        np.array(slow) * ARCSEC,
        np.radians(np.reshape(angles, (-1, 3))),
        np.array(amplitudes, dtype=np.float64).reshape(-1, 2, 3) * ARCSEC,
    )


MJD_JD = 2400000.5
# Fields of a line of finals2000A (IERS, readme.finals2000A): MJD, pole x and y, UT1 - UTC, the
# offsets dX and dY, the sigmas of UT1 and of the pole's x.
FINALS = ((7, 15), (18, 27), (37, 46), (58, 68), (97, 106), (116, 125), (68, 78), (27, 36))
# The same columns of EOP C04 tables, by how many they have: of series 20 with hours, of 08 and 14.
C04_COLUMNS = {21: (4, 5, 6, 7, 8, 9, 15, 13), 16: (3, 4, 5, 6, 8, 9, 12, 10)}
MIN_LINES = 2
# Offsets of the pole from IAU 2006/2000A stay below 1 mas, those from the nutation of 1980 do not.
MAX_OFFSET_ARCSEC = 5e-3
MAX_UT1_S, MAX_POLE_ARCSEC = 1.0, 2.0
MAX_GAP_DAYS = 10.0  # tides move UT1 off a straight line over more days by over a metre
TIDES_M = 0.02  # of less than a day, 1 sigma at the surface
EARTH_RADIUS_M = 6.378137e6
EARTH_RATE_M_S = 465.1  # of the equator


@dataclass(frozen=True, eq=False)
class EarthOrientation:
    """UT1 and polar motion by a table of the IERS.

    mjd       (n,) UTC days, rising
    columns   (n, 7) UT1 - TAI, s; pole x, y and offsets dX, dY, rad; 1 sigma of UT1, s, and of the
              pole, rad
    """

    name: str
    mjd: FloatArray
    columns: FloatArray

    def interpolate(self, mjd: FloatArray) -> FloatArray:
        """Columns (n, 7) at UTC days (n,). Raises DataError beyond the table, with its dates."""
        early, late = float(mjd.min()), float(mjd.max())
        first, last = float(self.mjd[0]), float(self.mjd[-1])
        if not first <= early <= late <= last:
            asked = early if early < first else late
            raise DataError(
                f"{self.name}: holds {_format_day(first)} to {_format_day(last)}, not "
                f"{_format_day(asked)}; name a table of the IERS that has that day"
            )
        return np.stack([np.interp(mjd, self.mjd, c) for c in self.columns.T], axis=1)


def is_earth_orientation(path: Path) -> bool:
    """Whether a file is a text table, by its first bytes; SPICE kernels name their kind there.

    Raises DataError for a missing file.
    """
    head = read_input(path, "SPICE kernel or IERS table")[:8].lstrip()
    return not head.startswith((b"DAF/", b"KPL/", b"NAIF/"))


def read_earth_orientation(path: Path) -> EarthOrientation:
    """Read finals2000A or EOP C04 of the IERS, whose lines say by themselves what they are.

    Raises DataError for other files, damaged lines, gaps, and the nutation of 1980.
    """
    text = read_input(path, "IERS table").decode("latin-1")
    rows = np.array([*_parse_rows(path, text)], dtype=np.float64).reshape(-1, 8)
    if len(rows) < MIN_LINES:
        raise DataError(
            f"{path}: has {len(rows)} lines of UT1 and polar motion; wanted finals2000A or EOP C04 "
            "of the IERS"
        )
    mjd, pole, ut1, offsets = rows[:, 0], rows[:, 1:3], rows[:, 3], rows[:, 4:6]
    gaps = np.diff(mjd)
    if not (gaps.min() > 0.0 and gaps.max() <= MAX_GAP_DAYS):
        at = int(np.argmin(gaps)) if gaps.min() <= 0.0 else int(np.argmax(gaps))
        raise DataError(
            f"{path}: {_format_day(mjd[at])} is followed by {_format_day(mjd[at + 1])}; wanted "
            f"days in order, at most {MAX_GAP_DAYS:g} apart: fetch the file again"
        )
    largest = np.abs(offsets).max()
    if largest > MAX_OFFSET_ARCSEC:
        raise DataError(
            f"{path}: the pole is {1e3 * largest:.3g} mas off the theory, as that of 1980 is; "
            "wanted the table for IAU 2006/2000A: finals2000A or EOP C04"
        )
    for values, most, what in (
        (ut1, MAX_UT1_S, "UT1 - UTC, s"),
        (pole, MAX_POLE_ARCSEC, "the pole, arcsec"),
    ):
        if not np.abs(values).max() <= most:
            raise DataError(f"{path}: {what}, is {np.abs(values).max():g}; wanted up to {most:g}")
    year, month, day, part = erfa.jd2cal(MJD_JD, mjd)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # years beyond the leap-second table
        ut1_tai = ut1 - erfa.dat(year, month, day, part)
    angles = np.column_stack([pole, offsets]) * ARCSEC
    columns = np.column_stack([ut1_tai, angles, rows[:, 6], rows[:, 7] * ARCSEC])
    return EarthOrientation(path.name, mjd, columns)


def _parse_rows(path: Path, text: str) -> Iterator[list[float]]:
    """Yield the eight numbers of each line that has them, as FINALS names them."""
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        columns = C04_COLUMNS.get(len(words))
        if not words or words[0].startswith("#") or not words[0][0].isdigit():
            continue
        if columns is not None and len(words[0]) == 4:
            fields = [words[k] for k in columns]
        else:
            fields = [line[first:end].strip() for first, end in FINALS]
            if not fields[3]:  # days to come, without a prediction
                continue
            fields[4:6] = [str(1e-3 * _parse(path, number, field or "0")) for field in fields[4:6]]
        yield [_parse(path, number, field) for field in fields]


def _parse(path: Path, number: int, field: str) -> float:
    try:
        value = float(field)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(
            f"{path}, line {number}: has {field[:40]!r} where a number is wanted; wanted "
            "finals2000A or EOP C04 of the IERS: fetch the file again"
        )
    return value


def _format_day(mjd: float) -> str:
    year, month, day, _ = erfa.jd2cal(MJD_JD, mjd)
    return f"{int(year):04d}-{int(month):02d}-{int(day):02d}"


def rotate_earth(tdb_s: ArrayLike, orientation: EarthOrientation | None) -> FloatArray:
    """Rotation (..., 3, 3) from the celestial (GCRS) to the terrestrial frame (ITRS).

    tdb_s  (...)  TDB seconds past J2000
    orientation  None: UT1 = UTC, the pole of the theory
    Raises DataError beyond the table.
    """
    times = np.asarray(tdb_s, dtype=np.float64).reshape(-1)
    tai1, tai2 = tai_from_tdb_s(times)
    tt1, tt2 = erfa.taitt(tai1, tai2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # years beyond the leap-second table
        utc1, utc2 = erfa.taiutc(tai1, tai2)
    if orientation is None:
        ut1, x_pole, y_pole, dx, dy = (utc1, utc2), *np.zeros((4, len(times)))
    else:
        columns = orientation.interpolate((utc1 - MJD_JD) + utc2)
        ut1_tai, x_pole, y_pole, dx, dy = columns.T[:5]
        ut1 = erfa.taiut1(tai1, tai2, ut1_tai)
    x, y, s = erfa.xys06a(tt1, tt2)
    celestial = erfa.c2ixys(x + dx, y + dy, s)
    pole = erfa.pom00(x_pole, y_pole, erfa.sp00(tt1, tt2))
    turned: FloatArray = erfa.c2tcio(celestial, erfa.era00(*ut1), pole)
    return turned.reshape(*np.shape(tdb_s), 3, 3)


def estimate_earth_error_m(tdb_s: float, orientation: EarthOrientation) -> float:
    """Estimate the error of the Earth's rotation by a table as a shift of the surface, 1 sigma, m.

    Predicted days of a table state larger errors than measured ones.
    """
    tai1, tai2 = tai_from_tdb_s(np.array([tdb_s]))
    ut1_s, pole = orientation.interpolate((tai1 - MJD_JD) + tai2)[0, 5:]
    return float(math.hypot(ut1_s * EARTH_RATE_M_S, pole * EARTH_RADIUS_M, TIDES_M))
