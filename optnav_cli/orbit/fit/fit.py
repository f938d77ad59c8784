"""Fit an orbit through fixes: a first orbit, the smoother, outliers, and what the residuals say.

Outliers are judged only after the smoother has converged, all anew each time, by the residual's own
covariance: R - H P H' of a fix that is used, R + H P H' of one that is left out. Both are the
chi-square of a fix against all others.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtri

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.epochs import DAY_S, utc_from_tdb_s
from catalog.errors import NoSolutionError
from optnav_cli.estimation.smoother import LinearArc, SmoothedArc, nuisance, smooth
from optnav_cli.orbit.fit.first import first_orbit
from optnav_cli.orbit.fit.missing_forces import MEDIAN_OF_3, FitVerdict, check_pattern, mending
from optnav_cli.orbit.fit.problem import OrbitProblem, Trajectory, unobserved_remarks
from optnav_cli.orbit.fit.settings import NoiseModel
from optnav_cli.orbit.fit.time_errors import (
    are_whole_seconds,
    lie_within_half_a_second,
    with_time_errors,
    with_whole_seconds,
)

MAX_STEPS, MAX_ROUNDS = 30, 40
SETTLED, NEAR = 1e-3, 3.0  # sigmas: of a fit, and of a start
NEAR_WHOLE = 30.0  # of a start with all fixes, after which the fit itself goes on
# The windows that a first orbit grows over, radians of the motion: 0.7, 2, 5 h about the Moon.
WINDOWS_RAD = (2.2, 6.4, 16.0, math.inf)
ROBUST_STEPS, ROBUST_CHI_SQUARE = 8, 25.0
DOUBTED = 0.05  # weight below which a fix starts the last fit left out
SWAMPED = 0.3  # of the largest chi-square: what the worst fix may have caused in others
SHOCK_PROBABILITY = 1e-9
MIN_FIXES = 3
MAX_BETWEEN = 100_000
# A field and its noise say nothing of a place after so long, and minutes would go into the way.
MAX_GAP_S = 30.0 * DAY_S
RUNAWAY_M = 1e12  # of a step: no orbit about a body is so wide


@dataclass(frozen=True, eq=False)
class FixResidual:
    """A fix after the fit: residual (3,), body-fixed, m, its covariance by the fit, chi-square."""

    residual_m: FloatArray
    covariance_m2: FloatArray
    chi_square: float
    used: bool


@dataclass(frozen=True, eq=False)
class OrbitFit:
    """An orbit through fixes.

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
        return len(self.residuals)

    @property
    def used(self) -> int:
        """Measurements that the orbit rests on."""
        return sum(residual.used for residual in self.residuals)


class OrbitSolver:
    """Steps of Gauss and Newton about a trajectory."""

    def __init__(self, problem: OrbitProblem, model: NoiseModel) -> None:
        self.problem = problem
        self.solve: Callable[[LinearArc], SmoothedArc] = nuisance if model == "nuisance" else smooth
        self.steps = 0
        self.sigmas: FloatArray | None = None

    def of(self, problem: OrbitProblem) -> "OrbitSolver":
        """Return the solver of a part of the problem."""
        return OrbitSolver(problem, "white" if self.solve is smooth else "nuisance")

    def step(self, at: Trajectory, weights: FloatArray) -> tuple[Trajectory, SmoothedArc, float]:
        """The next trajectory, the linear solution, and its longest step in sigmas."""
        try:
            arc, _ = self.problem.linearise(at, weights, self.sigmas)
        except NoSolutionError as error:
            first, last = _utc(self.problem, 0), _utc(self.problem, -1)
            raise NoSolutionError(
                f"the {self.problem.measured} from {first} to {last} fit no one orbit ({error}); "
                "see that they are of one flight, and fit parts of it"
            ) from error
        smoothed = self.solve(arc)
        self.steps += 1
        width = self.problem.width
        deltas = smoothed.deviations[:, :width, 0]
        if not np.abs(deltas[:, :6]).max() < RUNAWAY_M:
            text = f"the steps of the fit run away; the {self.problem.measured} fit no orbit"
            raise NoSolutionError(text)
        parameters = at.parameters + deltas[-1, 6:]
        sigmas = np.sqrt(np.maximum(np.diagonal(smoothed.covariances, axis1=1, axis2=2), 1e-300))
        sigmas = sigmas[:, :width]
        self.sigmas = sigmas[0, :6]
        size = float(np.max(np.abs(deltas) / sigmas))
        return Trajectory(at.states + deltas[:, :6], parameters), smoothed, size

    def settle(self, at: Trajectory, weights: FloatArray) -> tuple[Trajectory, SmoothedArc]:
        """The trajectory that no step moves. Raises NoSolutionError where there is none."""
        size = math.inf
        for _ in range(MAX_STEPS):
            fresh, before = self.sigmas is None, size
            at, smoothed, size = self.step(at, weights)
            # steps near the end shrink by ever smaller shares: the next one is known to be short
            if not fresh and (size < SETTLED or size * size < SETTLED * min(before, NEAR)):
                return at, smoothed
            if not math.isfinite(size):
                break
        raise NoSolutionError(
            f"the fit does not converge: after {MAX_STEPS} steps it still moves by {size:.2g} "
            f"sigmas; see that the {self.problem.measured} are of one flight and the forces are "
            "those of this body"
        )


def fit_orbit(problem: OrbitProblem, model: NoiseModel, gate_probability: float) -> OrbitFit:
    """Fit. Raises NoSolutionError where the fixes fit no orbit, with the test that says so."""
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
    if len(problem.fixes) < MIN_FIXES and not problem.priors:
        raise NoSolutionError(
            f"too few fixes: {len(problem.fixes)} leave the orbit open; wanted {MIN_FIXES} or "
            "more, or a [[prior]]"
        )
    _check_gaps(problem)
    problem = with_time_errors(problem, lambda rough: _start(rough, OrbitSolver(rough, model))[0])
    solver = OrbitSolver(problem, model)
    at, weights = _start(problem, solver)
    at, smoothed = solver.settle(at, np.ones(len(weights)))
    residuals = _residuals(problem, at, smoothed, np.ones(len(weights), bool))
    _check_breaks(problem, at, smoothed, residuals)
    used = weights > DOUBTED
    gate = float(chdtri(3, gate_probability))
    seen: set[bytes] = set()
    for number in range(MAX_ROUNDS):
        if number or not used.all():  # all of them are solved above
            at, smoothed = solver.settle(at, used.astype(np.float64))
            residuals = _residuals(problem, at, smoothed, used)
        judged = _judged(residuals, gate)
        if (judged == used).all() or judged.tobytes() in seen:
            break
        seen.add(used.tobytes())
        used = judged
    inflation, remarks = check_pattern(problem, at, used, alone=False)
    remarks += _judge(problem, smoothed, residuals)
    covariances = inflation * with_considered(problem, at, smoothed, used, solver)
    return OrbitFit(
        problem,
        at,
        covariances[:, :6, :6] + problem.motion.local(at.states),
        covariances[-1, : problem.width, : problem.width],
        smoothed.disturbances[:, :6, 0],
        residuals,
        smoothed.chi_square,
        _freedom(problem, smoothed),
        solver.steps,
        [*remarks, *unobserved_remarks(problem, covariances[-1, 6:, 6:])],
        inflation,
    )


def _check_gaps(problem: OrbitProblem) -> None:
    """Raise NoSolutionError for a fix or a prior far from the others in time."""
    named = [(fix.tdb_s, fix.file) for fix in problem.fixes]
    named += [(prior.tdb_s, "the prior") for prior in problem.priors]
    named.sort()
    for (before_s, before), (after_s, after) in pairwise(named):
        if after_s - before_s > MAX_GAP_S:
            raise NoSolutionError(
                f"{after} is of {utc_from_tdb_s(after_s)}, {(after_s - before_s) / DAY_S:.0f} days "
                f"after {before}; an orbit is fitted over gaps of up to {MAX_GAP_S / DAY_S:.0f}: "
                "see that the times are right, and fit each flight by itself"
            )


def _start(problem: OrbitProblem, solver: OrbitSolver) -> tuple[Trajectory, FloatArray]:
    """A trajectory near enough, and the weights of the fixes that it ends with."""
    times, parameters = problem.times, np.zeros(problem.width - 6)
    node, state = first_orbit(problem)
    states = np.empty((len(times), 6))
    states[node] = state
    weights = np.zeros(len(problem.fixes))
    radian = problem.motion.radian_s(state[:3])
    low = high = node
    before: OrbitSolver | None = None
    windows = (math.inf,) if problem.priors else WINDOWS_RAD
    for window in windows:
        near = np.flatnonzero(np.abs(times - times[node]) <= window * radian)
        had = low
        low, high = _lengthen(problem, states, (low, high), (int(near[0]), int(near[-1])))
        part = problem.part(low, high)
        inner = solver if part is problem else solver.of(part)
        if before is not None and low == had:
            # else the first state is open by so many sigmas that covariances lose their digits
            inner.sigmas = before.sigmas
        before = inner
        here = [k for k, i in enumerate(problem.node_of) if low <= i <= high]
        at = Trajectory(states[low : high + 1], parameters)
        for _ in range(ROBUST_STEPS):
            robust_weights = _robust(part, at)
            if part is problem and robust_weights.min() > DOUBTED:
                break  # none of them is doubted: the fit itself goes on, with all of them
            at, _, size = inner.step(at, robust_weights)
            if not np.isfinite(at.states).all():
                raise NoSolutionError("the fixes fit no orbit of these forces")
            if size < (NEAR_WHOLE if part is problem else NEAR):
                break
        states[low : high + 1], parameters = at.states, at.parameters
        weights[here] = _robust(part, at)
        if low == 0 and high == len(times) - 1:
            break
    return Trajectory(states, parameters), weights


def _lengthen(
    problem: OrbitProblem, states: FloatArray, had: tuple[int, int], wanted: tuple[int, int]
) -> tuple[int, int]:
    """Fill the states of further nodes by the motion from the ends of those there are."""
    times = problem.times
    for end, nodes in (
        (had[1], range(had[1] + 1, wanted[1] + 1)),
        (had[0], range(wanted[0], had[0])),
    ):
        if len(nodes):
            start = float(times[end])
            states[list(nodes)] = problem.motion.path(states[end], start, times[list(nodes)])
    return min(had[0], wanted[0]), max(had[1], wanted[1])


def _robust(problem: OrbitProblem, at: Trajectory) -> FloatArray:
    """Weights that let a fix far from the trajectory count little."""
    weights = np.empty(len(problem.fixes))
    for number, fix in enumerate(problem.fixes):
        residual = problem.measure(number, at)[0]
        chi_square = float(residual @ np.linalg.solve(fix.covariance_m2, residual))
        weights[number] = 1.0 / (1.0 + chi_square / ROBUST_CHI_SQUARE)
    return weights


def _residuals(
    problem: OrbitProblem, at: Trajectory, found: SmoothedArc, used: BoolArray
) -> list[FixResidual]:
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
    return residuals


def _judged(residuals: list[FixResidual], gate: float) -> BoolArray:
    """Which fixes to use: those within the gate, and those that a worse one may have moved."""
    worst = max((r.chi_square for r in residuals if r.used), default=0.0)
    limit = max(gate, SWAMPED * worst)
    return np.array([r.chi_square < (limit if r.used else gate) for r in residuals])


def _check_breaks(
    problem: OrbitProblem, at: Trajectory, found: SmoothedArc, residuals: list[FixResidual]
) -> None:
    """Raise NoSolutionError where the fixes before and after a time are of two orbits.

    The adjoint state of an interval tests a shock there: with three numbers a manoeuvre, with six
    another flight (de Jong and Penzer, "Diagnosing shocks in time series", 1998).
    """
    if not found.information.size:
        return
    single = max(r.chi_square for r in residuals)
    limit = 2.0 * single + float(chdtri(3, SHOCK_PROBABILITY / max(len(found.scores), 1)))
    best: tuple[float, int, FloatArray, float] | None = None
    for i, (score, info) in enumerate(zip(found.scores, found.information, strict=True)):
        kick = -_solved(info[3:6, 3:6], score[3:6])
        jump = -_solved(info[:6, :6], score[:6])
        by_kick, by_all = -float(kick @ score[3:6]), -float(jump @ score[:6])
        if best is None or by_all > best[0]:
            best = by_all, i, jump, by_kick
    if best is None or best[0] < limit:
        return
    chi_square, i, shock, by_kick = best
    mends, forces = mending(problem, at, np.ones(len(residuals), bool))
    when = f"between {_utc(problem, i)} and {_utc(problem, i + 1)}"
    if by_kick > 0.5 * chi_square and by_kick > limit:
        speed = float(np.linalg.norm(_solved(found.information[i][3:6, 3:6], found.scores[i][3:6])))
        broken = (
            f"a manoeuvre {when}: the velocity changes by {speed:.3g} m/s there (chi-square "
            f"{by_kick:.0f} of 3); describe it as [[forces.thrust]], or fit each part by itself"
        )
    else:
        apart = float(np.linalg.norm(shock[:3]))
        broken = (
            f"the arc does not close: {when} the orbit jumps by {apart / 1e3:.3g} km and "
            f"{np.linalg.norm(shock[3:]):.3g} m/s (chi-square {chi_square:.0f} of 6); the fixes "
            "are of two flights or bodies, or the craft has manoeuvred: fit each part by itself"
        )
    if mends:
        raise NoSolutionError(f"the forces lack something: {forces}. If not that, {broken}")
    raise NoSolutionError(f"{broken}. Of forces left out {forces}")


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve along the directions of a positive matrix that are known to some digits."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, axes = np.linalg.eigh(matrix * np.outer(scale, scale))
    kept = values > 1e-10 * max(float(values[-1]), 1e-300)
    inner = axes[:, kept]
    solved: FloatArray = scale * (inner @ ((inner.T @ (scale * right)) / values[kept]))
    return solved


def _judge(problem: OrbitProblem, found: SmoothedArc, residuals: list[FixResidual]) -> list[str]:
    """Remarks on model and noise. Raises NoSolutionError where the residuals refute them."""
    judged = FitVerdict(
        "fixes",
        np.array([r.chi_square for r in residuals]),
        MEDIAN_OF_3,
        np.array([r.used for r in residuals]),
        found.chi_square,
        _freedom(problem, found),
    )
    return judged.remarks(
        "their covariances are too small, forces are lacking ([forces] degree), or [noise] "
        "density_m2_s3 is too small",
        "the covariances of fixes or the noise are",
    )


def _freedom(problem: OrbitProblem, found: SmoothedArc) -> int:
    # parameters have priors, and so has the state where one is stated
    return found.count - 6


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
    """Return the orbit with nodes between the fixes, no farther apart than a step."""
    problem, times = fit.problem, fit.problem.times
    marks = np.arange(math.ceil(times[0] / step_s), math.floor(times[-1] / step_s) + 1) * step_s
    if len(marks) > MAX_BETWEEN:
        raise NoSolutionError(
            f"{len(marks)} rows of {step_s:g} s are more than {MAX_BETWEEN}; set a longer step_s"
        )
    dense = replace(problem, between=marks)
    states = np.empty((len(dense.times), 6))
    nodes = np.searchsorted(dense.times, times - 1e-6)
    states[nodes] = fit.trajectory.states
    for k, node in enumerate(nodes[:-1]):
        inner = list(range(node + 1, nodes[k + 1]))
        if inner:
            start = float(times[k])
            states[inner] = problem.motion.path(states[node], start, dense.times[inner])
    solver = OrbitSolver(dense, "white")
    used = np.array([r.used for r in fit.residuals])
    at, smoothed = solver.settle(Trajectory(states, fit.trajectory.parameters), used.astype(float))
    covariances = fit.inflation * with_considered(dense, at, smoothed, used, solver)
    return replace(
        fit,
        problem=dense,
        trajectory=at,
        covariances=covariances[:, :6, :6] + problem.motion.local(at.states),
        last_covariance=covariances[-1, : dense.width, : dense.width],
    )


def _utc(problem: OrbitProblem, node: int) -> str:
    return utc_from_tdb_s(float(problem.times[node]), 0)
