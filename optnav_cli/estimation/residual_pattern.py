"""Whether residuals follow a pattern along an arc that errors of single measurements do not make.

Residuals of one series (a star, an axis) are averaged over parts of the arc. The variance between
these means against that within the parts is Fisher's F of an analysis of variance, however much
larger the errors are than stated: Fisher, "Statistical Methods for Research Workers", 1925. Errors
smaller than stated count as stated: an orbit held by its prior then shows in all residuals, within
its own sigma. A fit that takes some of the pattern away makes F smaller, so the probability is an
upper bound.
"""

from collections.abc import Iterator

import numpy as np
from scipy.special import fdtrc

from catalog.arrays import FloatArray, IntArray

PARTS_OF_REVOLUTION = 8  # a force left out acts with the revolution, or half of it
MIN_IN_PART = 4.0  # residuals, in the mean: else parts are longer
MIN_PARTS = 4


def pattern_probability(
    values: FloatArray, series: IntArray, times: FloatArray, revolution_s: float
) -> float:
    """Compute the probability that chance makes residuals so alike in parts of an arc.

    values        (n,) residuals over their sigmas, as far as they err for themselves
    series        (n,) number of the series;  times (n,) s
    revolution_s  how long the motion takes for a revolution

    Returns 1 where there are too few to say.
    """
    parts = next(_parts(series, times, revolution_s), None)
    if parts is None:
        return 1.0
    group, count = parts
    means = np.bincount(group, values) / count
    between = float((count * means**2).sum())
    within = float(((values - means[group]) ** 2).sum())
    freedom = len(values) - len(count)
    if freedom < 1:
        return 1.0
    return float(fdtrc(len(count), freedom, between / len(count) / max(within / freedom, 1.0)))


def pattern_inflation(
    values: FloatArray, series: IntArray, times: FloatArray, revolution_s: float
) -> float:
    """Compute how much larger a covariance is by errors that go together as the residuals do.

    Means of n independent errors of one sigma have a variance of 1/n; the factor is the mean square
    of such means times n, in the series and the length of parts where it is largest: what an orbit
    is wrong by varies slowly, as they do. Arguments as of `pattern_probability`.

    Returns the factor of the covariance, at least 1.
    """
    factor = 1.0
    for group, count in _parts(series, times, revolution_s):
        means = np.bincount(group, values) / count
        of = np.zeros(len(count), np.int64)
        of[group] = series
        squares = np.bincount(of, count * means**2) / np.maximum(np.bincount(of), 1)
        factor = max(factor, float(squares.max()))
    return factor


def _parts(
    series: IntArray, times: FloatArray, revolution_s: float
) -> Iterator[tuple[IntArray, IntArray]]:
    """Number (n,) of the part and series of each residual, and their counts; longer parts next."""
    if not len(times):
        return
    since, width = times - times.min(), revolution_s / PARTS_OF_REVOLUTION
    while True:
        part = np.floor(since / width).astype(np.int64)
        if part.max() < MIN_PARTS - 1:
            return
        _, group = np.unique(np.stack([series, part], axis=1), axis=0, return_inverse=True)
        group = group.ravel()
        count = np.bincount(group)
        if len(times) >= MIN_IN_PART * len(count):
            yield group, count
        width *= 2.0
