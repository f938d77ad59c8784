"""What earlier fixes say of where a craft can be."""

import numpy as np

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from optnav_cli.fix import Fix, Method
from optnav_cli.navigate.history import History

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
    assert history.check_speed(START_S, near) == ""
    assert history.check_speed(START_S, far) == "6100 km from the fix 0 s before"
    history.remember(START_S, fix(FAR_M, NARROW_M2), "narrow")
    assert history.check_speed(START_S, near) != ""


def test_more_fixes_do_not_average_a_boresight_error_out():
    """1000" at 1.9e6 m are 9.2 km across, whatever the arc of twelve fixes says of itself."""
    moon = load_body("moon")
    speed = np.sqrt(moon.gm_m3_s2 / 1.9e6)
    sigma_rad = 1000.0 * np.pi / 648000.0
    alone, shared = (History(AnalyticEphemeris(moon)) for _ in range(2))
    for step in range(12):
        angle = speed / 1.9e6 * 10.0 * step
        motion = AnalyticEphemeris(moon).body_from_inertial(START_S + 10.0 * step)
        place = motion @ (1.9e6 * np.array([np.cos(angle), np.sin(angle), 0.0]))
        one = fix(place, np.diag([1e4, 1e4, 1e4]))
        alone.add_fix(START_S + 10.0 * step, one, confirmed=True)
        shared.add_fix(START_S + 10.0 * step, one, confirmed=True, boresight_rad=sigma_rad)
    before, after = (history.predict(START_S + 120.0) for history in (alone, shared))
    added = after.covariance_m2 - before.covariance_m2
    np.testing.assert_allclose(after.position_m, before.position_m)
    across = np.linalg.eigvalsh(added)
    np.testing.assert_allclose(np.sqrt(across[1:]), 1.9e6 * sigma_rad, rtol=1e-3)
    assert abs(across[0]) < 1.0
