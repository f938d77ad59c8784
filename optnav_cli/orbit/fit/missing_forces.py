"""Judge an orbit's fit by the pattern of its residuals, and try the forces that it left out.

A force left out moves the craft by less than one measurement shows, and by many times the sigma of
the orbit through thousands: its residuals go together along the arc. Where chance makes them so
with less than PATTERN_PROBABILITY, each force that the fit lacks is solved for in turn, and the one
that mends the residuals is named. Third bodies (Sun, planet, the Earth's Moon) are in every fit.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import msgspec
import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import ConfigError, DataError, NoSolutionError
from optnav_cli.dynamics.forces import Forces
from optnav_cli.dynamics.left_out import forces_left_out
from optnav_cli.estimation.smoother import SmoothedArc, smooth
from optnav_cli.orbit.fit.problem import OrbitProblem, Trajectory
from optnav_cli.orbit.fit.settings import ParameterSettings

PARTS_OF_REVOLUTION = 8  # a force left out acts with the revolution, or half of it
MIN_IN_PART = 4.0  # residuals, in the mean: else parts are longer
MIN_PARTS = 4
# False alarms: a right fit is refused with this probability at most.
PATTERN_PROBABILITY = 1e-6
# Below it the covariance is inflated: of 200 right fits, 0.02 are by chance.
INFLATED_PROBABILITY = 1e-4
MENDING_PROBABILITY = 1e-6  # of as large a fall of chi-square by chance
STEPS = 3  # of Gauss and Newton with a force more, from a fit that is near
SUNLIGHT_SIGMA = 10.0  # m^2/kg: an open prior; sails have 0.2
ACCELERATION_SIGMA = 1e-3  # m/s^2
MEDIAN_OF_1, MEDIAN_OF_3 = 0.455, 2.366  # of a chi-square of one number, of three
REFUTED = "the residuals refute the fit"
REFUTED_PROBABILITY = 1e-6
SHOCK_PROBABILITY = 1e-9  # of a manoeuvre or a jump by chance
MAX_LEFT_OUT = 1.0 / 3.0
MAX_SCATTER = 3.0  # times the stated sigmas, of the middle measurement
# Of the residuals to their sigmas; beyond it they refute the fit, below it is a remark: what stands
# for the field that is left out is right to some tens of percent.
MAX_RATIO = 1.5


def pattern_probability(
    values: FloatArray, series: IntArray, times: FloatArray, revolution_s: float
) -> float:
    """Compute the probability that chance makes residuals so alike in parts of an arc.

    values        (n,) residuals over their sigmas, as far as they err for themselves
    series        (n,) number of the series;  times (n,) s
    revolution_s  how long the motion takes for a revolution

    Returns 1 where there are too few to say.
    """
    parts = next(_parts(series, times, revolution_s), None)
    if parts is None:
        return 1.0
    group, count = parts
    means = np.bincount(group, values) / count
    between = float((count * means**2).sum())
    within = float(((values - means[group]) ** 2).sum())
    freedom = len(values) - len(count)
    if freedom < 1:
        return 1.0
    return float(fdtrc(len(count), freedom, between / len(count) / max(within / freedom, 1.0)))


def pattern_inflation(
    values: FloatArray, series: IntArray, times: FloatArray, revolution_s: float
) -> float:
    """Compute how much larger a covariance is by errors that go together as the residuals do.

    Means of n independent errors of one sigma have a variance of 1/n; the factor is the mean square
    of such means times n, in the series and the length of parts where it is largest: what an orbit
    is wrong by varies slowly, as they do. Arguments as of `pattern_probability`.

    Returns the factor of the covariance, at least 1.
    """
    factor = 1.0
    for group, count in _parts(series, times, revolution_s):
        means = np.bincount(group, values) / count
        of = np.zeros(len(count), np.int64)
        of[group] = series
        squares = np.bincount(of, count * means**2) / np.maximum(np.bincount(of), 1)
        factor = max(factor, float(squares.max()))
    return factor


def _parts(
    series: IntArray, times: FloatArray, revolution_s: float
) -> Iterator[tuple[IntArray, IntArray]]:
    """Number (n,) of the part and series of each residual, and their counts; longer parts next."""
    if not len(times):
        return
    since, width = times - times.min(), revolution_s / PARTS_OF_REVOLUTION
    while True:
        part = np.floor(since / width).astype(np.int64)
        if part.max() < MIN_PARTS - 1:
            return
        _, group = np.unique(np.stack([series, part], axis=1), axis=0, return_inverse=True)
        group = group.ravel()
        count = np.bincount(group)
        if len(times) >= MIN_IN_PART * len(count):
            yield group, count
        width *= 2.0


@dataclass(frozen=True, eq=False)
class _Solved:
    """A fit with what is tried: trajectory, chi-square, residuals.

    residuals  standardised, their series and times: what `pattern_probability` takes, with the
               revolution in s
    """

    at: Trajectory
    chi_square: float
    residuals: tuple[FloatArray, IntArray, FloatArray, float]

    @cached_property
    def probability(self) -> float:
        """Probability of such a pattern of the residuals by chance."""
        return pattern_probability(*self.residuals)

    @cached_property
    def inflation(self) -> float:
        """Factor of the covariance by that pattern."""
        return pattern_inflation(*self.residuals)


@dataclass(frozen=True, eq=False)
class _Trial:
    """A force that the fit lacks: the problem with it, numbers more, and the advice with them."""

    problem: OrbitProblem
    advice: str
    name: str = ""  # of the parameter that is more; none: the forces have no more numbers

    def value(self, at: Trajectory) -> FloatArray:
        """Numbers (n,) of the parameter that is more."""
        spans = [at.parameters[p.span] for p in self.problem.estimated if p.name == self.name]
        return np.concatenate([np.empty(0), *spans])


def check_pattern(
    problem: OrbitProblem, at: Trajectory, used: BoolArray, *, alone: bool
) -> tuple[float, list[str]]:
    """Check the residuals of a fit for a pattern along the arc.

    at     the trajectory that the fit found;  used  (n,) which measurements it rests on
    alone  whether each measurement errs for itself, so that a pattern refutes the fit whatever
           makes it; fixes of like ground may have one by themselves

    Returns the factor of the covariance, 1 without a pattern, and remarks.
    Raises NoSolutionError for a pattern that a force left out mends, or any where `alone`.
    """
    open_problem = _with(problem, [])
    base = _solve(open_problem, _carried(problem, at, open_problem), used, 1)
    if base.probability >= INFLATED_PROBABILITY:
        return 1.0, []
    pattern = (
        f"the residuals of the {problem.measured} follow a pattern along the arc (chance makes it "
        f"with {base.probability:.1g})"
    )
    inflated = (
        f"{pattern}, so the orbit's sigmas are {math.sqrt(base.inflation):.3g} times those of "
        "errors without one"
    )
    if base.probability >= PATTERN_PROBABILITY:
        return (1.0, []) if alone else (base.inflation, [inflated])
    mends, forces = mending(problem, at, used, base)
    if mends or alone:
        raise NoSolutionError(
            f"the residuals refute the fit: {pattern}, as a force left out does; {forces}"
        )
    return base.inflation, [f"{inflated}: {forces}"]


def mending(
    problem: OrbitProblem, at: Trajectory, used: BoolArray, base: _Solved | None = None
) -> tuple[bool, str]:
    """Tell whether a force that is left out mends the residuals of a fit, and which, in words."""
    if base is None:
        open_problem = _with(problem, [])
        base = _solve(open_problem, _carried(problem, at, open_problem), used, STEPS)
    best: tuple[float, str] | None = None
    tried = []
    for trial in _trials(problem):
        tried.append(trial.advice.partition(" of ")[0])
        try:
            solved = _solve(trial.problem, _carried(problem, at, trial.problem), used, STEPS)
        except NoSolutionError:
            continue
        fall, value = base.chi_square - solved.chi_square, trial.value(solved.at)
        if fall <= 0.0 or chdtrc(max(len(value), 1), fall) > MENDING_PROBABILITY:
            continue
        if best is None or solved.chi_square < best[0]:
            advice = trial.advice.format(value=", ".join(f"{v:.3g}" for v in value))
            best = solved.chi_square, advice
    sizes = "; ".join(forces_left_out(problem.motion.forces, at.states[0], *_span(problem)))
    if best is None:
        words = f"none of these mends it: {', '.join(tried)}" if tried else ""
        return False, f"{words}; left out are {sizes}. See that sigmas and times are right"
    force, _, remedy = best[1].partition(":")
    return True, (
        f"{force} lowers chi-square from {base.chi_square:.0f} to {best[0]:.0f}:{remedy} (left "
        f"out are {sizes})"
    )


def _span(problem: OrbitProblem) -> tuple[float, float]:
    return float(problem.times[0]), float(problem.times[-1] - problem.times[0])


def _with(problem: OrbitProblem, more: Sequence[ParameterSettings]) -> OrbitProblem:
    """The problem with all that is considered estimated, and further parameters."""
    parameters = [msgspec.structs.replace(p, mode="estimate") for p in problem.parameters]
    return replace(problem, parameters=[*parameters, *more])


def _trials(problem: OrbitProblem) -> Iterator[_Trial]:
    names = {parameter.name for parameter in problem.parameters}
    body, settings = problem.ephemeris.body, problem.motion.forces.settings
    if "srp" not in names:
        sunlight = ParameterSettings("srp", prior_sigma=SUNLIGHT_SIGMA)
        advice = "sunlight pressure of {value} m2/kg: solve for it by --solve srp"
        yield _Trial(_with(problem, [sunlight]), advice, "srp")
    if settings.degree is not None:
        higher = msgspec.structs.replace(settings, degree=None)
        try:
            forces = Forces(problem.ephemeris, higher)
        except (ConfigError, DataError):
            forces = None
        if forces is not None and forces.field.degree > problem.motion.forces.field.degree:
            fuller = replace(_with(problem, []), motion=problem.motion.with_forces(forces))
            advice = f"gravity of degree {forces.field.degree}: leave [forces] degree out"
            yield _Trial(fuller, advice)
    if "acceleration" not in names:
        constant = ParameterSettings("acceleration", prior_sigma=ACCELERATION_SIGMA)
        why = "drag or another constant" if body.atmosphere is not None else "a constant"
        advice = f"{why} acceleration of {{value}} m/s2 along R, N, B: solve for it by --solve "
        yield _Trial(_with(problem, [constant]), advice + "acceleration", "acceleration")


def _carried(problem: OrbitProblem, at: Trajectory, to: OrbitProblem) -> Trajectory:
    """A trajectory with the parameters of another problem; new ones are 0."""
    parameters = np.zeros(to.width - 6)
    before = {(p.name, p.settings.label): p for p in problem.estimated}
    for p in to.estimated:
        same = before.get((p.name, p.settings.label))
        if same is not None:
            parameters[p.span] = at.parameters[same.span]
    return Trajectory(at.states, parameters)


def _solve(problem: OrbitProblem, at: Trajectory, used: BoolArray, steps: int) -> _Solved:
    weights = used.astype(np.float64)
    for _ in range(steps):
        arc, _ = problem.linearise(at, weights)
        smoothed = smooth(arc)
        chi_square = smoothed.chi_square + problem.left_over(at, weights)
        deltas = smoothed.deviations[:, : problem.width, 0]
        at = Trajectory(at.states + deltas[:, :6], at.parameters + deltas[-1, 6:])
    revolution_s = float(2.0 * np.pi * problem.motion.radian_s(at.states[0, :3]))
    return _Solved(at, chi_square, (*problem.standardised(at, smoothed, used), revolution_s))


def check_breaks(problem: OrbitProblem, at: Trajectory, found: SmoothedArc, worst: float) -> None:
    """Raise NoSolutionError where the fixes before and after a time are of two orbits.

    The adjoint state of an interval tests a shock there: with three numbers a manoeuvre, with six
    another flight (de Jong and Penzer, "Diagnosing shocks in time series", 1998).

    worst  largest chi-square of a fix
    """
    if not found.information.size:
        return
    limit = 2.0 * worst + float(chdtri(3, SHOCK_PROBABILITY / max(len(found.scores), 1)))
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
    mends, forces = mending(problem, at, np.ones(len(problem.fixes), bool))
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


def _utc(problem: OrbitProblem, node: int) -> str:
    return utc_from_tdb_s(float(problem.times[node]), 0)


@dataclass(frozen=True, eq=False)
class FitVerdict:
    """The residuals of an orbit's fit.

    what         the measurements, in words
    chi_squares  (n,) of each against all others;  median  of such a one by chance
    used         (n,) which of them the fit has
    chi_square, freedom  of the whole fit
    """

    what: str
    chi_squares: FloatArray
    median: float
    used: BoolArray
    chi_square: float
    freedom: int

    def refute(self, advice: str) -> None:
        """Raise NoSolutionError where the middle residual, or too many, disagree with the others.

        advice  what may be wrong
        """
        count = len(self.used)
        scatter = math.sqrt(float(np.median(self.chi_squares)) / self.median)
        if scatter > MAX_SCATTER:
            raise NoSolutionError(
                f"{REFUTED}: the middle one of {count} {self.what} lies {scatter:.3g} times its "
                f"sigma from the orbit of the others; {advice}"
            )
        out = int(np.count_nonzero(~self.used))
        if out > MAX_LEFT_OUT * count:
            raise NoSolutionError(
                f"{REFUTED}: {out} of {count} {self.what} would be left out; {advice}"
            )

    def remarks(self, advice: str, sized: str) -> list[str]:
        """Write the remarks about a fit that stands.

        advice  what may be wrong where it does not;  sized  whose size the scatter tells of
        Raises NoSolutionError where the residuals refute the fit.
        """
        self.refute(advice)
        if self.freedom <= 0:
            return [f"the {self.what} leave nothing to test the orbit by"]
        ratio = math.sqrt(self.chi_square / self.freedom)
        probability = float(chdtrc(self.freedom, self.chi_square))
        if probability < REFUTED_PROBABILITY and ratio > MAX_RATIO:
            raise NoSolutionError(
                f"{REFUTED}: chi-square {self.chi_square:.0f} of {self.freedom}, {ratio:.2f} times "
                f"the stated sigmas; {advice}"
            )
        if min(probability, 1.0 - probability) < REFUTED_PROBABILITY:
            size = "small" if ratio > 1.0 else "large"
            return [
                f"the {self.what} scatter {ratio:.2f} times their stated sigmas: {sized} too {size}"
            ]
        return []
