"""A position's correction from angles beside a silhouette of any shape.

The caller predicts the silhouette anew after each step. Robust weights are Tukey's, about a width
that follows the scatter: wide while the position is far off, narrow in the end.
"""

from operator import add

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.estimation.consider import azimuth_correlated
from optnav_cli.estimation.least_squares import (
    Estimate,
    Iteration,
    Linearisation,
    linearised,
    solve,
)
from optnav_cli.estimation.models.limb import MIN_LIMB_POINTS
from optnav_cli.estimation.robust import TUKEY, scatter, tukey_weights
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

ROUNDS = 6  # of weights and solution; later ones change a thousandth of a sigma
# Of weights that are given: the step that they make is the only one.
_OPEN = Reason(ReasonCode.DEGENERATE, "the limb points leave a direction of the position open")
ONE_STEP = Iteration(1, np.inf, undetermined=_OPEN, unsettled=NO_REASON)


class SilhouetteModel:
    """Angles beside a silhouette, known to first order about a position (3,), m.

    offsets (n,) rad there;  jacobian (n, 3) of the offsets, their sign turned;  weights (n,)
    """

    def __init__(
        self, position: FloatArray, offsets: FloatArray, jacobian: FloatArray, weights: FloatArray
    ) -> None:
        self._position, self._weights = position, weights
        self._offsets, self._jacobian = offsets, jacobian

    def linearise(self, state: FloatArray) -> Linearisation:
        """The angles from a position (3,)."""
        residuals = self._offsets - self._jacobian @ (state - self._position)
        return linearised(residuals, self._jacobian, self._weights)


def silhouette_step(
    position: FloatArray,
    offsets: FloatArray,
    rates: FloatArray,
    sigmas: FloatArray,
    azimuths: FloatArray,
    least_cut: float,
) -> Estimate[FloatArray]:
    """The position (3,), m, after a step, with its covariance as if it were the last.

    position  (3,)   m, where the silhouette was predicted
    offsets   (n,)   rad, rays beyond the silhouette along its normal
    rates     (n, 3) d offset / d position, rad a m
    sigmas    (n,)   rad, stated error of each, independent of the others
    azimuths  (n,)   rad about the nadir
    least_cut rad    errors below it are never outvoted as a whole

    The residuals are those after the step, to first order. Raises NoSolutionError for too few
    points or points that leave a direction open.
    """
    if len(offsets) < MIN_LIMB_POINTS:
        raise NoSolutionError(
            f"{len(offsets)} limb points; {MIN_LIMB_POINTS} are needed", ReasonCode.NOISY_LIMB
        )
    stated = 1.0 / (sigmas * sigmas)
    # begun by the absolute values' minimum, which a third of outliers does not carry away
    weights = stated
    for number in range(2 * ROUNDS):
        model = SilhouetteModel(position, offsets, -rates, weights)
        fit = solve([model], position, add, ONE_STEP)
        after = model.linearise(fit.state)
        sigma = scatter(after.residuals)
        if number < ROUNDS:
            size = max(sigma, least_cut / TUKEY)
            weights = stated / np.maximum(np.abs(after.residuals) / size, 1.0)
        elif number < 2 * ROUNDS - 1:
            weights = stated * tukey_weights(after.residuals, max(TUKEY * sigma, least_cut))
    covariance = azimuth_correlated(after, fit.noise, azimuths)
    return Estimate(fit.state, covariance, fit.noise, (after,))
