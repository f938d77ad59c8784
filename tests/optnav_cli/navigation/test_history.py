"""What earlier fixes say of where a craft can be."""

import numpy as np

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from optnav_cli.fix import Fix, Method
from optnav_cli.navigation.history import History

START_S = 8.2e8
FAR_M = np.array([1.0e8, 0.0, 0.0])
WIDE_M2 = np.diag([7.0e5, 8.0e3, 8.0e3]) ** 2  # what a fisheye knows at 100 000 km
NARROW_M2 = np.diag([4.0e4, 5.0e3, 5.0e3]) ** 2


def fix(position_m, covariance_m2):
    return Fix(Method.HORIZON, position_m, covariance_m2)


def test_a_sharper_fix_at_the_same_time_may_lie_off_by_what_the_first_did_not_know():
    history = History(AnalyticEphemeris(load_body("moon")))
    history.remember(START_S, fix(FAR_M, WIDE_M2), "wide")
    near, far = (fix(FAR_M + [away, 0.0, 0.0], NARROW_M2) for away in (6.1e5, 6.1e6))
    assert history.exceeds_max_speed(START_S, near) == ""
    assert history.exceeds_max_speed(START_S, far) == "6100 km from the fix 0 s before"
    history.remember(START_S, fix(FAR_M, NARROW_M2), "narrow")
    assert history.exceeds_max_speed(START_S, near) != ""
