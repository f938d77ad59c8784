"""The reference path of a delivery: motion about a centre to a target, and its B-plane.

The centre (the Earth for the Moon, the Sun for planets) and the target attract as points, the
target also the centre; where the target is, the analytic theories say. Aim: Tuchin, thesis (2010),
chapter 5, (20): e_eta = e_n x S, e_xi = e_eta x S with S the direction of the arrival and e_n the
target's north pole. The source prints e_xi = e_n x S, which is parallel to e_eta. Against the
usual axes T = S x N, R = S x T: xi = B.R, eta = -B.T.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, load_body
from catalog.bodies.ephemeris import SUN_GM_M3_S2, AnalyticEphemeris
from catalog.bodies.epochs import DAY_S
from catalog.bodies.rotation import body_from_inertial
from catalog.errors import NoSolutionError
from optnav_cli.dynamics.orbit_integrator import SUN_RADIUS_M
from optnav_cli.reasons import ReasonCode

RELATIVE, PLACE_M, SPEED_M_S = 1e-11, 1e-3, 1e-9
NODES = 600  # of the splines of the target's place
AIM_STEPS, AIM_M, AIM_S = 12, 1.0, 0.01
MIN_SIZE = 1e-14  # of singular values: s a m/s over m a m/s make 1e-7 of it
Event = Callable[[float, FloatArray], float]
DIFFERENCE = np.array([1.0, 1.0, 1.0, 1e-4, 1e-4, 1e-4])  # m, m/s: of the aim by a state


@dataclass(frozen=True, eq=False)
class BPlane:
    """A hyperbola's arrival: xi, eta, m, and the time of the pericentre after the state, s."""

    aim: FloatArray
    speed_m_s: float
    pericentre_m: float


def b_plane(state: FloatArray, gm: float, pole: FloatArray) -> BPlane:
    """The arrival (xi, eta, tau) of a state (6,) about a target whose north is a unit vector.

    S = p/e + q sqrt(1 - 1/e^2), p to the pericentre, q = h x p; B = |a| sqrt(e^2 - 1) S x h.
    Raises NoSolutionError for a path that is no hyperbola.
    """
    position, speed = state[:3], state[3:]
    r = float(np.linalg.norm(position))
    momentum = np.cross(position, speed)
    energy = 0.5 * float(speed @ speed) - gm / r
    if energy <= 0.0:
        raise NoSolutionError(
            "the path does not come to the target from far away: it is bound to it, or does not "
            "reach it",
            ReasonCode.NO_SOLUTION,
        )
    a = gm / (2.0 * energy)  # of the hyperbola, positive
    vector = np.cross(speed, momentum) / gm - position / r
    e = float(np.linalg.norm(vector))
    p, h = vector / e, momentum / np.linalg.norm(momentum)
    q = np.cross(h, p)
    s = p / e + q * np.sqrt(1.0 - 1.0 / e**2)
    b = a * np.sqrt(e**2 - 1.0) * np.cross(s, h)
    e_eta = np.cross(pole, s)
    e_eta /= np.linalg.norm(e_eta)
    e_xi = np.cross(e_eta, s)
    # M = e sinh H - H; before the pericentre the radial speed is negative
    sinh = float(position @ speed) / (e * np.sqrt(gm * a))
    since = (e * sinh - np.arcsinh(sinh)) * np.sqrt(a**3 / gm)
    aim = np.array([b @ e_xi, b @ e_eta, -since])
    return BPlane(aim, float(np.sqrt(2.0 * energy)), a * (e - 1.0))


class TargetMotion:
    """Motion about a centre with a target; states (6,) are inertial, from the centre."""

    def __init__(self, target: Body, centre: str, begin_s: float, end_s: float) -> None:
        """centre  "sun" or "earth"; begin and end, TDB s, of all that is asked for."""
        self.target, self.centre = target, centre
        times = np.linspace(begin_s - 0.01 * DAY_S, end_s, NODES)
        motion = AnalyticEphemeris(target)
        name = "sun" if centre == "sun" else "earth"
        places = np.array([-motion.position_m(name, float(t)) for t in times])  # type: ignore[arg-type]
        self._spline = CubicSpline(times, places)
        self.gm, self.radius_m = SUN_GM_M3_S2, SUN_RADIUS_M
        if centre != "sun":
            body = load_body(centre)
            self.gm, self.radius_m = body.gm_m3_s2, body.radius_m
        self.pole = body_from_inertial(target, begin_s)[2]
        distance = float(np.linalg.norm(places[-1]))
        self.sphere_m = distance * (target.gm_m3_s2 / self.gm) ** 0.4

    def place(self, tdb_s: float) -> FloatArray:
        """The target's state (6,) from the centre."""
        return np.concatenate([self._spline(tdb_s), self._spline(tdb_s, 1)])

    def rates(self, t: float, y: FloatArray) -> FloatArray:
        there = self._spline(t)
        offset = y[:3] - there
        pulls = np.zeros(3)
        gradient = np.zeros((3, 3))
        for gm, x in ((self.gm, y[:3]), (self.target.gm_m3_s2, offset)):
            r = float(np.sqrt(x @ x))
            pulls -= gm / r**3 * x
            gradient += gm / r**3 * (3.0 / r**2 * np.outer(x, x) - np.eye(3))
        distance = float(np.sqrt(there @ there))
        pulls -= self.target.gm_m3_s2 / distance**3 * there
        phi = y[6:].reshape(6, 6)
        derivative: FloatArray = np.concatenate(
            [y[3:6], pulls, phi[3:].ravel(), (gradient @ phi[:3]).ravel()]
        )
        return derivative

    def fly(self, state: FloatArray, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States (n, 6) and transitions (n, 6, 6) at rising times (n,) from the first on."""
        tolerance = np.concatenate([[PLACE_M] * 3, [SPEED_M_S] * 3, [1e-9] * 36])
        span = float(times[0]), float(times[-1])
        done = self.follow(state, span, (), t_eval=times, rtol=RELATIVE, atol=tolerance)
        if not done.success or not np.isfinite(done.y).all():
            raise NoSolutionError("the path cannot be followed", ReasonCode.NO_SOLUTION)
        return done.y[:6].T.copy(), done.y[6:].T.reshape(-1, 6, 6)

    def follow(
        self, state: FloatArray, span: tuple[float, float], events: Sequence[Event], **options: Any
    ) -> Any:
        """Integrate a state (6,) and its transition over a span of TDB s with scipy's solve_ivp.

        Raises NoSolutionError for a path that begins inside the centre or meets it: through its
        middle steps would become as small as they can.
        """

        def over_centre(t: float, y: FloatArray) -> float:
            return float(np.linalg.norm(y[:3]) - self.radius_m)

        over_centre.terminal = True  # type: ignore[attr-defined]
        if over_centre(span[0], state) < 0.0:
            raise NoSolutionError(
                f"the start is {np.linalg.norm(state[:3]) / 1e3:.0f} km from the centre of the "
                f"{self.centre}, inside it; state another start",
                ReasonCode.NO_SOLUTION,
            )
        start = np.concatenate([state, np.eye(6).ravel()])
        done = solve_ivp(
            self.rates, span, start, "DOP853", events=[*events, over_centre], **options
        )
        if len(done.t_events[-1]):
            raise NoSolutionError(
                f"the path meets the {self.centre} {done.t_events[-1][0] - span[0]:.0f} s after "
                "the start; state another start",
                ReasonCode.NO_SOLUTION,
            )
        return done

    def arrival(self, state: FloatArray, tdb_s: float) -> BPlane:
        """The arrival of a state (6,) from the centre at a time near the target."""
        return b_plane(state - self.place(tdb_s), self.target.gm_m3_s2, self.pole)

    def by_state(self, state: FloatArray, tdb_s: float) -> FloatArray:
        """Derivative (3, 6) of the arrival by such a state."""
        columns = []
        for axis in range(6):
            aside = DIFFERENCE[axis] * np.eye(6)[axis]
            ends = [self.arrival(state + way * aside, tdb_s).aim for way in (1.0, -1.0)]
            columns.append((ends[0] - ends[1]) / (2.0 * DIFFERENCE[axis]))
        return np.array(columns).T


@dataclass(frozen=True, eq=False)
class ReferencePath:
    """The path to the aim.

    tdb_s, states, transitions  (n,), (n, 6), (n, 6, 6) from the first time on
    entry     number of the time at which the target's sphere begins, where the arrival is taken
    by_state  (3, 6) of the arrival by the state there
    """

    motion: TargetMotion
    tdb_s: FloatArray
    states: FloatArray
    transitions: FloatArray
    entry: int
    plane: BPlane
    by_state: FloatArray

    @property
    def pericentre_s(self) -> float:
        return float(self.tdb_s[self.entry] + self.plane.aim[2])

    def number_of(self, tdb_s: float) -> int:
        """The number of a time of the path."""
        return int(np.argmin(np.abs(self.tdb_s - tdb_s)))

    def partials(self, number: int) -> FloatArray:
        """(3, 6): d (xi, eta, tau) by the state at a time of the path."""
        if number > self.entry:
            return self.motion.by_state(self.states[number], float(self.tdb_s[number]))
        return self.from_transition(self.transitions[number])

    def from_transition(self, transition: FloatArray) -> FloatArray:
        """Map it by the transition (6, 6) from the first time to a time before the entry."""
        partials: FloatArray = (
            self.by_state @ self.transitions[self.entry] @ np.linalg.inv(transition)
        )
        return partials


def reference_path(
    motion: TargetMotion,
    state: FloatArray,
    times: FloatArray,
    aim: FloatArray | None,
) -> ReferencePath:
    """The path from a state to an aim (xi, eta, m, pericentre TDB s), by Newton's method.

    times  (n,) TDB s, rising: those of the path that are asked for; the first is the state's
    aim    None: where the state leads
    Raises NoSolutionError for a state that does not come to the target, or to the aim.
    """
    state = state.copy()
    end = _entry(motion, state, times[0], float(times[-1]))
    for _ in range(AIM_STEPS):
        grid = np.append(times[times < end], end)
        states, transitions = motion.fly(state, grid)
        plane = motion.arrival(states[-1], end)
        slope = motion.by_state(states[-1], end)
        if aim is None:
            break
        miss = aim - np.append(plane.aim[:2], end + plane.aim[2])
        if np.abs(miss[:2]).max() < AIM_M and abs(miss[2]) < AIM_S:
            break
        by_velocity = (slope @ transitions[-1])[:, 3:]
        sizes = np.linalg.svd(by_velocity, compute_uv=False)
        if not (np.isfinite(miss).all() and sizes[-1] > MIN_SIZE * sizes[0]):
            raise NoSolutionError(
                "the velocity at the start does not change the arrival in three ways (W is "
                "singular); state another start",
                ReasonCode.NO_SOLUTION,
            )
        state[3:] += np.linalg.solve(by_velocity, miss)
    else:
        raise NoSolutionError(
            f"the start does not lead to the aim: {np.abs(miss[:2]).max() / 1e3:.1f} km and "
            f"{abs(miss[2]):.0f} s are left; state a nearer one",
            ReasonCode.NO_SOLUTION,
        )
    entry = len(grid) - 1
    inside = times[(times > end) & (times < end + plane.aim[2])]
    if inside.size:
        on = motion.fly(states[-1], np.concatenate([[end], inside]))
        grid, states = np.append(grid, inside), np.vstack([states, on[0][1:]])
        transitions = np.concatenate([transitions, on[1][1:] @ transitions[-1]])
    return ReferencePath(motion, grid, states, transitions, entry, plane, slope)


def _entry(motion: TargetMotion, state: FloatArray, begin: float, end: float) -> float:
    """When a path first comes to the target's sphere. Raises NoSolutionError if it never does."""

    def inside(t: float, y: FloatArray) -> float:
        offset = y[:3] - motion.place(t)[:3]
        return float(np.linalg.norm(offset) - motion.sphere_m)

    inside.terminal = True  # type: ignore[attr-defined]
    solution = motion.follow(state, (begin, end), (inside,), rtol=1e-9, atol=1.0)
    if solution.status != 1:
        raise NoSolutionError(
            f"the path does not come within {motion.sphere_m / 1e3:.0f} km of "
            f"{motion.target.name} in the time; state another start",
            ReasonCode.NO_SOLUTION,
        )
    return float(solution.t[-1])
