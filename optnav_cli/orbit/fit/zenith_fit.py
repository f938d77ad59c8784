"""Fit an orbit through zenith distances of stars: a first orbit, the smoother, outliers, words."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtri

from catalog.arrays import BoolArray, FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.estimation.smoother import SmoothedArc
from optnav_cli.orbit.fit.fit import (
    DOUBTED,
    MAX_ROUNDS,
    NEAR,
    ROBUST_CHI_SQUARE,
    ROBUST_STEPS,
    SWAMPED,
    WINDOWS_RAD,
    OrbitFit,
    OrbitSolver,
    with_considered,
)
from optnav_cli.orbit.fit.missing_forces import MAX_SCATTER, MEDIAN_OF_1, FitVerdict, check_pattern
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.problem import OrbitPrior, Trajectory, unobserved_remarks
from optnav_cli.orbit.fit.settings import ParameterSettings
from optnav_cli.orbit.fit.zenith import ZenithSights
from optnav_cli.orbit.fit.zenith_problem import ZenithProblem, first_orbits

NODE_RAD = 0.19  # of the motion between nodes: noise is added up in one piece
MAX_NODES = 20_000
MIN_SIGHTS = 6
# Two first orbits whose fits differ by less in chi-square are both the sights'.
ALIKE = 50.0
DROPPED = 25.0  # times the chi-square of a fit there is: a first orbit is not followed further


@dataclass(frozen=True, eq=False)
class SightResidual:
    """Residuals of all sights: rad (n,), chi-squares (n,) by their covariances, used (n,)."""

    residual_rad: FloatArray
    chi_square: FloatArray
    used: BoolArray


@dataclass(frozen=True, eq=False)
class ZenithFit(OrbitFit):
    """An orbit through sights; `problem` is theirs."""

    problem: ZenithProblem

    sights: ZenithSights = field(kw_only=True)
    looks: SightResidual = field(kw_only=True)

    @property
    def count(self) -> int:
        return len(self.sights)

    @property
    def used(self) -> int:
        return int(self.looks.used.sum())


def zenith_problem(
    motion: ArcMotion,
    sights: ZenithSights,
    priors: Sequence[OrbitPrior],
    parameters: Sequence[ParameterSettings],
    state: FloatArray,
    step_s: float = math.inf,
) -> ZenithProblem:
    """The problem with its nodes.

    state   (6,) of about the orbit, whose motion the nodes' distance follows
    step_s  nodes are no farther apart

    Raises NoSolutionError for an arc of more than MAX_NODES.
    """
    first, last = float(sights.tdb_s[0]), float(sights.tdb_s[-1])
    # at the pericentre the motion is quickest: by a third there for an eccentricity of 0.2
    step = min(NODE_RAD * motion.radian_s(state[:3]) / 1.5, step_s)
    count = max(math.ceil((last - first) / step), 1)
    if count > MAX_NODES:
        raise NoSolutionError(
            f"the zenith distances span {(last - first) / 86400.0:.1f} days, {count} steps of the "
            f"motion; wanted at most {MAX_NODES}: fit parts of them"
        )
    nodes = np.linspace(first, last, count + 1)
    radius = motion.ephemeris.body.radius_m
    return ZenithProblem(motion, [], list(priors), list(parameters), radius, nodes, sights=sights)


def fit_zenith(
    motion: ArcMotion,
    sights: ZenithSights,
    priors: Sequence[OrbitPrior],
    parameters: Sequence[ParameterSettings],
    gate_probability: float,
) -> ZenithFit:
    """Fit. Raises NoSolutionError where the sights leave the orbit open or fit none."""
    _check(sights, bool(priors))
    fit = best_fit(motion, sights, priors, parameters, gate_probability)
    check_pattern(fit.problem, fit.trajectory, fit.looks.used, alone=True)
    return with_remarks(fit, [*_one_star(sights), *_judged_fit(fit)])


def best_fit(
    motion: ArcMotion,
    sights: ZenithSights,
    priors: Sequence[OrbitPrior],
    parameters: Sequence[ParameterSettings],
    gate_probability: float,
) -> ZenithFit:
    """The fit that its residuals are not judged by. Raises NoSolutionError where there is none."""
    if priors:
        starts = [(priors[0].tdb_s, priors[0].state)]
    else:
        body = motion.ephemeris.body
        candidates = first_orbits(sights, motion.forces.gm, body.radius_m)
        starts = [(orbit.tdb_s, orbit.state) for orbit in candidates]
    begun: list[tuple[float, ZenithProblem, Trajectory]] = []
    said: NoSolutionError | None = None
    for first in starts:
        problem = zenith_problem(motion, sights, priors, parameters, first[1])
        least = min((ratio for ratio, *_ in begun), default=math.inf)
        try:
            at = _start(problem, first, DROPPED * max(least, 1.0))
        except NoSolutionError as error:
            text = (
                f"the zenith distances fit no one orbit ({error}); see that they are of one flight"
            )
            said = said or NoSolutionError(text)
            continue
        begun.append((_usual(problem, at), problem, at))
        if len(sights.stars_used) > 2 and begun[-1][0] < MAX_SCATTER**2:
            break
    fits: list[ZenithFit] = []
    for usual, problem, at in sorted(begun, key=lambda start: start[0]):
        if fits and usual > DROPPED * max(_usual(fits[0].problem, fits[0].trajectory), 1.0):
            break
        try:
            fits.append(settled(problem, at, gate_probability))
        except NoSolutionError as error:
            said = said or error
    if not fits:
        raise said or NoSolutionError("the zenith distances fit no orbit; state a [[prior]]")
    fits.sort(key=lambda fit: (fit.count - fit.used, fit.chi_square))
    best = fits[0]
    for other in fits[1:]:
        apart = np.abs(other.trajectory.states[-1] - best.trajectory.states[-1])[:3].max()
        far = apart > 0.01 * float(np.linalg.norm(best.trajectory.states[-1, :3]))
        if far and other.used == best.used and other.chi_square < best.chi_square + ALIKE:
            raise NoSolutionError(
                "two orbits have these zenith distances, mirrored in the plane of "
                f"{' and '.join(sights.stars_used)}: which of them is not observed; add sights of "
                "a third star, or state a [[prior]]"
            )
    return best


def settled(problem: ZenithProblem, at: Trajectory, gate_probability: float) -> ZenithFit:
    """The fit from a trajectory near it, outliers left out, without words.

    Raises NoSolutionError where the steps do not settle.
    """
    solver = OrbitSolver(problem, "white")
    gate = float(chdtri(1, gate_probability))
    weights = _robust(problem, at)
    used = weights > DOUBTED
    seen: set[bytes] = set()
    for _ in range(MAX_ROUNDS):
        at, smoothed = solver.settle(at, used.astype(np.float64))
        looks = _looks(problem, at, smoothed, used)
        judged = _judged(looks, gate)
        if (judged == used).all() or judged.tobytes() in seen:
            break
        seen.add(used.tobytes())
        used = judged
    looks = _looks(problem, at, smoothed, used)
    chi_square = smoothed.chi_square + problem.remainder(problem.rows(at), used.astype(np.float64))
    covariances = with_considered(problem, at, smoothed, used, solver)
    return ZenithFit(
        problem,
        at,
        covariances[:, :6, :6] + problem.motion.local(at.states),
        covariances[-1],
        smoothed.disturbances[:, :6, 0],
        [],
        chi_square,
        int(used.sum()) + 6 * len(problem.priors) - 6,
        solver.steps,
        unobserved_remarks(problem, covariances[-1, 6:, 6:]),
        sights=problem.sights,
        looks=looks,
    )


def with_remarks(fit: ZenithFit, remarks: Sequence[str]) -> ZenithFit:
    """Return the fit with further remarks before its own."""
    return replace(fit, remarks=[*remarks, *fit.remarks])


def denser(fit: ZenithFit, step_s: float) -> ZenithFit:
    """Return the orbit with nodes no farther apart than a step."""
    before, at = fit.problem, fit.trajectory
    problem = zenith_problem(
        before.motion, fit.sights, before.priors, before.parameters, at.states[0], step_s
    )
    if len(problem.times) <= len(before.times):
        return fit
    last = np.searchsorted(before.times, problem.times, "right") - 1
    states = np.empty((len(problem.times), 6))
    motion = before.motion_at(at)
    for node in np.unique(last):
        here = last == node
        start = float(before.times[node])
        states[here] = motion.path(at.states[node], start, problem.times[here])
    used, solver = fit.looks.used, OrbitSolver(problem, "white")
    dense, smoothed = solver.settle(Trajectory(states, at.parameters), used.astype(np.float64))
    covariances = with_considered(problem, dense, smoothed, used, solver)
    return replace(
        fit,
        problem=problem,
        trajectory=dense,
        covariances=covariances[:, :6, :6] + problem.motion.local(dense.states),
        last_covariance=covariances[-1],
    )


def _check(sights: ZenithSights, with_prior: bool) -> None:
    """Raise NoSolutionError for sights that leave an orbit open whatever they are."""
    if with_prior:
        return
    if len(sights.stars_used) == 1:
        raise NoSolutionError(
            f"all zenith distances are of one star, {sights.stars_used[0]}: the orbit's turn about "
            "the direction to it is not observed; add sights of a second star, or state a [[prior]]"
        )
    if len(sights) < MIN_SIGHTS:
        raise NoSolutionError(
            f"too few zenith distances: {len(sights)} leave the orbit open; wanted {MIN_SIGHTS} or "
            "more, or a [[prior]]"
        )


def _one_star(sights: ZenithSights) -> list[str]:
    if len(sights.stars_used) > 1:
        return []
    return [
        f"all zenith distances are of one star, {sights.stars_used[0]}: the orbit's turn about the "
        "direction to it is not observed, and is that of the prior"
    ]


def _start(problem: ZenithProblem, first: tuple[float, FloatArray], most: float) -> Trajectory:
    """A trajectory near enough, from a time and state that is roughly right, by longer windows.

    Raises NoSolutionError where the middle chi-square of a window is above `most` times a right
    one's.
    """
    tdb_s, state = first
    times, parameters = problem.times, np.zeros(problem.width - 6)
    motion = problem.motion
    radian = motion.radian_s(state[:3])
    node = int(np.argmin(np.abs(times - tdb_s)))
    states = np.empty((len(times), 6))
    states[node] = motion.carry(state, tdb_s, float(times[node]) - tdb_s)[0]
    low = high = node
    for window in (math.inf,) if problem.priors else WINDOWS_RAD:
        near = np.flatnonzero(np.abs(times - times[node]) <= window * radian)
        for end, nodes in (
            (high, range(high + 1, int(near[-1]) + 1)),
            (low, range(int(near[0]), low)),
        ):
            if len(nodes):
                start = float(times[end])
                states[list(nodes)] = motion.path(states[end], start, times[list(nodes)])
        low, high = int(near[0]), int(near[-1])
        part = problem.part(low, high)
        if low == high or (len(part.sights) < MIN_SIGHTS and not part.priors):
            continue
        solver, at = OrbitSolver(part, "white"), Trajectory(states[low : high + 1], parameters)
        for _ in range(ROBUST_STEPS):
            at, _, size = solver.step(at, _robust(part, at))
            if size < NEAR:
                break
        if _usual(part, at) > most:
            raise NoSolutionError("another orbit fits the zenith distances better")
        states[low : high + 1], parameters = at.states, at.parameters
        if (low, high) == (0, len(times) - 1):
            break
    return Trajectory(states, parameters)


def _robust(problem: ZenithProblem, at: Trajectory) -> FloatArray:
    """Weights that let a sight far from the trajectory, and from most others, count little."""
    off = (problem.rows(at).residuals / problem.sights.sigmas_rad) ** 2
    # a trajectory that is still far off is not the sights' fault
    usual = max(float(np.median(off)) / MEDIAN_OF_1, 1.0)
    weights: FloatArray = 1.0 / (1.0 + off / (ROBUST_CHI_SQUARE * usual))
    return weights


def _usual(problem: ZenithProblem, at: Trajectory) -> float:
    """The middle chi-square over that of right sights."""
    off = (problem.rows(at).residuals / problem.sights.sigmas_rad) ** 2
    return float(np.median(off)) / MEDIAN_OF_1


def _looks(
    problem: ZenithProblem, at: Trajectory, found: SmoothedArc, used: BoolArray
) -> SightResidual:
    rows, variances = problem.rows(at), problem.sights.sigmas_rad**2
    spread = found.covariances[problem.node_of_sight]
    orbit = (rows.design[:, None] @ spread @ rows.design[:, :, None])[:, 0, 0]
    # of a sight that alone holds the orbit nothing is left to judge it by
    left = np.maximum(np.where(used, variances - orbit, variances + orbit), 1e-6 * variances)
    return SightResidual(rows.residuals, rows.residuals**2 / left, used)


def _judged(looks: SightResidual, gate: float) -> BoolArray:
    """Which to use: those within the gate, and those that a worse one may have moved."""
    worst = float(looks.chi_square[looks.used].max(initial=0.0))
    limit = np.where(looks.used, max(gate, SWAMPED * worst), gate)
    judged: BoolArray = looks.chi_square < limit
    return judged


def _judged_fit(fit: ZenithFit) -> list[str]:
    """Remarks on sights and forces. Raises NoSolutionError where the residuals refute them."""
    judged = FitVerdict(
        "zenith distances",
        fit.looks.chi_square,
        MEDIAN_OF_1,
        fit.looks.used,
        fit.chi_square,
        fit.degrees_of_freedom,
    )
    return judged.remarks(
        "their sigmas are too small, or forces are lacking ([forces] degree, sunlight)", "they are"
    )
