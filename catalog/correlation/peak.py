"""The peak of a correlation surface: sub-node place, covariance, best rival.

The surface near its peak is modelled as score - 1/2 d' H d. With the reference true up to gain
and the remainder of the image behaving as noise, the share of unexplained variance is
1 - score^2, and the covariance of the peak's place is (1 - score^2) / (score n_eff) H^-1, the
usual least-squares result written for correlation. n_eff counts independent samples: high-passed
terrain decorrelates over a few nodes, so it is far below the number of nodes.

That is quick and right for noise alone. Relief and albedo that a reference lacks are correlated
over many nodes: `refined_by_remainder` takes their spectrum from what the match leaves over.
"""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.geometry.kernel import kernel

# Nodes of high-passed lunar relief that share one independent brightness error: fitted to the
# errors of 900 matches on simulated frames, with scores from 0.4 to 0.97.
NODES_PER_SAMPLE = 1.6
# What a match leaves over is high-passed: beyond this it is correlated by chance alone.
CORRELATED_NODES = 28
# The spectrum of what is left over is known to the width that this taper of its correlation gives,
# and to a share of its mean: with less of either, few frequencies take all the weight.
LAG_NODES = 2.5
SPECTRUM_FLOOR = 0.5
# Waves are damped as by a blur of this sigma, nodes: the shortest ones are moved by local errors of
# the relief, which do not average. Chosen with the two above on 40 frames of real_unk_200km.
DAMPED_NODES = 0.6
# A rival nearer than this many nodes is the same peak.
RIVAL_DISTANCE = 5


class Match(NamedTuple):
    """Where a reference was found in a search grid.

    dx, dy      offset of the reference's centre from the search grid's centre, nodes;
                x along columns (east), y along rows (south)
    score       correlation at the peak, -1..1
    runner_up   the best score away from the peak, -1 when the search leaves no room for one
    covariance  (2, 2) of (dx, dy), nodes^2, from the curvature of the peak
    """

    dx: float
    dy: float
    score: float
    runner_up: float
    covariance: FloatArray


# Least-squares quadratic over a 3 x 3 neighbourhood: rows give 1, x, y, x^2, xy, y^2.
_X, _Y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
_QUADRATIC = np.linalg.pinv(
    np.stack([g.ravel() for g in (np.ones((3, 3)), _X, _Y, _X**2, _X * _Y, _Y**2)], axis=1)
)


def locate_peak(surface: Float32Array, nodes: int) -> Match:
    """Find the best place of a correlation surface.

    surface  (rows, cols)  score at integer offsets; the middle element is offset zero
             (both sides odd)
    nodes    how many nodes of the reference took part
    Returns the match; a peak on the surface's border has an infinite covariance, for it is no
    peak: the true place may lie outside.
    """
    row, col = (int(i) for i in np.unravel_index(int(np.argmax(surface)), surface.shape))
    dx, dy, best, runner_up, xx, xy, yy = _shape(np.ascontiguousarray(surface), row, col)
    covariance = np.array([[xx, xy], [xy, yy]])
    if np.isfinite(xx):
        samples = max(nodes / NODES_PER_SAMPLE, 1.0)
        covariance *= max(1.0 - best * best, 0.0) / (max(best, 0.05) * samples)
    rows, cols = surface.shape
    return Match(dx - cols // 2, dy - rows // 2, best, runner_up, covariance)


@kernel
def _shape(
    surface: Float32Array, row: int, col: int
) -> tuple[float, float, float, float, float, float, float]:
    """Sub-node place (x, y) of the peak at (row, col), its score, the runner-up, H^-1 (xx, xy, yy).

    H^-1 is that of `locate_peak`'s model; diagonal and infinite where the peak is none.
    """
    rows, cols = surface.shape
    best = float(surface[row, col])
    runner_up = _runner_up(surface, row, col)
    none = float(col), float(row), best, runner_up, np.inf, 0.0, np.inf
    if not (0 < row < rows - 1 and 0 < col < cols - 1):
        return none
    fit = np.zeros(6)
    for k in range(9):
        score = float(surface[row - 1 + k // 3, col - 1 + k % 3])
        for i in range(6):
            fit[i] += _QUADRATIC[i, k] * score
    gx, gy = fit[1], fit[2]
    xx, xy, yy = -2.0 * fit[3], -fit[4], -2.0 * fit[5]
    determinant = xx * yy - xy * xy
    if xx <= 0.0 or determinant <= 1e-12:
        return none
    xx, xy, yy = yy / determinant, -xy / determinant, xx / determinant
    # the true peak of a sampled surface lies within a node of its largest sample
    x = min(max(xx * gx + xy * gy, -0.75), 0.75)
    y = min(max(xy * gx + yy * gy, -0.75), 0.75)
    return col + x, row + y, best, runner_up, xx, xy, yy


@kernel
def _runner_up(surface: Float32Array, row: int, col: int) -> float:
    """Highest local maximum at least RIVAL_DISTANCE nodes from the peak; its slope is no rival."""
    rows, cols = surface.shape
    best = -1.0
    for r in range(1, rows - 1):
        for c in range(1, cols - 1):
            here = surface[r, c]
            if (
                here > best
                and max(abs(r - row), abs(c - col)) > RIVAL_DISTANCE
                and here >= surface[r - 1, c]
                and here >= surface[r + 1, c]
                and here >= surface[r, c - 1]
                and here >= surface[r, c + 1]
            ):
                best = float(here)
    return best


class Remainder(NamedTuple):
    """A match's place with what the two leave over for its error: see `refined_by_remainder`.

    shift       (2,) x, y, nodes, from where the template was laid
    covariance  (2, 2) of the place, nodes^2; infinite where the patch does not show the template
    """

    shift: FloatArray
    covariance: FloatArray


_LOADED = np.ones((4, 4)) + 1e-9 * np.eye(4)  # so little that no digit of a place hangs on it
NO_REMAINDER = Remainder(np.zeros(2), np.diag([np.inf, np.inf]))


def refined_by_remainder(
    template: Float32Array, slopes: Float32Array, patch: Float32Array, common: BoolArray
) -> Remainder:
    """A match's place by generalised least squares, weighted by what the two do not share.

    template, patch (n, n)  both high-passed, the template laid where it was found
    slopes (n, n, 2)        of the template, t_x and t_y
    common (n, n)           the nodes that both have

    The patch is fitted as p = a t + b t_x + c t_y + const; its rest is taken for an error of the
    patch that is correlated as it is. Its spectrum S, from its correlation tapered over LAG_NODES,
    weights a second fit: wavelengths that the two share count, those that terrain model, albedo or
    blur spoil do not. The place moves by -(b, c) / a, near the maximum likelihood of a delay
    (Hannan and Thomson, "Estimating group delay", Biometrika 60, 1973). With N the normal equations
    of that fit and J the covariance of its right side from the spectrum of the rest as it is, the
    place has N^-1 J N^-1 / a^2; infinite where a <= 0: the patch does not show the template.
    """
    # one kind of array, so that the kernels are compiled once
    template, patch = np.ascontiguousarray(template), np.ascontiguousarray(patch)
    slopes = np.ascontiguousarray(slopes)
    sums = _fit_sums(template, slopes, patch, common)
    # a template without contrast leaves an unknown open: then there is no gain
    if not sums.diagonal().min() > 1e-30:
        return NO_REMAINDER
    fit: FloatArray = np.linalg.solve(sums[:, :4] * _LOADED, sums[:, 4]).astype(np.float64)
    if not fit[1] > 0.0:
        return NO_REMAINDER
    # zeros about the grids keep opposite borders apart as far as errors are correlated
    side = cv2.getOptimalDFTSize(max(template.shape) + CORRELATED_NODES)
    both, pair = np.zeros((2, side, side, 2), np.float32)
    _lay_out(template, slopes, patch, common, fit, both, pair)
    of_slopes, of_pair = (
        np.asarray(cv2.dft(grid, nonzeroRows=template.shape[0]), np.float32)
        for grid in (both, pair)
    )
    # both are even, so that the transform is its own inverse
    correlation = _real_transform(_power(of_pair))
    spectrum = _real_transform(correlation * lag_taper(side)) / np.float32(common.sum() * side**2)
    normal, right, scatter = _weighted_sums(of_slopes, of_pair, spectrum)
    inverse = inverse_of_normal(normal)
    if inverse is None:
        return NO_REMAINDER
    gain, *moved = fit[1:] + inverse @ right
    if not gain > 0.0:
        return NO_REMAINDER
    covariance = inverse @ scatter @ inverse / (float(common.sum()) * gain**2)
    return Remainder(-np.array(moved) / gain, covariance[1:, 1:])


def inverse_of_normal(normal: FloatArray) -> FloatArray | None:
    """Inverse (n, n) of normal equations in units of their own; None where unknowns stay open."""
    size = np.sqrt(np.diag(normal))
    if not size.min() > 1e-12 * size.max():
        return None
    units = np.outer(size, size)
    scaled = normal / units
    if not np.linalg.det(scaled) > 1e-9:
        return None
    inverse: FloatArray = np.linalg.inv(scaled) / units
    return inverse


def _real_transform(even: Float32Array) -> Float32Array:
    """The transform (n, n) of a grid that is the same at opposite places; real as well."""
    whole = np.asarray(cv2.dft(even, flags=cv2.DFT_COMPLEX_OUTPUT), np.float32)
    return np.ascontiguousarray(whole[..., 0])


@cache
def lag_taper(side: int) -> Float32Array:
    """Weights (side, side) of a correlation by its lags, which wrap."""
    lag = np.minimum(np.arange(side), side - np.arange(side)) / LAG_NODES
    one = np.exp(-0.5 * lag * lag)
    return np.outer(one, one).astype(np.float32)


@kernel
def _fit_sums(
    template: Float32Array, slopes: Float32Array, patch: Float32Array, common: BoolArray
) -> FloatArray:
    """Normal equations of const, a, b, c and their right side (4, 5)."""
    rows, cols = template.shape
    # sums of 1, t, t_x, t_y by themselves and by p; one by one takes a third of the time
    n = s_t = s_x = s_y = s_p = 0.0
    tt = tx = ty = tp = xx = xy = xp = yy = yp = 0.0
    for r in range(rows):
        for c in range(cols):
            if not common[r, c]:
                continue
            t, p = float(template[r, c]), float(patch[r, c])
            x, y = float(slopes[r, c, 0]), float(slopes[r, c, 1])
            n += 1.0
            s_t += t
            s_x += x
            s_y += y
            s_p += p
            tt += t * t
            tx += t * x
            ty += t * y
            tp += t * p
            xx += x * x
            xy += x * y
            xp += x * p
            yy += y * y
            yp += y * p
    sums = np.empty((4, 5))
    sums[0, 0], sums[0, 1], sums[0, 2], sums[0, 3], sums[0, 4] = n, s_t, s_x, s_y, s_p
    sums[1, 0], sums[1, 1], sums[1, 2], sums[1, 3], sums[1, 4] = s_t, tt, tx, ty, tp
    sums[2, 0], sums[2, 1], sums[2, 2], sums[2, 3], sums[2, 4] = s_x, tx, xx, xy, xp
    sums[3, 0], sums[3, 1], sums[3, 2], sums[3, 3], sums[3, 4] = s_y, ty, xy, yy, yp
    return sums


@kernel
def _lay_out(
    template: Float32Array,
    slopes: Float32Array,
    patch: Float32Array,
    common: BoolArray,
    fit: FloatArray,
    both: Float32Array,
    pair: Float32Array,
) -> None:
    """Put slopes, and the template with what const, a, b, c leave over of the patch, into corners.

    both, pair  (m, m, 2) zeros, which stay where not common
    """
    rows, cols = template.shape
    for r in range(rows):
        for c in range(cols):
            if common[r, c]:
                shown = fit[0] + fit[1] * template[r, c]
                shown += fit[2] * slopes[r, c, 0] + fit[3] * slopes[r, c, 1]
                pair[r, c, 0], pair[r, c, 1] = template[r, c], patch[r, c] - shown
                both[r, c, 0], both[r, c, 1] = slopes[r, c, 0], slopes[r, c, 1]


@kernel
def _power(pair: Float32Array) -> Float32Array:
    """|R|^2 (n, n) of the transform (n, n, 2) of two real grids together, F = T + i R."""
    side = pair.shape[0]
    power = np.empty((side, side), np.float32)
    for i in range(side):
        m = side - i if i else 0
        for j in range(side):
            k = side - j if j else 0
            # R = (F - G*) / 2i with G = F of the mirror frequency
            real, imag = pair[i, j, 0] - pair[m, k, 0], pair[i, j, 1] + pair[m, k, 1]
            power[i, j] = np.float32(0.25) * (real * real + imag * imag)
    return power


@kernel
def _weighted_sums(
    slopes: Float32Array, pair: Float32Array, spectrum: Float32Array
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normal equations (3, 3), (3,) of the rest by template and slopes, over a spectrum.

    slopes, pair (n, n, 2) transforms of T_x + i T_y and of T + i R
    Returns also the covariance (3, 3) of the right side, for one node of n.
    """
    side = pair.shape[0]
    floor = SPECTRUM_FLOOR * spectrum.mean() + 1e-30  # of a perfect match nothing is left over
    damped = np.empty(side)
    for i in range(side):
        damping = 2.0 * np.pi * DAMPED_NODES * (min(i, side - i) / side)
        damped[i] = np.exp(-(damping * damping))
    sums, right = np.zeros((2, 6)), np.zeros(3)
    for i in range(side):
        m = side - i if i else 0
        for j in range(side):
            k = side - j if j else 0
            weight = damped[i] * damped[j] / (spectrum[i, j] + floor)
            # F and its mirror G* hold both of two real grids: (F + G*) / 2 and (F - G*) / 2i
            a, b, c, d = slopes[i, j, 0], slopes[i, j, 1], slopes[m, k, 0], slopes[m, k, 1]
            x_real, x_imag, y_real, y_imag = a + c, b - d, b + d, c - a
            a, b, c, d = pair[i, j, 0], pair[i, j, 1], pair[m, k, 0], pair[m, k, 1]
            t_real, t_imag, r_real, r_imag = a + c, b - d, b + d, c - a
            right[0] += weight * (t_real * r_real + t_imag * r_imag)
            right[1] += weight * (x_real * r_real + x_imag * r_imag)
            right[2] += weight * (y_real * r_real + y_imag * r_imag)
            tt, tx = t_real * t_real + t_imag * t_imag, t_real * x_real + t_imag * x_imag
            ty, xx = t_real * y_real + t_imag * y_imag, x_real * x_real + x_imag * x_imag
            xy, yy = x_real * y_real + x_imag * y_imag, y_real * y_real + y_imag * y_imag
            noise = 0.25 * weight * weight * (r_real * r_real + r_imag * r_imag)
            for n, share in ((0, weight), (1, noise)):
                sums[n, 0] += share * tt
                sums[n, 1] += share * tx
                sums[n, 2] += share * ty
                sums[n, 3] += share * xx
                sums[n, 4] += share * xy
                sums[n, 5] += share * yy
    scale = 0.25 / (side * side)
    normal, scatter = np.empty((3, 3)), np.empty((3, 3))
    n = 0
    for i in range(3):
        right[i] *= scale
        for j in range(i, 3):
            normal[i, j] = normal[j, i] = sums[0, n] * scale
            scatter[i, j] = scatter[j, i] = sums[1, n] * scale
            n += 1
    return normal, right, scatter
