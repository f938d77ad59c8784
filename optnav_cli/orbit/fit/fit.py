"""Fit an orbit through measurements: a first orbit, the smoother, outliers, and what is left over.

Outliers are judged only after the smoother has converged, all anew each time, by the residual's own
covariance: R - H P H' of a measurement that is used, R + H P H' of one that is left out. Both are
the chi-square of one against all others.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtri

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.epochs import DAY_S, utc_from_tdb_s
from catalog.errors import NoSolutionError
from optnav_cli.estimation.smoother import SmoothedArc
from optnav_cli.orbit.fit.first import MIN_FIXES, MIN_SIGHTS, first_states, with_nodes
from optnav_cli.orbit.fit.missing_forces import (
    MAX_SCATTER,
    MEDIAN_OF_1,
    MEDIAN_OF_3,
    FitVerdict,
    check_breaks,
    check_pattern,
)
from optnav_cli.orbit.fit.parameters import unobserved_remarks
from optnav_cli.orbit.fit.problem import OrbitProblem, Trajectory
from optnav_cli.orbit.fit.settings import NoiseModel
from optnav_cli.orbit.fit.solver import (
    DOUBTED,
    OrbitSolver,
    are_whole_seconds,
    lie_within_half_a_second,
    median_ratio,
    robust_weights,
    start_fit,
    with_time_errors,
    with_whole_seconds,
)

MAX_ROUNDS = 40
SWAMPED = 0.3  # of the largest chi-square: what the worst measurement may have caused in others
MAX_BETWEEN = 100_000
# A field and its noise say nothing of a place after so long, and minutes would go into the way.
MAX_GAP_S = 30.0 * DAY_S
# Two first orbits whose fits differ by less in chi-square are both the sights'.
ALIKE = 50.0
DROPPED = 25.0  # times the chi-square of a fit there is: a first orbit is not followed further


@dataclass(frozen=True, eq=False)
class FixResidual:
    """A fix after the fit: residual (3,), body-fixed, m, its covariance by the fit, chi-square."""

    residual_m: FloatArray
    covariance_m2: FloatArray
    chi_square: float
    used: bool


@dataclass(frozen=True, eq=False)
class ScalarResidual:
    """Residuals (n,) of scalar measurements, chi-squares (n,) by their covariances, used (n,)."""

    residual: FloatArray
    chi_square: FloatArray
    used: BoolArray


@dataclass(frozen=True, eq=False)
class OrbitFit:
    """An orbit through measurements.

    residuals     of the fixes;  looks  of the scalar measurements

    covariances   (N, 6, 6) of the states, with what is considered and what is local
    last_covariance  (6 + p, 6 + p) of the last state and the parameters, without what is local:
                  what predictions start from
    disturbances  (N-1, 6) of the intervals
    inflation     factor in the covariances for residuals that follow a pattern; 1 without one
    """

    problem: OrbitProblem
    trajectory: Trajectory
    covariances: FloatArray
    last_covariance: FloatArray
    disturbances: FloatArray
    residuals: list[FixResidual]
    looks: ScalarResidual
    chi_square: float
    degrees_of_freedom: int
    steps: int
    remarks: list[str]
    inflation: float = 1.0

    @property
    def parameter_covariance(self) -> FloatArray:
        """(p, p) of the parameters."""
        return self.last_covariance[6:, 6:]

    @property
    def count(self) -> int:
        """Measurements, those left out among them."""
        return self.problem.count

    @property
    def is_used(self) -> BoolArray:
        """(count,) which of the measurements the orbit rests on."""
        of_fixes = np.array([residual.used for residual in self.residuals], bool)
        return np.concatenate([of_fixes, self.looks.used])

    @property
    def used(self) -> int:
        """Measurements that the orbit rests on."""
        return int(self.is_used.sum())


def fit_orbit(problem: OrbitProblem, model: NoiseModel, gate_probability: float) -> OrbitFit:
    """Fit. Raises NoSolutionError where no orbit has the measurements, with the test that failed.

    Scalar measurements get their nodes here.
    """
    try:
        return _fitted(problem, model, gate_probability)
    except NoSolutionError as error:
        if _fit_whole_seconds(problem, model, gate_probability):
            raise NoSolutionError(
                f"perhaps whole seconds: all stamps are of such, the residuals lie along the "
                f"motion within half a second of it, and with [fixes] time_sigma_s = 0.29 an orbit "
                f"fits; state that, or utc_sigma_s in frames.csv ({error})"
            ) from error
        raise


def _fit_whole_seconds(problem: OrbitProblem, model: NoiseModel, gate_probability: float) -> bool:
    """Tell whether fixes that fit no orbit do with times of whole seconds, and look like these."""
    if len(problem.fixes) < MIN_FIXES or not are_whole_seconds(problem.fixes):
        return False
    try:
        fit = _fitted(with_whole_seconds(problem), model, gate_probability)
    except NoSolutionError:
        return False
    residuals = np.array([residual.residual_m for residual in fit.residuals])
    return lie_within_half_a_second(fit.problem, fit.trajectory, residuals)


def _fitted(problem: OrbitProblem, model: NoiseModel, gate_probability: float) -> OrbitFit:
    _check_enough(problem)
    _check_gaps(problem)

    def start_fixes(rough: OrbitProblem) -> Trajectory:
        fixes = replace(rough, sights=None, tracking=())
        return start_fit(fixes, OrbitSolver(fixes, model), first_states(fixes)[0])

    problem = with_time_errors(problem, start_fixes)
    fit = best_fit(problem, model, gate_probability)
    problem, used = fit.problem, fit.is_used
    inflation, remarks = check_pattern(problem, fit.trajectory, used, alone=not problem.fixes)
    remarks += _judge(fit)
    local = problem.motion.local(fit.trajectory.states)
    return replace(
        fit,
        covariances=inflation * (fit.covariances - local) + local,
        last_covariance=inflation * fit.last_covariance,
        remarks=[*_one_star(problem), *remarks, *fit.remarks],
        inflation=inflation,
    )


def best_fit(problem: OrbitProblem, model: NoiseModel, gate_probability: float) -> OrbitFit:
    """Find the best fit, before its residuals are judged.

    Raises NoSolutionError where there is none, or two are as good.
    """
    begun: list[tuple[float, OrbitSolver, Trajectory]] = []
    errors: list[NoSolutionError] = []
    for first in first_states(problem):
        noded = with_nodes(problem, first[1])
        least = min((ratio for ratio, *_ in begun), default=math.inf)
        solver = OrbitSolver(noded, model)
        try:
            at = start_fit(noded, solver, first, DROPPED * max(least, 1.0))
        except NoSolutionError as error:
            if not problem.sets:
                raise
            text = (
                f"the {problem.measured} fit no one orbit ({error}); see that they are of one "
                "flight"
            )
            errors.append(NoSolutionError(text))
            continue
        begun.append((median_ratio(noded, at), solver, at))
        if len(_stars(problem)) > 2 and begun[-1][0] < MAX_SCATTER**2:
            break
    fits: list[OrbitFit] = []
    for ratio, solver, at in sorted(begun, key=lambda start: start[0]):
        if fits and ratio > DROPPED * max(median_ratio(fits[0].problem, fits[0].trajectory), 1.0):
            break
        try:
            fits.append(settle_fit(solver, at, gate_probability))
        except NoSolutionError as error:
            if not problem.sets:
                raise
            errors.append(error)
    if not fits:
        text = f"the {problem.measured} fit no orbit; state a [[prior]]"
        raise errors[0] if errors else NoSolutionError(text)
    fits.sort(key=lambda fit: (fit.count - fit.used, fit.chi_square))
    best = fits[0]
    for other in fits[1:]:
        apart = np.abs(other.trajectory.states[-1] - best.trajectory.states[-1])[:3].max()
        far = apart > 0.01 * float(np.linalg.norm(best.trajectory.states[-1, :3]))
        if far and other.used == best.used and other.chi_square < best.chi_square + ALIKE:
            raise NoSolutionError(
                "two orbits have these zenith distances, mirrored in the plane of "
                f"{' and '.join(_stars(problem))}: which of them is not observed; add sights of "
                "a third star, or state a [[prior]]"
            )
    return best


def settle_fit(solver: OrbitSolver, at: Trajectory, gate_probability: float) -> OrbitFit:
    """Fit from a trajectory near it, outliers left out; remarks on unobserved parameters alone.

    Raises NoSolutionError where the steps do not converge, and for fixes of two flights.
    """
    problem = solver.problem
    if not problem.fixes:
        solver = solver.of(problem)
    used = robust_weights(problem, at) > DOUBTED
    every = np.ones(problem.count, bool)
    if not problem.sets:
        at, smoothed = solver.settle(at, every.astype(np.float64))
        residuals, looks = _residuals(problem, at, smoothed, every)
        check_breaks(problem, at, smoothed, max(r.chi_square for r in residuals))
    gates = float(chdtri(3, gate_probability)), float(chdtri(1, gate_probability))
    seen: set[bytes] = set()
    for number in range(MAX_ROUNDS):
        if number or problem.sets or not used.all():  # all fixes alone are solved above
            at, smoothed = solver.settle(at, used.astype(np.float64))
            residuals, looks = _residuals(problem, at, smoothed, used)
        judged = _judged(residuals, looks, gates)
        if (judged == used).all() or judged.tobytes() in seen:
            break
        seen.add(used.tobytes())
        used = judged
    covariances = with_considered(problem, at, smoothed, used, solver)
    count = len(problem.fixes)
    return OrbitFit(
        problem,
        at,
        covariances[:, :6, :6] + problem.motion.local(at.states),
        covariances[-1, : problem.width, : problem.width],
        smoothed.disturbances[:, :6, 0],
        residuals,
        looks,
        smoothed.chi_square + problem.left_over(at, used.astype(np.float64)),
        # parameters have priors, and so has the state where one is stated
        3 * int(used[:count].sum()) + int(used[count:].sum()) + 6 * len(problem.priors) - 6,
        solver.steps,
        unobserved_remarks(problem.estimated, covariances[-1, 6:, 6:]),
    )


def _stars(problem: OrbitProblem) -> tuple[str, ...]:
    """Names of the stars that there are sights of."""
    return problem.sights.stars_used if problem.sights is not None else ()


def _one_star(problem: OrbitProblem) -> list[str]:
    stars = _stars(problem)
    if len(stars) != 1 or problem.fixes or problem.tracking:
        return []
    return [
        f"all zenith distances are of one star, {stars[0]}: the orbit's turn about the "
        "direction to it is not observed, and is that of the prior"
    ]


def _check_enough(problem: OrbitProblem) -> None:
    """Raise NoSolutionError for measurements that leave an orbit open whatever they are."""
    if problem.priors or len(problem.fixes) >= MIN_FIXES:
        return
    sights, stars = problem.sights, _stars(problem)
    if sights is None or not len(sights):
        raise NoSolutionError(
            f"too few fixes: {len(problem.fixes)} leave the orbit open; wanted {MIN_FIXES} or "
            "more, or a [[prior]]"
        )
    if len(stars) == 1:
        raise NoSolutionError(
            f"all zenith distances are of one star, {stars[0]}: the orbit's turn about "
            "the direction to it is not observed; add sights of a second star, or state a [[prior]]"
        )
    if len(sights) < MIN_SIGHTS:
        raise NoSolutionError(
            f"too few zenith distances: {len(sights)} leave the orbit open; wanted {MIN_SIGHTS} or "
            "more, or a [[prior]]"
        )


def _check_gaps(problem: OrbitProblem) -> None:
    """Raise NoSolutionError for a measurement or a prior far from the others in time."""
    named = [(fix.tdb_s, fix.file) for fix in problem.fixes]
    named += [(prior.tdb_s, "the prior") for prior in problem.priors]
    for part in problem.sets:
        named += [(float(time), f"one of the {part.measured}") for time in part.epochs[:, 0]]
    named.sort()
    for (before_s, before), (after_s, after) in pairwise(named):
        if after_s - before_s > MAX_GAP_S:
            raise NoSolutionError(
                f"{after} is of {utc_from_tdb_s(after_s)}, {(after_s - before_s) / DAY_S:.0f} days "
                f"after {before}; an orbit is fitted over gaps of up to {MAX_GAP_S / DAY_S:.0f}: "
                "see that the times are right, and fit each flight by itself"
            )


def _residuals(
    problem: OrbitProblem, at: Trajectory, found: SmoothedArc, used: BoolArray
) -> tuple[list[FixResidual], ScalarResidual]:
    residuals = []
    for number, fix in enumerate(problem.fixes):
        residual, design, _ = problem.measure(number, at)
        node = problem.node_of[number]
        moved, white = problem.split(number)
        design = np.concatenate([design, moved], axis=1)
        spread = design @ found.covariances[node] @ design.T
        covariance = white - spread if used[number] else white + spread
        # of a fix that alone holds a direction of the orbit nothing is left to judge it by
        values, axes = np.linalg.eigh(covariance)
        kept = values > 1e-6 * np.trace(fix.covariance_m2)
        # what it has in common with near ones speaks neither for nor against it
        common = moved @ found.deviations[node, problem.width :, 0]
        along = axes[:, kept].T @ (residual - common)
        chi_square = float((along**2 / values[kept]).sum())
        residuals.append(FixResidual(residual, covariance, chi_square, bool(used[number])))
    return residuals, _scalar_residuals(problem, at, found, used[len(problem.fixes) :])


def _scalar_residuals(
    problem: OrbitProblem, at: Trajectory, found: SmoothedArc, used: BoolArray
) -> ScalarResidual:
    if not problem.sets:
        return ScalarResidual(np.empty(0), np.empty(0), used)
    rows, variances = problem.rows(at), problem.scalars.sigmas**2
    width = problem.width
    spread = found.covariances[problem.scalars.node_of][:, :width, :width]
    orbit = (rows.design[:, None] @ spread @ rows.design[:, :, None])[:, 0, 0]
    # of one that alone holds the orbit nothing is left to judge it by
    left = np.maximum(np.where(used, variances - orbit, variances + orbit), 1e-6 * variances)
    return ScalarResidual(rows.residuals, rows.residuals**2 / left, used)


def _judged(
    residuals: list[FixResidual], looks: ScalarResidual, gates: tuple[float, float]
) -> BoolArray:
    """Which to use: those within the gate, and those that a worse one may have moved.

    gates  of the chi-squares of fixes, and of scalar measurements
    """
    squares = np.concatenate([[r.chi_square for r in residuals], looks.chi_square])
    used = np.concatenate([np.array([r.used for r in residuals], bool), looks.used])
    gate = np.repeat(gates, (len(residuals), len(looks.used)))
    worst = float(squares[used].max(initial=0.0))
    judged: BoolArray = squares < np.where(used, np.maximum(gate, SWAMPED * worst), gate)
    return judged


def _judge(fit: OrbitFit) -> list[str]:
    """Remarks on measurements and noise. Raises NoSolutionError where the residuals refute them."""
    problem, verdicts = fit.problem, []
    total = fit.chi_square, fit.degrees_of_freedom
    if fit.residuals or not problem.sets:
        squares = np.array([r.chi_square for r in fit.residuals])
        used = np.array([r.used for r in fit.residuals])
        verdicts.append(FitVerdict("fixes", squares, MEDIAN_OF_3, used, *total))
    for part, here in zip(problem.sets, problem.scalars.spans, strict=True):
        squares, used = fit.looks.chi_square[here], fit.looks.used[here]
        verdicts.append(FitVerdict(part.measured, squares, MEDIAN_OF_1, used, *total))
    advice = (
        "their sigmas are too small, or forces are lacking ([forces] degree, sunlight)",
        "they are",
    )
    if fit.residuals or not problem.sets:
        advice = (
            "their covariances are too small, forces are lacking ([forces] degree), or [noise] "
            "density_m2_s3 is too small",
            "the covariances of fixes or the noise are",
        )
    for verdict in verdicts[1:]:
        verdict.refute(advice[0])
    return replace(verdicts[0], what=problem.measured).remarks(*advice)


def with_considered(
    problem: OrbitProblem, at: Trajectory, found: SmoothedArc, used: BoolArray, solver: OrbitSolver
) -> FloatArray:
    """Covariances (N, n, n) of the states with parameters and what near fixes have in common.

    Considered numbers move the estimate as their columns say; the gains are those without them.
    """
    covariances = found.covariances
    if problem.considered:
        arc, paths = problem.linearise(at, used.astype(np.float64))
        moved = solver.solve(arc).deviations[:, :, 1:] - paths
        moved = moved @ np.linalg.cholesky(problem.prior_covariance(problem.considered))
        covariances = covariances + moved @ moved.transpose(0, 2, 1)
    return covariances


def densify(fit: OrbitFit, step_s: float) -> OrbitFit:
    """Return the orbit with further nodes, no farther apart than a step."""
    problem, at = fit.problem, fit.trajectory
    times = problem.times
    if problem.fixes:
        first, last = math.ceil(times[0] / step_s), math.floor(times[-1] / step_s)
        if last - first >= MAX_BETWEEN:
            raise NoSolutionError(
                f"{last - first + 1} rows of {step_s:g} s are more than {MAX_BETWEEN}; set a "
                "longer step_s"
            )
        marks = np.arange(first, last + 1) * step_s
        dense = replace(problem, between=np.concatenate([problem.between, marks]))
    else:
        dense = with_nodes(problem, at.states[0], step_s)
        if len(dense.times) <= len(times):
            return fit
    before = np.clip(np.searchsorted(times, dense.times + 1e-6, "right") - 1, 0, None)
    states = np.empty((len(dense.times), 6))
    motion = problem.motion_at(at)
    for node in np.unique(before):
        here = before == node
        start = float(times[node])
        states[here] = motion.path(at.states[node], start, dense.times[here])
    solver, used = OrbitSolver(dense, "white"), fit.is_used
    at, smoothed = solver.settle(Trajectory(states, at.parameters), used.astype(np.float64))
    covariances = fit.inflation * with_considered(dense, at, smoothed, used, solver)
    return replace(
        fit,
        problem=dense,
        trajectory=at,
        covariances=covariances[:, :6, :6] + problem.motion.local(at.states),
        last_covariance=covariances[-1, : dense.width, : dense.width],
    )
