"""How well a path to a target is known at a correction: least squares with considered errors.

Source: Tuchin, thesis (2010), chapter 5, (19). The state at the end of an arc of measurements is
estimated; what all measurements of a station or an arc have in common (biases, places of antennas,
troposphere, ionosphere, light pressure) is considered: it widens the covariance and is not solved
for. Everything is linear about the reference path.
"""

from dataclasses import dataclass

import erfa
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AU_M, AnalyticEphemeris
from catalog.bodies.epochs import DAY_S, J2000_JD
from catalog.errors import NoSolutionError
from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.rotations import ARCSEC
from catalog.geometry.vectors import perpendicular_basis
from optnav_cli.estimation.consider import considered
from optnav_cli.orbit.delivery.path import ReferencePath
from optnav_cli.orbit.delivery.settings import DeliverySettings, OpticalSettings, RadioSettings
from optnav_cli.reasons import ReasonCode

PRIOR_M, PRIOR_M_S = 1e6, 100.0  # 1 sigma of a state before its arc: keeps short arcs solvable
EARTH_RATE, EARTH_M = 7.2921159e-5, 6.371e6  # rad/s; a sphere serves for stations


@dataclass(frozen=True, eq=False)
class ArcMeasurements:
    """Measurements before a correction, linear in the state there.

    jacobian (n, 6), sigmas (n,)  of single measurements
    shared   (n, m) what 1 sigma of each considered error adds to them
    """

    jacobian: FloatArray
    sigmas: FloatArray
    shared: FloatArray

    def gain(self) -> FloatArray:
        """(6, n) d state / d measurement of the estimate."""
        weighted = self.jacobian / self.sigmas[:, None] ** 2
        gains: FloatArray = self._random() @ weighted.T
        return gains

    def _random(self) -> FloatArray:
        prior = np.diag([PRIOR_M**-2] * 3 + [PRIOR_M_S**-2] * 3)
        scaled = self.jacobian / self.sigmas[:, None]
        # scaled to a unit diagonal: metres and their rates differ by ten powers of ten
        normal = scaled.T @ scaled + prior
        size = np.sqrt(np.diag(normal))
        covariance: FloatArray = np.linalg.inv(normal / np.outer(size, size)) / np.outer(size, size)
        return covariance

    def covariance(self) -> tuple[FloatArray, FloatArray]:
        """(6, 6) of the state: by the noise alone, and with what is considered."""
        random = self._random()
        return random, random + considered(self.gain(), self.shared)


def arc_before(path: ReferencePath, settings: DeliverySettings, tdb_s: float) -> ArcMeasurements:
    """The measurements of the arc that ends at a time of the path.

    Raises NoSolutionError when nothing is measured in it.
    """
    rows: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    if settings.radio is not None:
        rows.append(_radio(path, settings, settings.radio, tdb_s))
    if settings.optical is not None:
        rows.append(_optical(path, settings.optical, tdb_s))
    width = sum(row[2].shape[1] for row in rows)
    shared, at = np.zeros((sum(len(row[1]) for row in rows), width)), [0, 0]
    for _, sigmas, effects in rows:
        shared[at[0] : at[0] + len(sigmas), at[1] : at[1] + effects.shape[1]] = effects
        at = [at[0] + len(sigmas), at[1] + effects.shape[1]]
    if not len(shared):
        day = (tdb_s - path.tdb_s[0]) / DAY_S
        raise NoSolutionError(
            f"nothing is measured before the correction after {day:g} days: no station sees the "
            "craft; add a station or lengthen arc_days",
            ReasonCode.NO_SOLUTION,
        )
    jacobian, sigmas = (np.concatenate([row[k] for row in rows]) for k in (0, 1))
    return ArcMeasurements(jacobian, sigmas, shared)


def _arc(
    path: ReferencePath, tdb_s: float, arc_days: float, every_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times (n,), states (n, 6) and their derivatives (n, 6, 6) by the state at the end."""
    begin = max(tdb_s - arc_days * DAY_S, float(path.tdb_s[0]))
    count = max(int((tdb_s - begin) / every_s), 2)
    times = np.linspace(begin, tdb_s, count + 1)
    known = int(np.searchsorted(path.tdb_s, begin, side="right")) - 1
    grid = np.concatenate([path.tdb_s[known : known + 1], times[times > path.tdb_s[known]]])
    states, transitions = path.motion.fly(path.states[known], grid)
    last = np.linalg.inv(transitions[-1])
    return grid, states, transitions @ last


def _radio(
    path: ReferencePath, settings: DeliverySettings, radio: RadioSettings, tdb_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    times, states, phi = _arc(path, tdb_s, radio.arc_days, radio.every_s)
    earth = _earth(path, times)
    light = _light(path, radio, times, states, phi)
    stations = len(settings.station)
    # considered: for each station range and rate bias, place, troposphere, ionosphere; light
    width = 7 * stations + 1
    rows, sigmas, shared = [], [], []
    for number, station in enumerate(settings.station):
        lat, lon = np.radians([station.lat_deg, station.lon_deg]).tolist()
        station_m = xyz_from_latlon(lat, lon, EARTH_M)
        for at, time in enumerate(times):
            turn = _earth_turn(float(time))
            up = turn @ station_m
            spin = np.cross([0.0, 0.0, EARTH_RATE], up)
            offset = states[at] - earth[at] - np.concatenate([up, spin])
            distance = float(np.linalg.norm(offset[:3]))
            way = offset[:3] / distance
            sine = float(way @ up) / EARTH_M
            if sine < np.sin(np.radians(radio.min_elevation_deg)):
                continue
            rate_way = (offset[3:] - float(offset[3:] @ way) * way) / distance
            for kind, sigma in ((0, radio.range_m), (1, 1e-3 * radio.rate_mm_s)):
                by_state = np.concatenate([way, np.zeros(3)] if kind == 0 else [rate_way, way])
                effects = np.zeros(width)
                first = 7 * number
                effects[first + kind] = (radio.range_bias_m, 1e-3 * radio.rate_bias_mm_s)[kind]
                by_place = way if kind == 0 else rate_way + np.cross(way, [0.0, 0.0, EARTH_RATE])
                effects[first + 2 : first + 5] = -radio.place_m * (turn.T @ by_place)
                if kind == 0:
                    effects[first + 5] = radio.troposphere_m / sine
                    effects[first + 6] = radio.ionosphere_m / sine
                effects[-1] = by_state @ light[at]
                rows.append(by_state @ phi[at])
                sigmas.append(sigma)
                shared.append(effects)
    return np.array(rows).reshape(-1, 6), np.array(sigmas), np.array(shared).reshape(-1, width)


def _optical(
    path: ReferencePath, optical: OpticalSettings, tdb_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    times, states, phi = _arc(path, tdb_s, optical.arc_days, optical.every_s)
    rows, sigmas, shared = [], [], []
    for at, time in enumerate(times):
        there = path.motion.place(float(time))[:3]
        offset = states[at, :3] - there
        if path.motion.centre != "sun" and np.linalg.norm(states[at, :3]) < np.linalg.norm(offset):
            offset = states[at, :3]
        distance = float(np.linalg.norm(offset))
        way = offset / distance
        across = max(optical.direction_arcsec * ARCSEC * distance, optical.least_m)
        along = max(optical.range_share * distance, optical.least_m)
        for number, (axis, sigma) in enumerate(
            zip((way, *perpendicular_basis(way)), (along, across, across), strict=True)
        ):
            effects = np.zeros(3)
            effects[number] = optical.bias_share * sigma
            rows.append(np.concatenate([axis, np.zeros(3)]) @ phi[at])
            sigmas.append(sigma)
            shared.append(effects)
    return np.array(rows), np.array(sigmas), np.array(shared)


def _light(
    path: ReferencePath,
    radio: RadioSettings,
    times: FloatArray,
    states: FloatArray,
    phi: FloatArray,
) -> FloatArray:
    """(n, 6) how a wrong light pressure moves past states against the one at the end, 1 sigma."""
    sun = np.array([_sun(path, float(time)) for time in times])
    offset = states[:, :3] - sun
    distance = np.linalg.norm(offset, axis=1)[:, None]
    size = radio.light_pressure_m_s2 * radio.light_pressure_share
    pushes = size * (AU_M / distance) ** 2 * offset / distance
    # what acts between a time and the end moves the former, seen from the end, backwards
    impulses = np.hstack([np.zeros_like(pushes), pushes])
    ends = np.einsum("nij,nj->ni", np.linalg.inv(phi), impulses)
    steps = np.gradient(times)
    later = np.cumsum((ends * steps[:, None])[::-1], axis=0)[::-1]
    moved: FloatArray = -np.einsum("nij,nj->ni", phi, later)
    return moved


def _earth(path: ReferencePath, times: FloatArray) -> FloatArray:
    """The Earth's states (n, 6) from the centre."""
    if path.motion.centre == "earth":
        return np.zeros((len(times), 6))
    earth = AnalyticEphemeris(load_body("earth"))
    places = []
    for time in times:
        ends = [-earth.position_m("sun", float(time) + way * 50.0) for way in (-1.0, 1.0)]
        places.append(np.concatenate([0.5 * (ends[0] + ends[1]), (ends[1] - ends[0]) / 100.0]))
    return np.array(places)


def _sun(path: ReferencePath, tdb_s: float) -> FloatArray:
    if path.motion.centre == "sun":
        return np.zeros(3)
    return AnalyticEphemeris(load_body("earth")).position_m("sun", tdb_s)


def _earth_turn(tdb_s: float) -> FloatArray:
    """Inertial from Earth-fixed (3, 3) by the Earth's angle alone: stations to some 10 km."""
    angle = float(erfa.era00(J2000_JD, tdb_s / DAY_S))
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
