"""When a picture was taken, from where it was taken and a known orbit.

A fix and the orbit's body-fixed path meet in time: where the path passes the fix, its nearest
approach, measured by the covariance of both, tells the time as well as the fix is known along the
path. A low orbit passes near a place again after a month, or on the next revolution where the fix
is wide, so every pass is listed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.special import chdtri

from catalog.arrays import FloatArray
from catalog.bodies.epochs import DAY_S
from catalog.errors import DataError
from optnav_cli.orbit.fit.folder import body_fixed_state, stated_turn
from optnav_cli.orbit.fit.predict import OrbitPath
from optnav_cli.orbit.fit.problem import OrbitFix

STEP_RAD = 0.05  # between places of the path: between them it is known to 3 cm at 100 km
# Two of the three components of a fix are left once the time is chosen.
PASS_GATE = float(chdtri(2, 0.0027))  # 3 sigmas
NEWTON_STEPS = 8
MAX_PLACES = 400_000


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
