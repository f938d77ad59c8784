"""CCSDS Orbit Ephemeris Messages in keyword form (CCSDS 502.0-B-3): states, interpolation, writing.

Inertial states in km and km/s; covariances are lower triangles row by row. Those written are of
version 2.0, with times in TDB. `oem_reader` reads them.

Also as SPICE kernels (.bsp) of type 13, Hermite polynomials of unequal steps, with the extra
`spice`: times are TDB, as SPICE's own, axes J2000, which SPICE has as ICRF.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.interpolate import BarycentricInterpolator, KroghInterpolator

from catalog.arrays import FloatArray
from catalog.bodies.epochs import DAY_S, utc_from_tdb_s
from catalog.errors import DataError, UsageError

BEGINNING = b"CCSDS_OEM_VERS"
SAME_TIME_S = 1e-3  # stamps of milliseconds name one time
DEGREE = 7  # of Hermite's polynomials where a file states no interpolation
UNDATED = "2000-01-01T00:00:00"  # of a file without a clock: the same input gives the same


@dataclass(frozen=True, eq=False)
class OemSegment:
    """States that belong together: no polynomial goes beyond them.

    times          (n,) TDB s, ever later;  states (n, 6) inertial, m and m/s
    accelerations  (n, 3) m/s^2, or (0, 3) where the file has none
    method         HERMITE, LAGRANGE or LINEAR, with the degree of its polynomials
    usable         TDB s of the first and the last time to be asked for; states beyond them serve
                   interpolation alone
    """

    times: FloatArray
    states: FloatArray
    accelerations: FloatArray
    method: str
    degree: int
    usable: tuple[float, float]

    def contains(self, tdb_s: float) -> bool:
        """Whether a time lies in the usable span, within a millisecond."""
        return self.usable[0] - SAME_TIME_S <= tdb_s <= self.usable[1] + SAME_TIME_S

    def state_at(self, tdb_s: float) -> FloatArray:
        """State (6,) at a time, by the polynomial of the stated degree about it.

        Raises DataError for a segment of fewer states than the degree needs.
        """
        nearest = int(np.argmin(np.abs(self.times - tdb_s)))
        if abs(float(self.times[nearest]) - tdb_s) < 1e-6:
            state: FloatArray = self.states[nearest]
            return state
        # Hermite's polynomial through k states with their velocities has degree 2 k - 1
        count = self.degree // 2 + 1 if self.method == "HERMITE" else self.degree + 1
        if count > len(self.times):
            raise DataError(
                f"a segment of {len(self.times)} states states INTERPOLATION = {self.method} of "
                f"degree {self.degree}, which needs {count}; state a lower INTERPOLATION_DEGREE"
            )
        after = int(np.searchsorted(self.times, tdb_s))
        first = min(max(after - count // 2, 0), len(self.times) - count)
        if count % 2 and 0 <= nearest - count // 2 <= len(self.times) - count:
            first = nearest - count // 2
        return self._polynomial(slice(first, first + count), tdb_s)

    def _polynomial(self, near: slice, tdb_s: float) -> FloatArray:
        middle = float(self.times[near].mean())
        scale = float(np.ptp(self.times[near])) / 2.0
        nodes, at = (self.times[near] - middle) / scale, (tdb_s - middle) / scale
        states = self.states[near]
        if self.method != "HERMITE":
            return np.asarray(BarycentricInterpolator(nodes, states)(at), np.float64)
        twice = np.repeat(nodes, 2)
        places = np.stack([states[:, :3], scale * states[:, 3:]], axis=1).reshape(-1, 3)
        path = KroghInterpolator(twice, places)
        if not len(self.accelerations):
            return np.concatenate([path(at), path.derivative(at) / scale])
        speeds = np.stack([states[:, 3:], scale * self.accelerations[near]], axis=1)
        return np.concatenate([path(at), KroghInterpolator(twice, speeds.reshape(-1, 3))(at)])


@dataclass(frozen=True, eq=False)
class Oem:
    """Inertial states (n, 6), m and m/s, at TDB s times (n,); covariances by the same times.

    covariances  (m, 6, 6), inertial, at covariance_times (m,); none where the file has none
    segments     of a file that was read: `times` and `states` are those of their usable spans
    """

    body: str
    times: FloatArray
    states: FloatArray
    covariance_times: FloatArray = field(default_factory=lambda: np.empty(0))
    covariances: FloatArray = field(default_factory=lambda: np.empty((0, 6, 6)))
    segments: Sequence[OemSegment] = ()

    def state_at(self, tdb_s: float) -> FloatArray:
        """State (6,) at a time, interpolated inside of its segment; at a border in the later one.

        Raises DataError for a time in no usable span, and as `OemSegment.state_at` does.
        """
        for segment in reversed(self.segments):
            if segment.contains(tdb_s):
                return segment.state_at(tdb_s)
        spans = ", ".join(
            " to ".join(utc_from_tdb_s(end, 0) for end in segment.usable)
            for segment in self.segments
        )
        raise DataError(f"has no states at {utc_from_tdb_s(tdb_s, 0)}; its spans are {spans}")


def write_oem(path: Path, oem: Oem, name: str, created_utc: str = UNDATED) -> None:
    """Write a file; times are TDB."""
    stamps = [_tdb_text(time) for time in oem.times]
    lines = [
        "CCSDS_OEM_VERS = 2.0",
        f"CREATION_DATE = {created_utc}",
        "ORIGINATOR = optnav",
        "",
        "META_START",
        f"OBJECT_NAME = {name}",
        f"OBJECT_ID = {name}",
        f"CENTER_NAME = {oem.body.upper()}",
        "REF_FRAME = ICRF",
        "TIME_SYSTEM = TDB",
        f"START_TIME = {stamps[0]}",
        f"STOP_TIME = {stamps[-1]}",
        "INTERPOLATION = HERMITE",
        f"INTERPOLATION_DEGREE = {min(DEGREE, 2 * len(stamps) - 1)}",
        "META_STOP",
        "",
    ]
    for stamp, state in zip(stamps, oem.states / 1e3, strict=True):
        lines.append(f"{stamp} " + " ".join(f"{v:.9f}" for v in state))
    if len(oem.covariances):
        lines += ["", "COVARIANCE_START"]
        for time, covariance in zip(oem.covariance_times, oem.covariances / 1e6, strict=True):
            lines += [f"EPOCH = {_tdb_text(time)}", "COV_REF_FRAME = ICRF"]
            for i in range(6):
                lines.append(" ".join(f"{v:.12e}" for v in covariance[i, : i + 1]))
        lines.append("COVARIANCE_STOP")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _tdb_text(tdb_s: float) -> str:
    """A TDB time as a calendar shows it."""
    day, second = divmod(tdb_s + 0.5 * DAY_S, DAY_S)
    micro = round(second * 1e6)
    if micro >= 86_400_000_000:
        day, micro = day + 1.0, 0
    date = np.datetime64("2000-01-01") + np.timedelta64(int(day), "D")
    hour, remainder = divmod(micro, 3_600_000_000)
    minute, remainder = divmod(remainder, 60_000_000)
    return (
        f"{date}T{hour:02d}:{minute:02d}:{remainder // 1_000_000:02d}.{remainder % 1_000_000:06d}"
    )


SPK_BEGINNING = b"DAF/SPK"
CRAFT = -999  # NAIF number of a craft that has none
SPK_DEGREE = 7  # through 4 states: 1e-6 m at 60 s over the Moon
# States nearer to each other, as of two cameras, would be divided by their gap's cube.
MIN_GAP_S = 1.0
SEGMENT, INTERNAL_NAME = "optnav orbit", "optnav"


def write_spk(path: Path, tdb_s: FloatArray, states: FloatArray, craft: int, centre: int) -> None:
    """Write states (n, 6), m and m/s, inertial about a body, at times (n,), TDB s.

    craft, centre  NAIF numbers
    Of states nearer to each other than MIN_GAP_S one is written.
    Raises UsageError without the extra, DataError for fewer than two states.
    """
    try:
        import spiceypy
    except ImportError:
        raise UsageError(
            "a .bsp is written by SPICE: pip install 'optnav[spice]', or write an .oem"
        ) from None
    kept = _apart(tdb_s)
    tdb_s, states = tdb_s[kept], states[kept]
    if len(tdb_s) < 2:
        raise DataError(f"a .bsp needs two states or more; there are {len(tdb_s)}")
    degree = SPK_DEGREE if len(tdb_s) >= (SPK_DEGREE + 1) // 2 else 3
    handle = spiceypy.spkopn(str(path), INTERNAL_NAME, 0)
    try:
        ends = float(tdb_s[0]), float(tdb_s[-1])
        in_km = np.ascontiguousarray(states) / 1e3
        epochs = np.ascontiguousarray(tdb_s, dtype=np.float64)
        spiceypy.spkw13(
            handle, craft, centre, "J2000", *ends, SEGMENT, degree, len(epochs), in_km, epochs
        )
    finally:
        spiceypy.spkcls(handle)


def _apart(tdb_s: FloatArray) -> list[int]:
    """Numbers of the times that lie apart; the first and the last among them."""
    kept = [0]
    for number, time in enumerate(tdb_s):
        if time - tdb_s[kept[-1]] >= MIN_GAP_S:
            kept.append(number)
    last = len(tdb_s) - 1
    if kept[-1] != last:
        kept[-1:] = [last] if len(kept) > 1 else [0, last]
    return kept
