"""Mean brightness of the columns of a lit cylinder's picture, by what is not known of it.

The terms of the light are Lambert's law, a departure from it (as Minnaert's law has it, in both
angles), rough facets as Oren and Nayar have them, and lobes of gloss.
"""

import math

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.kernel import inplace_kernel, kernel

STRIPS, DUSK_STRIPS = 48, 12  # of the seen surface that is lit by all, and by a part, of the source
DARKEST, STEEPEST = 0.02, 1.5  # least cosine under a logarithm, largest angle of a tangent
HALF_ROOT = math.sqrt(0.5)
REACH_SIGMAS = 6.5  # of the blur that are drawn
LOBES = (8, 20, 50)  # exponents of the lobes of gloss
LIT = 4 + len(LOBES)  # terms of the light: Lambert, two of Minnaert, rough facets, lobes


@inplace_kernel
def _compute_lit_terms(
    psi: float, middle: float, theta: float, source: float, terms: FloatArray
) -> None:
    """Compute brightness by each of the linear unknowns from the light on, into terms (LIT,).

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
    terms[0] = cosine
    terms[1] = cosine * math.log(max(cosine, DARKEST))
    terms[2] = cosine * math.log(max(emission, DARKEST))
    terms[3] = 0.0
    if (psi - theta) * (psi + middle) > 0.0:  # Oren and Nayar's share of rough facets
        from_light, from_normal = abs(psi - theta), abs(psi + middle)
        terms[3] = (
            cosine
            * math.sin(max(from_light, from_normal))
            * math.tan(min(from_light, from_normal, STEEPEST))
        )
    # half way between the directions to the light and to the camera
    half = max(math.cos(psi - 0.5 * (theta - middle)), 0.0)
    risen = min(max(0.5 + 0.5 * up / source, 0.0), 1.0)
    for k in range(len(LOBES)):
        terms[4 + k] = risen * half ** LOBES[k]


@kernel
def draw_columns(
    columns: FloatArray, state: FloatArray, radius: float, focal: float, centre: float
) -> FloatArray:
    """Draw the brightness (n, LIT + 2) of columns (n,) by each linear unknown.

    The lit surface is cut into strips from the terminator to the limb, finer where a part of the
    source has risen. Brightness is linear over each of them, and what of it a blurred column holds
    is written down in closed form, so that the result is smooth in all unknowns.
    """
    distance, axis, theta = state[0], state[1], state[2]
    blur, source = math.exp(state[3]), math.exp(state[4])
    brightness = np.zeros((columns.size, LIT + 2))
    brightness[:, 0] = 1.0
    widest = math.acos(radius / distance)
    limb = math.asin(radius / distance)
    low, high = centre + focal * math.tan(axis - limb), centre + focal * math.tan(axis + limb)
    edge, known = np.empty((columns.size, 2)), (0, 0)
    _add_strip(columns, low, high, blur, np.ones((2, 1)), brightness[:, 1:2], edge, known)
    side = 1.0 if theta >= 0.0 else -1.0
    # measured to the lit side, from the terminator on
    risen = min(max(abs(theta) - 0.5 * math.pi + source, -widest), widest)
    begun = min(max(abs(theta) - 0.5 * math.pi - source, -widest), widest)
    far = min(abs(theta) + 0.5 * math.pi + source, widest)
    ends, lit = np.empty((2, LIT)), brightness[:, 2:]
    last = 0.0
    for j in range(DUSK_STRIPS + STRIPS + 1):
        if j <= DUSK_STRIPS:
            psi = begun + (risen - begun) * j / DUSK_STRIPS
        else:
            psi = risen + (far - risen) * (j - DUSK_STRIPS) / STRIPS
        psi *= side
        middle = math.atan2(radius * math.sin(psi), distance - radius * math.cos(psi))
        fresh = centre + focal * math.tan(axis + middle)
        _compute_lit_terms(psi, middle, theta, source, ends[1])
        if j > 0 and (fresh - last) * side > 0.0:
            known = _add_strip(columns, last, fresh, blur, ends, lit, edge, known)
        else:
            known = 0, 0
        last = fresh
        ends[0] = ends[1]
    return brightness


@inplace_kernel
def _add_strip(
    columns: FloatArray,
    last: float,
    fresh: float,
    blur: float,
    ends: FloatArray,
    brightness: FloatArray,
    edge: FloatArray,
    known: tuple[int, int],
) -> tuple[int, int]:
    """Add a strip between two edges, px, whose k brightnesses (2, k) go from one to the other.

    last   the edge that it has in common with the strip before; fresh is the other one
    found  (n, k)
    edge   (n, 2) share and bell of the last edge for the columns from known[0] to known[1], those
           of the fresh one afterwards
    Returns the columns for which they are.
    """
    reach, side = REACH_SIGMAS * blur, 1.0 if fresh > last else -1.0
    begin = max(math.floor(min(last, fresh) - reach - columns[0]), 0)
    end = min(math.ceil(max(last, fresh) + reach - columns[0]) + 1, columns.size)
    for i in range(begin, end):
        if not known[0] <= i < known[1]:
            off = (last - columns[i]) / blur
            edge[i, 0], edge[i, 1] = math.erf(off * HALF_ROOT), math.exp(-0.5 * off * off)
        off = (fresh - columns[i]) / blur
        share, bell = math.erf(off * HALF_ROOT), math.exp(-0.5 * off * off)
        covered, bells = 0.5 * side * (share - edge[i, 0]), side * (edge[i, 1] - bell)
        edge[i, 0], edge[i, 1] = share, bell
        # the mean of how far along the strip the light of the column comes from
        along = bells * blur / math.sqrt(2.0 * math.pi) + (columns[i] - last) * covered
        along /= fresh - last
        for k in range(ends.shape[1]):
            brightness[i, k] += covered * ends[0, k] + along * (ends[1, k] - ends[0, k])
    return begin, end
