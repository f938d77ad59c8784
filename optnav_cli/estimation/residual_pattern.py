"""Whether residuals follow a pattern along an arc that errors of single measurements do not make.

Residuals of one series (a star, an axis) are averaged over parts of the arc. The variance between
these means against that within the parts is Fisher's F of an analysis of variance, however much
larger the errors are than stated: Fisher, "Statistical Methods for Research Workers", 1925. Errors
smaller than stated count as stated: an orbit held by its prior then shows in all residuals, within
its own sigma. A fit that takes some of the pattern away makes F smaller, so the probability is an
upper bound.
"""

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
    if not len(values):
        return 1.0
    since, width = times - times.min(), revolution_s / PARTS_OF_REVOLUTION
    while True:
        part = np.floor(since / width).astype(np.int64)
        _, place = np.unique(np.stack([series, part], axis=1), axis=0, return_inverse=True)
        place = place.ravel()
        count = np.bincount(place)
        if part.max() < MIN_PARTS - 1:
            return 1.0
        if len(values) >= MIN_IN_PART * len(count):
            break
        width *= 2.0
    means = np.bincount(place, values) / count
    between = float((count * means**2).sum())
    within = float(((values - means[place]) ** 2).sum())
    freedom = len(values) - len(count)
    if freedom < 1:
        return 1.0
    return float(fdtrc(len(count), freedom, between / len(count) / max(within / freedom, 1.0)))
