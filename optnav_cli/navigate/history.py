"""Where earlier pictures place the camera now: a fix at the same time, or the orbit arc.

Fixes are kept in inertial axes, where orbits are simple; what goes in and out is body-fixed.
"""

import numpy as np

from catalog.bodies.ephemeris import Ephemeris
from catalog.geometry.vectors import squared_distance
from optnav_cli.dynamics.arc import GATE, ArcDisagreement, OrbitArc, TimedPosition
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.fix import Fix, PositionPrior

# Cameras that are triggered together; a low orbit goes 2 m in it.
SAME_TIME_S = 1e-3


class NeedsPastError(Exception):
    """A frame cannot be solved before those ahead of it."""


class History:
    """The solved frames of a run so far, in the order of their times."""

    def __init__(self, motion: Ephemeris) -> None:
        self._motion = motion
        self._arc = OrbitArc(OrbitMotion(Forces(motion)))
        self._last: tuple[float, PositionPrior] | None = None
        self._boresight_rad = 0.0

    def find_at_same_time(self, tdb_s: float) -> PositionPrior | None:
        """Find the fix of another camera at a time; None for none."""
        if self._last is None or abs(self._last[0] - tdb_s) > SAME_TIME_S:
            return None
        return self._last[1]

    def predict(self, tdb_s: float) -> PositionPrior | None:
        """Predict the position by the orbit arc; None where it is of no use."""
        predicted = self._arc.predict(tdb_s)
        if predicted is None:
            return None
        body_from_inertial = self._motion.body_from_inertial(tdb_s)
        covariance = body_from_inertial @ predicted.covariance_m2 @ body_from_inertial.T
        position = body_from_inertial @ predicted.position_m
        if self._boresight_rad:  # which more fixes do not average out
            across = float(position @ position) * np.eye(3) - np.outer(position, position)
            covariance = covariance + self._boresight_rad**2 * across
        return PositionPrior(position, covariance, predicted.source)

    def add_fix(
        self, tdb_s: float, fix: Fix, *, confirmed: bool, boresight_rad: float = 0.0
    ) -> ArcDisagreement | None:
        """Add a fix to the arc; return how it disagrees where it is off the arc.

        confirmed      two methods agree on the fix, so that it is the arc that no longer holds
        boresight_rad  sigma of its camera's mounting
        """
        self._boresight_rad = max(self._boresight_rad, boresight_rad)
        inertial_from_body = self._motion.body_from_inertial(tdb_s).T
        covariance = inertial_from_body @ fix.covariance_m2 @ inertial_from_body.T
        inertial = TimedPosition(tdb_s, inertial_from_body @ fix.position_m, covariance)
        return self._arc.add(inertial, confirmed=confirmed)

    def check_speed(self, tdb_s: float, fix: Fix) -> str:
        """Describe why no craft can have reached a fix since the last one; empty when one can.

        Too fast is twice the speed that escapes the body from the lower of both places, and more
        than any craft comes with from elsewhere.
        """
        if self._last is None:
            return ""
        last_s, last = self._last
        since = tdb_s - last_s
        before = self._motion.body_from_inertial(last_s).T @ last.position_m
        now = self._motion.body_from_inertial(tdb_s).T @ fix.position_m
        distance = float(np.linalg.norm(now - before))
        covariances = fix.covariance_m2, last.covariance_m2
        sigma = float(np.sqrt(sum(np.linalg.eigvalsh(each)[-1] for each in covariances)))
        lower = min(float(np.linalg.norm(before)), float(np.linalg.norm(now)))
        escape = float(np.sqrt(2.0 * self._motion.body.gm_m3_s2 / lower))
        # Far from the body a craft comes with a speed of its own, up to 3 km/s.
        max_speed = max(2.0 * escape, 3000.0)
        if distance - 5.0 * sigma <= max_speed * max(since, 0.0):
            return ""
        return f"{distance / 1e3:.0f} km from the fix {since:.0f} s before"

    def is_consistent(self, tdb_s: float, fix: Fix) -> bool:
        """Whether a fix agrees with the arc, and with the last fix and a possible speed."""
        predicted = self.predict(tdb_s)
        if predicted is not None:
            offset = fix.position_m - predicted.position_m
            if squared_distance(offset, fix.covariance_m2 + predicted.covariance_m2) >= GATE:
                return False
        return not self.check_speed(tdb_s, fix)

    def remember(self, tdb_s: float, fix: Fix, source: str) -> None:
        """Keep a fix for other cameras at the same time; of two at one time the sharper."""
        known = self.find_at_same_time(tdb_s)
        if known is not None and np.trace(known.covariance_m2) <= np.trace(fix.covariance_m2):
            return
        self._last = tdb_s, PositionPrior(fix.position_m, fix.covariance_m2, source)


class UnseenPast(History):
    """The past of a frame processed ahead of time: nothing is known, nothing contradicts.

    has_twin  whether a frame before is of the same time: its fix would come first
    """

    def __init__(self, motion: Ephemeris, *, has_twin: bool) -> None:
        super().__init__(motion)
        self._has_twin = has_twin

    def find_at_same_time(self, tdb_s: float) -> PositionPrior | None:
        if self._has_twin:
            raise NeedsPastError
        return None

    def predict(self, tdb_s: float) -> PositionPrior | None:
        raise NeedsPastError

    def add_fix(
        self, tdb_s: float, fix: Fix, *, confirmed: bool, boresight_rad: float = 0.0
    ) -> ArcDisagreement | None:
        return None

    def is_consistent(self, tdb_s: float, fix: Fix) -> bool:
        return True

    def remember(self, tdb_s: float, fix: Fix, source: str) -> None:
        pass
