"""A short orbit arc through past fixes: least squares, prediction, and when it no longer holds.

The state at the last fix is fitted to positions with covariances. What the orbit's forces leave
out is process noise: it widens an old fix by the time since, so the arc forgets, and it widens a
prediction. A single fix already makes an arc: then the velocity is only known not to be far from
that of a circular orbit in size, which a prediction some seconds ahead can bear.
"""

from dataclasses import dataclass
from operator import add

import numpy as np
from scipy.special import chdtri  # chi-square that is exceeded with a probability

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from catalog.geometry.vectors import squared_distance
from optnav_cli.dynamics.forces import OrbitMotion
from optnav_cli.estimation.least_squares import (
    Iteration,
    Linearisation,
    VectorPrior,
    linearised,
    solve,
)
from optnav_cli.fix import PositionPrior
from optnav_cli.reasons import Reason, ReasonCode

# A right fix is farther from the arc than this once in a million.
GATE_PROBABILITY = 1e-6
GATE = float(chdtri(3, GATE_PROBABILITY))
MAX_FIXES = 12
_NO_ORBIT = Reason(ReasonCode.NO_SOLUTION, "the fixes fit no orbit")
ITERATION = Iteration(12, 1e-3, undetermined=_NO_ORBIT, unsettled=_NO_ORBIT)
# Further ahead than the orbit takes for one radian an arc of a few minutes says little, and the
# frames may belong to another flight.
MAX_GAP_RAD = 1.0
# A craft on its way to the body is faster than a circular orbit is there.
EXCESS_M_S = 1000.0
# A prediction with a larger share of the distance as its sigma says nothing of use.
MAX_SHARE = 0.005


@dataclass(frozen=True, eq=False)
class TimedPosition:
    """A position (3,), m, inertial, with its covariance (3, 3), at a time, TDB s."""

    tdb_s: float
    position_m: FloatArray
    covariance_m2: FloatArray


@dataclass(frozen=True)
class ArcDisagreement:
    """Say in words where a fix lies relative to the arc's prediction.

    new_arc  whether the fix begins a new arc; otherwise it is left out until the next one agrees
    """

    words: str
    new_arc: bool


class FixesModel:
    """Positions at several times as measurements of an orbit's state (6,) at the last of them.

    What the orbit leaves out widens an old position by the time since.
    """

    def __init__(self, orbit: OrbitMotion, fixes: list[TimedPosition]) -> None:
        self._orbit, self._times = orbit, np.array([fix.tdb_s for fix in fixes])
        self._positions = np.stack([fix.position_m for fix in fixes])
        self._covariances = np.stack([fix.covariance_m2 for fix in fixes])

    def linearise(self, state: FloatArray) -> Linearisation:
        """The positions on the orbit of a state (6,)."""
        last = float(self._times[-1])
        states, transitions = self._orbit.propagate(state, last, self._times)
        drift = [self._orbit.noise(state, time - last)[:3, :3] for time in self._times]
        weights = np.linalg.inv(self._covariances + drift).astype(np.float64)
        return linearised(self._positions - states[:, :3], transitions[:, :3], weights)


class OrbitArc:
    """The arc through the last fixes, in the order of time.

    A fix that does not lie where the arc leads is held back: if the next one lies with the arc it
    was wrong; if the next one contradicts the arc too, the craft has manoeuvred or the arc was
    wrong, and a new one begins with the two.
    """

    def __init__(self, model: OrbitMotion) -> None:
        self._model = model
        self._fixes: list[TimedPosition] = []
        self._doubted: TimedPosition | None = None
        self._fitted: tuple[FloatArray, FloatArray] | None = None

    def predict(self, tdb_s: float) -> PositionPrior | None:
        """The inertial position at a time not before the last fix; None where that is of no use.

        There is none without fixes, when the fixes fit no orbit, long after them, and when they
        leave more than a small share of the distance open.
        """
        if not self._fixes or self._is_over(tdb_s):
            return None
        epoch = self._fixes[-1].tdb_s
        try:
            state, covariance = self._fit()
            states, transitions = self._model.propagate(state, epoch, np.array([tdb_s]))
        except NoSolutionError:
            return None
        spread = transitions[0] @ covariance @ transitions[0].T
        spread = (spread + self._model.noise(state, tdb_s - epoch))[:3, :3]
        position = states[0, :3]
        widest = float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))
        if not widest < MAX_SHARE * float(np.linalg.norm(position)):
            return None
        count = f"{len(self._fixes)} fixes" if len(self._fixes) > 1 else "one fix"
        return PositionPrior(position, spread, f"arc of {count}")

    def add(self, fix: TimedPosition, *, confirmed: bool = False) -> ArcDisagreement | None:
        """Add a fix not before the last; how it disagrees where it does not lie on the arc.

        confirmed  two methods agree on the fix: where it contradicts the arc, the arc ends
        """
        predicted = self.predict(fix.tdb_s)
        if predicted is None:
            # an arc that says nothing of use is not worth keeping, but for its first fix
            young = len(self._fixes) < 2 and not self._is_over(fix.tdb_s)
            self._restart(_with(self._fixes if young else [], fix))
            return None
        offset = fix.position_m - predicted.position_m
        square = squared_distance(offset, predicted.covariance_m2 + fix.covariance_m2)
        if square < GATE:
            self._restart(_with(self._fixes, fix))
            return None
        new_arc = confirmed or self._doubted is not None
        if new_arc:
            doubted = [] if confirmed or self._doubted is None else [self._doubted]
            self._restart(_with(doubted, fix))
        else:
            self._doubted = fix
        words = (
            f"{np.linalg.norm(offset) / 1e3:.1f} km ({np.sqrt(square):.0f} sigmas) from where the "
            f"{predicted.source} leads"
        )
        return ArcDisagreement(words, new_arc)

    def _is_over(self, tdb_s: float) -> bool:
        if not self._fixes:
            return False
        last = self._fixes[-1]
        return tdb_s - last.tdb_s > MAX_GAP_RAD * self._model.radian_s(last.position_m)

    def _restart(self, fixes: list[TimedPosition]) -> None:
        self._fixes, self._doubted, self._fitted = fixes[-MAX_FIXES:], None, None

    def _fit(self) -> tuple[FloatArray, FloatArray]:
        """State (6,) and covariance (6, 6) at the last fix. Raises NoSolutionError."""
        if self._fitted is not None:
            return self._fitted
        last = self._fixes[-1]
        speed = float(np.hypot(self._model.circular_speed(last.position_m), EXCESS_M_S))
        state = np.concatenate([last.position_m, self._first_velocity(speed)])
        velocity = VectorPrior(3, np.zeros(3), np.full(3, speed), 6)
        fixes = FixesModel(self._model, self._fixes)
        estimate = solve([fixes, velocity], state, add, ITERATION)
        # three measurements a fix and three of the velocity's size, six unknowns
        if estimate.cost > chdtri(estimate.degrees_of_freedom, GATE_PROBABILITY):
            raise _NO_ORBIT.error()
        self._fitted = estimate.state, estimate.covariance
        return self._fitted

    def _first_velocity(self, speed: float) -> FloatArray:
        """A first velocity from the last two fixes that lie far enough apart, else zero."""
        last = self._fixes[-1]
        for earlier in reversed(self._fixes[:-1]):
            gap = last.tdb_s - earlier.tdb_s
            chord = (last.position_m - earlier.position_m) / gap
            scatter = np.trace(last.covariance_m2 + earlier.covariance_m2) / gap**2
            if scatter < (0.1 * speed) ** 2 and float(np.linalg.norm(chord)) < 2.0 * speed:
                # the chord's velocity is that of its middle; the pull since then turns it
                position = last.position_m
                pull = (
                    -(self._model.circular_speed(position) ** 2)
                    * position
                    / float(position @ position)
                )
                return chord + pull * gap / 2.0
        return np.zeros(3)


def _with(fixes: list[TimedPosition], fix: TimedPosition) -> list[TimedPosition]:
    """Fixes and a new one; of two at one time the more certain stays."""
    if fixes and fix.tdb_s <= fixes[-1].tdb_s:
        both = sorted((fixes[-1], fix), key=lambda f: float(np.trace(f.covariance_m2)))
        return [*fixes[:-1], both[0]]
    return [*fixes, fix]
