"""Craft of Kuznetsov's constellation with the truth of another model, and their zenith distances.

The truth has a field of degree 20 and sunlight on 0.02 m^2/kg and is flown by scipy's integrator;
fits have degree 8, and sunlight as a parameter that is not known before.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.stars import load_bright_stars
from catalog.geometry.rotations import ARCSEC
from optnav_cli.dynamics.forces import Forces
from optnav_cli.dynamics.orbit_settings import ForcesSettings, SunlightSettings
from optnav_cli.navigate.zenith_file import SightPlace, choose_zenith_pair, list_navigation_stars
from optnav_cli.orbit.fit.fit import OrbitFit
from optnav_cli.orbit.fit.motion import ArcMotion, rnb_of
from optnav_cli.orbit.fit.problem import Trajectory
from optnav_cli.orbit.fit.settings import NoiseSettings, ParameterSettings
from optnav_cli.orbit.fit.zenith import ZenithSights, zenith_distances
from optnav_cli.orbit.fit.zenith_job import settled, zenith_problem
from tests.studies.orbit_flights import ephemeris_of, fly

START_UTC = "2017-07-25T09:10:45Z"
AXIS_M, ECCENTRICITY, INCLINATION = 6000e3, 0.01, np.radians(58.0)
PLANES_DEG = {1: (0.0, 0.0), 2: (120.0, 15.0), 3: (240.0, 30.0)}  # node, argument of pericentre
TRUE_DEGREE, FIT_DEGREE, TRUE_SUNLIGHT = 20, 8, 0.02
SENSOR_ARCSEC, CATALOG_ARCSEC = 0.1, 0.005
SESSIONS = 500
PAIRS = 60  # choices of stars a revolution: the pair of the session before is nearly always right
START_M, START_M_S = 1000.0, 0.1  # what the first orbit of a fit is off by: a reference orbit's
GATE = 1e-5


def start_of(craft: str) -> FloatArray:
    """State (6,) of a craft such as "1.5" at the start, inertial, its elements against ICRF."""
    plane, place = map(int, craft.split("."))
    node, argument = np.radians(PLANES_DEG[plane])
    anomaly = np.radians(60.0 * (place - 1))
    gm = ephemeris_of("moon").body.gm_m3_s2
    parameter = AXIS_M * (1.0 - ECCENTRICITY**2)
    size = parameter / (1.0 + ECCENTRICITY * np.cos(anomaly))
    speed = np.sqrt(gm / parameter)
    inner = np.array([np.cos(anomaly), np.sin(anomaly), 0.0]) * size
    motion = np.array([-np.sin(anomaly), ECCENTRICITY + np.cos(anomaly), 0.0]) * speed

    def about_z(angle: float) -> FloatArray:
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    c, s = np.cos(INCLINATION), np.sin(INCLINATION)
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    turn = about_z(node) @ tilt @ about_z(argument)
    return np.concatenate([turn @ inner, turn @ motion])


@dataclass(frozen=True)
class SightErrors:
    """What zenith distances are wrong by, and what is stated of it, arc seconds.

    vertical_arcsec  of the vertical, drawn for each session and common to both stars
    bias_arcsec      of the vertical forward and across, constant; 1 sigma each, drawn for an arc
    stars_arcsec     of where each star stands, constant; 1 sigma east and north
    """

    sensor_arcsec: float = float(np.hypot(SENSOR_ARCSEC, CATALOG_ARCSEC))
    vertical_arcsec: float = 0.0
    bias_arcsec: float = 0.0
    stars_arcsec: float = 0.0


class ZenithFlight:
    """The truth of one craft over some revolutions."""

    def __init__(self, craft: str, revolutions: float, rows: int = 240) -> None:
        """rows  times a revolution that the path is kept at; between them it is carried."""
        self.craft = craft
        ephemeris = ephemeris_of("moon")
        sunlight = SunlightSettings(area_over_mass_m2_kg=TRUE_SUNLIGHT, reflectivity=1.0)
        self.forces = Forces(ephemeris, ForcesSettings(degree=TRUE_DEGREE, sunlight=sunlight))
        self.period_s = float(2.0 * np.pi * np.sqrt(AXIS_M**3 / self.forces.gm))
        self.start_s = utc_to_tdb_s(START_UTC)
        count = round(revolutions * rows) + 1
        times = self.start_s + self.period_s / rows * np.arange(float(count))
        self.flight = fly(self.forces, start_of(craft), times)
        self._motion = ArcMotion(self.forces, NoiseSettings("none"))

    def states(self, times: FloatArray) -> FloatArray:
        """True states (n, 6) at times (n,) in order, carried from the stored one before."""
        kept, found = self.flight, np.empty((len(times), 6))
        before = np.clip(np.searchsorted(kept.times, times, "right") - 1, 0, len(kept.times) - 1)
        for row in np.unique(before):
            here = before == row
            start = float(kept.times[row])
            found[here] = self._motion.path(kept.states[row], start, times[here])
        return found

    def sessions(self, first: float, revolutions: float, count: int) -> FloatArray:
        """Times of so many sessions a revolution, from a revolution on."""
        number = round(count * revolutions)
        return self.start_s + self.period_s * (first + np.arange(number) / count)

    @cached_property
    def _stars(self) -> FloatArray:
        return load_bright_stars().propagate(self.start_s)[list_navigation_stars()]

    def pairs(self, times: FloatArray, states: FloatArray) -> IntArray:
        """(n, 2) which of the navigation stars are looked at; -1 where there is none."""
        ephemeris = self.forces.motion
        step = max(round(len(times) * self.period_s / PAIRS / (times[-1] - times[0])), 1)
        found = np.full((len(times), 2), -1)
        for k in range(0, len(times), step):
            time, state = float(times[k]), states[k]
            place = SightPlace(
                state[:3],
                ephemeris.body.radius_m,
                ephemeris.sun_inertial(time),
                ephemeris.position_m("earth", time)[None],
            )
            chosen = choose_zenith_pair(place, np.cross(state[:3], state[3:]), self._stars)
            found[k : k + step, : len(chosen)] = chosen
        return found

    def sights(
        self, times: FloatArray, errors: SightErrors, rng: np.random.Generator
    ) -> ZenithSights:
        """Zenith distances of a pair of stars a session, with drawn errors."""
        states = self.states(times)
        pairs = self.pairs(times, states)
        session, column = np.nonzero(pairs >= 0)
        number = pairs[session, column]
        used, star_of = np.unique(number, return_inverse=True)
        directions = self._stars[number]
        values, by_place, by_star = zenith_distances(states[session, :3], directions)
        axes = np.stack([rnb_of(state) for state in states])[session, 1:]
        size = np.linalg.norm(states[session, :3], axis=1)[:, None]
        by_vertical = (axes @ by_place[:, :, None])[:, :, 0] * size
        tilt = errors.vertical_arcsec * rng.normal(size=(len(times), 2))[session]
        tilt += errors.bias_arcsec * rng.normal(size=2)
        values = values + ARCSEC * (by_vertical * tilt).sum(axis=1)
        names = tuple(load_bright_stars().label(int(list_navigation_stars()[k])) for k in used)
        sigma = ARCSEC * np.hypot(errors.sensor_arcsec, errors.vertical_arcsec)
        sights = ZenithSights(
            times[session], directions, values, np.full(len(values), sigma), star_of, names
        )
        wrong = errors.stars_arcsec * rng.normal(size=(len(names), 2))
        along = (sights.star_axes @ by_star[:, :, None])[:, :, 0]
        values += ARCSEC * (along * wrong[star_of]).sum(axis=1)
        values += ARCSEC * errors.sensor_arcsec * rng.normal(size=len(values))
        return sights


def fit_motion(degree: int = FIT_DEGREE) -> ArcMotion:
    """The motion of a fit."""
    return ArcMotion(
        Forces(ephemeris_of("moon"), ForcesSettings(degree=degree)), NoiseSettings("none")
    )


@dataclass(frozen=True, eq=False)
class JudgedFit:
    """A fit against its truth: errors (n, 6) at its nodes, and the true states there."""

    fit: OrbitFit
    errors: FloatArray
    truth: FloatArray

    @property
    def sizes(self) -> tuple[float, float, float]:
        """Mean sizes over the arc of errors of place, m, velocity, m/s, and height, m."""
        place = np.linalg.norm(self.errors[:, :3], axis=1)
        speed = np.linalg.norm(self.errors[:, 3:], axis=1)
        up = self.truth[:, :3] / np.linalg.norm(self.truth[:, :3], axis=1, keepdims=True)
        height = np.abs((self.errors[:, :3] * up).sum(axis=1))
        return float(place.mean()), float(speed.mean()), float(height.mean())

    @property
    def nees(self) -> float:
        """Of places, a component, mean over the arc."""
        pairs = zip(self.errors[:, :3], self.fit.covariances[:, :3, :3], strict=True)
        return float(np.mean([e @ np.linalg.solve(p, e) / 3.0 for e, p in pairs]))

    @property
    def sigma_m(self) -> float:
        """Stated, the length of three axes, rms over the arc."""
        traces = np.trace(self.fit.covariances[:, :3, :3], axis1=1, axis2=2)
        return float(np.sqrt(traces.mean()))


def judged(
    flight: ZenithFlight,
    sights: ZenithSights,
    motion: ArcMotion,
    parameters: tuple[ParameterSettings, ...],
    rng: np.random.Generator,
) -> JudgedFit:
    """The fit of sights from a reference orbit that is wrong by START_M, against the truth."""
    start = flight.states(sights.tdb_s[:1])[0]
    off = np.concatenate([START_M * rng.normal(size=3), START_M_S * rng.normal(size=3)])
    problem = zenith_problem(motion, sights, [], parameters, start)
    nodes = motion.path(start + off, float(sights.tdb_s[0]), problem.times)
    fit = settled(problem, Trajectory(nodes, np.zeros(problem.width - 6)), GATE)
    truth = flight.states(fit.problem.times)
    return JudgedFit(fit, fit.trajectory.states - truth, truth)


def forecast_m(flight: ZenithFlight, one: JudgedFit, to_s: FloatArray) -> FloatArray:
    """Errors (n,) of places that a fit leads to at later times, m."""
    fit = one.fit
    motion = fit.problem.motion_at(fit.trajectory)
    start = float(fit.problem.times[-1])
    found = motion.path(fit.trajectory.states[-1], start, to_s)
    off: FloatArray = np.linalg.norm((found - flight.states(to_s))[:, :3], axis=1)
    return off


def noisier(errors: SightErrors, sensor_arcsec: float) -> SightErrors:
    """The same errors with another one of the sensor."""
    return replace(errors, sensor_arcsec=float(np.hypot(sensor_arcsec, CATALOG_ARCSEC)))
