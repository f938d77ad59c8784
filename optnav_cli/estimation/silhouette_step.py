"""One Gauss-Newton step of a position from angles beside a silhouette of any shape.

The caller predicts the silhouette anew after each step. Robust weights are Tukey's, about a width
that follows the scatter: wide while the position is far off, narrow in the end.
"""

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.estimation.limb_fit import MIN_LIMB_POINTS, LimbFit, correlated_covariance
from optnav_cli.reasons import ReasonCode

TUKEY = 4.685  # 95 % efficient for normal errors
MAD_TO_SIGMA = 1.4826
ROUNDS = 6  # of weights and solution; later ones change a thousandth of a sigma
MAX_CONDITION = 1e10


def silhouette_step(
    position: FloatArray,
    offsets: FloatArray,
    rates: FloatArray,
    sigmas: FloatArray,
    azimuths: FloatArray,
    least_cut: float,
) -> LimbFit:
    """The position after a step, with its covariance as if it were the last.

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
    shares = np.ones(len(offsets))
    residuals = offsets
    for number in range(2 * ROUNDS):
        noise, gain = _solution(rates, stated * shares)
        residuals = offsets + rates @ (gain @ offsets)
        scatter = MAD_TO_SIGMA * float(np.median(np.abs(residuals)))
        if number < ROUNDS:
            shares = 1.0 / np.maximum(np.abs(residuals) / max(scatter, least_cut / TUKEY), 1.0)
        elif number < 2 * ROUNDS - 1:
            far = residuals / max(TUKEY * scatter, least_cut)
            shares = np.where(np.abs(far) < 1.0, np.square(1.0 - far * far), 0.0)
    information = stated * shares
    covariance = correlated_covariance(rates, residuals, information, noise, azimuths)
    return LimbFit(
        position + gain @ offsets, covariance, noise, gain, rates, information, residuals, shares
    )


def _solution(rates: FloatArray, information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariance (3, 3) of independent errors, and gain (3, n), m a rad."""
    weighted = rates * information[:, None]
    normal = weighted.T @ rates
    if not np.linalg.cond(normal) < MAX_CONDITION:
        raise NoSolutionError(
            "the limb points leave a direction of the position open", ReasonCode.DEGENERATE
        )
    noise = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return noise, -noise @ weighted.T
