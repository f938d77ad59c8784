"""Orbits known from elsewhere, for the times of pictures: CCSDS OEM, two-line elements, SPICE SPK.

Each gives body-fixed states with covariances. A file that states none is taken for exact, two-line
elements for TLE_SIGMA_M at their epoch and as much more a day (Vallado and Cefola, "Two-line
element sets: practice and use", IAC-12-C1.6.12: 1 km, and 1 to 3 km a day).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import erfa
import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.special import chdtri

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.bodies.ephemeris import Ephemeris, load_ephemeris
from catalog.bodies.epochs import DAY_S, J2000_JD, utc_from_tdb_s
from catalog.errors import DataError, UsageError
from catalog.geometry.rotations import rnb_axes
from catalog.inputs import MEGABYTE, read_input
from optnav_cli.dynamics.left_out import warn_of_unknown_gravity
from optnav_cli.orbit.fit.folder import body_fixed_state, read_orbit, stated_turn
from optnav_cli.orbit.fit.oem import BEGINNING, SPK_BEGINNING
from optnav_cli.orbit.fit.oem_reader import read_oem
from optnav_cli.orbit.fit.predict import OrbitPath
from optnav_cli.orbit.fit.problem import OrbitFix

STEP_RAD = 0.05  # between places of the path: between them it is known to 3 cm at 100 km
# Two of the three components of a fix are left once the time is chosen.
PASS_GATE = float(chdtri(2, 0.0027))  # 3 sigmas
NEWTON_STEPS = 8
MAX_PLACES = 400_000
TLE_SIGMA_M = 1000.0
TLE_DAYS = 30.0  # elements older than that are kilometres off
MAX_BYTES = 64 * MEGABYTE
EARTH_TURN = 7.292115855e-5  # rad/s, of the mean equinox of date
Span = tuple[float, float]


class KnownPath(Protocol):
    """An orbit that is known, body-fixed; note: what people should know of it."""

    note: str

    def spans(self, stamps: FloatArray, margin_s: float) -> Sequence[tuple[float, float]]:
        """Spans of time to search, TDB s; stamps (n,) of the pictures, NaN where unknown."""

    def radian_s(self) -> float:
        """Return the time that the motion takes per radian, s."""

    def fixed(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Body-fixed states (n, 6), m and m/s, and covariances (n, 3, 3) of their places."""


class FittedPath:
    """The orbit of a folder of `orbit fit`, with predictions before and after its arc."""

    note = ""

    def __init__(self, path: OrbitPath) -> None:
        self._path = path

    def spans(self, stamps: FloatArray, margin_s: float) -> Sequence[tuple[float, float]]:
        """The arc and the stamps, with the margin."""
        known = stamps[np.isfinite(stamps)]
        first, last = min(self._path.first_s, *known), max(self._path.last_s, *known)
        return [(first - margin_s, last + margin_s)]

    def radian_s(self) -> float:
        """Return the time that the path takes per radian at the last fix, s."""
        return self._path.radian_s()

    def fixed(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States (n, 6) and covariances (n, 3, 3); fewer where the path meets the body."""
        rows = self._path.rows(times).rows
        motion = self._path.orbit.ephemeris
        pairs = zip(rows.times, rows.states, strict=True)
        fixed = np.array([body_fixed_state(motion, float(t), state) for t, state in pairs])
        turns = np.array([stated_turn(motion, float(t)) for t in rows.times])
        return fixed, turns @ rows.covariances[:, :3, :3] @ turns.transpose(0, 2, 1)


@dataclass(frozen=True)
class Pass:
    """When the path passes a fix: TDB s, 1 sigma, and the chi-square of what is left (2)."""

    tdb_s: float
    sigma_s: float
    chi_square: float


@dataclass(frozen=True)
class PictureTime:
    """A picture's stamp and the passes within 3 sigmas, in the order of time."""

    fix: OrbitFix
    passes: tuple[Pass, ...]

    @property
    def best(self) -> Pass | None:
        """The pass nearest to the stamp, without a stamp that of the best fit; None without one."""

        def rank(one: Pass) -> float:
            stamped = np.isfinite(self.fix.tdb_s)
            return abs(one.tdb_s - self.fix.tdb_s) if stamped else one.chi_square

        return min(self.passes, key=rank, default=None)


@dataclass(frozen=True, eq=False)
class _Track:
    """The body-fixed path: times (n,), its spline, speeds (n,) and covariances (n, 3, 3)."""

    times: FloatArray
    spline: CubicHermiteSpline
    speeds: FloatArray
    covariances: FloatArray


def picture_times(
    known: KnownPath | OrbitPath, fixes: Sequence[OrbitFix], margin_s: float
) -> list[PictureTime]:
    """When pictures with these fixes were taken.

    margin_s  so much before and after the arc and the stamps is searched as well
    Raises DataError for a search of more than MAX_PLACES, and as the path does.
    """
    path = FittedPath(known) if isinstance(known, OrbitPath) else known
    stamps = np.array([fix.tdb_s for fix in fixes])
    tracks = [_track(path, *span) for span in path.spans(stamps, margin_s)]
    return [
        PictureTime(fix, tuple(crossing for track in tracks for crossing in _passes(track, fix)))
        for fix in fixes
    ]


def _track(path: KnownPath, first_s: float, last_s: float) -> _Track:
    step = STEP_RAD * path.radian_s()
    count = int(np.ceil((last_s - first_s) / step)) + 1
    if count > MAX_PLACES:
        raise DataError(
            f"the orbit and the stamps of the pictures are {(last_s - first_s) / DAY_S:.0f} days "
            "long, too much to search; name an orbit of the time of the pictures"
        )
    times = np.linspace(first_s, last_s, max(count, 2))
    fixed, spreads = path.fixed(times)
    times = times[: len(fixed)]
    spline = CubicHermiteSpline(times, fixed[:, :3], fixed[:, 3:])
    return _Track(times, spline, np.linalg.norm(fixed[:, 3:], axis=1), spreads)


def _passes(track: _Track, fix: OrbitFix) -> Iterator[Pass]:
    """Local least distances of the path from a fix that lie within 3 sigmas."""
    gaps_m = np.linalg.norm(track.spline(track.times) - fix.position_m, axis=1)
    step = float(np.diff(track.times).max())
    ends = np.concatenate([[np.inf], gaps_m, [np.inf]])
    is_least = (gaps_m <= ends[:-2]) & (gaps_m < ends[2:])
    widest = np.sqrt(np.linalg.eigvalsh(track.covariances + fix.covariance_m2)[:, -1])
    near = gaps_m < track.speeds * step + 6.0 * widest
    for index in np.flatnonzero(is_least & near):
        crossing = _nearest(track, int(index), fix, step)
        if crossing is not None and crossing.chi_square <= PASS_GATE:
            yield crossing


def _nearest(track: _Track, index: int, fix: OrbitFix, step: float) -> Pass | None:
    """The least of the weighed distance about a place of the path; None where it has none."""
    weight = np.linalg.inv(track.covariances[index] + fix.covariance_m2)
    middle = time = float(track.times[index])
    for _ in range(NEWTON_STEPS):
        gap, speed = track.spline(time) - fix.position_m, track.spline(time, 1)
        along = float(speed @ weight @ speed)
        time -= float(speed @ weight @ gap) / along
        if abs(time - middle) > 2.0 * step:
            return None
    if not track.times[0] <= time <= track.times[-1]:
        return None
    gap = track.spline(time) - fix.position_m
    return Pass(time, along**-0.5, float(gap @ weight @ gap))


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
