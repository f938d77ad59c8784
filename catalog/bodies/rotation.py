"""Orientation of a body in inertial space from its series of pole and prime meridian.

Source: Archinal et al., reports of the IAU Working Group on Cartographic Coordinates and Rotational
Elements, 2009 and 2015; the numbers live in configs/bodies. The lunar series differs from the ME
frame of DE421 by 80 m on average and 155 m at most at the surface (1997-2010), so the Moon's file
adds a correction that is fitted to that frame; `make study-rotation` fits and checks it.
"""

import math
from functools import lru_cache

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
from catalog.bodies.epochs import DAY_S
from catalog.geometry.kernel import kernel
from catalog.geometry.rotations import ARCSEC

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
