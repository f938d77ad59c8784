"""The one loop: linear problems in a step, priors, limited steps, refusals; robust weights."""

from operator import add

import numpy as np
import pytest

from catalog.errors import NoSolutionError
from optnav_cli.estimation.consider import considered, with_shared_errors
from optnav_cli.estimation.least_squares import (
    Iteration,
    VectorPrior,
    inverse_of,
    linearised,
    solve,
)
from optnav_cli.estimation.robust import scatter, tukey_weights
from optnav_cli.reasons import Reason, ReasonCode

OPEN = Reason(ReasonCode.DEGENERATE, "open")
RESTLESS = Reason(ReasonCode.NOT_SETTLED, "restless")
ITERATION = Iteration(20, 1e-6, undetermined=OPEN, unsettled=RESTLESS)


class Line:
    """Measurements y of a straight line in x, each with its sigma."""

    def __init__(self, x, y, sigmas):
        self.jacobian = np.stack([np.ones_like(x), x], axis=1)
        self.y, self.weights = y, sigmas**-2

    def linearise(self, state):
        return linearised(self.y - self.jacobian @ state, self.jacobian, self.weights)


class Arctangent:
    """One measurement, 0, of the arctangent of a number: undamped steps from 2 on diverge."""

    def linearise(self, state):
        jacobian = 1.0 / (1.0 + state**2)
        return linearised(-np.arctan(state), jacobian[:, None], np.full(1, 1e4))


def line(seed=1, count=30):
    rng = np.random.default_rng(seed)
    x, sigmas = rng.uniform(-1.0, 1.0, count), rng.uniform(0.5, 2.0, count)
    return Line(x, 3.0 - 2.0 * x + sigmas * rng.normal(size=count), sigmas)


def test_a_line_is_that_of_numpy_and_its_covariance_too():
    model = line()
    found = solve([model], np.zeros(2), add, ITERATION)
    root = np.sqrt(model.weights)
    expected, *_ = np.linalg.lstsq(model.jacobian * root[:, None], model.y * root, rcond=None)
    assert found.state == pytest.approx(expected, rel=1e-12)
    normal = (model.jacobian * model.weights[:, None]).T @ model.jacobian
    assert found.covariance == pytest.approx(np.linalg.inv(normal), rel=1e-12)
    assert found.degrees_of_freedom == 28
    # what each measurement moves the state by, against a difference
    model.y = model.y + 1e-3 * (np.arange(30) == 7)
    moved = solve([model], np.zeros(2), add, ITERATION).state - found.state
    assert found.measured.gain(found.noise)[:, 7] == pytest.approx(moved / 1e-3, rel=1e-6)


def test_a_prior_is_a_measurement_and_makes_up_for_missing_ones():
    one = Line(np.zeros(4), np.full(4, 5.0), np.ones(4))
    with pytest.raises(NoSolutionError, match="open") as error:
        solve([one], np.zeros(2), add, ITERATION)
    assert error.value.code == ReasonCode.DEGENERATE
    slope = VectorPrior(1, np.array([0.7]), np.array([0.1]), 2)
    found = solve([one, slope], np.zeros(2), add, ITERATION)
    assert found.state == pytest.approx([5.0, 0.7])
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx([0.5, 0.1])
    assert found.degrees_of_freedom == 3
    assert slope.cost(np.array([9.0, 1.0])) == slope.linearise(np.array([9.0, 1.0])).cost > 8.9


def test_limited_steps_settle_what_plain_steps_do_not():
    start = np.array([2.0])
    with pytest.raises(NoSolutionError, match=r"restless|open"):
        solve([Arctangent()], start, add, ITERATION)
    limited = solve([Arctangent()], start, lambda s, step: s + np.clip(step, -0.5, 0.5), ITERATION)
    assert limited.state == pytest.approx([0.0], abs=1e-6)


def test_blocks_of_measurements_weigh_by_their_covariances():
    """Two positions with covariances: the mean of both by their weights."""
    places = np.array([[1.0, 2.0], [3.0, 1.0]])
    covariances = np.array([[[1.0, 0.5], [0.5, 2.0]], [[4.0, -1.0], [-1.0, 1.0]]])
    weights = np.linalg.inv(covariances)

    class Places:
        def linearise(self, state):
            return linearised(places - state, np.tile(np.eye(2), (2, 1, 1)), weights)

    found = solve([Places()], np.zeros(2), add, ITERATION)
    expected = np.linalg.inv(weights.sum(axis=0))
    assert found.covariance == pytest.approx(expected)
    assert found.state == pytest.approx(expected @ np.einsum("nij,nj->i", weights, places))


def test_an_inverse_of_numbers_of_any_size_and_none_of_a_singular_matrix():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(6, 6)) * 10.0 ** np.arange(-6.0, 6.0, 2.0)
    matrix = root.T @ root
    scale = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
    assert inverse_of(matrix) * scale == pytest.approx(np.linalg.inv(matrix / scale), rel=1e-9)
    assert np.isnan(inverse_of(np.ones((3, 3)))).all()


def test_errors_that_measurements_share_are_considered_or_solved_for():
    """A shared offset of a line cannot be seen beside its constant; one of half of them can."""
    model = line(count=400)
    found = solve([model], np.zeros(2), add, ITERATION)
    gain = found.measured.gain(found.noise)
    assert considered(gain, np.full((400, 1), 0.3))[0, 0] == pytest.approx(0.09)
    half = np.where(np.arange(400) < 200, 1.0, 0.0)
    model.y = model.y + 2.0 * half
    spoilt = solve([model], np.zeros(2), add, ITERATION)
    state, covariance = with_shared_errors(spoilt, 3.0 * half[:, None])
    error = state - found.state
    assert abs(spoilt.state[0] - found.state[0]) > 0.9
    assert error @ np.linalg.solve(covariance, error) < 9.0


def test_tukey_s_weights_fall_from_one_to_zero_at_the_cut():
    residuals = np.array([0.0, -0.5, 0.5, 1.0, -3.0])
    assert tukey_weights(residuals, 1.0) == pytest.approx([1.0, 0.5625, 0.5625, 0.0, 0.0])
    normal = np.random.default_rng(3).normal(0.0, 2.0, 20_000)
    assert scatter(np.append(normal, np.full(500, 1e6))) == pytest.approx(2.0, rel=0.05)
