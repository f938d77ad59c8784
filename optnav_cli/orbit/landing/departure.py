"""The transfer of a landing: from a quasi-satellite orbit to a place over the target.

Source: Tuchin, thesis (2010), chapter 2. The departure impulse is found by Newton's method with the
variational equations, from the velocity that the craft has: three steps leave less than 1e-3 mm/s.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.rotation import body_from_inertial
from catalog.errors import NoSolutionError
from catalog.geometry.ellipsoid import compute_normals
from catalog.geometry.latlon import xyz_from_latlon
from optnav_cli.orbit.landing.rays import DigitalSurface
from optnav_cli.orbit.qso.motion import MoonMotion, split
from optnav_cli.reasons import ReasonCode

STEPS, STEP_S = 4, 60.0
PATH_STEP_S = 30.0
MAX_MISS_M = 1.0  # of the last step


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
        states, transitions = split(motion.propagate(state, times, STEP_S, transition=True))
        miss = aim - states[1, :3]
        if not np.isfinite(miss).all():
            break
        change = np.linalg.solve(transitions[1, :3, 3:], miss)
        state[3:] += change
        changes.append(change)
    end = motion.propagate(state, times, STEP_S)[1, :3]
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
    states = motion.propagate(departure.state, times, STEP_S)
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
