"""Iterated least squares: measurement models linearise themselves at a state, one loop solves.

A state is what the models agree on: a vector, or a pose that a step moves and turns. A prior is a
model like any other. Models whose loop over the measurements is compiled return sums over them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np

from catalog.arrays import BoolArray, FloatArray
from catalog.geometry.kernel import kernel
from optnav_cli.reasons import Reason

MIN_PIVOT = 1e-13  # of a normal matrix scaled to a unit diagonal: below it an unknown is open
# A step that raises the cost so many times is followed by damped ones.
COST_RISE, FIRST_DAMPING, MAX_DAMPING = 4.0, 1e-3, 1e3

S = TypeVar("S")
S_contra = TypeVar("S_contra", contravariant=True)


class Linearisation(NamedTuple):
    """Measurements at a state of k unknowns: n of one number, or n of d numbers each.

    normal     (k, k)  J' W J;  gradient (k,) J' W r;  cost  r' W r
    residuals  (n,) or (n, d)     r, measured less predicted
    jacobian   (n, k) or (n, d, k)  J, d predicted / d state
    weights    (n,) or (n, d, d)  W, inverse of the stated covariance, times a robust weight
    """

    normal: FloatArray
    gradient: FloatArray
    cost: float
    residuals: FloatArray
    jacobian: FloatArray
    weights: FloatArray

    def gain(self, covariance: FloatArray) -> FloatArray:
        """(k, n d) d state / d measurement of a solution with a covariance (k, k)."""
        return covariance @ _weighted(self.jacobian, self.weights).T


class Model(Protocol[S_contra]):
    """One kind of measurement."""

    def linearise(self, state: S_contra) -> Linearisation:
        """The measurements at a state. Raises NoSolutionError where they cannot be predicted."""


class VectorPrior:
    """Expected values of some neighbouring numbers of a state (k,), each with its sigma."""

    def __init__(self, first: int, expected: FloatArray, sigmas: FloatArray, unknowns: int) -> None:
        self._part = slice(first, first + len(expected))
        self._expected, self._weights = expected, sigmas**-2
        self._jacobian = np.eye(unknowns)[self._part]

    def linearise(self, state: FloatArray) -> Linearisation:
        """The expectation at a state."""
        return linearised(self._expected - state[self._part], self._jacobian, self._weights)

    def cost(self, state: FloatArray) -> float:
        """Return the cost that `linearise` has."""
        off = self._expected - state[self._part]
        return float(self._weights @ (off * off))


@dataclass(frozen=True)
class Iteration:
    """Settings of the iteration of a solution.

    max_steps       before it counts as not settled
    settled_sigmas  a step below this share of its own sigma is the last
    each_unknown    whether every unknown's step is judged by that unknown's sigma, or all at once
    damped          whether steps are shortened after one that raised the cost
    max_cost        given up where even a step's own prediction costs more
    undetermined, unsettled  why there is no solution
    """

    max_steps: int
    settled_sigmas: float
    undetermined: Reason
    unsettled: Reason
    each_unknown: bool = False
    damped: bool = False
    max_cost: float = np.inf


@dataclass(frozen=True, eq=False)
class Estimate(Generic[S]):
    """A state that fits measurements.

    covariance  (k, k)  of the state
    noise       (k, k)  what the stated errors alone give, each measurement erring for itself
    terms       of each model, where the last step began
    """

    state: S
    covariance: FloatArray
    noise: FloatArray
    terms: tuple[Linearisation, ...]

    @property
    def measured(self) -> Linearisation:
        """The first model's measurements."""
        return self.terms[0]

    @property
    def used(self) -> BoolArray:
        """(n,) which of the first model's measurements have a weight."""
        return self.measured.weights > 0.0

    @property
    def cost(self) -> float:
        """Squared residuals of all models in units of their covariance."""
        return sum(term.cost for term in self.terms)

    @property
    def degrees_of_freedom(self) -> int:
        """Measurements less unknowns, priors counted as measurements."""
        return sum(term.residuals.size for term in self.terms) - len(self.noise)


def linearised(residuals: FloatArray, jacobian: FloatArray, weights: FloatArray) -> Linearisation:
    """Residuals, Jacobian and weights, of the shapes that `Linearisation` names, summed up."""
    unknowns = jacobian.shape[-1]
    weighted = _weighted(jacobian, weights)
    rows = jacobian.reshape(-1, unknowns)
    if weights.ndim == 1:
        cost = float(weights @ (residuals * residuals))
    else:
        cost = float(np.einsum("ni,nij,nj->", residuals, weights, residuals))
    return Linearisation(
        weighted.T @ rows, weighted.T @ residuals.ravel(), cost, residuals, jacobian, weights
    )


def _weighted(jacobian: FloatArray, weights: FloatArray) -> FloatArray:
    """W J, (n d, k)."""
    if weights.ndim == 1:
        return jacobian * weights[:, None]
    weighted: FloatArray = np.matmul(weights, jacobian)
    return weighted.reshape(-1, jacobian.shape[-1])


def solve(
    models: Sequence[Model[S]], start: S, move: Callable[[S, FloatArray], S], iteration: Iteration
) -> Estimate[S]:
    """The state that fits all models best, by Gauss-Newton.

    move  the state after a step (k,): the retraction; may limit the step

    Raises NoSolutionError when an unknown is open or the iteration does not settle.
    """
    state, cost, damping = start, np.inf, 0.0
    for _ in range(iteration.max_steps):
        terms = tuple(model.linearise(state) for model in models)
        normal, gradient, new_cost = terms[0][:3]
        for term in terms[1:]:
            normal, gradient = normal + term.normal, gradient + term.gradient
            new_cost += term.cost
        if iteration.damped and new_cost > COST_RISE * cost and damping < MAX_DAMPING:
            damping = max(10.0 * damping, FIRST_DAMPING)
        cost = new_cost
        covariance, step, judged = _step(normal, gradient, damping, iteration.each_unknown)
        if not np.isfinite(judged):
            raise iteration.undetermined.error()
        if cost - float(step @ gradient) > iteration.max_cost:
            raise iteration.unsettled.error()
        state = move(state, step)
        if judged < iteration.settled_sigmas and damping < 1.0:
            return Estimate(state, covariance, covariance, terms)
        damping *= 0.1
    raise iteration.unsettled.error()


@kernel
def inverse_of(matrix: FloatArray) -> FloatArray:
    """Inverse of a symmetric positive matrix (k, k); NaN where an unknown is open."""
    # by single numbers: sums of whole arrays take numba ten times as long to compile
    size = matrix.shape[0]
    scale, inverse = np.empty(size), np.empty((size, size))
    for i in range(size):
        scale[i] = 1.0 / np.sqrt(matrix[i, i])
    for i in range(size):
        for j in range(size):
            inverse[i, j] = matrix[i, j] * (scale[i] * scale[j])
    # Gauss-Jordan: the pivots of a positive matrix need no order
    for j in range(size):
        pivot = inverse[j, j]
        if not pivot > MIN_PIVOT:
            inverse[:] = np.nan
            return inverse
        inverse[j, j] = 1.0
        for k in range(size):
            inverse[j, k] /= pivot
        for i in range(size):
            if i != j:
                factor = inverse[i, j]
                inverse[i, j] = 0.0
                for k in range(size):
                    inverse[i, k] -= factor * inverse[j, k]
    for i in range(size):
        for j in range(i + 1):
            mean = 0.5 * (inverse[i, j] + inverse[j, i]) * (scale[i] * scale[j])
            inverse[i, j] = inverse[j, i] = mean
    return inverse


@kernel
def mirrored(upper: FloatArray) -> FloatArray:
    """A square matrix whose upper triangle is filled, with the lower one too."""
    for k in range(upper.shape[0]):
        for m in range(k):
            upper[k, m] = upper[m, k]
    return upper


@kernel
def _step(
    normal: FloatArray, gradient: FloatArray, damping: float, each_unknown: bool
) -> tuple[FloatArray, FloatArray, float]:
    """Covariance (k, k), the step (k,), and its size in sigmas; NaN where an unknown is open."""
    covariance = inverse_of(normal)
    inverse = covariance
    if damping > 0.0:
        damped = normal.copy()
        for i in range(len(gradient)):
            damped[i, i] *= 1.0 + damping
        inverse = inverse_of(damped)
    step = np.zeros(len(gradient))
    largest, gained = 0.0, 0.0
    for i in range(len(gradient)):
        for j in range(len(gradient)):
            step[i] += inverse[i, j] * gradient[j]
        gained += step[i] * gradient[i]
        largest = max(largest, abs(step[i]) / np.sqrt(covariance[i, i]))
    if each_unknown and gained < np.inf:
        return covariance, step, largest
    return covariance, step, np.sqrt(abs(gained))
