"""Least squares among wrong measurements: robust weights, small-sample consensus, chi-square gates.

Every small sample of the measurements proposes a state; the state that most measurements agree
with starts a least-squares solution, from which disagreeing measurements are taken out one by one
and agreeing ones taken back.
"""

from collections.abc import Callable, Iterator
from itertools import combinations
from typing import TypeVar

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.errors import NoSolutionError
from catalog.geometry.kernel import kernel
from optnav_cli.estimation.least_squares import Estimate, inverse_of
from optnav_cli.reasons import ReasonCode

TUKEY = 4.685  # 95 % efficient for normal errors
MAD_TO_SIGMA = 1.4826
MAX_SAMPLES = 120
MAX_LISTED = 40  # measurements of which all samples are listed before some are drawn
MAX_GATE_ROUNDS = 15
# A sample's own error adds to the residuals of the others: the gate is so many times as wide.
SAMPLE_GATE_FACTOR = 9.0
# Weight, in degrees of freedom, of the stated measurement sigmas against the scatter that a
# frame's own residuals show: a frame with few points leans on the statement. More scatter than is
# stated is taken for true sooner than less, which neighbours that err alike show, too.
STATED_DEGREES_OF_FREEDOM, STATED_IF_LESS = 4.0, 10.0
# Gates follow the scatter up to twice the stated sigmas. Beyond, it is not a larger error but other
# places, and gates that followed would open for every wrong match and certify them all.
MAX_GATE_FACTOR = 4.0

S = TypeVar("S")


def scatter(residuals: FloatArray) -> float:
    """Sigma of residuals (n,) about 0 by their median size, which outliers hardly move."""
    return MAD_TO_SIGMA * float(np.median(np.abs(residuals)))


@kernel
def tukey(ratio: float) -> float:
    """Tukey's biweight of a residual over the cut."""
    return (1.0 - ratio * ratio) ** 2 if abs(ratio) < 1.0 else 0.0


@kernel
def tukey_weights(residuals: FloatArray, cut: float) -> FloatArray:
    """Tukey's biweights (n,) of residuals (n,); 0 beyond the cut."""
    weights = np.empty(residuals.size)
    for i in range(residuals.size):
        weights[i] = tukey(residuals[i] / cut)
    return weights


def consensus(
    count: int,
    size: int,
    propose: Callable[[IntArray], S],
    squares_of: Callable[[S], FloatArray],
    gate: float,
) -> BoolArray:
    """The most measurements (count,) that one state explains, of all and of samples of a size.

    propose     the state of some measurements; may raise NoSolutionError
    squares_of  (count,) squared residuals at a state, in units of their covariance
    gate        of these, for a state that rests on many measurements
    """
    best_count, best_cost = 0, np.inf
    best = np.zeros(count, dtype=bool)
    # All first: where most are right and lie close together, a pair fixes less than they do.
    for sample in (np.arange(count), *_samples(count, size)):
        try:
            squares = squares_of(propose(sample))
        except NoSolutionError:
            continue
        inside = squares < SAMPLE_GATE_FACTOR * gate
        agreeing, cost = int(inside.sum()), float(squares[inside].sum())
        if agreeing > best_count or (agreeing == best_count and cost < best_cost):
            best_count, best_cost, best = agreeing, cost, inside
        if best_count == count:
            break
    return best


def _samples(count: int, size: int) -> Iterator[IntArray]:
    generator = np.random.default_rng(0)
    if count > MAX_LISTED:
        for _ in range(MAX_SAMPLES):
            yield generator.choice(count, size, replace=False)
        return
    samples = np.array(list(combinations(range(count), size)))
    if len(samples) > MAX_SAMPLES:
        samples = generator.permutation(samples)[:MAX_SAMPLES]
    yield from samples


def gated(
    used: BoolArray,
    fewest: int,
    solve: Callable[[BoolArray], Estimate[S]],
    squares_of: Callable[[S], FloatArray],
    gate: float,
) -> tuple[Estimate[S], BoolArray, float]:
    """A solution without the measurements that disagree, which it rests on, and variance factor.

    used  (n,) to begin with;  solve  from the measurements of a mask;  others as in `consensus`

    Raises NoSolutionError when fewer than `fewest` agree.
    """
    for _ in range(MAX_GATE_ROUNDS):
        if used.sum() < fewest:
            raise NoSolutionError("the matches contradict each other", ReasonCode.POINTS_DISAGREE)
        estimate = solve(used)
        squares = squares_of(estimate.state)
        factor = variance_factor(squares[used], estimate.degrees_of_freedom)
        inside = squares < gate * min(max(factor, 1.0), MAX_GATE_FACTOR)
        if (inside == used).all():
            return estimate, used, factor
        if (used & ~inside).any():
            # a wrong match drags others over the gate: only the worst goes in one round
            worst = int(np.argmax(np.where(used, squares, -1.0)))
            used = used.copy()
            used[worst] = False
        else:
            used = inside
    # the loop may end on its count while swapping one match in and out; solve for the last set
    estimate = solve(used)
    squares = squares_of(estimate.state)
    return estimate, used, variance_factor(squares[used], estimate.degrees_of_freedom)


def variance_factor(squares: FloatArray, degrees_of_freedom: int) -> float:
    """Variance of unit weight, pulled toward the stated one for lack of redundancy."""
    total, free = float(squares.sum()), max(degrees_of_freedom, 0)
    stated = STATED_DEGREES_OF_FREEDOM if total > free else STATED_IF_LESS
    return (total + stated) / (free + stated)


def rescaled(estimate: Estimate[S], factor: float) -> FloatArray:
    """Covariance (k, k) when the measurements' own is scaled; priors are not theirs to scale."""
    normal = estimate.measured.normal / factor
    for prior in estimate.terms[1:]:
        normal = normal + prior.normal
    return inverse_of(normal)
