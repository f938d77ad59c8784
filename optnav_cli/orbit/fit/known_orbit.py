"""Orbits known from elsewhere, for the times of pictures: CCSDS OEM, two-line elements, SPICE SPK.

Each gives body-fixed states with covariances. A file that states none is taken for exact, two-line
elements for TLE_SIGMA_M at their epoch and as much more a day (Vallado and Cefola, "Two-line
element sets: practice and use", IAC-12-C1.6.12: 1 km, and 1 to 3 km a day).
"""

from collections.abc import Sequence
from pathlib import Path

import erfa
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.bodies.ephemeris import Ephemeris, load_ephemeris
from catalog.bodies.epochs import DAY_S, J2000_JD, utc_from_tdb_s
from catalog.errors import DataError, UsageError
from catalog.geometry.rotations import rnb_axes
from catalog.inputs import MEGABYTE, read_input
from optnav_cli.dynamics.left_out import warn_of_unknown_gravity
from optnav_cli.orbit.fit.folder import body_fixed_state, read_orbit, stated_turn
from optnav_cli.orbit.fit.oem import BEGINNING
from optnav_cli.orbit.fit.oem_reader import read_oem
from optnav_cli.orbit.fit.picture_times import FittedPath, KnownPath
from optnav_cli.orbit.fit.predict import OrbitPath
from optnav_cli.orbit.fit.spk import SPK_BEGINNING

TLE_SIGMA_M = 1000.0
TLE_DAYS = 30.0  # elements older than that are kilometres off
MAX_BYTES = 64 * MEGABYTE
EARTH_TURN = 7.292115855e-5  # rad/s, of the mean equinox of date
Span = tuple[float, float]


def known_orbit(path: Path, body: Body, craft: int) -> KnownPath:
    """Read an orbit about a body: a folder of `orbit fit`, an OEM, an SPK or two-line elements.

    craft  NAIF number sought in an SPK that holds several
    Raises DataError for a file of another kind, about another body, or damaged.
    """
    if path.is_dir():
        orbit = read_orbit(path)
        if orbit.body.name != body.name:
            raise DataError(
                f"{path}: the fixes are about {body.name}, the orbit about {orbit.body.name}; "
                "name an orbit about the same body"
            )
        warn_of_unknown_gravity(orbit.body, orbit.forces)
        return FittedPath(OrbitPath(orbit))
    raw = read_input(path, "orbit", "name a folder, an OEM, a TLE or an SPK", limit=MAX_BYTES)
    begins = raw.removeprefix(b"\xef\xbb\xbf").lstrip()
    if begins.startswith(BEGINNING):
        return OemPath(path, load_ephemeris(body, []))
    if raw.startswith((SPK_BEGINNING, b"NAIF/DAF")):
        return SpkPath(path, load_ephemeris(body, []), craft)
    lines = [line.strip() for line in raw.decode("ascii", "replace").splitlines() if line.strip()]
    firsts = [k for k, line in enumerate(lines) if line.startswith("1 ") and len(line) > 60]
    if firsts and len(lines) > firsts[0] + 1 and lines[firsts[0] + 1].startswith("2 "):
        if len(firsts) > 1:
            raise DataError(f"{path}: has {len(firsts)} sets of two lines; keep that of the time")
        return TlePath(path, body, lines[firsts[0]], lines[firsts[0] + 1])
    raise DataError(
        f"{path}: is no orbit that is known here; wanted a folder of `optnav orbit fit`, a CCSDS "
        "OEM (CCSDS_OEM_VERS), a SPICE .bsp, or the two lines of a TLE"
    )


def _body_fixed(
    ephemeris: Ephemeris, times: FloatArray, states: FloatArray, spreads: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """States (n, 6) and covariances (n, 3, 3) of places, from inertial axes to the body's."""
    pairs = list(zip(times, states, strict=True))
    fixed = np.array([body_fixed_state(ephemeris, float(t), state) for t, state in pairs])
    turns = np.array([stated_turn(ephemeris, float(t)) for t, _ in pairs])
    return fixed, turns @ spreads @ turns.transpose(0, 2, 1)


class OemPath:
    """The states of an OEM inside of its usable spans, with the covariance nearest in time."""

    def __init__(self, path: Path, ephemeris: Ephemeris) -> None:
        self._oem, self._ephemeris = read_oem(path, ephemeris.body), ephemeris
        self.note = "" if len(self._oem.covariances) else f"{path}: states no covariance: exact"

    def spans(self, stamps: FloatArray, margin_s: float) -> Sequence[Span]:
        """Those of its segments."""
        return [segment.usable for segment in self._oem.segments if len(segment.times) > 1]

    def radian_s(self) -> float:
        """Return the time that its motion takes per radian, s."""
        distance = np.linalg.norm(self._oem.states[:, :3], axis=1)
        return float((distance / np.linalg.norm(self._oem.states[:, 3:], axis=1)).min())

    def fixed(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Body-fixed states (n, 6) and covariances (n, 3, 3) at times (n,)."""
        oem = self._oem
        states = np.array([oem.state_at(float(time)) for time in times])
        spreads = np.zeros((len(times), 3, 3))
        if len(oem.covariances):
            nearest = np.abs(times[:, None] - oem.covariance_times).argmin(axis=1)
            for k, number in enumerate(nearest):
                there = oem.state_at(float(oem.covariance_times[number]))
                # the error along the motion turns with it
                axes = rnb_axes(there[:3], there[3:])
                turn = rnb_axes(states[k, :3], states[k, 3:]).T @ axes
                spreads[k] = turn @ oem.covariances[number][:3, :3] @ turn.T
        return _body_fixed(self._ephemeris, times, states, spreads)


class SpkPath:
    """The states of a craft in a SPICE kernel, taken for exact."""

    def __init__(self, path: Path, ephemeris: Ephemeris, craft: int) -> None:
        """Raises UsageError without the extra, DataError for a kernel without the craft."""
        try:
            import spiceypy
        except ImportError:
            raise UsageError(
                "a .bsp is read by SPICE: pip install 'optnav[spice]', or name an OEM"
            ) from None
        self._spice, self._path, self._ephemeris = spiceypy, path, ephemeris
        spice = ephemeris.body.spice
        if spice is None:
            raise DataError(
                f"{ephemeris.body.name}: its body file has no [spice] naif; name an OEM"
            )
        self._centre = spice.naif[0]
        try:
            objects = [int(number) for number in spiceypy.spkobj(str(path))]
            flying = [number for number in objects if number < 0]
            if craft in objects:
                self._craft = craft
            elif len(flying) == 1:
                self._craft = flying[0]
            else:
                raise DataError(f"{path}: holds {objects}; name one by --craft")
            window = spiceypy.spkcov(str(path), self._craft)
            count = spiceypy.wncard(window)
            self._spans = [tuple(map(float, spiceypy.wnfetd(window, k))) for k in range(count)]
        except spiceypy.utils.exceptions.SpiceyError as error:
            raise DataError(f"{path}: is damaged ({_short(error)})") from None
        self.note = f"{path}: states no covariance: exact"

    def spans(self, stamps: FloatArray, margin_s: float) -> Sequence[Span]:
        """Those that the kernel covers."""
        return [(first, last) for first, last in self._spans if last > first]

    def radian_s(self) -> float:
        """Return the time that its motion takes per radian at its start, s."""
        state = self._states(np.array([self._spans[0][0]]))[0]
        return float(np.linalg.norm(state[:3]) / np.linalg.norm(state[3:]))

    def fixed(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Body-fixed states (n, 6) and covariances (n, 3, 3) at times (n,)."""
        states = self._states(times)
        return _body_fixed(self._ephemeris, times, states, np.zeros((len(times), 3, 3)))

    def _states(self, times: FloatArray) -> FloatArray:
        spice = self._spice
        try:
            spice.furnsh(str(self._path))
            states_km = [
                spice.spkgeo(self._craft, float(time), "J2000", self._centre)[0] for time in times
            ]
        except spice.utils.exceptions.SpiceyError as error:
            raise DataError(
                f"{self._path}: does not lead from {self._craft} to {self._ephemeris.body.name} "
                f"({_short(error)}); name a kernel with that centre, or an OEM"
            ) from None
        finally:
            spice.unload(str(self._path))
        return 1e3 * np.array(states_km, np.float64)


class TlePath:
    """Two-line elements about the Earth by SGP4, in axes fixed to it by sidereal time.

    UT1 is taken for UTC, at most 0.9 s and 0.4 km of ground apart; poles do not move (10 m).
    """

    def __init__(self, path: Path, body: Body, first: str, second: str) -> None:
        """Raises UsageError without the extra, DataError for lines that are damaged."""
        try:
            from sgp4.api import Satrec
        except ImportError:
            raise UsageError(
                "two-line elements need SGP4: pip install 'optnav[tle]', or name an OEM"
            ) from None
        if body.name != "earth":
            raise DataError(f"{path}: a TLE is about the Earth, the fixes about {body.name}")
        for number, line in enumerate((first, second), start=1):
            digits = sum(int(c) if c.isdigit() else c == "-" for c in line[:68])
            if len(line) < 69 or not line[68].isdigit() or digits % 10 != int(line[68]):
                raise DataError(
                    f"{path}: line {number} of its TLE fails its checksum; fetch it again"
                )
        try:
            self._craft = Satrec.twoline2rv(first, second)
        except ValueError as error:
            raise DataError(f"{path}: its TLE is damaged: {error}") from None
        self._path = path
        day = (self._craft.jdsatepoch - J2000_JD) + self._craft.jdsatepochF
        self._epoch_s = day * DAY_S + 69.184  # TDB less UTC; of a sigma's age, any will do
        self.note = f"{path}: taken for right to 1 km at {utc_from_tdb_s(self._epoch_s, 0)}"

    def spans(self, stamps: FloatArray, margin_s: float) -> Sequence[Span]:
        """List the spans of the stamps with the margin; without stamps a day about the epoch."""
        known = stamps[np.isfinite(stamps)]
        if not len(known):
            known = self._epoch_s + np.array([-0.5, 0.5]) * DAY_S
        first, last = float(known.min()) - margin_s, float(known.max()) + margin_s
        if max(abs(first - self._epoch_s), abs(last - self._epoch_s)) > TLE_DAYS * DAY_S:
            raise DataError(
                f"{self._path}: its elements are of {utc_from_tdb_s(self._epoch_s, 0)}, more than "
                f"{TLE_DAYS:g} days from the pictures; name elements nearer to them"
            )
        return [(first, last)]

    def radian_s(self) -> float:
        """Return the mean time that its motion takes per radian, s."""
        return float(60.0 / self._craft.no_kozai)

    def fixed(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Body-fixed states (n, 6) and covariances (n, 3, 3) at times (n,)."""
        fixed, spreads = np.empty((len(times), 6)), np.empty((len(times), 3, 3))
        for k, time in enumerate(times):
            utc = _utc_days(float(time))
            code, position_km, velocity = self._craft.sgp4(*utc)
            if code:
                raise DataError(f"{self._path}: SGP4 cannot follow it (code {code}) at that time")
            angle = erfa.gmst82(*utc)
            turn = erfa.rz(angle, np.eye(3))
            fixed[k, :3] = 1e3 * turn @ np.array(position_km)
            fixed[k, 3:] = 1e3 * turn @ np.array(velocity)
            fixed[k, 3:] -= np.cross([0.0, 0.0, EARTH_TURN], fixed[k, :3])
            days = abs(float(time) - self._epoch_s) / DAY_S
            spreads[k] = np.eye(3) * (TLE_SIGMA_M * (1.0 + days)) ** 2
        return fixed, spreads


def _utc_days(tdb_s: float) -> tuple[float, float]:
    """Both parts of the Julian date, UTC."""
    tt = J2000_JD, tdb_s / DAY_S  # TDB less TT, 2 ms, is 15 m of way
    utc1, utc2 = erfa.taiutc(*erfa.tttai(*tt))
    return float(utc1), float(utc2)


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120]
