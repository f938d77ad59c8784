"""Resection among wrong matches: small-sample consensus, then chi-square gates.

Every pair (triple when the attitude is free) of matches proposes a pose; the pose that most
matches agree with starts a least-squares solution, from which disagreeing matches are taken out
one by one and agreeing ones taken back.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.stats import chi2

from catalog.arrays import BoolArray, FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.estimation.resection import (
    Pose,
    ProjectingCamera,
    Resection,
    Sightings,
    predict,
    resect,
)
from optnav_cli.reasons import ReasonCode

MAX_PROPOSALS = 120
MAX_GATE_ROUNDS = 15
# Weight, in degrees of freedom, of the stated measurement sigmas against the scatter that a
# frame's own residuals show: a frame with few points leans on the statement.
STATED_DEGREES_OF_FREEDOM = 10.0
# Gates follow the scatter up to twice the stated sigmas. Beyond, it is not a larger error but other
# places, and gates that followed would open for every wrong match and certify them all.
MAX_GATE_FACTOR = 4.0


@dataclass(frozen=True)
class RobustResection:
    """A resection and which of the offered sightings it rests on.

    used            (n,) bool over the offered sightings
    variance_factor by which the stated covariances were scaled after looking at the residuals
    residuals_px    (n, 2) of all offered sightings at the final pose
    """

    resection: Resection
    used: BoolArray
    variance_factor: float
    residuals_px: FloatArray


def resect_robustly(
    camera: ProjectingCamera,
    sightings: Sightings,
    start: Pose,
    attitude_sigma_rad: float | None,
    *,
    common_errors_px: FloatArray | None = None,
    error_correlation: FloatArray | None = None,
    gate_probability: float = 0.999,
) -> RobustResection:
    """Solve for the pose with wrong matches among the sightings.

    common_errors_px  (n, 2, k) what one sigma of each of k errors that all sightings share moves
                      them by; they are not solved for, but their effect is in the covariance
    alike             (n, n) correlation of the sightings' own errors; None: each errs for itself.
                      They are weighted as if it were so, but the covariance is the true one's
    gate_probability  a sighting is dropped when its normalised residual is rarer than this
    Arguments otherwise as `resect`. Raises NoSolutionError when no two (three with a free
    attitude) sightings agree.
    """
    gate = float(chi2.ppf(gate_probability, 2))
    used = _consensus(camera, sightings, start, attitude_sigma_rad, gate)
    least = 2 if attitude_sigma_rad is not None else 3
    for _ in range(MAX_GATE_ROUNDS):
        if used.sum() < least:
            raise NoSolutionError("the matches contradict each other", ReasonCode.POINTS_DISAGREE)
        solution = resect(
            camera,
            sightings.subset(used),
            start,
            attitude_sigma_rad,
            measured_attitude=start.camera_from_body,
        )
        factor = _variance_factor(solution)
        normalised = _normalised(camera, sightings, solution.pose)
        inside = normalised < gate * min(max(factor, 1.0), MAX_GATE_FACTOR)
        if (inside == used).all():
            break
        dropped = used & ~inside
        if dropped.any():
            # a wrong match drags others over the gate: only the worst goes in one round
            worst = int(np.argmax(np.where(used, normalised, -1.0)))
            used = used.copy()
            used[worst] = False
        else:
            used = inside
    # the loop may end on its count while swapping one match in and out; solve for the last set
    solution = resect(
        camera,
        sightings.subset(used),
        start,
        attitude_sigma_rad,
        measured_attitude=start.camera_from_body,
    )
    factor = _variance_factor(solution)
    covariance = _scaled(solution, factor, attitude_sigma_rad)
    kept, each = sightings.subset(used), covariance / factor
    if error_correlation is not None:
        together = error_correlation[np.ix_(used, used)]
        shared = _shared_part(camera, kept, solution.pose, each, together)
        covariance = covariance + shared * factor
    if common_errors_px is not None:
        covariance = covariance + _common_part(
            camera, kept, solution.pose, each, common_errors_px[used]
        )
    scaled = replace(solution, covariance=covariance)
    pixels, _ = predict(camera, solution.pose, sightings.points_body_m)
    return RobustResection(scaled, used, factor, sightings.pixels - pixels)


def _variance_factor(solution: Resection) -> float:
    """Variance of unit weight, pulled toward the stated one for lack of redundancy."""
    total = float(solution.normalised.sum())
    freedom = max(solution.degrees_of_freedom, 0)
    return (total + STATED_DEGREES_OF_FREEDOM) / (freedom + STATED_DEGREES_OF_FREEDOM)


def _scaled(
    solution: Resection,
    factor: float,
    attitude_sigma_rad: float | None,
) -> FloatArray:
    """Covariance with the sightings' part scaled; the star sensor's is not theirs to scale."""
    if not attitude_sigma_rad:
        return solution.covariance * factor
    prior = np.zeros((6, 6))
    prior[3:, 3:] = np.eye(3) / attitude_sigma_rad**2
    sighted = np.linalg.inv(solution.covariance) - prior
    return np.asarray(np.linalg.inv(sighted / factor + prior))


def _shared_part(
    camera: ProjectingCamera,
    sightings: Sightings,
    pose: Pose,
    covariance: FloatArray,
    error_correlation: FloatArray,
) -> FloatArray:
    """What sightings that err alike add to a covariance that takes each for itself."""
    _, jacobian = predict(camera, pose, sightings.points_body_m)
    # with S S' the covariance of a sighting, its weight times S is the inverse of S'
    root = np.linalg.inv(np.linalg.cholesky(sightings.covariances_px2))
    moved = np.einsum("lk,nik,nji->nlj", covariance, jacobian[:, :, : len(covariance)], root)
    others = error_correlation - np.diag(np.diag(error_correlation))
    return np.asarray(np.einsum("nlj,nm,mkj->lk", moved, others, moved))


def _common_part(
    camera: ProjectingCamera,
    sightings: Sightings,
    pose: Pose,
    covariance: FloatArray,
    errors_px: FloatArray,
) -> FloatArray:
    """What errors that all sightings share do to the solution: considered, not estimated."""
    _, jacobian = predict(camera, pose, sightings.points_body_m)
    weighted = np.einsum(
        "nik,nij->nkj", jacobian[:, :, : len(covariance)], np.linalg.inv(sightings.covariances_px2)
    )
    moved = covariance @ np.einsum("nkj,njc->kc", weighted, errors_px)
    return np.asarray(moved @ moved.T)


def _normalised(camera: ProjectingCamera, sightings: Sightings, pose: Pose) -> FloatArray:
    """(n,) squared residuals at a pose in units of their covariance; infinite when out of view."""
    pixels, _ = predict(camera, pose, sightings.points_body_m)
    residuals = sightings.pixels - pixels
    seen = np.isfinite(residuals).all(axis=1)
    out = np.full(len(sightings), np.inf)
    information = np.linalg.inv(sightings.covariances_px2[seen])
    out[seen] = np.einsum("ni,nij,nj->n", residuals[seen], information, residuals[seen])
    return out


def _consensus(
    camera: ProjectingCamera,
    sightings: Sightings,
    start: Pose,
    attitude_sigma_rad: float | None,
    gate: float,
) -> BoolArray:
    """The largest set of sightings that one pose explains, of all and of small samples."""
    size = 2 if attitude_sigma_rad is not None else 3
    n = len(sightings)
    if n < size:
        raise NoSolutionError(
            f"{n} matched control points; {size} are needed", ReasonCode.FEW_POINTS
        )
    samples = np.array(list(combinations(range(n), size))) if n <= 40 else None
    generator = np.random.default_rng(0)
    if samples is None:
        samples = np.array([generator.choice(n, size, replace=False) for _ in range(MAX_PROPOSALS)])
    elif len(samples) > MAX_PROPOSALS:
        samples = generator.permutation(samples)[:MAX_PROPOSALS]
    sigma = attitude_sigma_rad
    if sigma is not None and sigma * _reach_px(sightings) < _smallest_sigma_px(sightings):
        # A roll of arc seconds moves no point out of the gate, and three unknowns are quicker.
        sigma = 0.0
    # Proposals rest on two points only, so their own error adds to the residuals of the others.
    wide = 9.0 * gate
    best_count, best_cost = 0, np.inf
    best = np.zeros(n, dtype=bool)
    # All first: where most are right and lie close together, a pair tells less than they do.
    for sample in (np.arange(n), *samples):
        try:
            pose = _propose(camera, sightings.subset(sample), start, sigma)
        except NoSolutionError:
            continue
        normalised = _normalised(camera, sightings, pose)
        inside = normalised < wide
        count = int(inside.sum())
        cost = float(normalised[inside].sum())
        if count > best_count or (count == best_count and cost < best_cost):
            best_count, best_cost, best = count, cost, inside
        if best_count == n:
            break
    if best_count < size:
        raise NoSolutionError(f"no {size} matches agree on a position", ReasonCode.POINTS_DISAGREE)
    return best


def _reach_px(sightings: Sightings) -> float:
    """How far the sightings lie from their middle at most."""
    away = sightings.pixels - sightings.pixels.mean(axis=0)
    return float(np.linalg.norm(away, axis=1).max())


def _smallest_sigma_px(sightings: Sightings) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(sightings.covariances_px2)[:, 0].min()))


def _propose(camera: ProjectingCamera, sample: Sightings, start: Pose, sigma: float | None) -> Pose:
    return resect(camera, sample, start, sigma).pose
