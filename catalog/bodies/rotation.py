"""Orientation of a body in inertial space from its series of pole and prime meridian.

Source: Archinal et al., reports of the IAU Working Group on Cartographic Coordinates and Rotational
Elements, 2009 and 2015; the numbers live in configs/bodies. The lunar series differs from the ME
frame of DE421 by 80 m on average and 155 m at most at the surface (1997-2010), so the Moon's file
adds a correction that is fitted to that frame; `optnav study rotation` fits and checks it.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.bodies import rotation_kernel
from catalog.bodies.body import (
    J2000_YEAR,
    JULIAN_YEAR_S,
    Body,
    RotationCorrection,
    RotationSeries,
)
from catalog.geometry.rotations import ARCSEC


def body_from_inertial(body: Body, tdb_s: ArrayLike) -> FloatArray:
    """Rotation (..., 3, 3) taking inertial (ICRF) vectors to the body-fixed frame.

    tdb_s  (...)  TDB seconds past J2000
    """
    times = np.ascontiguousarray(tdb_s, dtype=np.float64).reshape(-1)
    rotations = np.empty((len(times), 3, 3))
    rotation_kernel.rotate_by_series(times, *_series_table(body.rotation), rotations)
    if body.rotation_correction is not None:
        rotation_kernel.turn_on(times, *_correction_table(body.rotation_correction), rotations)
    return rotations.reshape(*np.shape(tdb_s), 3, 3)


@lru_cache
def _series_table(series: RotationSeries) -> tuple[FloatArray, FloatArray, FloatArray]:
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
def _correction_table(
    correction: RotationCorrection,
) -> tuple[tuple[float, float], FloatArray, FloatArray, FloatArray]:
    """First and last time, s, slow part (3, 3), angles (n, 3), amplitudes (n, 2, 3), rad."""
    slow = (
        correction.x_arcsec_by_century,
        correction.y_arcsec_by_century,
        correction.z_arcsec_by_century,
    )
    first, last = ((year - J2000_YEAR) * JULIAN_YEAR_S for year in correction.years)
    angles = [term.angle_deg_by_century for term in correction.terms]
    amplitudes = [(term.sin_arcsec, term.cos_arcsec) for term in correction.terms]
    return (
        (first, last),
        np.array(slow) * ARCSEC,
        np.radians(np.reshape(angles, (-1, 3))),
        np.array(amplitudes, dtype=np.float64).reshape(-1, 2, 3) * ARCSEC,
    )
