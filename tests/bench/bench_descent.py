"""The joint filter of a descent against products of matrices of its covariance's size."""

import time

import numpy as np
import pytest

from optnav_cli.navigate.descent.filter import TRACK
from tests.bench.timing import in_turn, result, spread, within
from tests.studies.descent import TIMED_LANDMARKS, filter_update

pytestmark = pytest.mark.bench

ROUNDS = 25
LIMIT_MS, LIMIT_RATIO = 20.0, 40.0


def test_an_update_with_sixty_landmarks_against_a_product_of_its_covariance():
    """All of a frame's landmarks at once, three relinearisations, gates included."""
    size = TRACK + 3 * TIMED_LANDMARKS
    square = np.random.default_rng(1).normal(size=(size, size))
    update = filter_update()
    update()
    calls = {"product": lambda: square @ square, "update": update}
    times = in_turn(calls, ROUNDS, time.process_time)
    ratio = spread(np.divide(times["update"], np.maximum(times["product"], 1e-6)))
    milliseconds = 1e3 * float(np.median(times["update"]))
    result(
        f"update of a descent's filter with {TIMED_LANDMARKS} landmarks",
        f"{milliseconds:.1f} ms",
        f"{ratio} × a product of its covariance; limits {LIMIT_MS:.0f} ms, {LIMIT_RATIO:.0f} ×",
    )
    assert within(milliseconds, LIMIT_MS)
    assert within(ratio.median, LIMIT_RATIO)
