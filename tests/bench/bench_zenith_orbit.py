"""An orbit through zenith distances of stars: 3 revolutions x 500 sights, degree 8, no prior."""

import time

import numpy as np
import pytest

from optnav_cli.orbit.fit.zenith_job import fit_zenith
from tests.bench.timing import in_turn, result, sized, within
from tests.studies.zenith import SUNLIGHT
from tests.studies.zenith_flights import (
    GATE,
    SESSIONS,
    SightErrors,
    ZenithFlight,
    fit_motion,
)

pytestmark = pytest.mark.bench

LIMIT_S, ROUNDS = 2.0, 5


def test_a_fit_of_three_revolutions_of_500_sights():
    """Sessions look at two stars: half as many as sights."""
    revolutions = sized(3.0, 1.0)
    flight, motion = ZenithFlight("1.1", revolutions + 0.1, rows=60), fit_motion()
    times = flight.sessions(0.0, revolutions, SESSIONS // 2)
    sights = flight.sights(times, SightErrors(), np.random.default_rng(1))
    calls = {"fit": lambda: fit_zenith(motion, sights, [], [SUNLIGHT], GATE)}
    seconds = float(np.median(in_turn(calls, ROUNDS, time.process_time)["fit"]))
    result(
        f"an orbit through {len(sights)} zenith distances, degree 8",
        f"{seconds:.2f} s",
        f"limit {LIMIT_S:g} s",
    )
    assert within(seconds, LIMIT_S)
