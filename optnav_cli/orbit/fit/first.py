"""A first orbit: of a prior, through two fixes that the next ones agree with, or of sights."""

import math
from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.orbit.fit.problem import OrbitProblem
from optnav_cli.orbit.fit.zenith import ZenithSights

MIN_FIXES = 3
MAX_FIRST, MAX_PAIRS = 14, 12
BEST_GAP_RAD, MAX_GAP_RAD = 0.25, 2.5
WINDOW_RAD = 2.2  # over which a pair is judged
SHOTS = 12
GOOD_SCORE = 1.0  # the next fixes lie within their sigmas: no need of a better pair

# Of the mean motion: no orbit is lower than this share of the radius; steps in radians at the ends.
LOWEST, STEP_RAD = 0.97, 0.4
MAX_RAD = 120.0  # of the lowest orbit's motion: what is looked at of a long arc
MAX_USED = 300  # sights
# What a direction may differ from the model's, and its vectors but the first two: small orbits'
# eccentricities.
MODEL_ERROR, ECCENTRIC = 3e-3, 0.1
FLAT = 1e-6  # of the stars' moments: below it they lie in one plane
SHAPE_ERROR = 0.1
MAX_FOUND = 4
MIN_SIGHTS = 6
NODE_RAD = 0.19  # of the motion between nodes: noise is added up in one piece
QUIET_NODE_RAD = 1.0  # without noise: near enough for steps of Gauss and Newton
MAX_NODES = 20_000


def first_states(problem: OrbitProblem) -> list[tuple[float, FloatArray]]:
    """Times and states (6,) that a fit may start from, the best one first.

    Of a prior, else of fixes, else of zenith distances. Raises NoSolutionError where none of these
    gives an orbit.
    """
    if problem.priors:
        return [(prior.tdb_s, prior.state) for prior in problem.priors[:1]]
    if len(problem.fixes) >= MIN_FIXES:
        node, state = _through_fixes(problem)
        return [(float(problem.times[node]), state)]
    if problem.sights is not None:
        candidates = first_orbits(problem.sights, problem.motion.forces.gm, problem.radius_m)
        return [(orbit.tdb_s, orbit.state) for orbit in candidates]
    raise NoSolutionError(
        f"the {problem.measured} give no first orbit; add {MIN_FIXES} fixes or more, or a [[prior]]"
    )


def with_nodes(problem: OrbitProblem, state: FloatArray, step_s: float = math.inf) -> OrbitProblem:
    """Lay nodes for the scalar measurements, where there are any.

    state   (6,) of about the orbit, whose motion the nodes' distance follows
    step_s  nodes are no farther apart

    Raises NoSolutionError for an arc of more than MAX_NODES.
    """
    if not problem.sets:
        return problem
    epochs = np.concatenate([part.epochs.ravel() for part in problem.sets])
    stamps = [*(fix.tdb_s for fix in problem.fixes), epochs.min(), epochs.max()]
    first, last = float(min(stamps)), float(max(stamps))
    # at the pericentre the motion is quickest: by a third there for an eccentricity of 0.2
    step = min(NODE_RAD * problem.motion.radian_s(state[:3]) / 1.5, step_s)
    if problem.motion.is_noisy:
        step = min([step, *(part.node_step_s for part in problem.sets)])
    elif problem.tracking:
        step = min(QUIET_NODE_RAD * problem.motion.radian_s(state[:3]), step_s)
    count = max(math.ceil((last - first) / step), 1)
    if count > MAX_NODES:
        raise NoSolutionError(
            f"the {problem.measured} span {(last - first) / 86400.0:.1f} days, {count} steps of "
            f"the motion; wanted at most {MAX_NODES}: fit parts of them"
        )
    return replace(problem, between=np.linspace(first, last, count + 1))


def _through_fixes(problem: OrbitProblem) -> tuple[int, FloatArray]:
    """A node and its state (6,). Raises NoSolutionError where no pair of fixes gives an orbit."""
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


@dataclass(frozen=True, eq=False)
class FirstOrbit:
    """A state (6,) at a time, inertial, and how badly its model fits."""

    tdb_s: float
    state: FloatArray
    cost: float


def first_orbits(sights: ZenithSights, gm: float, radius_m: float) -> list[FirstOrbit]:
    """Circular orbits that may have the sights, the best one first; of two stars in mirrored pairs.

    The sights are of two stars or more.
    """
    fastest = float(np.sqrt(gm / (LOWEST * radius_m) ** 3))
    times = sights.tdb_s - sights.tdb_s[0]
    inside = np.flatnonzero(times <= MAX_RAD / fastest)
    used = inside[np.unique(np.linspace(0, len(inside) - 1, MAX_USED).round().astype(int))]
    times, stars = times[used], sights.directions[used]
    middle = 0.5 * float(times[-1])
    since, cosines = times - middle, np.cos(sights.values_rad[used])
    steps = max(int(np.ceil(fastest * float(times[-1]) / STEP_RAD)), 4)
    rates = fastest * np.arange(1, steps + 1) / steps
    vectors, costs = _fitted(rates, since, stars, cosines)
    moments, axes = np.linalg.eigh(stars.T @ stars / len(stars))
    across = axes[:, 0] if moments[0] < FLAT else None
    candidates = []
    for k, rate in enumerate(rates):
        for cosine_axis, sine_axis in _axis_pairs(vectors[k, 1], vectors[k, 2], across):
            off = [
                float(cosine_axis @ cosine_axis) - 1.0,
                float(sine_axis @ sine_axis) - 1.0,
                2.0 * float(cosine_axis @ sine_axis),
            ]
            cost = float(costs[k]) + float(np.square(off).sum()) / SHAPE_ERROR**2
            left, _, right = np.linalg.svd(np.array([cosine_axis, sine_axis]), full_matrices=False)
            first, second = left @ right
            size = float(gm / rate**2) ** (1.0 / 3.0)
            state = np.concatenate([size * first, size * rate * second])
            candidates.append(FirstOrbit(float(sights.tdb_s[0]) + middle, state, cost))
    return sorted(candidates, key=lambda orbit: orbit.cost)[:MAX_FOUND]


def _fitted(
    rates: FloatArray, since: FloatArray, stars: FloatArray, cosines: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Vectors (k, 5, 3) of 1, cos, sin, cos and sin of twice, and costs (k,) of each rate."""
    angle = rates[:, None] * since
    basis = np.ones((*angle.shape, 5))
    basis[..., 1], basis[..., 2] = np.cos(angle), np.sin(angle)
    basis[..., 3], basis[..., 4] = np.cos(2.0 * angle), np.sin(2.0 * angle)
    rows = (basis[..., None] * stars[:, None]).reshape(len(rates), len(since), 15)
    ridge = np.repeat([ECCENTRIC, 1.0, 1.0, ECCENTRIC, ECCENTRIC], 3) ** -2.0
    normal = rows.transpose(0, 2, 1) @ rows / MODEL_ERROR**2 + np.diag(ridge)
    right = rows.transpose(0, 2, 1) @ cosines / MODEL_ERROR**2
    solution = np.linalg.solve(normal, right[..., None])[..., 0]
    residuals = (rows @ solution[..., None])[..., 0] - cosines
    costs = (residuals**2).sum(axis=1) / MODEL_ERROR**2 + (solution**2 * ridge).sum(axis=1)
    return np.asarray(solution.reshape(-1, 5, 3), np.float64), np.asarray(costs, np.float64)


def _axis_pairs(
    first: FloatArray, second: FloatArray, across: FloatArray | None
) -> list[tuple[FloatArray, FloatArray]]:
    """The two axes; where the stars lie in a plane, with what lies across it, either way."""
    if across is None:
        return [(first, second)]
    first, second = first - (first @ across) * across, second - (second @ across) * across
    a, b = (float(np.sqrt(max(1.0 - float(v @ v), 0.0))) for v in (first, second))
    sign = -1.0 if float(first @ second) > 0.0 else 1.0
    return [(first + side * a * across, second + side * sign * b * across) for side in (1.0, -1.0)]
