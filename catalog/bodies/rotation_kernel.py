"""Compiled rotation of a body: series of pole and prime meridian, and the turn that corrects them.

Orbits ask for it at every step, one time at a call: numpy takes 60 microseconds for the Moon's 133
terms, this about 10 (3 of them in the kernel). Angles of terms are polynomials (n, 3) in centuries,
rad.
"""

import math

from catalog.arrays import FloatArray
from catalog.bodies.epochs import DAY_S
from catalog.geometry.kernel import kernel

Axes = tuple[float, float, float]

CENTURY_S = 36525.0 * DAY_S
_DEGREE = math.pi / 180.0


@kernel
def _pole(t_s: float, slow: FloatArray, angles: FloatArray, amplitudes: FloatArray) -> Axes:
    """Right ascension and declination of the pole and prime meridian, rad.

    slow        (3, 3)  polynomials of the three, deg by centuries, centuries and days
    amplitudes  (n, 3)  deg, of sine, cosine and sine of the terms' angles
    """
    c, d = t_s / CENTURY_S, t_s / DAY_S
    ra = slow[0, 0] + c * (slow[0, 1] + c * slow[0, 2])
    dec = slow[1, 0] + c * (slow[1, 1] + c * slow[1, 2])
    # whole turns off before small terms are added: at 1e7 deg each sum would cost digits
    meridian = slow[2, 0] + d * (slow[2, 1] + d * slow[2, 2])
    meridian -= 360.0 * math.floor(meridian / 360.0)
    for i in range(angles.shape[0]):
        angle = angles[i, 0] + c * (angles[i, 1] + c * angles[i, 2])
        sine = math.sin(angle)
        ra += amplitudes[i, 0] * sine
        dec += amplitudes[i, 1] * math.cos(angle)
        meridian += amplitudes[i, 2] * sine
    return ra * _DEGREE, dec * _DEGREE, meridian * _DEGREE


@kernel
def _turn(t_s: float, slow: FloatArray, angles: FloatArray, amplitudes: FloatArray) -> Axes:
    """Rotation vector, rad, about body x, y, z.

    slow        (3, 3)     its slow part, axis by powers of centuries
    amplitudes  (n, 2, 3)  of sine and cosine of the terms' angles
    """
    c = t_s / CENTURY_S
    x = slow[0, 0] + c * (slow[0, 1] + c * slow[0, 2])
    y = slow[1, 0] + c * (slow[1, 1] + c * slow[1, 2])
    z = slow[2, 0] + c * (slow[2, 1] + c * slow[2, 2])
    for i in range(angles.shape[0]):
        angle = angles[i, 0] + c * (angles[i, 1] + c * angles[i, 2])
        sine, cosine = math.sin(angle), math.cos(angle)
        x += amplitudes[i, 0, 0] * sine + amplitudes[i, 1, 0] * cosine
        y += amplitudes[i, 0, 1] * sine + amplitudes[i, 1, 1] * cosine
        z += amplitudes[i, 0, 2] * sine + amplitudes[i, 1, 2] * cosine
    return x, y, z


@kernel
def rotate_by_series(
    times_s: FloatArray,
    slow: FloatArray,
    angles: FloatArray,
    amplitudes: FloatArray,
    out: FloatArray,
) -> None:
    """Write rotations (n, 3, 3) from inertial to body axes of times (n,)."""
    for i in range(times_s.shape[0]):
        ra, dec, meridian = _pole(times_s[i], slow, angles, amplitudes)
        # about z by 90 deg + ra, about x by 90 deg - dec, about z by the meridian, multiplied out
        cn, sn = -math.sin(ra), math.cos(ra)
        ci, si = math.sin(dec), math.cos(dec)
        cw, sw = math.cos(meridian), math.sin(meridian)
        m = out[i]
        m[0, 0], m[0, 1], m[0, 2] = cw * cn - sw * ci * sn, cw * sn + sw * ci * cn, sw * si
        m[1, 0], m[1, 1], m[1, 2] = -sw * cn - cw * ci * sn, -sw * sn + cw * ci * cn, cw * si
        m[2, 0], m[2, 1], m[2, 2] = si * sn, -si * cn, ci


@kernel
def turn_on(
    times_s: FloatArray,
    years_s: tuple[float, float],
    slow: FloatArray,
    angles: FloatArray,
    amplitudes: FloatArray,
    out: FloatArray,
) -> None:
    """Turn rotations (n, 3, 3) on by the correction where a time lies from years_s[0] to [1]."""
    for i in range(times_s.shape[0]):
        if not (years_s[0] <= times_s[i] <= years_s[1]):
            continue
        x, y, z = _turn(times_s[i], slow, angles, amplitudes)
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
