"""Pull and gradient of a body's field, compiled: Cunningham's solid harmonics, fully normalised.

Derivatives of solid harmonics are solid harmonics one degree up (Cunningham, Celest. Mech. 2, 1970;
Montenbruck and Gill, "Satellite Orbits", 3.2.5), so coefficients are shifted once, and pull and
gradient are sums with the same harmonics. Of these, V_nm + i W_nm = (V_mm + i W_mm) h_nm with h
real: the sums over degree run on h alone, an order after the other.
"""

import math

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel
from optnav_cli.dynamics.gravity_field import HarmonicField

Coefficients = tuple[FloatArray, FloatArray]
Table = tuple[FloatArray, FloatArray]

# The variational equations need fewer degrees than the path: without degrees 21 to 50 a transition
# at 100 km over the Moon is 0.1 % off after 2 hours, 0.4 % after 12.
GRADIENT_DEGREE = 20


def harmonic_tables(field: HarmonicField, degree: int) -> tuple[Table, Table]:
    """Pack recursions, coefficients and sectorial factors for `pull` and `gradient`.

    degree  of the gradient, at most
    """
    unit = np.zeros_like(field.c), np.zeros_like(field.s)
    for array, source in zip(unit, (field.c, field.s), strict=True):
        array[2:] = source[2:]
    first = [_along_x(*unit), _along_y(*unit), _along_z(*unit)]
    low = tuple(array[: degree + 1, : degree + 1] for array in unit)
    x, z = _along_x(*low), _along_z(*low)
    # yy is -(xx + zz), by Laplace
    second = [_along_x(*x), _along_y(*x), _along_x(*z), _along_y(*z), _along_z(*z)]
    return _packed(first), _packed(second)


def _packed(parts: list[Coefficients]) -> Table:
    """A row [a, b, C, S, C, S...] of each degree and order, an order after the other; factors."""
    top = len(parts[0][0]) - 1
    rows = []
    for m in range(top + 1):
        n = np.arange(m, top + 1, dtype=np.float64)
        row = np.zeros((len(n), 2 + 2 * len(parts)))
        if len(n) > 1:
            above, sums, gaps = n[1:], n[1:] + m, n[1:] - m
            row[1:, 0] = np.sqrt((2.0 * above + 1.0) * (2.0 * above - 1.0) / (gaps * sums))
            share = (2.0 * above + 1.0) * (sums - 1.0) * (gaps - 1.0) / (gaps * sums)
            row[2:, 1] = np.sqrt(share[1:] / (2.0 * above[1:] - 3.0))
        for number, (c, s) in enumerate(parts):
            row[:, 2 + 2 * number] = c[m:, m]
            row[:, 3 + 2 * number] = s[m:, m]
        rows.append(row)
    orders = np.arange(1.0, top + 1.0)
    factors = np.concatenate([[1.0], np.sqrt((2.0 * orders + 1.0) / (2.0 * orders))])
    factors[1:2] = math.sqrt(3.0)
    # one row more, which the loop reads and does not use
    rows.append(np.zeros((1, rows[0].shape[1])))
    return np.concatenate(rows), factors


def _grid(c: FloatArray) -> tuple[FloatArray, FloatArray]:
    n = np.arange(len(c), dtype=np.float64)
    return np.meshgrid(n, n, indexing="ij")


def _shifted(c: FloatArray, step: int, factor: FloatArray) -> FloatArray:
    """Coefficients (N + 2, N + 2), a degree up and `step` orders on, times a factor."""
    size = len(c) + 1
    out = np.zeros((size, size + 1))
    moved = np.where(factor == 0.0, 0.0, factor * c)
    if step < 0:
        out[1:, : size - 2] = moved[:, 1:]
    else:
        out[1:, step : step + size - 1] = moved
    return np.ascontiguousarray(out[:, :size])


def _up(c: FloatArray) -> FloatArray:
    """To order m + 1: -1/2 (-1 from order 0) and the ratio of both norms."""
    n, m = _grid(c)
    share = (2.0 * n + 1.0) / (2.0 * n + 3.0) * (n + m + 1.0) * (n + m + 2.0)
    # from order 0 the norm grows by sqrt(2), and the whole goes up instead of its half
    ratio = np.sqrt(share) * np.where(m == 0, math.sqrt(0.5), 0.5)
    return np.where(m <= n, -ratio, 0.0)


def _down(c: FloatArray) -> FloatArray:
    """To order m - 1: (n - m + 2)(n - m + 1)/2 and the ratio of both norms."""
    n, m = _grid(c)
    gap = np.maximum(n - m, 0.0)
    share = (2.0 * n + 1.0) / (2.0 * n + 3.0) * (gap + 1.0) * (gap + 2.0)
    ratio = 0.5 * np.sqrt(share) * np.where(m == 1, math.sqrt(2.0), 1.0)
    return np.where((m >= 1) & (m <= n), ratio, 0.0)


def _along_x(c: FloatArray, s: FloatArray) -> Coefficients:
    up, down = _up(c), _down(c)
    return (
        _shifted(c, 1, up) + _shifted(c, -1, down),
        _shifted(s, 1, np.where(_grid(c)[1] == 0, 0.0, up)) + _shifted(s, -1, down),
    )


def _along_y(c: FloatArray, s: FloatArray) -> Coefficients:
    up, down = _up(c), _down(c)
    inner = np.where(_grid(c)[1] == 0, 0.0, up)
    return (
        _shifted(s, 1, -inner) + _shifted(s, -1, down),
        _shifted(c, 1, up) - _shifted(c, -1, down),
    )


def _along_z(c: FloatArray, s: FloatArray) -> Coefficients:
    n, m = _grid(c)
    gap = np.maximum(n - m, 0.0)
    share = (2.0 * n + 1.0) / (2.0 * n + 3.0) * (gap + 1.0) * (n + m + 1.0)
    down = np.where(m <= n, -np.sqrt(share), 0.0)
    return _shifted(c, 0, down), _shifted(s, 0, down)


@kernel
def pull(place: FloatArray, scale: tuple[float, float], table: Table, out: FloatArray) -> None:
    """Write the pull (3,) of degrees 2 and up at a place (3,), axes of the field, m/s^2.

    scale  GM, m^3/s^2, and R, m
    """
    rows, factors = table
    gm, radius = scale
    x, y, z = place[0], place[1], place[2]
    share = radius / (x * x + y * y + z * z)
    x, y, z, square = x * share, y * share, z * share, radius * share
    v, w = math.sqrt(square), 0.0
    ax = ay = az = 0.0
    top, k = factors.shape[0], 0
    # two orders at once: each sum waits for its own last term alone
    for m in range(0, top, 2):
        if m > 0:
            v, w = factors[m] * (x * v - y * w), factors[m] * (x * w + y * v)
        p = k + top - m
        xc, xs, yc = rows[k, 2], rows[k, 3], rows[k, 4]
        ys, zc, zs = rows[k, 5], rows[k, 6], rows[k, 7]
        k += 1
        f1, f, g1, g = 1.0, rows[k, 0] * z, 0.0, 1.0
        xc2 = xs2 = yc2 = ys2 = zc2 = zs2 = 0.0
        for _ in range(m + 1, top):
            xc += rows[k, 2] * f
            xs += rows[k, 3] * f
            yc += rows[k, 4] * f
            ys += rows[k, 5] * f
            zc += rows[k, 6] * f
            zs += rows[k, 7] * f
            xc2 += rows[p, 2] * g
            xs2 += rows[p, 3] * g
            yc2 += rows[p, 4] * g
            ys2 += rows[p, 5] * g
            zc2 += rows[p, 6] * g
            zs2 += rows[p, 7] * g
            k += 1
            p += 1
            f1, f = f, rows[k, 0] * z * f - rows[k, 1] * square * f1
            g1, g = g, rows[p, 0] * z * g - rows[p, 1] * square * g1
        ax += v * xc + w * xs
        ay += v * yc + w * ys
        az += v * zc + w * zs
        if m + 1 < top:
            v, w = factors[m + 1] * (x * v - y * w), factors[m + 1] * (x * w + y * v)
            ax += v * xc2 + w * xs2
            ay += v * yc2 + w * ys2
            az += v * zc2 + w * zs2
        k = p
    unit = gm / (radius * radius)
    out[0], out[1], out[2] = unit * ax, unit * ay, unit * az


@kernel
def gradient(place: FloatArray, scale: tuple[float, float], table: Table, out: FloatArray) -> None:
    """Write the derivative (3, 3) of the pull of degrees 2 and up by the place, 1/s^2."""
    rows, factors = table
    gm, radius = scale
    x, y, z = place[0], place[1], place[2]
    share = radius / (x * x + y * y + z * z)
    x, y, z, square = x * share, y * share, z * share, radius * share
    v, w = math.sqrt(square), 0.0
    xx = xy = xz = yz = zz = 0.0
    top, k = factors.shape[0], 0
    for m in range(top):
        if m > 0:
            v, w = factors[m] * (x * v - y * w), factors[m] * (x * w + y * v)
        h1, h = 0.0, 1.0
        for _ in range(m, top):
            vh, wh = v * h, w * h
            xx += rows[k, 2] * vh + rows[k, 3] * wh
            xy += rows[k, 4] * vh + rows[k, 5] * wh
            xz += rows[k, 6] * vh + rows[k, 7] * wh
            yz += rows[k, 8] * vh + rows[k, 9] * wh
            zz += rows[k, 10] * vh + rows[k, 11] * wh
            k += 1
            h1, h = h, rows[k, 0] * z * h - rows[k, 1] * square * h1
    unit = gm / (radius * radius * radius)
    out[0, 0], out[1, 1], out[2, 2] = unit * xx, -unit * (xx + zz), unit * zz
    out[0, 1] = out[1, 0] = unit * xy
    out[0, 2] = out[2, 0] = unit * xz
    out[1, 2] = out[2, 1] = unit * yz
