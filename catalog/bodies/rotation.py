"""Orientation of a body in inertial space from its series of pole and prime meridian.

Source: Archinal et al., reports of the IAU Working Group on Cartographic Coordinates and Rotational
Elements, 2009 and 2015; the numbers live in configs/bodies. The lunar series differs from the ME
frame of DE421 by 80 m on average and 155 m at most at the surface (1997-2010), so the Moon's file
adds a correction that is fitted to that frame; `optnav study rotation` fits and checks it.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from catalog.bodies.body import (
    J2000_YEAR,
    JULIAN_YEAR_S,
    Body,
    RotationCorrection,
    RotationSeries,
)

FloatArray = NDArray[np.float64]

DAY_S = 86400.0
CENTURY_S = 36525.0 * DAY_S
ARCSEC = np.pi / 648000.0


def body_from_inertial(body: Body, tdb_s: ArrayLike) -> FloatArray:
    """Rotation (..., 3, 3) taking inertial (ICRF) vectors to the body-fixed frame.

    tdb_s  (...)  TDB seconds past J2000
    """
    published = published_from_inertial(body, tdb_s)
    correction = body.rotation_correction
    if correction is None or not np.any(held := _held(correction, tdb_s)):
        return published
    angles = correction_angles(correction, tdb_s)
    return _turn(angles if np.all(held) else angles * held[..., None]) @ published


def published_from_inertial(body: Body, tdb_s: ArrayLike) -> FloatArray:
    """The same rotation (..., 3, 3) by the published series alone."""
    ra, dec, meridian = pole_and_meridian(body.rotation, tdb_s)
    # The frame turns about z by 90 deg + ra, about x by 90 deg - dec, about z by the meridian;
    # multiplied out, for one small matrix after another would take most of the time.
    cn, sn = -np.sin(ra), np.cos(ra)
    ci, si = np.sin(dec), np.cos(dec)
    cw, sw = np.cos(meridian), np.sin(meridian)
    matrix = np.empty((*np.shape(tdb_s), 3, 3))
    matrix[..., 0, 0] = cw * cn - sw * ci * sn
    matrix[..., 0, 1] = cw * sn + sw * ci * cn
    matrix[..., 0, 2] = sw * si
    matrix[..., 1, 0] = -sw * cn - cw * ci * sn
    matrix[..., 1, 1] = -sw * sn + cw * ci * cn
    matrix[..., 1, 2] = cw * si
    matrix[..., 2, 0] = si * sn
    matrix[..., 2, 1] = -si * cn
    matrix[..., 2, 2] = ci
    return matrix


def pole_and_meridian(
    series: RotationSeries, tdb_s: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Right ascension and declination of the pole and prime-meridian angle W, rad, each (...).

    tdb_s  (...)  TDB seconds past J2000
    """
    time = np.asarray(tdb_s, dtype=np.float64)
    centuries = time / CENTURY_S
    ra = _polynomial(series.pole_ra_deg_by_century, centuries)
    dec = _polynomial(series.pole_dec_deg_by_century, centuries)
    meridian = _polynomial(series.meridian_deg_by_day, time / DAY_S)
    if series.terms:
        angles, amplitudes = _series_table(series)
        argument = _polynomial(angles, centuries[..., None])
        sines, cosines = np.sin(argument), np.cos(argument)
        ra = ra + sines @ amplitudes[0]
        dec = dec + cosines @ amplitudes[1]
        meridian = meridian + sines @ amplitudes[2]
    return np.radians(ra), np.radians(dec), np.radians(np.mod(meridian, 360.0))


def _held(correction: RotationCorrection, tdb_s: ArrayLike) -> NDArray[np.bool_]:
    """Whether each time lies in the years of the fit."""
    first, last = (year - J2000_YEAR for year in correction.years)
    years = np.asarray(tdb_s, dtype=np.float64) / JULIAN_YEAR_S
    return np.asarray((first <= years) & (years <= last))


def correction_angles(correction: RotationCorrection, tdb_s: ArrayLike) -> FloatArray:
    """Rotation vectors (..., 3), rad, body axes, by which the frame is turned on from the series.

    tdb_s  (...)  TDB seconds past J2000, in the years of the fit: beyond them this goes astray
    """
    centuries = np.asarray(tdb_s, dtype=np.float64)[..., None] / CENTURY_S
    slow, angles, amplitudes = _correction_table(correction)
    argument = _polynomial(angles, centuries)
    waves = np.concatenate([np.sin(argument), np.cos(argument)], axis=-1)
    return np.asarray((_polynomial(slow, centuries) + waves @ amplitudes) * ARCSEC)


def _turn(vectors: FloatArray) -> FloatArray:
    """Frame rotations (..., 3, 3) of rotation vectors (..., 3): the axes of vectors turn back.

    Rodrigues' formula, with the series of its two factors: below 0.01 rad they are exact.
    """
    squared = np.sum(vectors * vectors, axis=-1)[..., None, None]
    first = 1.0 - squared / 6.0 * (1.0 - squared / 20.0)
    second = 0.5 - squared / 24.0 * (1.0 - squared / 30.0)
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    cross = np.zeros((*vectors.shape, 3))
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -z, y, -x
    cross[..., 1, 0], cross[..., 2, 0], cross[..., 2, 1] = z, -y, x
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


@lru_cache
def _series_table(series: RotationSeries) -> tuple[FloatArray, FloatArray]:
    """Polynomials (3, n) of the terms' angles, rad, and amplitudes (3, n) of ra, dec, W, deg."""
    angles = np.radians([term.angle_deg_by_century for term in series.terms]).T
    amplitudes = [(term.ra_deg, term.dec_deg, term.meridian_deg) for term in series.terms]
    return np.ascontiguousarray(angles), np.ascontiguousarray(np.transpose(amplitudes))


@lru_cache
def _correction_table(correction: RotationCorrection) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Polynomials (3, axis), arcsec; angles' polynomials (3, n), rad; amplitudes (2n, axis)."""
    slow = (
        correction.x_arcsec_by_century,
        correction.y_arcsec_by_century,
        correction.z_arcsec_by_century,
    )
    angles = np.radians([term.angle_deg_by_century for term in correction.terms]).T
    sines = [term.sin_arcsec for term in correction.terms]
    cosines = [term.cos_arcsec for term in correction.terms]
    return np.transpose(slow), np.ascontiguousarray(angles), np.array([*sines, *cosines])


def _polynomial(coefficients: ArrayLike, t: FloatArray) -> FloatArray:
    constant, linear, quadratic = np.asarray(coefficients)
    return np.asarray(constant + t * (linear + t * quadratic))
