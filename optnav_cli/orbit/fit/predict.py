"""Where a fitted orbit leads at any time: within its arc, ahead of it and before it.

Ahead the state at the last fix goes on with its covariance, that of the force parameters, what was
only considered, arcs of thrust, and the noise of what the forces leave out; what is local adds to
each state and is not carried on. Before the arc the first state goes back; its correlation with the
force parameters is not stored and left out. Within the arc the nearest stored state is carried over
less than a step.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from catalog.arrays import FloatArray
from catalog.bodies.epochs import DAY_S, utc_from_tdb_s
from catalog.errors import DataError, NoSolutionError
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.orbit.fit.folder import Kind, OrbitRows, StoredOrbit, stated_turn
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.settings import OF_MEASUREMENTS

LOOK_RAD = 0.05  # between places that are held against the surface: 0.6 km of height at most
LOOKS_AT_ONCE = 500
TO_MEETING_S = 0.01
# Long before, the sigma along the path is that of the whole orbit.
MAX_AHEAD_S = 100.0 * DAY_S
AHEAD: Kind = "prediction"
WITHIN: Kind = "between"


@dataclass(frozen=True, eq=False)
class Prediction:
    """Rows in the order of time, and when the path met the body's ellipsoid; None if it did not.

    After a meeting there are no rows.
    """

    rows: OrbitRows
    meets_s: float | None

    @property
    def meeting(self) -> str:
        """In words; empty without one."""
        if self.meets_s is None:
            return ""
        return f"the path meets the body's surface at {utc_from_tdb_s(self.meets_s, 0)}"


@dataclass(frozen=True, eq=False)
class _At:
    """A state with the covariance (6 + p, 6 + p) of it and of p force parameters."""

    tdb_s: float
    state: FloatArray
    covariance: FloatArray


class OrbitPath:
    """A stored orbit as a path."""

    def __init__(self, orbit: StoredOrbit) -> None:
        """Raises DataError or ConfigError where the orbit's gravity field is not there."""
        self.orbit = orbit
        forces = Forces(orbit.ephemeris, orbit.forces, orbit.path)
        added, self._names, self._last = _with_parameters(orbit, forces)
        motion = OrbitMotion(forces)
        self._motion = ArcMotion(forces, orbit.noise, motion).with_added(added)
        self._radii_m = np.array(orbit.body.radii_m)
        self._widest_m = float(self._radii_m.max())

    @property
    def first_s(self) -> float:
        """TDB s of the first stored state."""
        return float(self.orbit.rows.times[0])

    @property
    def last_s(self) -> float:
        """TDB s of the last one."""
        return float(self.orbit.rows.times[-1])

    def rows(self, times: FloatArray, advance: Callable[[], None] = lambda: None) -> Prediction:
        """Inertial states and covariances at times (n,), TDB s, in their order.

        advance  called for each state beyond the arc

        Times beyond where the path meets the body are left out.
        Raises NoSolutionError when it cannot be followed, DataError beyond the kernels and for
        times farther than MAX_AHEAD_S from the arc.
        """
        times = np.sort(np.asarray(times, dtype=np.float64))
        for ahead_s in (self.first_s - times[0], times[-1] - self.last_s) if len(times) else ():
            if ahead_s > MAX_AHEAD_S:
                raise DataError(
                    f"{self.orbit.path}: its arc is {ahead_s / DAY_S:.0f} days from the time asked "
                    f"for; wanted at most {MAX_AHEAD_S / DAY_S:.0f}: name an orbit nearer to it"
                )
        before, after = times[times < self.first_s], times[times > self.last_s]
        stored = self.orbit.rows
        inner = [self._between(float(t)) for t in times[len(before) : len(times) - len(after)]]
        last = _At(self.orbit.epoch_s, self.orbit.state, self._last)
        parameters = self._last[6:, 6:]
        first_spread = block_diag(
            stored.covariances[0] - self._motion.local(stored.states[:1])[0], parameters
        )
        first = _At(self.first_s, stored.states[0], first_spread)
        ahead, met_after = self._walk(last, after, advance)
        back, met_before = self._walk(first, before[::-1], advance)
        points = [*back[::-1], *inner, *ahead]
        kinds: list[Kind] = [*len(back) * (AHEAD,), *len(inner) * (WITHIN,), *len(ahead) * (AHEAD,)]
        states = np.array([at.state for at in points]).reshape(-1, 6)
        spreads = np.array([at.covariance[:6, :6] for at in points]).reshape(-1, 6, 6)
        beyond = np.array([kind == AHEAD for kind in kinds], dtype=bool)
        spreads[beyond] += self._motion.local(states[beyond])  # stored states have it
        rows = OrbitRows(np.array([at.tdb_s for at in points]), kinds, states, spreads)
        return Prediction(rows, met_after if met_after is not None else met_before)

    def radian_s(self) -> float:
        """Return the time that the path takes per radian at the last fix, s."""
        return self._motion.radian_s(self.orbit.state[:3])

    def height_m(self, tdb_s: float, state: FloatArray) -> float:
        """Return the height of a state (6,) over the reference sphere."""
        return float(np.linalg.norm(state[:3])) - self.orbit.body.radius_m

    def _between(self, tdb_s: float) -> _At:
        """At a time within the arc."""
        stored = self.orbit.rows
        nearest = int(np.argmin(np.abs(stored.times - tdb_s)))
        time, state = float(stored.times[nearest]), stored.states[nearest]
        return self._carried(_At(time, state, stored.covariances[nearest]), tdb_s, ())

    def _carried(self, at: _At, to_s: float, names: tuple[str, ...]) -> _At:
        if to_s == at.tdb_s:
            return at
        step = self._motion.step(at.state, at.tdb_s, to_s, names)
        transition = np.eye(len(at.covariance))
        transition[:6, :6], transition[:6, 6:] = step.transition, step.by_parameters
        covariance = transition @ at.covariance @ transition.T
        covariance[:6, :6] += step.noise
        return _At(to_s, step.state, covariance)

    def _walk(
        self, at: _At, times: FloatArray, advance: Callable[[], None]
    ) -> tuple[list[_At], float | None]:
        """On to times ever farther to one side; and when the path meets the body."""
        points: list[_At] = []
        for time in times:
            meets = self._meeting(at, float(time))
            if meets is not None:
                return points, meets
            at = self._carried(at, float(time), self._names)
            points.append(at)
            advance()
        return points, None

    def _meeting(self, at: _At, to_s: float) -> float | None:
        """When the path first lies inside the body's ellipsoid on the way to a time."""
        pieces = abs(to_s - at.tdb_s) / (LOOK_RAD * self._motion.radian_s(at.state[:3]))
        looks = np.linspace(at.tdb_s, to_s, max(int(np.ceil(pieces)), 1) + 1)
        state, start = at.state, at.tdb_s
        for first in range(1, len(looks), LOOKS_AT_ONCE):
            ahead = looks[first : first + LOOKS_AT_ONCE]
            try:
                states = self._motion.path(state, start, ahead)
            except NoSolutionError:  # so deep that it is not followed: which look is the first
                return self._meeting_by_looks(state, start, ahead)
            for number in np.flatnonzero(np.linalg.norm(states[:, :3], axis=1) < self._widest_m):
                if not self._is_inside(float(ahead[number]), states[number]):
                    continue
                if number > 0:
                    state, start = states[number - 1], float(ahead[number - 1])
                return self._first_inside(state, start, float(ahead[number]))
            state, start = states[-1], float(ahead[-1])
        return None

    def _meeting_by_looks(self, state: FloatArray, start: float, looks: FloatArray) -> float:
        for end in looks:
            try:
                there, _ = self._motion.carry(state, start, float(end) - start)
            except NoSolutionError:
                return float(end)
            if self._is_inside(float(end), there):
                return self._first_inside(state, start, float(end))
            state, start = there, float(end)
        return start

    def _first_inside(self, state: FloatArray, outside_s: float, inside_s: float) -> float:
        """When a path enters, by halving; its state is that at `outside_s`."""
        from_s = outside_s
        while abs(inside_s - outside_s) > TO_MEETING_S:
            middle = 0.5 * (outside_s + inside_s)
            there, _ = self._motion.carry(state, from_s, middle - from_s)
            if self._is_inside(middle, there):
                inside_s = middle
            else:
                outside_s = middle
        return inside_s

    def _is_inside(self, tdb_s: float, state: FloatArray) -> bool:
        position = stated_turn(self.orbit.ephemeris, tdb_s) @ state[:3]
        return float(np.linalg.norm(position / self._radii_m)) < 1.0


def _with_parameters(
    orbit: StoredOrbit, forces: Forces
) -> tuple[dict[str, FloatArray], tuple[str, ...], FloatArray]:
    """Return the estimated force parameters, their names, and the covariance with the state.

    Those estimated come with their correlations, those considered with their prior, arcs of thrust
    with the errors that the settings state.
    """
    added: dict[str, FloatArray] = {}
    names: list[str] = []
    taken, alone, column = list(range(6)), [], 6
    for parameter in orbit.parameters:
        count = len(parameter.value)
        estimated, moves = parameter.mode == "estimate", parameter.name not in OF_MEASUREMENTS
        if estimated and moves:
            added[parameter.name] = np.array(parameter.value)
            names.append(parameter.name)
            taken += range(column, column + count)
        column += count if estimated else 0
    for parameter in orbit.parameters:
        if parameter.mode == "consider" and parameter.name not in OF_MEASUREMENTS:
            names.append(parameter.name)
            alone.append(np.eye(len(parameter.value)) * parameter.prior_sigma**2)
    for number, arc in enumerate(forces.settings.thrust, start=1):
        names.append(f"thrust_{number}")
        alone.append(arc.covariance)
    known = orbit.covariance[np.ix_(taken, taken)]
    return added, tuple(names), np.asarray(block_diag(known, *alone), dtype=np.float64)
