"""What earlier pictures say of where a camera is now: a fix at the same time, or the orbit arc.

Fixes are kept in inertial axes, where orbits are simple; what goes in and out is body-fixed.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.ephemeris import Ephemeris
from optnav_cli.dynamics.arc import GATE, Fix, OrbitArc, Prediction
from optnav_cli.dynamics.forces import Forces
from optnav_cli.dynamics.integrator import OrbitMotion

# Cameras that are triggered together; a low orbit goes 2 m in it.
SAME_TIME_S = 1e-3
MAX_ESCAPES = 2.0
# Far from the body a craft comes with a speed of its own, m/s.
MAX_FAR_M_S = 3000.0
GATE_SIGMAS = 5.0


@dataclass(frozen=True, eq=False)
class PositionPrior:
    """A position (3,), m, with its covariance (3, 3), body frame, and where it comes from."""

    position_m: FloatArray
    covariance_m2: FloatArray
    source: str


@dataclass(frozen=True, eq=False)
class _Solved:
    belief: PositionPrior
    tdb_s: float


@dataclass(frozen=True)
class Odd:
    """How a fix lies off the arc, in words; `ended`: the arc begins anew with it."""

    words: str
    ended: bool


class History:
    """The solved frames of a run so far, in the order of their times."""

    def __init__(self, motion: Ephemeris) -> None:
        self._motion = motion
        self._arc = OrbitArc(OrbitMotion(Forces(motion)))
        self._last: _Solved | None = None

    def at_same_time(self, tdb_s: float) -> PositionPrior | None:
        """The fix of another camera at a time, if there is one."""
        if self._last is None or abs(self._last.tdb_s - tdb_s) > SAME_TIME_S:
            return None
        return self._last.belief

    def predict(self, tdb_s: float) -> PositionPrior | None:
        """Where the orbit arc leads; None where it says nothing of use."""
        found = self._arc.predict(tdb_s)
        if found is None:
            return None
        turn = self._motion.body_from_inertial(tdb_s)
        return PositionPrior(
            turn @ found.position_m, turn @ found.covariance_m2 @ turn.T, _words(found)
        )

    def take(
        self, tdb_s: float, position_m: FloatArray, covariance_m2: FloatArray, *, sure: bool
    ) -> Odd | None:
        """Take in a fix; says so when it does not lie where the arc leads.

        sure  the fix rests on two methods that agree, so that it is the arc that no longer holds
        """
        turn = self._motion.body_from_inertial(tdb_s).T
        fix = Fix(tdb_s, turn @ position_m, turn @ covariance_m2 @ turn.T)
        found = self._arc.add(fix, sure=sure)
        if found is None:
            return None
        away = float(np.linalg.norm(fix.position_m - found.predicted.position_m))
        sigmas = float(np.sqrt(found.predicted.distance_squared(fix)))
        whose = _words(found.predicted)
        words = f"{away / 1e3:.1f} km ({sigmas:.0f} sigmas) from where the {whose} leads"
        return Odd(words, found.ended)

    def exceeds_max_speed(
        self, tdb_s: float, position_m: FloatArray, covariance_m2: FloatArray
    ) -> str:
        """Why no craft can have come there since the last fix, in words; empty when one can.

        Too fast is twice the speed that escapes the body from the lower of both places, and more
        than any craft comes with from elsewhere.
        """
        if self._last is None:
            return ""
        since = tdb_s - self._last.tdb_s
        before = self._motion.body_from_inertial(self._last.tdb_s).T @ self._last.belief.position_m
        now = self._motion.body_from_inertial(tdb_s).T @ position_m
        away = float(np.linalg.norm(now - before))
        spreads = covariance_m2, self._last.belief.covariance_m2
        sigma = float(np.sqrt(sum(np.linalg.eigvalsh(spread)[-1] for spread in spreads)))
        lower = min(float(np.linalg.norm(before)), float(np.linalg.norm(now)))
        escape = float(np.sqrt(2.0 * self._motion.body.gm_m3_s2 / lower))
        fastest = max(MAX_ESCAPES * escape, MAX_FAR_M_S)
        if away - GATE_SIGMAS * sigma <= fastest * max(since, 0.0):
            return ""
        return f"{away / 1e3:.0f} km from the fix {since:.0f} s before"

    def fits(self, tdb_s: float, position_m: FloatArray, covariance_m2: FloatArray) -> bool:
        """Whether a position agrees with all that is known from before."""
        predicted = self.predict(tdb_s)
        if predicted is not None:
            offset = position_m - predicted.position_m
            spread = covariance_m2 + predicted.covariance_m2
            if float(offset @ np.linalg.solve(spread, offset)) >= GATE:
                return False
        return not self.exceeds_max_speed(tdb_s, position_m, covariance_m2)

    def keep(
        self, tdb_s: float, position_m: FloatArray, covariance_m2: FloatArray, source: str
    ) -> None:
        """Remember a solved frame for other cameras at the same time."""
        if self._last is not None and abs(self._last.tdb_s - tdb_s) <= SAME_TIME_S:
            known = float(np.trace(self._last.belief.covariance_m2))
            if known <= float(np.trace(covariance_m2)):
                return
        self._last = _Solved(PositionPrior(position_m, covariance_m2, source), tdb_s)


def _words(prediction: Prediction) -> str:
    count = prediction.fixes
    return f"arc of {count} fixes" if count > 1 else "arc of one fix"
