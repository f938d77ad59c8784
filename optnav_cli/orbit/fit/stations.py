"""Stations on the Earth, and the way of a signal from one to the craft and back.

Light moves in TDB and barycentric axes: the body moves by 39 km while light goes from the Earth to
the Moon. Sources: Moyer, Formulation for Observed and Computed Values of Deep
Space Network Data Types (2003), ch. 8, 10 and 11: light time, delay of signals by the Sun and the
Earth, scale of a station's place; Saastamoinen (1972) for the zenith delay of the troposphere with
the mapping of Chao (1974).
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import erfa
import msgspec
import numpy as np
from msgspec import Meta
from scipy.interpolate import BSpline, make_interp_spline

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import SUN_GM_M3_S2, Ephemeris
from catalog.bodies.epochs import DAY_S, J2000_JD
from catalog.bodies.rotation import (
    EarthOrientation,
    estimate_earth_error_m,
    read_earth_orientation,
    rotate_earth,
)
from catalog.config import Positive, load_toml
from catalog.errors import ConfigError
from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.vectors import unit
from catalog.terrain.dem.file import resolve_path

LIGHT_M_S = 299792458.0
WGS84 = 1  # SOFA's number of the ellipsoid
GEOCENTRIC_SCALE = 1.48082686741e-8  # L_C, of places in geocentric against barycentric time
LIGHT_STEPS = 4  # each leaves 1e-4 of the error before, the speed over that of light
SPLINE_DEGREE = 7
MAX_SPLINE_STEP_S = 600.0
# Of the fastest moon's motion (Phobos, 2.3e-4 rad/s) a step is 0.05 rad: 1e-6 m.
MOON_SPLINE_STEP_S = 200.0
MARGIN_SPLINES = 8  # samples beyond the ends
# Standard atmosphere: pressure at the sea, hPa, and its fall with height; the wet delay is 0.1 m.
SEA_PRESSURE_HPA, PRESSURE_SCALE_M, PRESSURE_POWER = 1013.25, 44330.77, 5.2559
DRY_M_PER_HPA, WET_ZENITH_M, WET_SCALE_M = 0.0022768, 0.1, 2000.0
CHAO_DRY, CHAO_WET = (0.00143, 0.0445), (0.00035, 0.017)
MAX_STATIONS = 100


class AntennaSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[[station]]: an antenna on the Earth.

    lat_deg, lon_deg, height_m  over the ellipsoid of WGS84, geodetic latitude, east longitude
    place_sigma_m       east, north, up
    zenith_delay_sigma_m  what the standard troposphere is wrong by at the zenith
    min_elevation_deg   measurements below it are refused
    """

    name: str
    lat_deg: Annotated[float, Meta(ge=-90.0, le=90.0)]
    lon_deg: Annotated[float, Meta(ge=-360.0, le=360.0)]
    height_m: Annotated[float, Meta(ge=-1000.0, le=9000.0)] = 0.0
    place_sigma_m: tuple[Positive, Positive, Positive] = (0.03, 0.03, 0.03)
    zenith_delay_sigma_m: Annotated[float, Meta(ge=0.0, le=3.0)] = 0.04
    min_elevation_deg: Annotated[float, Meta(ge=0.0, lt=90.0)] = 5.0


class StationsFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file of stations.

    earth_orientation  table of the IERS beside it (finals2000A, EOP C04); "": UT1 = UTC, which is
                       off by up to 420 m and considered as an error of all places
    """

    station: tuple[AntennaSettings, ...]
    earth_orientation: str = ""


def load_stations(path: Path) -> tuple[StationsFile, EarthOrientation | None]:
    """Read a file of stations. Raises ConfigError or DataError for a wrong one."""
    file = load_toml(path, StationsFile)
    names = [station.name for station in file.station]
    if not 0 < len(names) <= MAX_STATIONS or len(set(names)) < len(names) or "" in names:
        raise ConfigError(
            f"{path}: has the [[station]] names {', '.join(map(repr, names)) or 'none'}; wanted 1 "
            f"to {MAX_STATIONS} stations, each with a name of its own"
        )
    if not file.earth_orientation:
        return file, None
    return file, read_earth_orientation(resolve_path(file.earth_orientation, path.parent))


def zenith_delays_m(height_m: float) -> tuple[float, float]:
    """Compute the delay of the standard troposphere at the zenith of a height, dry and wet, m."""
    pressure = SEA_PRESSURE_HPA * (1.0 - height_m / PRESSURE_SCALE_M) ** PRESSURE_POWER
    return DRY_M_PER_HPA * pressure, WET_ZENITH_M * float(np.exp(-height_m / WET_SCALE_M))


def map_delay(sine: FloatArray, constants: tuple[float, float]) -> FloatArray:
    """Map a zenith delay to elevations of these sines (n,): 1/sin E with Chao's correction."""
    sine = np.maximum(sine, 1e-3)
    tangent = sine / np.sqrt(np.maximum(1.0 - sine**2, 1e-12))
    mapped: FloatArray = 1.0 / (sine + constants[0] / (tangent + constants[1]))
    return mapped


@dataclass(frozen=True, eq=False)
class StationPlaces:
    """Stations at times (n,): places (n, 3), m, and velocities from the Earth's centre, GCRS axes.

    axes  (n, 3, 3) east, north, up
    """

    places_m: FloatArray
    velocities_m_s: FloatArray
    axes: FloatArray

    def part(self, kept: BoolArray | IntArray) -> "StationPlaces":
        """Select some of them."""
        return StationPlaces(self.places_m[kept], self.velocities_m_s[kept], self.axes[kept])


class StationNetwork:
    """Stations and the motion of the Earth, the Sun and a body over an arc."""

    def __init__(
        self,
        stations: Sequence[AntennaSettings],
        orientation: EarthOrientation | None,
        ephemeris: Ephemeris,
        ends: tuple[float, float],
    ) -> None:
        """Prepare a network for measurements between two times, TDB s.

        Raises DataError for times that the ephemeris or the table of the Earth does not cover.
        """
        self.stations, self.orientation = tuple(stations), orientation
        self.names = [station.name for station in stations]
        self.middle_s = 0.5 * (ends[0] + ends[1])
        earth = load_body("earth")
        self.earth_gm = earth.gm_m3_s2
        self.gm = ephemeris.body.gm_m3_s2
        self.earth_error_m = earth.rotation_error_m(self.middle_s)
        if orientation is not None:
            self.earth_error_m = max(estimate_earth_error_m(t, orientation) for t in ends)
        step = MOON_SPLINE_STEP_S if ephemeris.body.orbit is not None else MAX_SPLINE_STEP_S
        # light from the farthest planet takes four hours
        self._far = ephemeris.body.name not in ("moon", "earth")
        margin = step * MARGIN_SPLINES + (16e3 if self._far else 10.0)
        count = int(np.ceil((ends[1] - ends[0] + 2.0 * margin) / step)) + SPLINE_DEGREE + 1
        times = ends[0] - margin + step * np.arange(count)
        self._start = float(times[0])

        def spline(places: list[FloatArray]) -> BSpline:
            return make_interp_spline(times - self._start, np.array(places), SPLINE_DEGREE)

        self.at_home = at_home = ephemeris.body.name == "earth"
        home = np.zeros(3)
        self._earth = spline([home if at_home else ephemeris.position_m("earth", t) for t in times])
        self._sun = spline([ephemeris.position_m("sun", t) for t in times])

    @property
    def place_sigmas_m(self) -> FloatArray:
        """(k, 3) of the stations, east, north, up, with the error of the Earth's rotation."""
        stated = np.array([station.place_sigma_m for station in self.stations])
        turned = np.array([self.earth_error_m, self.earth_error_m, 0.0])
        sigmas: FloatArray = np.hypot(stated, turned)
        return sigmas

    def drift(self, tdb_s: FloatArray) -> FloatArray:
        """Angles (n,) that the Earth moved by as seen from the body since the middle, rad."""
        middle = np.array([self.middle_s])
        far = float(np.linalg.norm(self.earth(middle)))
        rate = float(np.linalg.norm(self.earth(middle, 1))) / far if far else 0.0
        return rate * (tdb_s - self.middle_s)

    def earth(self, tdb_s: FloatArray, order: int = 0) -> FloatArray:
        """Place (n, 3) of the Earth from the body's centre, m, or its derivative by time."""
        value: FloatArray = self._earth(tdb_s - self._start, order)
        return value

    def body(self, tdb_s: FloatArray, order: int = 0) -> FloatArray:
        """Place (n, 3) of the body's centre from the Sun, m, or its derivative by time."""
        value: FloatArray = -self._sun(tdb_s - self._start, order)
        return value

    def locate(self, tdb_s: FloatArray, station: IntArray) -> StationPlaces:
        """Locate stations (n,) by their numbers at times (n,).

        Raises DataError beyond the table of the Earth.
        """
        turn = rotate_earth(tdb_s, self.orientation)
        before, after = (rotate_earth(tdb_s + d, self.orientation) for d in (-0.5, 0.5))
        fixed, local = self._fixed
        places = (fixed[station][:, None] @ turn)[:, 0]
        velocities = (fixed[station][:, None] @ (after - before))[:, 0]
        sun = self.body(tdb_s) + self.earth(tdb_s)
        speed = self.body(tdb_s, 1) + self.earth(tdb_s, 1)
        distance = np.linalg.norm(sun, axis=1)
        scale = 1.0 - GEOCENTRIC_SCALE - SUN_GM_M3_S2 / LIGHT_M_S**2 / distance
        along = (speed * places).sum(axis=1)[:, None] * speed / (2.0 * LIGHT_M_S**2)
        return StationPlaces(places * scale[:, None] - along, velocities, local[station] @ turn)

    @property
    def _fixed(self) -> tuple[FloatArray, FloatArray]:
        """Places (k, 3) on the Earth, m, and their axes (k, 3, 3) east, north, up."""
        lat = np.radians([station.lat_deg for station in self.stations])
        lon = np.radians([station.lon_deg for station in self.stations])
        heights = np.array([station.height_m for station in self.stations])
        xyz = np.asarray(erfa.gd2gc(WGS84, lon, lat, heights))
        zero = np.zeros_like(lat)
        east = np.stack([-np.sin(lon), np.cos(lon), zero], axis=1)
        up = xyz_from_latlon(lat, lon, 1.0)
        return xyz, np.stack([east, np.cross(up, east), up], axis=1)


@dataclass(frozen=True, eq=False)
class SignalPaths:
    """Halves of round trips (n,), m, at their reception.

    by_state       (n, 6) derivative by the craft's state at its nominal time
    rates_m_s      (n,) derivative by the time of reception
    by_receiver, by_sender  (n, 3) derivative by the stations' places, east, north, up
    by_earth       (n, 3) by the place of the Earth
    by_receiver_delay, by_sender_delay  (n,) by the zenith delays of the stations
    sines          (n, 2) of the elevations at the receiver and the sender
    """

    lengths_m: FloatArray
    by_state: FloatArray
    rates_m_s: FloatArray
    by_receiver: FloatArray
    by_sender: FloatArray
    by_earth: FloatArray
    by_receiver_delay: FloatArray
    by_sender_delay: FloatArray
    sines: FloatArray


class SignalGeometry:
    """Round trips from stations over a craft near a body, prepared for one set of receptions."""

    def __init__(
        self, network: StationNetwork, received_s: FloatArray, receiver: IntArray, sender: IntArray
    ) -> None:
        """Prepare receptions at times (n,), TDB s, by stations (n,) of signals of senders (n,).

        Raises DataError as `StationNetwork.locate` does.
        """
        self.network, self.received_s = network, received_s
        self.receiver, self.sender = receiver, sender
        self._last = network.locate(received_s, receiver)
        there = network.earth(received_s) + self._last.places_m
        bounced = received_s - np.linalg.norm(there, axis=1) / LIGHT_M_S
        for _ in range(LIGHT_STEPS):
            offset = there + network.body(received_s) - network.body(bounced)
            bounced = received_s - np.linalg.norm(offset, axis=1) / LIGHT_M_S
        self.bounced_s = bounced
        sent = 2.0 * bounced - received_s
        for _ in range(LIGHT_STEPS):
            first = network.locate(sent, sender)
            start = network.earth(sent) + first.places_m + network.body(sent)
            sent = bounced - np.linalg.norm(start - network.body(bounced), axis=1) / LIGHT_M_S
        self.sent_s, self._first = sent, network.locate(sent, sender)
        centre = network.body(bounced)
        self._centre, self._speed = centre, network.body(bounced, 1)
        self._pull = network.body(bounced, 2)
        self._end = there + network.body(received_s) - centre
        self._start = network.earth(sent) + self._first.places_m + network.body(sent) - centre
        speeds = [
            network.body(time, 1) + network.earth(time, 1) + station.velocities_m_s
            for time, station in ((received_s, self._last), (sent, self._first))
        ]
        self._end_speed, self._start_speed = speeds
        day = [time / DAY_S for time in (received_s, sent)]
        tdb_tt = [erfa.dtdb(J2000_JD, d, 0.0, 0.0, 0.0, 0.0) for d in day]
        self._clock_s = tdb_tt[0] - tdb_tt[1]  # the stations' clocks keep TT and not TDB

    def elevation_sines(self) -> FloatArray:
        """Sines (n, 2) of the elevations of the body's centre at the receiver and the sender."""
        ends = ((self._last, self._end), (self._first, self._start))
        return np.stack([-(p.axes[:, 2] * unit(way)).sum(axis=1) for p, way in ends], axis=1)

    def distances_m(self) -> FloatArray:
        """Half (n,) of the way from the senders over the body's centre to the receivers, m."""
        ways: FloatArray = np.linalg.norm(self._end, axis=1) + np.linalg.norm(self._start, axis=1)
        return 0.5 * ways

    def part(self, kept: BoolArray | IntArray) -> "SignalGeometry":
        """Select some of the receptions."""
        selected = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(selected, name, value[kept])
            elif isinstance(value, StationPlaces):
                setattr(selected, name, value.part(kept))
        return selected

    def follow(self, states: FloatArray) -> SignalPaths:
        """Follow signals to a craft and back, whose states (n, 6) are those at `bounced_s`."""
        position, speed = states[:, :3], states[:, 3:]
        cube = (position**2).sum(axis=1)[:, None] ** 1.5
        pull = -self.network.gm * position / cube + self._pull
        early, late = np.zeros(len(states)), np.zeros(len(states))
        wait = self.received_s - self.bounced_s
        for _ in range(LIGHT_STEPS):
            moved = (speed + self._speed) * early[:, None] + 0.5 * pull * early[:, None] ** 2
            craft = position + moved
            down = craft - self._end
            early = wait - np.linalg.norm(down, axis=1) / LIGHT_M_S
        velocity = speed + self._speed + pull * early[:, None]
        sent_before = self.bounced_s - self.sent_s
        for _ in range(LIGHT_STEPS):
            up = craft - self._start - self._start_speed * late[:, None]
            late = sent_before + early - np.linalg.norm(up, axis=1) / LIGHT_M_S
        down_unit, up_unit = unit(down), unit(up)
        trip = LIGHT_M_S * (self.received_s - self.sent_s - late - self._clock_s)
        sines = np.stack(
            [
                (self._last.axes[:, 2] * down_unit).sum(axis=1),
                (self._first.axes[:, 2] * up_unit).sum(axis=1),
            ],
            axis=1,
        )
        delays, by_delays = zip(
            *(
                self._troposphere(stations, sines[:, k])
                for k, stations in enumerate((self.receiver, self.sender))
            ),
            strict=True,
        )
        bent = sum(
            self._bend(station, craft)
            for station in (self._end, self._start + self._start_speed * late[:, None])
        )
        lengths = 0.5 * (trip + delays[0] + delays[1] + bent)
        # the craft's time moves by -(u.dr)/(c + u.v); the sender's by what that and dr leave
        back = down_unit / (LIGHT_M_S + (down_unit * velocity).sum(axis=1)[:, None])
        along = (up_unit * velocity).sum(axis=1)[:, None]
        remainder = LIGHT_M_S - (up_unit * self._start_speed).sum(axis=1)[:, None]
        by_place = 0.5 * LIGHT_M_S * (LIGHT_M_S * back + up_unit - along * back) / remainder
        end, start = velocity - self._end_speed, velocity - self._start_speed
        rates = 0.5 * ((down_unit * end).sum(axis=1) + (up_unit * start).sum(axis=1))
        return SignalPaths(
            lengths,
            np.concatenate([by_place, by_place * early[:, None]], axis=1),
            rates,
            -0.5 * (self._last.axes @ down_unit[:, :, None])[:, :, 0],
            -0.5 * (self._first.axes @ up_unit[:, :, None])[:, :, 0],
            -0.5 * (down_unit + up_unit),
            0.5 * by_delays[0],
            0.5 * by_delays[1],
            sines,
        )

    def _troposphere(self, stations: IntArray, sines: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Delays (n,), m, and their derivatives by the zenith delay."""
        zenith = np.array([zenith_delays_m(s.height_m) for s in self.network.stations])[stations]
        dry, wet = (map_delay(sines, constants) for constants in (CHAO_DRY, CHAO_WET))
        return zenith[:, 0] * dry + zenith[:, 1] * wet, wet

    def _bend(self, station: FloatArray, craft: FloatArray) -> FloatArray:
        """Delays (n,), m, of signals between a station and the craft by the Sun and the Earth."""
        distance = np.linalg.norm(station - craft, axis=1)
        earth = self.network.earth(self.bounced_s)
        total = np.zeros(len(craft))
        for gm, centre in ((SUN_GM_M3_S2, -self._centre), (self.network.earth_gm, earth)):
            ends = sum(np.linalg.norm(end - centre, axis=1) for end in (station, craft))
            total += 2.0 * gm / LIGHT_M_S**2 * np.log((ends + distance) / (ends - distance))
        return total
