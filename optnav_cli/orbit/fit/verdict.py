"""What the residuals of an orbit say of its fit: too much left out, refuted, or a remark."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from catalog.arrays import BoolArray, FloatArray
from catalog.errors import NoSolutionError

MEDIAN_OF_1, MEDIAN_OF_3 = 0.455, 2.366  # of a chi-square of one number, of three
REFUTED_PROBABILITY = 1e-6
MAX_LEFT_OUT = 1.0 / 3.0
MAX_SCATTER = 3.0  # times the stated sigmas, of the middle measurement
# Of the residuals to their sigmas; beyond it they refute the fit, below it is a remark: what stands
# for the field that is left out is right to some tens of percent.
MAX_RATIO = 1.5


@dataclass(frozen=True, eq=False)
class FitVerdict:
    """The residuals of an orbit's fit.

    what         the measurements, in words
    chi_squares  (n,) of each against all others;  median  of such a one by chance
    used         (n,) which of them the fit has
    chi_square, freedom  of the whole fit
    """

    what: str
    chi_squares: FloatArray
    median: float
    used: BoolArray
    chi_square: float
    freedom: int

    def remarks(self, advice: str, sized: str) -> list[str]:
        """Write the remarks about a fit that stands.

        advice  what may be wrong where it does not;  sized  whose size the scatter tells of
        Raises NoSolutionError where the residuals refute the fit.
        """
        refuted, count = "the residuals refute the fit", len(self.used)
        scatter = math.sqrt(float(np.median(self.chi_squares)) / self.median)
        if scatter > MAX_SCATTER:
            raise NoSolutionError(
                f"{refuted}: the middle one of {count} {self.what} lies {scatter:.3g} times its "
                f"sigma from the orbit of the others; {advice}"
            )
        out = int(np.count_nonzero(~self.used))
        if out > MAX_LEFT_OUT * count:
            raise NoSolutionError(
                f"{refuted}: {out} of {count} {self.what} would be left out; {advice}"
            )
        if self.freedom <= 0:
            return [f"the {self.what} leave nothing to test the orbit by"]
        ratio = math.sqrt(self.chi_square / self.freedom)
        probability = float(chdtrc(self.freedom, self.chi_square))
        if probability < REFUTED_PROBABILITY and ratio > MAX_RATIO:
            raise NoSolutionError(
                f"{refuted}: chi-square {self.chi_square:.0f} of {self.freedom}, {ratio:.2f} times "
                f"the stated sigmas; {advice}"
            )
        if min(probability, 1.0 - probability) < REFUTED_PROBABILITY:
            size = "small" if ratio > 1.0 else "large"
            return [
                f"the {self.what} scatter {ratio:.2f} times their stated sigmas: {sized} too {size}"
            ]
        return []
