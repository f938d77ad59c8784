"""The transfer, vertical descent and braking of a landing, all trials at once.

Source of the stages and their limits: Tuchin, thesis (2010), chapter 2. A craft sinks at a constant
speed; where its side velocity is off what leads it to the target, an engine mends it. Below the
altimeter's last height the speed falls with the square root of the height. A filter takes the
ranges of four beams and, nearer, the velocities along them. The model of the ground is wrong alike
over a length: the filter's state is place, velocity and how much higher the ground is at the
model's vertices below. It begins with what the transfer's ranges say of all of them, and with how
their errors hang together: what was met from above is met again.

Axes are body-fixed; the pull of the moon, its turning and the planet's tide are compensated by the
engines as the state that the filter has says: what is left is the pull's change by its error.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.rotation import body_from_inertial
from catalog.errors import NoSolutionError
from catalog.geometry.ellipsoid import compute_normals
from catalog.geometry.latlon import xyz_from_latlon
from optnav_cli.orbit.landing.navigation import beams_about
from optnav_cli.orbit.landing.rays import DigitalSurface, GroundHits
from optnav_cli.orbit.landing.settings import LandingSettings
from optnav_cli.orbit.qso.motion import MoonMotion, split
from optnav_cli.reasons import ReasonCode

STEPS, COAST_STEP_S = 4, 60.0
PATH_STEP_S = 30.0
MAX_MISS_M = 1.0  # of the last step
STEP_S = 1.0
CONTROL_S = 20  # steps between burns of the descent; in the braking each step has one
SIDE_M_S = 4.0  # the largest side velocity that is asked for
DEAD_M_S = 0.05  # of a velocity that is not mended
LAST_M = 20.0  # below this height no side engine is used: dust
MAX_STEPS = 6000
BEAMS = 4
LIFT_M = 1000.0
ROUGH = 0.01  # of the variance of the ground's error: between vertices, and never quite the same


@dataclass(frozen=True, eq=False)
class Site:
    """A place of the ground: point and up (3,), body frame; east and north complete it."""

    point: FloatArray
    up: FloatArray

    @classmethod
    def at(cls, lat: float, lon: float, ground: DigitalSurface) -> "Site":
        """The ground at a latitude and longitude, rad; up is the ellipsoid's normal there."""
        direction = xyz_from_latlon(lat, lon, 1.0)
        reach = 2.0 * ground.mesh.reach_m
        hit = ground.cast((reach * direction)[None], -direction[None])
        return cls(hit.points[0], compute_normals(hit.points[0], ground.radii))

    @property
    def axes(self) -> FloatArray:
        """(3, 3): rows east, north, up."""
        east = np.cross([0.0, 0.0, 1.0], self.up)
        east /= np.linalg.norm(east)
        return np.stack([east, np.cross(self.up, east), self.up])

    def above(self, height_m: float) -> FloatArray:
        """The place (3,) so high over the site, body frame."""
        point: FloatArray = self.point + height_m * self.up
        return point


@dataclass(frozen=True, eq=False)
class Departure:
    """A departure impulse.

    changes  (k, 3) velocity changes of the steps, inertial, m/s: their sum is the impulse
    state    (6,) after it, inertial;  tdb_s, arrival_s  its time, and that of the arrival
    """

    changes: FloatArray
    state: FloatArray
    tdb_s: float
    arrival_s: float

    @property
    def impulse(self) -> FloatArray:
        total: FloatArray = self.changes.sum(axis=0)
        return total

    def errors_m_s(self) -> FloatArray:
        """(k,) what is left of the impulse to find after each step."""
        left = self.changes[::-1].cumsum(axis=0)[::-1]
        sizes: FloatArray = np.linalg.norm(np.vstack([left[1:], np.zeros(3)]), axis=1)
        return sizes


def depart(
    motion: MoonMotion,
    state: FloatArray,
    tdb_s: float,
    arrival_s: float,
    aim_body: FloatArray,
    steps: int = STEPS,
) -> Departure:
    """The impulse that brings a craft to a body-fixed place (3,) at a time.

    Raises NoSolutionError where Newton's method does not come to it.
    """
    times = np.array([tdb_s, arrival_s])
    aim = body_from_inertial(motion.moon, arrival_s).T @ aim_body
    state, changes = state.copy(), []
    for _ in range(steps):
        states, transitions = split(motion.propagate(state, times, COAST_STEP_S, transition=True))
        miss = aim - states[1, :3]
        if not np.isfinite(miss).all():
            break
        change = np.linalg.solve(transitions[1, :3, 3:], miss)
        state[3:] += change
        changes.append(change)
    end = motion.propagate(state, times, COAST_STEP_S)[1, :3]
    if not float(np.linalg.norm(end - aim)) < MAX_MISS_M:
        raise NoSolutionError(
            "no departure impulse leads to the place over the target in this time; give another "
            "transfer time, target or departure",
            ReasonCode.NO_SOLUTION,
        )
    return Departure(np.array(changes), state, tdb_s, arrival_s)


def check_clear(motion: MoonMotion, departure: Departure, ground: DigitalSurface) -> FloatArray:
    """Places (n, 3), body frame, of the transfer; they stay over the ground.

    Raises NoSolutionError for a transfer that meets it, as to a target on the far side.
    """
    count = int(np.ceil((departure.arrival_s - departure.tdb_s) / PATH_STEP_S)) + 1
    times = np.linspace(departure.tdb_s, departure.arrival_s, count)
    states = motion.propagate(departure.state, times, COAST_STEP_S)
    turns = body_from_inertial(motion.moon, times)
    places: FloatArray = np.einsum("nij,nj->ni", turns, states[:, :3])
    over = np.full(count, np.nan)
    far = np.linalg.norm(places, axis=1) > 1.02 * ground.mesh.reach_m
    over[far] = 1.0
    near = ~far & ((np.abs(places) / ground.radii).max(axis=1) > 0.5)
    if near.any():
        over[near] = ground.height(places[near])
    if not (over > 0.0).all():
        after = float(times[np.argmax(~(over > 0.0))] - departure.tdb_s)
        raise NoSolutionError(
            f"the transfer meets the ground {after:.0f} s after the departure: the target lies on "
            "the far side; choose another target, departure or transfer time",
            ReasonCode.NO_SOLUTION,
        )
    return places


@dataclass(frozen=True, eq=False)
class DescentErrors:
    """Errors of the filter at one moment of each trial (n).

    height_m, rate_m_s  along up;  side_m, side_m_s  (n,) across, the length of both components
    nees  of the place and velocity, over 6
    stated_m  (n, 2) 1 sigma of height and side as the filter states them
    """

    height_m: FloatArray
    side_m: FloatArray
    rate_m_s: FloatArray
    side_m_s: FloatArray
    nees: FloatArray
    stated_m: FloatArray


@dataclass(frozen=True, eq=False)
class Touchdown:
    """The end of each trial.

    east_m, north_m  from the target;  down_m_s, side_m_s  the velocity against the ground
    dv_m_s  of the descent;  landed  whether the ground was met in time
    """

    east_m: FloatArray
    north_m: FloatArray
    down_m_s: FloatArray
    side_m_s: FloatArray
    dv_m_s: FloatArray
    landed: BoolArray
    end: DescentErrors
    path: FloatArray


class VerticalDescent:
    """Craft over a site with a filter each; states (n, 6) in axes east, north, up of the site."""

    def __init__(
        self,
        model: DigitalSurface,
        truth: DigitalSurface,
        site: Site,
        settings: LandingSettings,
        gm: float,
        corners: IntArray,
    ) -> None:
        """corners  (faces, 3) of the model: numbers of the nodes whose heights are found, or -1."""
        self._model, self._truth, self._site = model, truth, site
        self._settings, self._gm = settings, gm
        self._roll = float(np.radians(settings.beams.roll_deg_s))
        self._beams = self._turned(0.0, np.inf)
        self._corners, self._unknowns = corners, 7 + int(corners.max())

    def _turned(self, seconds: float, height_m: float) -> FloatArray:
        """The beams (4, 3) so long after the arrival, at a height."""
        beams, turned = self._settings.beams, self._roll * seconds
        # upright at the altimeter's last height, from twice that on
        lean = beams.lean_deg * float(np.clip(height_m / beams.to_m - 1.0, 0.0, 1.0))
        down = np.array([0.0, 0.0, -1.0])
        axis = beams_about(down, float(np.radians(lean)), turned - np.radians(45.0))[0]
        return beams_about(axis, float(np.radians(beams.off_deg)), turned)

    def fly(
        self,
        states: FloatArray,
        guesses: FloatArray,
        covariances: FloatArray,
        rng: np.random.Generator,
    ) -> Touchdown:
        """Bring craft down from states (n, 6).

        guesses      (n, 6 + m) of the filter, with the ground's heights over its model at the nodes
        covariances  (n, 6 + m, 6 + m)
        """
        count = len(states)
        self._x, self._xhat, self._p = states.copy(), guesses.copy(), covariances.copy()
        self._rng, self._dv = rng, np.zeros(count)
        self._burn(self._wanted(), np.ones(count, bool))
        end: DescentErrors | None = None
        done = np.zeros(count, bool)
        last, path = self._x.copy(), []
        for step in range(MAX_STEPS):
            self._measure(step, ~done)
            if end is None and (self._xhat[:, 2] < self._settings.beams.to_m).all():
                end = self._errors()
            path.append(self._x[0].copy())
            braking = self._xhat[:, 2] < self._settings.beams.to_m
            due = braking | (step % CONTROL_S == 0)
            self._burn(self._wanted(), due & ~done)
            before = self._x.copy()
            self._move(~done)
            over = self._truth.height(self._body(self._x[:, :3]))
            fell = ~done & ~(over > 0.0)
            if fell.any():
                # the part of the step that ends on the ground
                drop = np.maximum(before[:, 2] - self._x[:, 2], 1e-6)
                share = np.clip(1.0 + np.where(np.isfinite(over), over, 0.0) / drop, 0.0, 1.0)
                where = before + share[:, None] * (self._x - before)
                last[fell] = where[fell]
                done |= fell
            if done.all():
                break
        side = np.linalg.norm(last[:, 3:5], axis=1)
        return Touchdown(
            last[:, 0], last[:, 1], -last[:, 5], side, self._dv, done,
            end or self._errors(), np.array(path),
        )  # fmt: skip

    def _body(self, places: FloatArray) -> FloatArray:
        positions: FloatArray = self._site.point + places @ self._site.axes
        return positions

    def _errors(self) -> DescentErrors:
        off = self._xhat[:, :6] - self._x
        square = np.einsum(
            "ni,ni->n", off, np.linalg.solve(self._p[:, :6, :6], off[..., None])[..., 0]
        )
        lengths = (np.linalg.norm(off[:, :2], axis=1), np.linalg.norm(off[:, 3:5], axis=1))
        variances = np.diagonal(self._p, axis1=1, axis2=2)
        stated = np.sqrt(np.stack([variances[:, 2], variances[:, 0] + variances[:, 1]], axis=1))
        return DescentErrors(off[:, 2], lengths[0], off[:, 5], lengths[1], square / 6.0, stated)

    def _shares(self, hits: GroundHits) -> FloatArray:
        """(n, m) of the nodes' heights in that of the ground where it is met; zero beside them."""
        nodes = self._corners[hits.faces]
        places = self._model.mesh.corners[hits.faces].transpose(0, 2, 1)
        three = np.linalg.solve(places, hits.points[..., None])[..., 0]
        three /= three.sum(axis=1, keepdims=True)
        inside = np.flatnonzero(np.isfinite(hits.range_m) & (nodes >= 0).all(axis=1))
        shares = np.zeros((len(nodes), self._unknowns - 6))
        shares[inside[:, None], nodes[inside]] = three[inside]
        return shares

    def _height(self) -> FloatArray:
        """(n,) over the ground below as model and filter have it: it slopes about the target."""
        up = self._site.up
        # from above: by the model a craft that is about to touch down may be under the ground
        above = self._body(self._xhat[:, :3]) + LIFT_M * up
        below = self._model.cast(above, np.tile(-up, (len(above), 1)))
        raised = np.einsum("nm,nm->n", self._shares(below), self._xhat[:, 6:])
        return np.where(
            np.isfinite(below.range_m), below.range_m - LIFT_M - raised, self._xhat[:, 2]
        )

    def _wanted(self) -> FloatArray:
        """The velocity (n, 3) that leads to the target."""
        section, beams = self._settings.landing, self._settings.beams
        height = np.maximum(self._height(), 0.0)
        share = np.sqrt(np.minimum(height / beams.to_m, 1.0))
        speed = np.maximum(section.descent_m_s * share, section.touchdown_m_s)
        togo = np.maximum(height / section.descent_m_s, 2.0 * CONTROL_S)
        side = -self._xhat[:, :2] / togo[:, None]
        length = np.linalg.norm(side, axis=1)
        side *= np.minimum(1.0, SIDE_M_S / np.maximum(length, 1e-9))[:, None]
        side[height < LAST_M] = 0.0
        return np.hstack([side, -speed[:, None]])

    def _burn(self, wanted: FloatArray, due: BoolArray) -> None:
        """Change velocities towards the wanted ones, with the errors of engines."""
        errors = self._settings.errors
        change = wanted - self._xhat[:, 3:6]
        low = self._height() < LAST_M
        change[low, :2] = 0.0
        size = np.linalg.norm(change, axis=1)
        due = due & (size > DEAD_M_S)
        change[~due] = 0.0
        size = np.where(due, size, 0.0)
        sigma = np.array([errors.size, *[np.radians(errors.direction_deg)] * 2])
        off = self._rng.normal(size=(len(change), 3)) * sigma
        unit = change / np.maximum(size, 1e-9)[:, None]
        u = np.cross(unit, [0.6, 0.64, 0.48])
        u /= np.maximum(np.linalg.norm(u, axis=1), 1e-9)[:, None]
        v = np.cross(unit, u)
        real = change + size[:, None] * (off[:, :1] * unit + off[:, 1:2] * u + off[:, 2:] * v)
        share = errors.accelerometer * size
        self._x[:, 3:] += real
        self._xhat[:, 3:6] += real + share[:, None] * self._rng.normal(size=real.shape)
        self._p[:, range(3, 6), range(3, 6)] += share[:, None] ** 2
        self._dv += np.linalg.norm(real, axis=1)

    def _move(self, flying: BoolArray) -> None:
        """One step: what is compensated leaves the pull's change by the filter's error."""
        pull = self._pull(self._x[:, :3]) - self._pull(self._xhat[:, :3])
        moving = flying[:, None]
        self._x[:, :3] += np.where(moving, STEP_S * self._x[:, 3:] + 0.5 * STEP_S**2 * pull, 0.0)
        self._x[:, 3:] += np.where(moving, STEP_S * pull, 0.0)
        self._xhat[:, :3] += np.where(moving, STEP_S * self._xhat[:, 3:6], 0.0)
        self._p[:, :3] += STEP_S * self._p[:, 3:6]
        self._p[:, :, :3] += STEP_S * self._p[:, :, 3:6]
        self._p[:, range(3, 6), range(3, 6)] += 1e-10  # the gradient of the pull, 1e-5 m/s a root s

    def _pull(self, places: FloatArray) -> FloatArray:
        body = self._body(places)
        pull = -self._gm * body / np.linalg.norm(body, axis=1)[:, None] ** 3
        local: FloatArray = pull @ self._site.axes.T
        return local

    def _measure(self, step: int, flying: BoolArray) -> None:
        beams = self._settings.beams
        # one attitude for all: their heights differ by metres
        self._beams = self._turned(step * STEP_S, float(np.median(self._xhat[:, 2])))
        height = self._x[:, 2]
        if step % beams.near_every_s == 0:
            # below the altimeter's last height the ranges are the Doppler radar's
            self._range(flying & (height > min(LAST_M, beams.to_m)))
        near = flying & (height < beams.doppler_from_m)
        if near.any():
            noise = beams.doppler_noise_m_s * self._rng.normal(size=(len(height), BEAMS))
            speeds = self._x[:, 3:] @ self._beams.T + noise
            h = np.zeros((len(height), BEAMS, self._unknowns))
            h[:, :, 3:6] = self._beams
            residual = speeds - self._xhat[:, 3:6] @ self._beams.T
            variances = np.full(residual.shape, beams.doppler_noise_m_s**2)
            self._update(residual, h, variances, near[:, None] & np.ones(BEAMS, bool))

    def _range(self, which: BoolArray) -> None:
        if not which.any():
            return
        count = len(which)
        rays = np.tile(self._beams @ self._site.axes, (count, 1))
        real = self._truth.cast(np.repeat(self._body(self._x[:, :3]), BEAMS, axis=0), rays)
        seen = self._model.ranges(np.repeat(self._body(self._xhat[:, :3]), BEAMS, axis=0), rays)
        noise = self._settings.beams.noise_m * self._rng.normal(size=(count, BEAMS))
        measured = real.range_m.reshape(count, BEAMS) + noise
        normals = (seen.normals @ self._site.axes.T).reshape(count, BEAMS, 3)
        slant = -np.einsum("nki,ki->nk", normals, self._beams)
        good = np.isfinite(measured) & np.isfinite(seen.range_m.reshape(count, BEAMS))
        good &= (slant > 0.2) & which[:, None]
        slant = np.where(slant > 0.2, slant, 1.0)
        h = np.zeros((count, BEAMS, self._unknowns))
        h[:, :, :3] = normals / slant[..., None]
        # ground that is higher than its model by b shortens the range by b n'up / slant
        shorter = normals[:, :, 2] / slant
        shares = self._shares(seen).reshape(count, BEAMS, -1)
        h[:, :, 6:] = -shorter[..., None] * shares
        predicted = seen.range_m.reshape(count, BEAMS) + np.einsum(
            "nkj,nj->nk", h[:, :, 6:], self._xhat[:, 6:]
        )
        residual = np.where(good, measured - predicted, 0.0)
        # beside the nodes the ground is as wrong as it was
        unknown = np.where(shares.any(axis=2), ROUGH, 1.0)
        error = unknown * (self._settings.surface.near_error_m * shorter) ** 2
        self._update(residual, h, self._settings.beams.noise_m**2 + error, good)

    def _update(
        self, residual: FloatArray, h: FloatArray, variances: FloatArray, good: BoolArray
    ) -> None:
        """Kalman's update of all filters; measurements that are not good change nothing."""
        h = np.where(good[..., None], h, 0.0)
        residual = np.where(good, residual, 0.0)
        gain_base = self._p @ h.transpose(0, 2, 1)
        s = h @ gain_base
        s[:, range(BEAMS), range(BEAMS)] += variances
        gain = np.linalg.solve(s, gain_base.transpose(0, 2, 1)).transpose(0, 2, 1)
        self._xhat += np.einsum("nij,nj->ni", gain, residual)
        # symmetric to the last digit, and with noise of metres far from losing any
        self._p -= gain @ s @ gain.transpose(0, 2, 1)
