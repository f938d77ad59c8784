"""CCSDS Orbit Ephemeris Messages, version 2.0, in keyword form (CCSDS 502.0-B-2): write and read.

Inertial states in km and km/s with TDB or UTC times; covariances are lower triangles row by row.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import DAY_S, utc_to_tdb_s
from catalog.errors import DataError
from catalog.inputs import MEGABYTE, read_input

BEGINNING = b"CCSDS_OEM_VERS"
MAX_BYTES = 64 * MEGABYTE
FRAMES = ("ICRF", "EME2000", "J2000", "GCRF")  # apart by 0.02": 0.2 m at the Moon's distance
LOWER = np.tril_indices(6)
UNDATED = "2000-01-01T00:00:00"  # of a file without a clock: the same input gives the same


@dataclass(frozen=True, eq=False)
class Oem:
    """Inertial states (n, 6), m and m/s, at TDB s times (n,); covariances by the same times.

    covariances  (m, 6, 6) at covariance_times (m,); none where the file has none
    """

    body: str
    times: FloatArray
    states: FloatArray
    covariance_times: FloatArray = field(default_factory=lambda: np.empty(0))
    covariances: FloatArray = field(default_factory=lambda: np.empty((0, 6, 6)))


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
        "INTERPOLATION_DEGREE = 7",
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


def read_oem(path: Path, body: str) -> Oem:
    """The states of all segments. Raises DataError for another centre or frame, or damage."""
    raw = read_input(path, "orbit", "name a CCSDS OEM", limit=MAX_BYTES)
    if not raw.lstrip().startswith(BEGINNING):
        raise DataError(f"{path}: is no CCSDS OEM in keyword form; it begins with CCSDS_OEM_VERS")
    reader = _Reader(path, body)
    try:
        for number, line in enumerate(raw.decode("ascii").splitlines(), start=1):
            reader.take(number, line.strip())
    except UnicodeDecodeError:
        raise DataError(f"{path}: is not plain text; name a CCSDS OEM in keyword form") from None
    return reader.finish()


class _Reader:
    """Takes a file line by line."""

    def __init__(self, path: Path, body: str) -> None:
        self._path, self._body = path, body
        self._meta: dict[str, str] = {}
        self._states: list[list[float]] = []
        self._epochs: list[float] = []
        self._triangle: list[float] | None = None
        self._covariances: list[FloatArray] = []

    def take(self, number: int, line: str) -> None:
        key, equals, value = (part.strip() for part in line.partition("="))
        if not line or line.startswith("COMMENT") or key in ("META_START",):
            return
        if key == "META_STOP":
            self._check_meta()
        elif key == "COVARIANCE_START":
            self._triangle = []
        elif key == "COVARIANCE_STOP":
            self._triangle = None
        elif equals:
            self._meta[key] = value
            if key == "EPOCH":
                self._epochs.append(self._time(number, value))
        else:
            self._numbers(number, line.split())

    def _numbers(self, number: int, words: Sequence[str]) -> None:
        if self._triangle is None and len(words) in (7, 10):
            row = self._floats(number, words[1:7])
            self._states.append([self._time(number, words[0]), *(1e3 * v for v in row)])
            return
        if self._triangle is None:
            raise DataError(f"{self._path}, line {number}: wanted a time and six numbers")
        self._triangle += self._floats(number, words)
        if len(self._triangle) == len(LOWER[0]):
            matrix = np.zeros((6, 6))
            matrix[LOWER] = self._triangle
            self._covariances.append(1e6 * (matrix + np.tril(matrix, -1).T))
            self._triangle = []

    def _floats(self, number: int, words: Sequence[str]) -> list[float]:
        try:
            found = [float(word) for word in words]
        except ValueError:
            raise DataError(
                f"{self._path}, line {number}: has a word where a number belongs"
            ) from None
        if not np.isfinite(found).all():
            raise DataError(f"{self._path}, line {number}: has a number that is not finite")
        return found

    def _time(self, number: int, text: str) -> float:
        system = self._meta.get("TIME_SYSTEM", "")
        try:
            if system == "UTC":
                return utc_to_tdb_s(text)
            return _tdb_of(text)
        except DataError as error:
            raise DataError(f"{self._path}, line {number}: {error}") from None

    def _check_meta(self) -> None:
        meta = self._meta
        centre, frame = meta.get("CENTER_NAME", ""), meta.get("REF_FRAME", "")
        if centre.lower() != self._body.lower():
            raise DataError(
                f"{self._path}: CENTER_NAME is '{centre}'; wanted {self._body.upper()}, about "
                "which the fixes are: move the states to it"
            )
        if frame.upper() not in FRAMES:
            raise DataError(
                f"{self._path}: REF_FRAME is '{frame}'; wanted ICRF or EME2000: turn the states"
            )
        if meta.get("TIME_SYSTEM") not in ("TDB", "UTC"):
            raise DataError(
                f"{self._path}: TIME_SYSTEM is '{meta.get('TIME_SYSTEM', '')}'; wanted TDB or UTC"
            )

    def finish(self) -> Oem:
        rows = np.array(self._states, np.float64)
        if len(rows) == 0:
            raise DataError(f"{self._path}: has no states; it may be cut short")
        if not (np.diff(rows[:, 0]) >= 0.0).all():
            raise DataError(f"{self._path}: its times are not in order; sort its lines")
        if len(self._epochs) != len(self._covariances):
            raise DataError(f"{self._path}: its covariances are cut short; write it again")
        covariances = np.array(self._covariances).reshape(-1, 6, 6)
        return Oem(self._body, rows[:, 0], rows[:, 1:], np.array(self._epochs), covariances)


def _tdb_text(tdb_s: float) -> str:
    """A TDB time as a calendar shows it."""
    day, second = divmod(tdb_s + 0.5 * DAY_S, DAY_S)
    micro = round(second * 1e6)
    if micro >= 86_400_000_000:
        day, micro = day + 1.0, 0
    date = np.datetime64("2000-01-01") + np.timedelta64(int(day), "D")
    hour, rest = divmod(micro, 3_600_000_000)
    minute, rest = divmod(rest, 60_000_000)
    return f"{date}T{hour:02d}:{minute:02d}:{rest // 1_000_000:02d}.{rest % 1_000_000:06d}"


def _tdb_of(text: str) -> float:
    """TDB s past J2000 of a TDB calendar time."""
    match = re.fullmatch(r"(\d{4}-\d{2}-\d{2})T(\d{2}):(\d{2}):(\d{2}(?:\.\d*)?)Z?", text)
    if match is None:
        raise DataError(f"time '{text}' is not understood; wanted such as 2023-08-17T05:23:10.250")
    try:
        days = (np.datetime64(match[1]) - np.datetime64("2000-01-01")).astype(int)
    except ValueError:
        raise DataError(f"time '{text}' does not exist") from None
    return (
        float(days) * DAY_S
        - 0.5 * DAY_S
        + 3600.0 * int(match[2])
        + 60.0 * int(match[3])
        + float(match[4])
    )
