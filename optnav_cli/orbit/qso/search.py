"""Quasi-satellite orbits that pass one longitude of a moon always at the same distance.

The averaged theory gives the first velocity, the numeric motion the right one: that of the least
difference, in all passes of the longitude, between the distance and that of the start.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from scipy.optimize import minimize
from scipy.special import ellipk

from catalog.arrays import FloatArray
from catalog.bodies.epochs import DAY_S
from catalog.bodies.rotation import body_from_inertial
from catalog.errors import NoSolutionError
from catalog.geometry.ellipsoid import project_to_surface
from optnav_cli.orbit.qso.motion import FlightTable, MoonMotion, fly
from optnav_cli.reasons import ReasonCode

K = float(ellipk(0.75))  # the complete elliptic integral of modulus sqrt(3)/2
KAPPA = 2.0  # the ratio of the axes of the centre's ellipse
MIN_A = float((256.0 * K / (5.0 * np.pi)) ** (1.0 / 3.0))  # (4): below it (3) has no real root
MIN_DE = 0.5 * MIN_A  # there both roots of (3) meet at A/4
_STEP = 1e-5
Velocity = Literal["free", "perpendicular"]

SEARCH_STEP_S, PASS_STEP_S = 900.0, 300.0
FIRST_STEP = 0.03  # of the speed: the first trials beside the theory's velocity
MAX_TRIALS, SETTLED_M_S, SETTLED_M = 90, 1e-3, 20.0
FAR = 6.0  # distances beyond which a craft has left
LOST_M = 1e9  # cost of a path that leaves or falls in, less what it flew
MAX_SPREAD = 0.25  # of the distance: an orbit with a larger one is not kept
BEYOND = 5.0  # how much more a pass beyond the greatest distance costs
# Where no orbit keeps the start's distance as the greatest, that cost widens the ring: at 50 km
# from Phobos, anomaly 270 deg, to 2.0 km of 0.75. An orbit with more than RING_EXCESS times the
# least ring gives way to one by the lower cost.
RING_EXCESS, BEYOND_EVEN = 2.0, 2.0
STARTS = (-0.06, -0.03, 0.0, 0.03, 0.06)  # of the speed, a component: the best starts, too
MIN_GAIN = 0.1  # of the cost: what a further start has to gain to be another minimum
MIN_RATE = 0.002  # below it the moon does not turn the craft: it goes round the planet by itself
LATE = 1.6  # revolutions after the last pass: the craft does not come back


def integral(a: float, xi: float, big_a: float, kappa: float = KAPPA) -> float:
    """The integral of 1/r over a turn, (1), by complete elliptic integrals."""
    w1, w2 = np.sin(xi), np.cos(xi)
    c0 = 0.625 * big_a**2 + 0.5 * a**2 * (1.0 + kappa**2) + big_a * a * (kappa + 0.5) * w2
    c1 = -0.75 * big_a**2 - big_a * a * (2.0 * kappa - 1.0) * w2
    c1 = 0.5 * (c1 + a**2 * (1.0 - kappa**2) * (w2**2 - w1**2))
    c2 = big_a * a * (1.0 - 2.0 * kappa) * w1 + 2.0 * a**2 * (1.0 - kappa**2) * w1 * w2
    d = np.hypot(c1, -0.5 * c2)
    return float(4.0 / np.sqrt(c0 + d) * ellipk(2.0 * d / (c0 + d)))


def averaged_rates(a: float, xi: float, big_a: float) -> FloatArray:
    """Rates (4,) of a, xi, A and phi by the anomaly, (2)."""

    def slope(of_a: float, of_xi: float, of_big: float) -> float:
        ahead = integral(a + of_a, xi + of_xi, big_a + of_big)
        return (ahead - integral(a - of_a, xi - of_xi, big_a - of_big)) / (2.0 * _STEP)

    by_a, by_xi, by_big = slope(_STEP, 0.0, 0.0), slope(0.0, _STEP, 0.0), slope(0.0, 0.0, _STEP)
    inner = -by_xi / (a * KAPPA * np.pi)
    phase = (4.0 / big_a * by_big + 2.0 / (a * KAPPA) * by_a) / (2.0 * np.pi)
    phase += -1.0 + 0.75 / KAPPA
    return np.array([inner, phase, -2.0 * by_xi / (big_a * np.pi), -2.0 * by_big / (big_a * np.pi)])


def inner_axes(big_a: float) -> tuple[float, float]:
    """The roots a of (3) for an A: that of quasi-satellite orbits, and the larger one.

    Raises ValueError below the bound (4).
    """
    if big_a < MIN_A:
        raise ValueError(f"A = {big_a:.4g}: (3) has no real root below {MIN_A:.4g}")
    root = np.sqrt(max(big_a**4 / 16.0 - 16.0 * K * big_a / (5.0 * np.pi), 0.0)) / big_a
    return float(big_a / 4.0 - root), float(big_a / 4.0 + root)


def axes_of(de: float) -> tuple[float, float]:
    """The axes a and A of the least drift whose path has the semi-axes De/2 and De, by (3)."""
    a = float((np.sqrt(de**2 + 256.0 * K / (5.0 * np.pi * de)) - de) / 4.0)
    return a, de + 2.0 * a


def phase_rate(de: float) -> float:
    """phi' of that path: how much faster than the moon the craft goes round, less 1."""
    _, big_a = axes_of(de)
    return 8.0 * K / (np.pi * big_a * de**2)


def first_guess(direction: float, distance: float) -> FloatArray:
    """Position and velocity (4,) x, y, x', y' in the turning frame at a place of the path.

    direction  of the place, rad, from x (away from the planet) to y (along the moon's motion)
    distance   from the moon; both units Hill's, the velocity by the true anomaly, osculating:
               that of the free path, (A/2) n at -y. The ellipse's own is 8 % less and falls in.
    """
    cosine, sine = np.cos(direction), np.sin(direction)
    de = distance * float(np.hypot(2.0 * cosine, sine))
    a, big_a = axes_of(de)
    # x = De/2 cos th, y = -De sin th
    theta = np.arctan2(-distance * sine / de, 2.0 * distance * cosine / de)
    along = (1.5 * a - big_a) * np.cos(theta)
    return np.array([distance * cosine, distance * sine, -0.5 * big_a * np.sin(theta), along])


@dataclass(frozen=True)
class QsoStart:
    """Where and when an orbit begins: over a longitude of the moon's equator.

    distance_m  from the surface of its ellipsoid;  longitude  east, rad;  tdb_s  TDB s
    """

    distance_m: float
    longitude: float
    tdb_s: float


@dataclass(frozen=True, eq=False)
class QsoPasses:
    """The passes of a longitude in a flight, the start among them.

    tdb_s, radius_m  (n,) when, and how far from the moon's centre
    states           (n, 6) inertial
    """

    tdb_s: FloatArray
    radius_m: FloatArray
    states: FloatArray

    def rates(self, mean_motion: float) -> FloatArray:
        """(n - 1,) how much faster than the moon each revolution is, less 1."""
        return 2.0 * np.pi / (np.diff(self.tdb_s) * mean_motion) - 1.0


@dataclass(frozen=True, eq=False)
class QsoOrbit:
    """An orbit that was found.

    radius_m       from the moon's centre at the start
    state, guess   (6,) inertial at the start: of the orbit, and by the averaged theory
    spread_m       largest difference of a pass from the start;  ring_m  farthest less nearest pass
    guess_spread_m the same difference of the theory's orbit, NaN where it is not kept
    trials         flights that the search took
    """

    start: QsoStart
    radius_m: float
    state: FloatArray
    guess: FloatArray
    passes: QsoPasses
    theory_rate: float
    guess_spread_m: float
    trials: int

    @property
    def spread_m(self) -> float:
        return float(np.abs(self.passes.radius_m - self.radius_m).max())

    @property
    def ring_m(self) -> float:
        return float(np.ptp(self.passes.radius_m))


class QsoSearch:
    """The search for the velocity of one start, over some days."""

    def __init__(
        self, motion: MoonMotion, start: QsoStart, days: float, greatest: bool = True
    ) -> None:
        """greatest  whether no pass is to be farther than the start, or on either side of it.

        Raises NoSolutionError for a distance at which the theory has no such orbit.
        """
        self.motion, self.start, self.days, self._greatest = motion, start, days, greatest
        moon = motion.moon
        cosine, sine = np.cos(start.longitude), np.sin(start.longitude)
        outward = np.array([cosine, sine, 0.0])  # body frame
        surface = float(np.linalg.norm(project_to_surface(outward, moon.radii_m)))
        self.radius_m = surface + start.distance_m
        self._across = np.array([-sine, cosine, 0.0])
        self._along = outward
        self._guess, self.theory_rate = self._first(surface)
        self._table, self._turns, self._times = self._tables(SEARCH_STEP_S)

    def _first(self, surface_m: float) -> tuple[FloatArray, float]:
        """The theory's state (6,), inertial, and its angular rate."""
        at = np.array([self.start.tdb_s])
        turning = self.motion.turning_from_inertial(at)[0]
        turns = body_from_inertial(self.motion.moon, at)[0]
        position = turning @ (turns.T @ self._along) * self.radius_m
        planet = float(np.linalg.norm(self.motion.planet_m(at)[0]))
        share = self.motion.pair.moon_gm / self.motion.pair.planet_gm
        hill = float(share ** (1.0 / 3.0))
        unit_m = planet * hill
        direction = float(np.arctan2(position[1], position[0]))
        # what is averaged goes by the planet's mean distance, the start by that of its time
        mean = self.radius_m / (1e3 * self.motion.orbit.semi_major_axis_km * hill)
        de = mean * float(np.hypot(2.0 * np.cos(direction), np.sin(direction)))
        if de < MIN_DE:
            least = self.radius_m * MIN_DE / de - surface_m
            raise NoSolutionError(
                f"{self.start.distance_m / 1e3:g} km from the surface is nearer than any "
                f"quasi-satellite orbit over this longitude, {least / 1e3:.1f} km; give more",
                ReasonCode.NO_SOLUTION,
            )
        rate = phase_rate(de)
        if rate < MIN_RATE:
            raise NoSolutionError(
                f"{self.start.distance_m / 1e3:g} km from the surface is beyond the region in "
                f"which {self.motion.moon.name} keeps a craft: it would gain {rate:.4f} of a "
                f"revolution in each, less than {MIN_RATE:g}; give less",
                ReasonCode.NO_SOLUTION,
            )
        x, y, dx, dy = first_guess(direction, self.radius_m / unit_m)
        turn, recession = self.motion.turning_rates(self.start.tdb_s)
        flat = unit_m * np.array([x, y, 0.0])
        velocity = unit_m * turn * np.array([dx, dy, 0.0]) + recession / planet * flat
        velocity = velocity + np.cross([0.0, 0.0, turn], flat)
        return np.concatenate([turning.T @ position, turning.T @ velocity]), rate

    def _tables(self, step_s: float) -> tuple[FlightTable, FloatArray, FloatArray]:
        steps = max(int(np.ceil(self.days * DAY_S / step_s)), 4)
        times = self.start.tdb_s + self.days * DAY_S * np.linspace(0.0, 1.0, steps + 1)
        table = self.motion.table(times)
        return table, body_from_inertial(self.motion.moon, times), times

    def state(self, steps: FloatArray) -> FloatArray:
        """The state (6,) whose velocity differs from the theory's by steps across and along.

        steps  (1,) or (2,), of the speed: of one alone the start is square to the line
        """
        state = self._guess.copy()
        speed = float(np.linalg.norm(state[3:]))
        outward = state[:3] / np.linalg.norm(state[:3])
        radial = float(state[3:] @ outward)
        across = state[3:] - radial * outward
        across *= 1.0 + steps[0] * speed / np.linalg.norm(across)
        radial = radial + steps[1] * speed if len(steps) > 1 else 0.0
        state[3:] = across + radial * outward
        return state

    def cost(self, steps: FloatArray, beyond: float = BEYOND) -> float:
        """The spread of a flight, m, larger than LOST_M / 2 where it is not kept.

        beyond  how much more a pass costs that is farther than the start
        """
        states, made = self._flown(self.state(steps), self._table)
        if made < len(states) - 1:
            return LOST_M * (1.0 - 0.4 * made / len(states))
        passes = self._passes(states, self._turns, self._times)
        late = self._times[-1] - passes[0][-1] if len(passes[0]) else np.inf
        spread = self._spread(passes[1], beyond)
        if late * self.motion.mean_motion > LATE * 2.0 * np.pi:
            return 0.5 * LOST_M + spread + float(np.linalg.norm(states[-1, :3]))
        return spread

    def _spread(self, radius_m: FloatArray, beyond: float) -> float:
        apart = self.radius_m - radius_m
        if not self._greatest:
            return float(np.abs(apart).max(initial=0.0))
        return float(apart.max(initial=0.0) + beyond * max(-apart.min(initial=0.0), 0.0))

    def _flown(self, state: FloatArray, table: FlightTable) -> tuple[FloatArray, int]:
        out = np.empty((len(table.steps_s) + 1, 6))
        out[0] = state
        limits = 0.9 * min(self.motion.moon.radii_m), FAR * self.radius_m
        made = fly(state, table, self.motion.pair, limits, out[1:])
        return out, made

    def _passes(
        self, states: FloatArray, turns: FloatArray, times: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Times (n,) and distances (n,) of the passes after the start."""
        places = np.einsum("nij,nj->ni", turns, states[:, :3])
        side, front = places @ self._across, places @ self._along > 0.0
        # the craft runs backwards: the side goes from plus to minus in front
        side[0] = 0.0
        before = np.flatnonzero((side[1:-2] > 0.0) & (side[2:-1] <= 0.0) & front[1:-2]) + 1
        nodes = before[:, None] + np.arange(-1, 3)
        across, radius = side[nodes], np.linalg.norm(places, axis=1)[nodes]
        u = across[:, 1] / (across[:, 1] - across[:, 2])
        for _ in range(3):
            weights, slopes = _cubic(u)
            rate = np.einsum("nk,nk->n", slopes, across)
            u = np.clip(u - np.einsum("nk,nk->n", weights, across) / rate, 0.0, 1.0)
        step = times[1] - times[0]
        return times[before] + u * step, np.einsum("nk,nk->n", _cubic(u)[0], radius)

    def solve(self, velocity: Velocity = "free") -> QsoOrbit:
        """The best velocity. Raises NoSolutionError where none keeps the craft."""
        steps, cost, trials = self._best(2 if velocity == "free" else 1)
        if not cost < MAX_SPREAD * self.radius_m:
            stays = cost < LOST_M / 2.0
            how = f"passes differ by {cost / 1e3:.0f} km" if stays else "it leaves or falls in"
            raise NoSolutionError(
                f"no velocity keeps the craft for {self.days:g} days at "
                f"{self.start.distance_m / 1e3:g} km: {how}; give another distance or fewer days",
                ReasonCode.NO_SOLUTION,
            )
        guess, made = self._flown(self._guess, self._table)
        kept = made == len(guess) - 1
        radius = self._passes(guess, self._turns, self._times)[1] if kept else np.array([np.nan])
        return QsoOrbit(
            self.start,
            self.radius_m,
            self.state(steps),
            self._guess,
            self.passes(self.state(steps)),
            self.theory_rate,
            float(np.abs(radius - self.radius_m).max(initial=0.0)),
            trials,
        )

    def _best(self, count: int) -> tuple[FloatArray, float, int]:
        """The steps (count,) of the least cost from two starts, that cost, and all trials."""
        steps, cost, trials = self._least(np.zeros(count), BEYOND)
        others = [np.array(start) for start in product(STARTS, repeat=count) if any(start)]
        other, lower, more = self._least(min(others, key=self.cost), BEYOND)
        trials += len(others) + more
        if lower < (1.0 - MIN_GAIN) * cost:
            steps, cost = other, lower
        if self._greatest and cost < LOST_M / 2.0:
            even, ring, more = self._least(steps, 1.0)  # passes to either side cost the same
            trials += more
            if self.cost(steps, 1.0) > RING_EXCESS * ring:
                steps, _, more = self._least(even, BEYOND_EVEN)
                cost, trials = self.cost(steps), trials + more
        return steps, cost, trials

    def _least(self, first: FloatArray, beyond: float) -> tuple[FloatArray, float, int]:
        """The steps of the least cost about the first ones, that cost, and the trials."""
        simplex = np.vstack([first, first + FIRST_STEP * np.eye(len(first))])
        options = {
            "initial_simplex": simplex,
            "maxfev": MAX_TRIALS,
            "xatol": SETTLED_M_S / float(np.linalg.norm(self._guess[3:])),
            "fatol": SETTLED_M,
        }
        cost: Callable[[FloatArray, float], float] = self.cost
        result = minimize(cost, first, args=(beyond,), method="Nelder-Mead", options=options)
        return result.x, float(result.fun), int(result.nfev)

    def passes(self, state: FloatArray) -> QsoPasses:
        """All passes of a flight, the start as the first, at a finer step."""
        table, turns, times = self._tables(PASS_STEP_S)
        states, _ = self._flown(state, table)
        at, _ = self._passes(states, turns, times)
        at = np.concatenate([times[:1], at])
        exact = self.motion.propagate(state, at, PASS_STEP_S)
        return QsoPasses(at, np.linalg.norm(exact[:, :3], axis=1), exact)


def _cubic(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights (n, 4) of values at -1, 0, 1, 2 of the cubic through them at u (n,), and slopes."""
    a, b, c, d = u + 1.0, u, u - 1.0, u - 2.0
    weights = np.stack([-b * c * d / 6.0, a * c * d / 2.0, -a * b * d / 2.0, a * b * c / 6.0], -1)
    slopes = np.stack(
        [
            -(b * c + b * d + c * d) / 6.0,
            (a * c + a * d + c * d) / 2.0,
            -(a * b + a * d + b * d) / 2.0,
            (a * b + a * c + b * c) / 6.0,
        ],
        axis=-1,
    )
    return weights, slopes
