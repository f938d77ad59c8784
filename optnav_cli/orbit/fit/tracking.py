"""Ranges, counted Doppler, angles and altimeter heights as scalar measurements of an orbit.

A range is half of the way of a signal from a station over the craft to a station; a range rate is
its mean over a count, the difference at the ends over the count (Moyer 2003, ch. 13). Angles are of
the direction from the craft to the body's centre or to a point of it, without aberration.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.ephemeris import Ephemeris
from catalog.geometry.ellipsoid import geodetic_from_xyz
from catalog.geometry.latlon import xyz_from_latlon
from optnav_cli.orbit.fit.parameters import FitParameter
from optnav_cli.orbit.fit.scalars import ScalarSet
from optnav_cli.orbit.fit.stations import SignalGeometry, SignalPaths, StationNetwork

# Between its nodes an arc has no noise; over a minute that of degree 50 about the Moon is 0.4 mm/s.
NODE_STEP_S = 60.0


@dataclass(frozen=True, eq=False)
class Passes:
    """Who received signals, and in which pass.

    network   the stations;  receiver (n,) number of the station
    pass_of   (n,) number of the pass over all stations, of `count`
    """

    network: StationNetwork
    receiver: IntArray
    pass_of: IntArray
    count: int

    def part(self, kept: BoolArray | IntArray) -> "Passes":
        """Select some of the measurements."""
        return Passes(self.network, self.receiver[kept], self.pass_of[kept], self.count)

    @property
    def sizes(self) -> Mapping[str, int]:
        """Number of components of the parameters, one a station or a pass."""
        stations = len(self.network.stations)
        sizes = {"station_place": 3 * stations, "troposphere": stations, "ephemeris": 6}
        for name in ("range_bias", "range_rate_bias", "station_clock"):
            sizes |= {name: stations, f"{name}/pass": self.count}
        return sizes

    def spread(self, parameter: FitParameter, values: FloatArray) -> FloatArray:
        """Spread derivatives (n,) over the stations or passes (n, size) that they belong to."""
        by_pass = parameter.settings.per == "pass"
        columns = np.zeros((len(values), parameter.size))
        columns[np.arange(len(values)), self.pass_of if by_pass else self.receiver] = values
        return columns

    def differentiate(
        self, parameter: FitParameter, geometry: SignalGeometry, paths: SignalPaths
    ) -> FloatArray | None:
        """Differentiate the ways of signals (n,) by a parameter of the stations or the Earth."""
        network, number = self.network, np.arange(len(paths.lengths_m))
        if parameter.name == "station_clock":
            return self.spread(parameter, paths.rates_m_s)
        if parameter.name == "ephemeris":
            drifting = paths.by_earth * network.drift(geometry.received_s)[:, None]
            return np.concatenate([paths.by_earth, drifting], axis=1)
        if parameter.name == "station_place":
            places = np.zeros((len(number), len(network.stations), 3))
            np.add.at(places, (number, geometry.receiver), paths.by_receiver)
            np.add.at(places, (number, geometry.sender), paths.by_sender)
            moved: FloatArray = (places * network.place_sigmas_m).reshape(len(number), -1)
            return moved
        if parameter.name == "troposphere":
            delays = np.zeros((len(number), len(network.stations)))
            np.add.at(delays, (number, geometry.receiver), paths.by_receiver_delay)
            np.add.at(delays, (number, geometry.sender), paths.by_sender_delay)
            sigmas = np.array([s.zenith_delay_sigma_m for s in network.stations])
            scaled: FloatArray = delays * sigmas
            return scaled
        return None


@dataclass(frozen=True, eq=False)
class TrackingSet(ScalarSet):
    """Measurements of a file: values and sigmas (n,) in the unit of their kind, lines (n,)."""

    numbers: FloatArray
    number_sigmas: FloatArray
    lines: IntArray

    @property
    def values(self) -> FloatArray:
        return self.numbers

    @property
    def sigmas(self) -> FloatArray:
        return self.number_sigmas


@dataclass(frozen=True, eq=False)
class SignalSet(TrackingSet):
    """Measurements of signals, with the stations and passes that they are of."""

    passes: Passes

    @property
    def series(self) -> IntArray:
        return self.passes.receiver

    @property
    def sizes(self) -> Mapping[str, int]:
        return self.passes.sizes


@dataclass(frozen=True, eq=False)
class MomentSet(TrackingSet):
    """Measurements each of the craft's state at its own time, tdb_s (n,)."""

    tdb_s: FloatArray

    @property
    def epochs(self) -> FloatArray:
        return self.tdb_s[:, None]


@dataclass(frozen=True, eq=False)
class Ranges(SignalSet):
    """Two- and three-way ranges, m."""

    geometry: SignalGeometry
    _memo: list[tuple[FloatArray, SignalPaths]] = field(
        default_factory=list, init=False, repr=False
    )

    @property
    def measured(self) -> str:
        return "ranges"

    @property
    def epochs(self) -> FloatArray:
        times: FloatArray = self.geometry.bounced_s[:, None]
        return times

    def _follow(self, states: FloatArray) -> SignalPaths:
        if not self._memo or self._memo[0][0] is not states:
            self._memo[:] = [(states, self.geometry.follow(states[:, 0]))]
        return self._memo[0][1]

    def compute(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        paths = self._follow(states)
        return paths.lengths_m, paths.by_state[:, None]

    def differentiate(
        self, parameter: FitParameter, states: FloatArray, by_states: FloatArray
    ) -> FloatArray | None:
        if parameter.name == "range_bias":
            return self.passes.spread(parameter, np.ones(len(self)))
        return self.passes.differentiate(parameter, self.geometry, self._follow(states))


@dataclass(frozen=True, eq=False)
class RangeRates(SignalSet):
    """Mean range rates, m/s, over counts (n,), s.

    starts, ends  the signals received when the counts start and end
    """

    counts_s: FloatArray
    starts: SignalGeometry
    ends: SignalGeometry
    _memo: list[tuple[FloatArray, SignalPaths, SignalPaths]] = field(
        default_factory=list, init=False, repr=False
    )

    @property
    def measured(self) -> str:
        return "range rates"

    @property
    def epochs(self) -> FloatArray:
        return np.stack([self.starts.bounced_s, self.ends.bounced_s], axis=1)

    @property
    def node_step_s(self) -> float:
        return NODE_STEP_S

    def _follow(self, states: FloatArray) -> tuple[SignalPaths, SignalPaths]:
        if not self._memo or self._memo[0][0] is not states:
            start, end = self.starts.follow(states[:, 0]), self.ends.follow(states[:, 1])
            self._memo[:] = [(states, start, end)]
        return self._memo[0][1:]

    def compute(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        start, end = self._follow(states)
        by_states = np.stack([-start.by_state, end.by_state], axis=1)
        count = self.counts_s
        return (end.lengths_m - start.lengths_m) / count, by_states / count[:, None, None]

    def differentiate(
        self, parameter: FitParameter, states: FloatArray, by_states: FloatArray
    ) -> FloatArray | None:
        if parameter.name == "range_rate_bias":
            return self.passes.spread(parameter, np.ones(len(self)))
        start, end = self._follow(states)
        first = self.passes.differentiate(parameter, self.starts, start)
        last = self.passes.differentiate(parameter, self.ends, end)
        if first is None or last is None:
            return None
        slopes: FloatArray = (last - first) / self.counts_s[:, None]
        return slopes


@dataclass(frozen=True, eq=False)
class Angles(MomentSet):
    """Right ascensions and declinations of points, deg.

    axis      (n,) 0: right ascension, 1: declination
    points_m  (n, 3) inertial, from the body's centre
    """

    axis: IntArray
    points_m: FloatArray

    @property
    def measured(self) -> str:
        return "angles"

    @property
    def series(self) -> IntArray:
        return self.axis

    def compute(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, y, z = (self.points_m - states[:, 0, :3]).T
        flat = np.maximum(x**2 + y**2, 1e-12 * z**2)
        level, square = np.sqrt(flat), flat + z**2
        right = self.axis == 0
        angles = np.degrees(np.where(right, np.arctan2(y, x), np.arctan2(z, level)))
        # the turn nearest to the measured one
        angles += np.where(right, 360.0 * np.round((self.values - angles) / 360.0), 0.0)
        by_right = np.stack([y, -x, 0.0 * z], axis=1) / flat[:, None]
        by_up = np.stack([z * x / level, z * y / level, -level], axis=1) / square[:, None]
        by_states = np.zeros((len(self), 1, 6))
        by_states[:, 0, :3] = np.degrees(np.where(right[:, None], by_right, by_up))
        return angles, by_states


@dataclass(frozen=True, eq=False)
class Altitudes(MomentSet):
    """Heights over the body's ellipsoid along its normal, m.

    turns  (n, 3, 3) body frame from inertial
    """

    turns: FloatArray
    radii_m: tuple[float, float, float]

    @property
    def measured(self) -> str:
        return "altimeter heights"

    @property
    def series(self) -> IntArray:
        return np.zeros(len(self), np.int64)

    def compute(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        fixed = (self.turns @ states[:, 0, :3, None])[:, :, 0]
        lat, lon, height = geodetic_from_xyz(fixed, self.radii_m)
        up = xyz_from_latlon(lat, lon, 1.0)
        by_states = np.zeros((len(self), 1, 6))
        by_states[:, 0, :3] = (up[:, None] @ self.turns)[:, 0]
        return height, by_states


def find_body_turns(ephemeris: Ephemeris, tdb_s: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3), the body frame of files from inertial, at times (n,)."""
    turns = [ephemeris.body_from_inertial(float(time)).T for time in tdb_s]
    stated = [ephemeris.body.catalog_frame.rotate_to_stated(turn).T for turn in turns]
    return np.array(stated).reshape(-1, 3, 3)
