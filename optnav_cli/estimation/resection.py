"""Resection: a camera's pose from known points in its picture, with wrong matches among them."""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.errors import NoSolutionError
from optnav_cli.estimation.consider import correlated
from optnav_cli.estimation.least_squares import Estimate, Iteration, Linearisation, Model, solve
from optnav_cli.estimation.models.points import (
    AttitudeModel,
    PointsModel,
    Pose,
    ProjectingCamera,
    Sightings,
    predict,
)
from optnav_cli.estimation.robust import consensus, gated, rescaled
from optnav_cli.reasons import Reason, ReasonCode

_OPEN = Reason(
    ReasonCode.DEGENERATE, "the control points do not fix all unknowns (degenerate geometry)"
)
_UNSETTLED = Reason(ReasonCode.NOT_SETTLED, "the position did not settle in 30 iterations")
ITERATION = Iteration(30, 1e-4, _OPEN, _UNSETTLED, each_unknown=True, damped=True)


@dataclass(frozen=True)
class Resection:
    """A pose from sightings, and which of those offered it rests on.

    covariance      (3, 3) of position, m^2, body frame, or (6, 6) with the rotation vector
                    (rad, camera frame) behind it
    degrees_of_freedom  measurements less unknowns, an attitude prior counted as a measurement
    used            (n,) over the offered sightings
    variance_factor by which the stated covariances were scaled after looking at the residuals
    residuals_px    (n, 2) of all offered sightings, measured less predicted
    """

    pose: Pose
    covariance: FloatArray
    degrees_of_freedom: int
    used: BoolArray
    variance_factor: float
    residuals_px: FloatArray

    @property
    def position_covariance_m2(self) -> FloatArray:
        """(3, 3) covariance of the position, body frame."""
        return self.covariance[:3, :3]

    @property
    def attitude_sigma_rad(self) -> float:
        """One-sigma attitude error per axis, root mean square over the axes; 0 when held exact."""
        if self.covariance.shape[0] == 3:
            return 0.0
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3.0))


def resect(
    camera: ProjectingCamera, sightings: Sightings, start: Pose, attitude_sigma_rad: float | None
) -> Estimate[Pose]:
    """Solve for the pose that explains the sightings best.

    start               first guess; its position is never a measurement
    attitude_sigma_rad  0: the attitude is exact; None: free; else the sigma per axis of
                        the start's camera_from_body

    Raises NoSolutionError for too few sightings, degenerate geometry or no convergence.
    """
    unknowns = 3 if attitude_sigma_rad == 0.0 else 6
    count = 2 * len(sightings) + (3 if attitude_sigma_rad else 0)
    if count < unknowns or len(sightings) < 2:
        text = f"{len(sightings)} control points are too few for {unknowns} unknowns"
        raise NoSolutionError(text, ReasonCode.FEW_POINTS)
    models: list[Model[Pose]] = [PointsModel(camera, sightings, unknowns)]
    if attitude_sigma_rad:
        models.append(AttitudeModel(start.camera_from_body, attitude_sigma_rad))
    return solve(models, start, Pose.moved, ITERATION)


def resect_robustly(
    camera: ProjectingCamera,
    sightings: Sightings,
    start: Pose,
    attitude_sigma_rad: float | None,
    *,
    common_errors_px: FloatArray | None = None,
    error_correlation: FloatArray | None = None,
    common_shares: tuple[float, float] = (0.0, 0.0),
    gate_probability: float = 0.999,
) -> Resection:
    """Solve for the pose with wrong matches among the sightings.

    common_errors_px  (n, 2, k) what one sigma of each of k errors that all sightings share moves
                      them by; once the wrong ones are out, they are solved for beside the pose
    error_correlation (n, n) of the sightings' own errors; None: each errs for itself. They are
                      weighted as if it were so, but the covariance is the true one's
    common_shares     of the sightings' own scatter: a shift along x and along y, and a stretch at
                      the rms distance from the middle, that all of them share beside
    gate_probability  a sighting is dropped when its normalised residual is rarer than this
    Arguments otherwise as `resect`. Raises NoSolutionError when no two (three with a free
    attitude) sightings agree.
    """
    fewest = 2 if attitude_sigma_rad is not None else 3
    if len(sightings) < fewest:
        raise NoSolutionError(
            f"{len(sightings)} matched control points; {fewest} are needed", ReasonCode.FEW_POINTS
        )
    gate = 2.0 * float(gammaincinv(1.0, gate_probability))  # of a chi-square with 2 degrees
    squares_of = PointsModel(camera, sightings, 6).squares
    sigma = attitude_sigma_rad
    reach_px = np.linalg.norm(sightings.pixels - sightings.pixels.mean(axis=0), axis=1).max()
    least_px = np.sqrt(np.linalg.eigvalsh(sightings.covariances_px2)[:, 0].min())
    if sigma is not None and sigma * reach_px < least_px:
        # A roll of arc seconds moves no point out of the gate, and three unknowns are quicker.
        sigma = 0.0

    def solved(some: IntArray | BoolArray, sigma_rad: float | None) -> Estimate[Pose]:
        return resect(camera, sightings.subset(some), start, sigma_rad)

    count = len(sightings)
    agreeing = consensus(count, fewest, lambda some: solved(some, sigma).state, squares_of, gate)
    if agreeing.sum() < fewest:
        raise NoSolutionError(
            f"no {fewest} matches agree on a position", ReasonCode.POINTS_DISAGREE
        )
    estimate, used, factor = gated(
        agreeing, fewest, lambda mask: solved(mask, attitude_sigma_rad), squares_of, gate
    )
    kept = sightings.subset(used)
    errors = errors_of_scatter(kept, factor, *common_shares)
    if common_errors_px is not None:
        errors = np.concatenate([errors, common_errors_px[used]], axis=2)
    if error_correlation is not None:
        error_correlation = error_correlation[np.ix_(used, used)]
    step, covariance = with_dependent_errors(
        rescaled(estimate, factor), estimate.measured, factor, kept, errors, error_correlation
    )
    pose = estimate.state.moved(step)
    pixels, _ = predict(camera, pose, sightings.points_body_m)
    return Resection(
        pose, covariance, estimate.degrees_of_freedom, used, factor, sightings.pixels - pixels
    )


def with_dependent_errors(
    covariance: FloatArray,
    measured: Linearisation,
    factor: float,
    sightings: Sightings,
    errors_px: FloatArray,
    correlation: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Propagate errors that sightings share to the solution: step (k,), covariance (k, k).

    covariance   (k, k) of a solution for which each sighting erred for itself
    measured     the sightings at that solution, by their stated covariances
    factor       by which these were scaled for it
    errors_px    (n, 2, m) one sigma of each of m errors that all sightings share
    correlation  (n, n) of their own errors; None: none

    The sizes of the shared errors are unknowns with a prior of one sigma. A sighting that they move
    farther than others, as one matched at a coarse level, so counts for less. Correlated errors of
    their own do not change the weights: their correlation is known by the overlap of templates
    alone, and weighted by it neighbours of opposite errors would carry the solution away.
    """
    unknowns, size = covariance.shape[0], measured.residuals.size
    weights = measured.weights / factor
    jacobian = measured.jacobian.reshape(size, unknowns)
    errors = errors_px.reshape(size, -1)
    weighted = np.matmul(weights, errors_px).reshape(size, -1)
    gain = measured.gain(covariance / factor)
    shift = gain @ errors
    spread = np.linalg.inv(np.eye(errors.shape[1]) + weighted.T @ (errors - jacobian @ shift))
    step = -shift @ spread @ (weighted.T @ measured.residuals.ravel())
    covariance = covariance + shift @ spread @ shift.T
    if correlation is not None:
        roots = np.linalg.cholesky(sightings.covariances_px2).astype(np.float64)
        gain = gain - shift @ spread @ (weighted.T - weighted.T @ jacobian @ gain)
        covariance = covariance + factor * correlated(gain, roots, correlation)
    return step, covariance


def errors_of_scatter(
    sightings: Sightings, factor: float, shift: float, stretch: float
) -> FloatArray:
    """Shifts along x and y and a stretch (n, 2, 3), px: shares of the scatter of a frame."""
    variance = np.trace(sightings.covariances_px2, axis1=1, axis2=2).mean() / 2.0
    scatter = float(np.sqrt(factor * variance))
    outward = sightings.pixels - sightings.pixels.mean(axis=0)
    reach = float(np.sqrt((outward**2).sum(axis=1).mean()))
    errors = np.zeros((len(sightings), 2, 3))
    errors[:, 0, 0] = errors[:, 1, 1] = shift * scatter
    errors[:, :, 2] = outward * (stretch * scatter / max(reach, 1e-9))
    return errors
