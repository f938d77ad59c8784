"""A short orbit arc through past fixes: least squares, prediction, and when it no longer holds.

The state at the last fix is fitted to positions with covariances. What the orbit's forces leave
out is process noise: it widens an old fix by the time since, so the arc forgets, and it widens a
prediction. A single fix already makes an arc: then the velocity is only known not to be far from
that of a circular orbit in size, which a prediction some seconds ahead can bear.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.stats import chi2

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.reasons import ReasonCode

# A right fix is farther from the arc than this once in a million.
GATE_PROBABILITY = 1e-6
GATE = float(chi2.isf(GATE_PROBABILITY, 3))
MAX_FIXES = 12
ITERATIONS = 12
# The state has settled when a step is below this share of its sigma.
SETTLED_SIGMAS = 1e-3
# Further ahead than the orbit takes for one radian an arc of a few minutes says little, and the
# frames may belong to another flight.
MAX_GAP_RAD = 1.0
# A craft on its way to the body is faster than a circular orbit is there.
EXCESS_M_S = 1000.0
# A prediction with a larger share of the distance as its sigma says nothing of use.
MAX_SHARE = 0.005


class OrbitModel(Protocol):
    """What the arc needs of the motion without thrust, see `optnav_cli.dynamics.integrator`."""

    def propagate(
        self, state: FloatArray, from_s: float, to_s: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """States (n, 6) and transitions (n, 6, 6) at other times."""
        ...

    def noise(self, state: FloatArray, seconds: float) -> FloatArray:
        """Covariance (6, 6) that unmodelled forces add in a time."""
        ...

    def circular_speed(self, position_m: FloatArray) -> float:
        """Of a circular orbit through a place, m/s."""
        ...

    def radian_s(self, position_m: FloatArray) -> float:
        """How long the motion there takes for one radian, s."""
        ...


@dataclass(frozen=True, eq=False)
class Fix:
    """A position (3,), m, inertial, with its covariance (3, 3), at a time, TDB s."""

    tdb_s: float
    position_m: FloatArray
    covariance_m2: FloatArray


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where the arc leads: position (3,) and covariance (3, 3), inertial; from how many fixes."""

    position_m: FloatArray
    covariance_m2: FloatArray
    fixes: int

    def distance_squared(self, fix: Fix) -> float:
        """Squared distance of a fix in units of both covariances; expectation 3."""
        offset = fix.position_m - self.position_m
        return float(offset @ np.linalg.solve(self.covariance_m2 + fix.covariance_m2, offset))


@dataclass(frozen=True, eq=False)
class Contradiction:
    """A fix that does not lie where the arc led; `ended`: a new arc begins with it."""

    predicted: Prediction
    ended: bool


class OrbitArc:
    """The arc through the last fixes, in the order of time.

    A fix that does not lie where the arc leads is held back: if the next one lies with the arc it
    was wrong; if the next one contradicts the arc too, the craft has manoeuvred or the arc was
    wrong, and a new one begins with the two.
    """

    def __init__(self, model: OrbitModel) -> None:
        self._model = model
        self._fixes: list[Fix] = []
        self._doubted: Fix | None = None
        self._fitted: tuple[FloatArray, FloatArray] | None = None

    def predict(self, tdb_s: float) -> Prediction | None:
        """The position at a time not before the last fix; None where the arc says nothing of use.

        It says nothing without fixes, when the fixes fit no orbit, long after them, and when they
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
        return Prediction(position, spread, len(self._fixes))

    def add(self, fix: Fix, *, sure: bool = False) -> Contradiction | None:
        """Take in a fix not before the last; says so when it does not lie where the arc leads.

        sure  the fix rests on two methods that agree: where it contradicts the arc, the arc ends
        """
        predicted = self.predict(fix.tdb_s)
        if predicted is None or predicted.distance_squared(fix) < GATE:
            # an arc that says nothing of use is not worth keeping, but for its first fix
            young = len(self._fixes) < 2 and not self._is_over(fix.tdb_s)
            kept = self._fixes if predicted is not None or young else []
            self._restart(_with(kept, fix))
            return None
        ended = sure or self._doubted is not None
        if ended:
            doubted = [] if sure or self._doubted is None else [self._doubted]
            self._restart(_with(doubted, fix))
        else:
            self._doubted = fix
        return Contradiction(predicted, ended)

    def _is_over(self, tdb_s: float) -> bool:
        if not self._fixes:
            return False
        last = self._fixes[-1]
        return tdb_s - last.tdb_s > MAX_GAP_RAD * self._model.radian_s(last.position_m)

    def _restart(self, fixes: list[Fix]) -> None:
        self._fixes, self._doubted, self._fitted = fixes[-MAX_FIXES:], None, None

    def _fit(self) -> tuple[FloatArray, FloatArray]:
        """State (6,) and covariance (6, 6) at the last fix. Raises NoSolutionError."""
        if self._fitted is not None:
            return self._fitted
        last = self._fixes[-1]
        speed = float(np.hypot(self._model.circular_speed(last.position_m), EXCESS_M_S))
        state = np.concatenate([last.position_m, self._first_velocity(speed)])
        times = np.array([fix.tdb_s for fix in self._fixes])
        for _ in range(ITERATIONS):
            states, transitions = self._model.propagate(state, last.tdb_s, times)
            normal = np.diag([0.0] * 3 + [1.0 / speed**2] * 3)
            gradient = -normal @ state
            misfit = float(state @ normal @ state)
            for fix, reached, transition in zip(self._fixes, states, transitions, strict=True):
                noise = self._model.noise(state, fix.tdb_s - last.tdb_s)[:3, :3]
                weight = np.linalg.inv(fix.covariance_m2 + noise)
                by_state, offset = transition[:3], fix.position_m - reached[:3]
                normal += by_state.T @ weight @ by_state
                gradient += by_state.T @ weight @ offset
                misfit += float(offset @ weight @ offset)
            covariance = np.linalg.inv(normal)
            step = covariance @ gradient
            state = state + step
            if float(step @ normal @ step) < SETTLED_SIGMAS**2:
                # three measurements a fix and three of the velocity's size, six unknowns
                if misfit > chi2.isf(GATE_PROBABILITY, 3 * len(times)):
                    break
                self._fitted = state, (covariance + covariance.T) / 2.0
                return self._fitted
        raise NoSolutionError("the fixes fit no orbit", ReasonCode.NO_SOLUTION)

    def _first_velocity(self, speed: float) -> FloatArray:
        """A guess from the last two fixes that lie far enough apart to tell, else none."""
        last = self._fixes[-1]
        for earlier in reversed(self._fixes[:-1]):
            gap = last.tdb_s - earlier.tdb_s
            chord = (last.position_m - earlier.position_m) / gap
            scatter = np.trace(last.covariance_m2 + earlier.covariance_m2) / gap**2
            if scatter < (0.1 * speed) ** 2 and float(np.linalg.norm(chord)) < 2.0 * speed:
                # the chord's velocity is that of its middle; the pull since then turns it
                away = last.position_m
                pull = -(self._model.circular_speed(away) ** 2) * away / float(away @ away)
                return np.asarray(chord + pull * gap / 2.0)
        return np.zeros(3)


def _with(fixes: list[Fix], fix: Fix) -> list[Fix]:
    """Fixes and a new one; of two at one time the more certain stays."""
    if fixes and fix.tdb_s <= fixes[-1].tdb_s:
        both = sorted((fixes[-1], fix), key=lambda f: float(np.trace(f.covariance_m2)))
        return [*fixes[:-1], both[0]]
    return [*fixes, fix]
