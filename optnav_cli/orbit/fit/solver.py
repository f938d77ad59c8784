"""Steps of Gauss and Newton about a trajectory, and the start of a fit by robust ones.

Times of fixes may be known to a fraction of a second: the craft's way in it is an error of each. A
stamp wrong by d moves a fix by v d along the motion; stamps of whole seconds (EXIF) are wrong by
0.29 s, 1 sigma, which is 460 m along a low lunar orbit and 2.2 km about the Earth. The velocity is
that of a first orbit, itself through the fixes with as wide an error to all sides.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import NoSolutionError
from optnav_cli.estimation.smoother import LinearArc, SmoothedArc, nuisance, smooth
from optnav_cli.orbit.fit.first import MIN_SIGHTS
from optnav_cli.orbit.fit.missing_forces import MEDIAN_OF_1
from optnav_cli.orbit.fit.problem import OrbitFix, OrbitProblem, Trajectory
from optnav_cli.orbit.fit.settings import NoiseModel

MAX_STEPS = 30
SETTLED, NEAR = 1e-3, 3.0  # sigmas: of a fit, and of a start
NEAR_WHOLE = 30.0  # of a start with all fixes, after which the fit itself goes on
# The windows that a first orbit grows over, radians of the motion: 0.7, 2, 5 h about the Moon.
WINDOWS_RAD = (2.2, 6.4, 16.0, math.inf)
TRACKING_WINDOWS_RAD = (*WINDOWS_RAD[:-1], 40.0, 100.0, 250.0, math.inf)
ROBUST_STEPS, ROBUST_CHI_SQUARE = 8, 25.0
DOUBTED = 0.05  # weight below which a measurement starts the last fit left out
RUNAWAY_M = 1e12  # of a step: no orbit about a body is so wide
WHOLE_SECOND = re.compile(r".*:\d{2}:\d{2}(?:\.0*)?\s*(?:Z|UTC)?", re.IGNORECASE)
ROUNDED_S = 12.0**-0.5  # 1 sigma of times cut or rounded to whole seconds
HALF_S = 0.5


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
            first, last = (utc_from_tdb_s(float(self.problem.times[k]), 0) for k in (0, -1))
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


def start_fit(
    problem: OrbitProblem,
    solver: OrbitSolver,
    first: tuple[float, FloatArray],
    most: float = math.inf,
) -> Trajectory:
    """Find a trajectory near enough, by longer windows.

    first  a time and a state (6,) that is roughly right
    most   chi-square of the middle scalar measurement over that of right ones, above which the
           first state is given up

    Raises NoSolutionError where it is, or where no trajectory is found.
    """
    tdb_s, state = first
    times, parameters = problem.times, np.zeros(problem.width - 6)
    node = int(np.argmin(np.abs(times - tdb_s)))
    states = np.empty((len(times), 6))
    after = float(times[node]) - tdb_s
    states[node] = problem.motion.carry(state, tdb_s, after)[0] if after else state
    radian = problem.motion.radian_s(state[:3])
    low = high = node
    before: OrbitSolver | None = None
    fixes_alone = not problem.sets
    for window in _windows(problem):
        near = np.flatnonzero(np.abs(times - times[node]) <= window * radian)
        had = low
        low, high = _lengthen(problem, states, (low, high), (int(near[0]), int(near[-1])))
        part = problem.part(low, high)
        if problem.sets and not part.priors and _is_open(part):
            continue
        inner = solver if part is problem and problem.fixes else solver.of(part)
        if before is not None and low == had and problem.fixes:
            # else the first state is open by so many sigmas that covariances lose their digits
            inner.sigmas = before.sigmas
        before = inner
        at = Trajectory(states[low : high + 1], parameters)
        for _ in range(ROBUST_STEPS):
            weights = robust_weights(part, at)
            if part is problem and fixes_alone and weights.min() > DOUBTED:
                break  # none of them is doubted: the fit itself goes on, with all of them
            at, _, size = inner.step(at, weights)
            if not np.isfinite(at.states).all():
                text = f"the {problem.measured} fit no orbit of these forces"
                raise NoSolutionError(text)
            if size < (NEAR_WHOLE if part is problem and fixes_alone else NEAR):
                break
        if median_ratio(part, at) > most:
            raise NoSolutionError(f"another orbit fits the {problem.measured} better")
        states[low : high + 1], parameters = at.states, at.parameters
        if low == 0 and high == len(times) - 1:
            break
    return Trajectory(states, parameters)


def _windows(problem: OrbitProblem) -> tuple[float, ...]:
    """Windows, rad, that the fit of a problem grows over."""
    if problem.tracking:  # a prior that serves fixes is off by thousands of their sigmas in days
        return TRACKING_WINDOWS_RAD
    return (math.inf,) if problem.priors else WINDOWS_RAD


def _is_open(part: OrbitProblem) -> bool:
    """Whether the measurements of a part are too few to move its states by."""
    return len(part.times) == 1 or (len(part.scalars) < MIN_SIGHTS and len(part.fixes) < 2)


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


def robust_weights(problem: OrbitProblem, at: Trajectory) -> FloatArray:
    """Weights that let a measurement far from the trajectory count little."""
    weights = np.empty(problem.count)
    for number, fix in enumerate(problem.fixes):
        residual = problem.measure(number, at)[0]
        chi_square = float(residual @ np.linalg.solve(fix.covariance_m2, residual))
        weights[number] = 1.0 / (1.0 + chi_square / ROBUST_CHI_SQUARE)
    if problem.sets:
        squares = (problem.rows(at).residuals / problem.scalars.sigmas) ** 2
        for here in problem.scalars.spans:
            # a trajectory that is still far off is not the measurements' fault
            typical = max(float(np.median(squares[here])) / MEDIAN_OF_1, 1.0)
            squares[here] /= typical
        weights[len(problem.fixes) :] = 1.0 / (1.0 + squares / ROBUST_CHI_SQUARE)
    return weights


def median_ratio(problem: OrbitProblem, at: Trajectory) -> float:
    """Median chi-square of scalar measurements over its expectation; 0 without any."""
    if not problem.sets:
        return 0.0
    squares = (problem.rows(at).residuals / problem.scalars.sigmas) ** 2
    return float(np.median(squares)) / MEDIAN_OF_1


def with_time_errors(
    problem: OrbitProblem, start: Callable[[OrbitProblem], Trajectory]
) -> OrbitProblem:
    """Add what errors of the stamps do to the covariances of the fixes.

    start  finds a trajectory near the fixes of a problem
    """
    if not any(fix.time_sigma_s for fix in problem.fixes):
        return problem
    wide = []
    for number, fix in enumerate(problem.fixes):
        position = problem.inertial(number)
        speed = float(np.linalg.norm(position)) / problem.motion.radian_s(position)
        wide.append(_moved(fix, np.eye(3) * speed))
    rough = replace(problem, fixes=wide)
    speeds = body_fixed_speeds(rough, start(rough))
    timed = [_moved(fix, speed[:, None]) for fix, speed in zip(problem.fixes, speeds, strict=True)]
    return replace(problem, fixes=timed)


def _moved(fix: OrbitFix, by_second: FloatArray) -> OrbitFix:
    timing = (fix.time_sigma_s or 0.0) ** 2 * by_second @ by_second.T
    return replace(fix, covariance_m2=fix.covariance_m2 + timing, timing_m2=timing)


def body_fixed_speeds(problem: OrbitProblem, at: Trajectory) -> FloatArray:
    """Velocities (n, 3) of the fixes along a trajectory, as the body frame sees them, m/s."""
    speeds = np.empty((len(problem.fixes), 3))
    for number, node in enumerate(problem.node_of):
        state = at.states[node]
        turned = problem.turn(number, 0.5) - problem.turn(number, -0.5)
        speeds[number] = problem.turn(number) @ state[3:] + turned @ state[:3]
    return speeds


def are_whole_seconds(fixes: Sequence[OrbitFix]) -> bool:
    """Tell whether all stamps are of whole seconds, and nothing is stated of their errors."""
    return all(WHOLE_SECOND.fullmatch(fix.utc) and not fix.time_sigma_s for fix in fixes)


def with_whole_seconds(problem: OrbitProblem) -> OrbitProblem:
    """Give each fix the error of a stamp of whole seconds."""
    return replace(problem, fixes=[replace(fix, time_sigma_s=ROUNDED_S) for fix in problem.fixes])


def lie_within_half_a_second(
    problem: OrbitProblem, at: Trajectory, residuals_m: FloatArray
) -> bool:
    """Tell whether residuals (n, 3) of fixes are those of stamps of whole seconds.

    Along the motion they are at most what half a second makes, but for the errors of the fixes;
    they are wider there than across it.
    """
    speeds = body_fixed_speeds(problem, at)
    size = np.linalg.norm(speeds, axis=1)
    along = (residuals_m * speeds).sum(axis=1) / size
    across = np.linalg.norm(residuals_m - along[:, None] * speeds / size[:, None], axis=1)
    covariances = np.array([fix.sighted_m2 for fix in problem.fixes])
    sigmas = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    inside = np.abs(along - np.median(along)) < HALF_S * size + 3.0 * sigmas
    return bool(inside.all() and np.median(np.abs(along)) > np.median(across))
