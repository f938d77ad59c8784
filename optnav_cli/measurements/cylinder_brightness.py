"""Mean brightness of the columns of a lit cylinder's picture, by what is not known of it.

The terms of the light are Lambert's law, a departure from it (as Minnaert's law has it, in both
angles), rough facets as Oren and Nayar have them, and lobes of gloss.
"""

import math

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel

STRIPS, DUSK_STRIPS = 48, 12  # of the seen surface that is lit by all, and by a part, of the source
DARKEST, STEEPEST = 0.02, 1.5  # least cosine under a logarithm, largest angle of a tangent
HALF_ROOT = math.sqrt(0.5)
REACH_SIGMAS = 6.5  # of the blur that are drawn
LOBES = (8.0, 20.0, 50.0)  # exponents of the lobes of gloss
LIT = 4 + len(LOBES)  # terms of the light: Lambert, two of Minnaert, rough facets, lobes


@kernel
def _lit_brightness(
    psi: float, middle: float, theta: float, source: float, found: FloatArray
) -> None:
    """Brightness by each of the linear unknowns from the light on, into found (LIT,).

    psi, middle  of a lit point of the surface: its angle and its bearing from the axis
    source       half the width of the source, rad
    """
    emission = math.cos(psi + middle)
    # the mean over the source of the sine of its height, which may be a part of it alone; both
    # agree to the last digit where they meet, for the sake of the derivatives
    up = 0.5 * math.pi - abs(psi - theta)
    cosine = 0.0
    if up >= source:
        cosine = math.sin(up) * math.sin(source) / source
    elif up > -source:
        cosine = (1.0 - math.cos(up + source)) / (2.0 * source)
    found[0] = cosine
    found[1] = cosine * math.log(max(cosine, DARKEST))
    found[2] = cosine * math.log(max(emission, DARKEST))
    found[3] = 0.0
    if (psi - theta) * (psi + middle) > 0.0:  # Oren and Nayar's share of rough facets
        one, other = abs(psi - theta), abs(psi + middle)
        found[3] = cosine * math.sin(max(one, other)) * math.tan(min(one, other, STEEPEST))
    # half way between the directions to the light and to the camera
    half = max(math.cos(psi - 0.5 * (theta - middle)), 0.0)
    risen = min(max(0.5 + 0.5 * up / source, 0.0), 1.0)
    for k in range(len(LOBES)):
        found[4 + k] = risen * half ** LOBES[k]


@kernel
def drawn_columns(
    columns: FloatArray, state: FloatArray, radius: float, focal: float, centre: float
) -> FloatArray:
    """Brightness (n, LIT + 2) of columns (n,) by each linear unknown.

    The lit surface is cut into strips from the terminator to the limb, finer where a part of the
    source has risen. Brightness is linear over each of them, and what of it a blurred column holds
    is written down in closed form, so that the result is smooth in all unknowns.
    """
    distance, axis, theta = state[0], state[1], state[2]
    blur, source = math.exp(state[3]), math.exp(state[4])
    found = np.zeros((columns.size, LIT + 2))
    found[:, 0] = 1.0
    widest = math.acos(radius / distance)
    limb = math.asin(radius / distance)
    one = np.ones(1)
    low, high = centre + focal * math.tan(axis - limb), centre + focal * math.tan(axis + limb)
    _add_strip(columns, low, high, blur, one, one, found[:, 1:2])
    side = 1.0 if theta >= 0.0 else -1.0
    # measured to the lit side, from the terminator on
    risen = min(max(abs(theta) - 0.5 * math.pi + source, -widest), widest)
    begun = min(max(abs(theta) - 0.5 * math.pi - source, -widest), widest)
    far = min(abs(theta) + 0.5 * math.pi + source, widest)
    here, there = np.empty(LIT), np.empty(LIT)
    left = 0.0
    for j in range(DUSK_STRIPS + STRIPS + 1):
        if j <= DUSK_STRIPS:
            psi = begun + (risen - begun) * j / DUSK_STRIPS
        else:
            psi = risen + (far - risen) * (j - DUSK_STRIPS) / STRIPS
        psi *= side
        middle = math.atan2(radius * math.sin(psi), distance - radius * math.cos(psi))
        right = centre + focal * math.tan(axis + middle)
        _lit_brightness(psi, middle, theta, source, there)
        if j > 0 and side > 0.0:
            _add_strip(columns, left, right, blur, here, there, found[:, 2:])
        elif j > 0:
            _add_strip(columns, right, left, blur, there, here, found[:, 2:])
        left = right
        here[:] = there
    return found


@kernel
def _add_strip(
    columns: FloatArray,
    left: float,
    right: float,
    blur: float,
    here: FloatArray,
    there: FloatArray,
    found: FloatArray,
) -> None:
    """Add a strip from left to right, px, whose k brightnesses go from here to there, to (n, k)."""
    width = right - left
    if not width > 0.0:
        return
    reach = REACH_SIGMAS * blur
    begin = max(math.floor(left - reach - columns[0]), 0)
    end = min(math.ceil(right + reach - columns[0]) + 1, columns.size)
    for i in range(begin, end):
        low, high = (left - columns[i]) / blur, (right - columns[i]) / blur
        whole = 0.5 * (math.erf(high * HALF_ROOT) - math.erf(low * HALF_ROOT))
        bells = math.exp(-0.5 * low * low) - math.exp(-0.5 * high * high)
        # the mean of how far along the strip the light of the column comes from
        along = (bells * blur / math.sqrt(2.0 * math.pi) + (columns[i] - left) * whole) / width
        for k in range(here.size):
            found[i, k] += whole * here[k] + along * (there[k] - here[k])
