"""A first orbit: of a prior, or through the two fixes that most of the next ones agree with."""

import math

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.orbit.fit.problem import OrbitProblem

MAX_FIRST, MAX_PAIRS = 14, 12
BEST_GAP_RAD, MAX_GAP_RAD = 0.25, 2.5
WINDOW_RAD = 2.2  # over which a pair is judged
SHOTS = 12
GOOD_SCORE = 1.0  # the next fixes lie within their sigmas: no need of a better pair


def first_orbit(problem: OrbitProblem) -> tuple[int, FloatArray]:
    """A node and its state (6,). Raises NoSolutionError where no pair of fixes gives an orbit."""
    if problem.priors:
        return problem.prior_nodes[0], problem.priors[0].state
    places = np.array([problem.inertial(number) for number in range(len(problem.fixes))])
    best: tuple[float, int, FloatArray] | None = None
    for start, other in _pairs(problem, places):
        try:
            state = _through(problem, places, start, other)
            score = _score(problem, places, start, state)
        except NoSolutionError:
            continue
        if best is None or score < best[0]:
            best = score, problem.node_of[start], state
        if score < GOOD_SCORE:
            break
    if best is None:
        raise NoSolutionError(
            "no two fixes lie near enough in time for a first orbit; state a [[prior]]"
        )
    return best[1], best[2]


def _pairs(problem: OrbitProblem, places: FloatArray) -> list[tuple[int, int]]:
    """Pairs of fixes, those with the best gap first."""
    times = np.array([fix.tdb_s for fix in problem.fixes])
    candidates = []
    for earlier in range(len(times)):
        radian = problem.motion.radian_s(places[earlier])
        for other in range(earlier + 1, len(times)):
            gap = (times[other] - times[earlier]) / radian
            if gap > MAX_GAP_RAD:
                break
            if gap > 1e-3:
                # an early pair is as good as a later one, but one of them may be wrong
                candidates.append((abs(math.log(gap / BEST_GAP_RAD)), earlier, other))
        if len({pair[1] for pair in candidates}) >= MAX_FIRST:
            break
    best = sorted(candidates)
    spread: list[tuple[int, int]] = []
    starts: dict[int, int] = {}
    for _, earlier, other in best:  # no more than two that start at one fix
        if starts.get(earlier, 0) < 2:
            spread.append((earlier, other))
            starts[earlier] = starts.get(earlier, 0) + 1
    return spread[:MAX_PAIRS]


def _through(problem: OrbitProblem, places: FloatArray, one: int, other: int) -> FloatArray:
    """The state at a fix from which the motion leads to another one."""
    start, gap = places[one], problem.fixes[other].tdb_s - problem.fixes[one].tdb_s
    radian = problem.motion.radian_s(start)
    chord = (places[other] - start) / gap
    velocity = chord + start * gap / (2.0 * radian**2)
    state = np.concatenate([start, velocity])
    for _ in range(SHOTS):
        end, phi = problem.motion.carry(state, problem.fixes[one].tdb_s, gap)
        miss = places[other] - end[:3]
        change = np.linalg.lstsq(phi[:3, 3:], miss, rcond=1e-9)[0]
        most = float(np.linalg.norm(start)) / radian
        change *= min(1.0, most / max(float(np.linalg.norm(change)), 1e-300))
        state[3:] += change
        if float(np.linalg.norm(miss)) < 1.0:
            return state
    raise NoSolutionError("no orbit leads from the one fix to the other")


def _score(problem: OrbitProblem, places: FloatArray, one: int, state: FloatArray) -> float:
    """The middle distance of the next fixes from an orbit, by their sigmas and the orbit's own."""
    fixes, start = problem.fixes, problem.fixes[one]
    radian = problem.motion.radian_s(state[:3])
    near = [
        k
        for k, fix in enumerate(fixes)
        if k != one and abs(fix.tdb_s - start.tdb_s) < WINDOW_RAD * radian
    ]
    if not near:
        return math.inf
    times = np.array([fixes[k].tdb_s for k in near])
    states = problem.motion.path(state, start.tdb_s, times)
    offsets = np.linalg.norm(states[:, :3] - places[near], axis=1)
    sigmas = np.sqrt([np.trace(fixes[k].covariance_m2) for k in near])
    # an orbit through two fixes is wrong by so much more the farther they are apart
    apart = 1.0 + np.abs(times - start.tdb_s) / (BEST_GAP_RAD * radian)
    return float(np.median(offsets / (sigmas * apart)))
