"""A match refined by what it leaves over: place and covariance by weighted least squares.

Relief and albedo that a reference lacks are correlated over many nodes. `refine_by_remainder` takes
their spectrum from the residual of the match and weights a second fit by it.
"""

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
import scipy.fft

from catalog.arrays import Float32Array, FloatArray
from catalog.correlation.peak import Match
from catalog.geometry.kernel import inplace_kernel, kernel

# What a match leaves over is high-passed: beyond this it is correlated by chance alone.
CORRELATED_NODES = 28
# The spectrum of what is left over is known to the width that this taper of its correlation gives,
# and to a share of its mean: with less of either, few frequencies take all the weight.
LAG_NODES = 2.5
SPECTRUM_FLOOR = 0.5
MAX_LAG = 15  # beyond it the taper is below 2e-9
# Waves are damped as by a blur of this sigma, nodes: the shortest ones are moved by local errors of
# the relief, which do not average. Chosen with the two above on 40 frames of real_unk_200km.
DAMPED_NODES = 0.6
# Nodes about one that `place_patterns` needs.
REACH = 4
# Coefficients by power of the polynomial through nodes -2 to 3.
_THROUGH_SIX = np.linalg.inv(np.vander(np.arange(-2.0, 4.0), increasing=True))


class Remainder(NamedTuple):
    """A match's place with what the two leave over for its error: see `refine_by_remainder`.

    shift       (2,) x, y, nodes, from where the template was laid
    covariance  (2, 2) of the place, nodes^2; infinite where the patch does not show the template
    """

    shift: FloatArray
    covariance: FloatArray


LOAD = 1e-9  # on the diagonal of normal equations; so little that no digit of a place hangs on it
NO_REMAINDER = Remainder(np.zeros(2), np.diag([np.inf, np.inf]))


class Prior(NamedTuple):
    """The prior of a pattern: its strength over the template's gain."""

    pattern: int
    mean: float
    sigma: float


class WeightedFit(NamedTuple):
    """A patch fitted by patterns and weighted by what they leave over, before priors of theirs.

    first (k,)   strengths of a fit in which all nodes count alike
    normal, right (k - 1, k - 1), (k - 1,)  equations of the steps from there, of the template on
    scatter      covariance (k - 1, k - 1) of the right side
    """

    first: FloatArray
    normal: FloatArray
    right: FloatArray
    scatter: FloatArray

    def solve_with_priors(
        self, priors: Sequence[Prior] = ()
    ) -> tuple[FloatArray, FloatArray] | None:
        """Strengths (k - 1,) from the template on, their covariance; None: no template is shown."""
        normal, right, scatter = self.normal.copy(), self.right.copy(), self.scatter.copy()
        for pattern, mean, sigma in priors:
            k, weight = pattern - 1, 1.0 / (sigma * self.first[1]) ** 2
            right[k] += weight * (mean * self.first[1] - self.first[pattern])
            normal[k, k] += weight
            scatter[k, k] += weight
        known, strengths, covariance = _solve_steps(self.first, normal, right, scatter)
        return (strengths, covariance) if known else None

    def remainder(self, priors: Sequence[Prior] = ()) -> Remainder:
        """The place that the strengths give."""
        solution = self.solve_with_priors(priors)
        if solution is None:
            return NO_REMAINDER
        (gain, *moved), covariance = solution[0][:3], solution[1][1:3, 1:3]
        return Remainder(-np.array(moved) / gain, covariance / gain**2)


def refine_by_remainder(patterns: Float32Array, patch: Float32Array, nodes: int) -> Remainder:
    """A match's place by generalised least squares, weighted by what the two do not share.

    patterns (k, n, n)  1, the template laid where it was found, its slopes t_x and t_y, and what
                        else the patch may show; high-passed, and zero where it is not compared
    patch (n, n)        as the patterns
    nodes               how many are compared

    The patch is fitted as p = const + a t + b t_x + c t_y + ...; its rest is taken for an error of
    the patch that is correlated as it is. Its spectrum S, from its correlation tapered over
    LAG_NODES, weights a second fit: wavelengths that the two share count, those that terrain model,
    albedo or blur spoil do not. The place moves by -(b, c) / a, near the maximum likelihood of a
    delay (Hannan and Thomson, "Estimating group delay", Biometrika 60, 1973). With N the normal
    equations of that fit and J the covariance of its right side from the spectrum of the rest as it
    is, the place has N^-1 J N^-1 / a^2; infinite where a <= 0: the patch does not show the
    template.
    """
    fit = fit_weighted(patterns, patch, nodes)
    return NO_REMAINDER if fit is None else fit.remainder()


def fit_weighted(patterns: Float32Array, patch: Float32Array, nodes: int) -> WeightedFit | None:
    """The fit of `refine_by_remainder`; None where the patch does not show the template."""
    patterns, patch = np.ascontiguousarray(patterns), np.ascontiguousarray(patch)
    first, grids = _fit_first(patterns, patch)
    if not first[1] > 0.0:
        return None
    # zeros about the grids keep opposite borders apart as far as errors are correlated
    side = cv2.getOptimalDFTSize(patch.shape[0] + CORRELATED_NODES)
    waves = scipy.fft.rfft2(grids, s=(side, side)).view(np.float32)
    power = _compute_power(waves[-1])
    spectrum, mean = _smooth_spectrum(power)
    # a perfect match leaves nothing
    floor = SPECTRUM_FLOOR * mean / nodes + 1e-30
    return WeightedFit(first, *_sum_weighted(waves, power, spectrum, floor, nodes))


def fit_plain(patterns: Float32Array, patch: Float32Array) -> FloatArray | None:
    """Fit the amplitudes (k,) of patterns (k, n, n) in a patch (n, n); None if one is absent."""
    strengths = _fit_strengths(np.ascontiguousarray(patterns), np.ascontiguousarray(patch))
    return strengths if np.isfinite(strengths).all() else None


@kernel
def _fit_first(patterns: Float32Array, patch: Float32Array) -> tuple[FloatArray, Float32Array]:
    """Return strengths (k,) of `_fit_strengths`; all patterns but the first, and the residual."""
    strengths, grids = _fit_strengths(patterns, patch), np.empty_like(patterns)
    grids[:-1] = patterns[1:]
    grids[-1] = subtract_patterns(patterns, patch, strengths)
    return strengths, grids


@kernel
def _fit_strengths(patterns: Float32Array, patch: Float32Array) -> FloatArray:
    """Strengths (k,) of `fit_plain`; NaN where a pattern is nowhere."""
    count, (rows, cols) = len(patterns), patch.shape
    normal, right = np.empty((count, count)), np.empty(count)
    # a sum a column, so that products are not added one after the other
    columns = np.empty(cols)
    for a in range(count):
        for b in range(a, count + 1):
            other = patterns[b] if b < count else patch
            columns[:] = 0.0
            for r in range(rows):
                for c in range(cols):
                    columns[c] += float(patterns[a, r, c]) * float(other[r, c])
            if b < count:
                normal[a, b] = normal[b, a] = columns.sum()
            else:
                right[a] = columns.sum()
    strengths, least = np.zeros(count), np.inf
    for a in range(count):
        least = min(least, normal[a, a])
    inverse = np.empty((count, count))
    if not (least > 1e-30 and _invert(normal, LOAD, inverse) > 0.0):
        strengths[:] = np.nan
        return strengths
    for a in range(count):
        for b in range(count):
            strengths[a] += inverse[a, b] * right[b]
    return strengths


@inplace_kernel
def _invert(normal: FloatArray, load: float, inverse: FloatArray) -> float:
    """Fill the inverse (n, n) of normal equations, solved in units of their own.

    load  added to the diagonal, which is 1 in these units
    Returns the determinant in these units, 0 where there is no inverse.
    """
    count = len(normal)
    for i in range(count):
        for j in range(count):
            inverse[i, j] = normal[i, j] / np.sqrt(normal[i, i] * normal[j, j])
        inverse[i, i] += load
    determinant = 1.0
    for k in range(count):  # Gauss and Jordan; what is positive definite needs no pivots
        pivot = inverse[k, k]
        if not pivot > 0.0:
            return 0.0
        determinant *= pivot
        inverse[k, k] = 1.0
        for j in range(count):
            inverse[k, j] /= pivot
        for i in range(count):
            if i != k:
                factor = inverse[i, k]
                inverse[i, k] = 0.0
                for j in range(count):
                    inverse[i, j] -= factor * inverse[k, j]
    for i in range(count):
        for j in range(count):
            inverse[i, j] /= np.sqrt(normal[i, i] * normal[j, j])
    return determinant


@kernel
def _solve_steps(
    first: FloatArray, normal: FloatArray, right: FloatArray, scatter: FloatArray
) -> tuple[bool, FloatArray, FloatArray]:
    """Strengths and covariance of `WeightedFit.solve_with_priors`, and whether they are known."""
    count = right.size
    strengths, covariance = first[1:].copy(), np.zeros((count, count))
    inverse = np.empty((count, count))
    least = most = normal[0, 0]
    for i in range(1, count):
        least, most = min(least, normal[i, i]), max(most, normal[i, i])
    # in roots, which the sizes of the unknowns go by
    if not least > 1e-24 * most or not _invert(normal, 0.0, inverse) > 1e-9:
        return False, strengths, covariance
    for i in range(count):
        for j in range(count):
            strengths[i] += inverse[i, j] * right[j]
            for k in range(count):
                for m in range(count):
                    covariance[i, m] += inverse[i, j] * scatter[j, k] * inverse[k, m]
    return strengths[0] > 0.0, strengths, covariance


@kernel
def _compute_power(waves: Float32Array) -> Float32Array:
    """Squares (n, m) of waves (n, 2 m), real and imaginary in turn."""
    rows, cols = waves.shape[0], waves.shape[1] // 2
    power = np.empty((rows, cols), np.float32)
    for i in range(rows):
        for j in range(cols):
            real, imaginary = waves[i, 2 * j], waves[i, 2 * j + 1]
            power[i, j] = real * real + imaginary * imaginary
    return power


def _smooth_spectrum(power: Float32Array) -> tuple[Float32Array, float]:
    """A power spectrum (n, n // 2 + 1) as its correlation's taper by lags leaves it; its mean.

    By the few lags that the taper leaves, to which and back matrices are quicker than transforms.
    """
    side, half = power.shape
    # the columns stand for those of the other half of the plane too
    folded = power * _count_columns_meant(side)
    # of a row and a column that both turn to their opposites the sines' product stays, but the
    # power's opposite is itself: cosines go with cosines alone, and sines with sines
    smooth = np.zeros_like(power)
    for waves in _make_lag_waves(side):
        along = waves[:, :half]
        smooth += waves.T @ ((waves @ folded @ along.T) @ along)
    return smooth, float(folded.sum()) / side**2


@cache
def _count_columns_meant(side: int) -> Float32Array:
    """Count the columns of a full spectrum that each of a half one (side // 2 + 1,) stands for."""
    meant = np.full(side // 2 + 1, 2.0, np.float32)
    meant[0] = 1.0
    if side % 2 == 0:
        meant[-1] = 1.0
    return meant


@cache
def _make_lag_waves(side: int) -> Float32Array:
    """Cosines and sines (2, MAX_LAG + 1, side) of lags by frequency, with the root of the taper."""
    lags = np.arange(min(MAX_LAG, (side - 1) // 2) + 1)
    taper = np.exp(-0.25 * (lags / LAG_NODES) ** 2) * np.sqrt(np.where(lags == 0, 1.0, 2.0) / side)
    angles = 2.0 * np.pi / side * np.outer(lags, np.arange(side))
    waves: FloatArray = taper[:, None] * np.stack([np.cos(angles), np.sin(angles)])
    return waves.astype(np.float32)


@kernel
def subtract_patterns(
    patterns: Float32Array, patch: Float32Array, strengths: FloatArray
) -> Float32Array:
    """Subtract patterns (k, n, m) of some amplitudes (k,) from a patch (n, m)."""
    count, rows, cols = patterns.shape
    residual = patch.copy()
    for k in range(count):
        strength = np.float32(strengths[k])
        for r in range(rows):
            for c in range(cols):
                residual[r, c] -= strength * patterns[k, r, c]
    return residual


@kernel
def _sum_weighted(
    waves: Float32Array, power: Float32Array, spectrum: Float32Array, floor: float, nodes: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Normal equations (k, k), (k,) of a rest by patterns, weighted by a spectrum.

    waves (k + 1, n, 2 m)   transforms of the patterns and the rest, real and imaginary in turn
    power, spectrum (n, m)  of the rest, as it is and smooth; for one of the nodes compared a floor
                            is added to the latter
    Returns also the covariance (k, k) of the right side.
    """
    count, side, cols = waves.shape[0] - 1, spectrum.shape[0], spectrum.shape[1]
    damped, share = np.empty(side), np.empty((2, cols))
    for i in range(side):
        damping = 2.0 * np.pi * DAMPED_NODES * (min(i, side - i) / side)
        damped[i] = np.exp(-(damping * damping))
    row = np.empty((count + 1, 2, cols))
    sums = np.zeros((count, count + 1, 2, cols))  # a sum a column
    for i in range(side):
        for j in range(cols):
            weight = damped[i] * damped[j] / (spectrum[i, j] / nodes + floor)
            # the columns stand for those of the other half of the plane too
            twice = 1.0 if j == 0 or 2 * j == side else 2.0
            share[0, j], share[1, j] = twice * weight, twice * weight * weight * power[i, j]
        for k in range(count + 1):
            for j in range(cols):
                row[k, 0, j], row[k, 1, j] = waves[k, i, 2 * j], waves[k, i, 2 * j + 1]
        for a in range(count):
            for b in range(a, count + 1):
                for j in range(cols):
                    both = row[a, 0, j] * row[b, 0, j] + row[a, 1, j] * row[b, 1, j]
                    sums[a, b, 0, j] += share[0, j] * both
                    sums[a, b, 1, j] += share[1, j] * both
    normal, scatter, right = np.empty((count, count)), np.empty((count, count)), np.empty(count)
    scale = 1.0 / (side * side)
    for a in range(count):
        right[a] = sums[a, count, 0].sum() * scale
        for b in range(a, count):
            normal[a, b] = normal[b, a] = sums[a, b, 0].sum() * scale
            scatter[a, b] = scatter[b, a] = sums[a, b, 1].sum() * (scale / nodes)
    return normal, right, scatter


def place_patterns(
    match: Match, template: Float32Array, margin_nodes: int, others: Sequence[Float32Array] = ()
) -> Float32Array:
    """Patterns (4 + k, n, n) of `refine_by_remainder`, laid where a template was found.

    template, others  k of them, high-passed, with a margin that is taken off
    By polynomials through six nodes a side: slopes of neighbours' differences would be too small
    for short waves, which move a place by too much.
    """
    along, down = (_weigh_six_nodes(np.rint(by) - by) for by in (match.dx, match.dy))
    shape = tuple(side - 2 * margin_nodes for side in template.shape)
    if margin_nodes < REACH:
        padded = [np.pad(grid, REACH, mode="reflect") for grid in (template, *others)]
        template, others = padded[0], padded[1:]
        margin_nodes += REACH
    laid = np.ones((4 + len(others), *shape), np.float32)
    moved = np.empty((shape[0] + 5, shape[1]), np.float32)
    _place_pattern(template, margin_nodes, along, down, moved, laid[1:4])
    for number, other in enumerate(others):
        _place_pattern(other, margin_nodes, along, down, moved, laid[4 + number : 5 + number])
    return laid


@inplace_kernel
def _place_pattern(
    grid: Float32Array,
    margin: int,
    along: tuple[int, Float32Array],
    down: tuple[int, Float32Array],
    moved: Float32Array,
    laid: Float32Array,
) -> None:
    """Fill in a grid, moved by weights of `_weigh_six_nodes` along rows and columns; its slopes.

    moved (n + 5, m)     to work in
    laid (1 or 3, n, m)  the grid without its margin, then its slopes to x and y where they fit
    """
    count, rows, cols = laid.shape
    left, top = margin + along[0], margin + down[0]
    for k in range(count):
        w = along[1][1 if k == 1 else 0]
        # as single numbers, which no array that is filled can change
        u, v, x, y, z, o = w[0], w[1], w[2], w[3], w[4], w[5]
        for r in range(rows + 5):
            to = moved[r]
            a, b = grid[top + r, left:], grid[top + r, left + 1 :]
            d, e = grid[top + r, left + 2 :], grid[top + r, left + 3 :]
            f, g = grid[top + r, left + 4 :], grid[top + r, left + 5 :]
            for c in range(cols):
                to[c] = u * a[c] + v * b[c] + x * d[c] + (y * e[c] + z * f[c] + o * g[c])
        w = down[1][1 if k == 2 else 0]
        u, v, x, y, z, o = w[0], w[1], w[2], w[3], w[4], w[5]
        for r in range(rows):
            to = laid[k, r]
            a, b, d = moved[r], moved[r + 1], moved[r + 2]
            e, f, g = moved[r + 3], moved[r + 4], moved[r + 5]
            for c in range(cols):
                to[c] = u * a[c] + v * b[c] + x * d[c] + (y * e[c] + z * f[c] + o * g[c])


@kernel
def _weigh_six_nodes(shift: float) -> tuple[int, Float32Array]:
    """Which node, from one on, is the first of six, and their weights for value and slope (2, 6).

    shift  where value and slope are wanted, nodes from that one; less than two
    """
    node0 = int(np.floor(shift))
    weights = np.empty((2, 6), np.float32)
    for node in range(6):
        value = slope = 0.0
        for power in range(5, -1, -1):  # by Horner's rule, the slope beside the value
            slope = slope * (shift - node0) + value
            value = value * (shift - node0) + _THROUGH_SIX[power, node]
        weights[0, node], weights[1, node] = value, slope
    return node0 - 2, weights
