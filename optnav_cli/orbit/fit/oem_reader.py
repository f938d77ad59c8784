"""Read CCSDS Orbit Ephemeris Messages, versions 1 to 3, in keyword form (CCSDS 502.0-B-3).

Each segment keeps its states apart, and covariances are turned from the axes that they state to
those of the segment. What a file says otherwise than can be used is refused by its keyword.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, load_body
from catalog.bodies.epochs import TIME_SYSTEMS, system_to_tdb_s, utc_from_tdb_s
from catalog.config import nearest_name
from catalog.errors import DataError
from catalog.geometry.rotations import rnb_axes
from catalog.inputs import MEGABYTE, read_input
from catalog.keywords import Keyword, check_keywords
from optnav_cli.orbit.fit.oem import BEGINNING, DEGREE, SAME_TIME_S, Oem, OemSegment

MAX_BYTES = 64 * MEGABYTE
ROUNDED_S = 1.0  # START_TIME and STOP_TIME may be cut to whole seconds
MAX_DEGREE = 31  # of polynomials on even nodes, which swing beyond it
LOWER = np.tril_indices(6)
# Apart by 0.02": 0.2 m at the Moon's distance, in one file 0.7 m at the geostationary ring.
FRAMES = ("ICRF", "ICRF1", "ICRF2", "ICRF3", "EME2000", "J2000", "GCRF", "GCRF1", "GCRF2", "GCRF3")
METHODS = ("HERMITE", "LAGRANGE", "LINEAR")
VERSIONS = ("1.0", "2.0", "3.0")
RADIAL, TANGENTIAL, NORMAL = ("RTN", "RSW", "RIC", "QSW"), "TNW", "NTW"
J2000_EPOCHS = tuple(
    f"{date}T12:00:00{fraction}"
    for date in ("2000-01-01", "2000-001")
    for fraction in ("", ".0", ".00", ".000", ".000000", "Z")
)
RADIAL_SINE = 1e-9  # between place and velocity: below it no plane of motion is known
STRUCTURE = ("META_START", "META_STOP", "COVARIANCE_START", "COVARIANCE_STOP")

KEYWORDS: dict[str, Keyword] = {
    "CCSDS_OEM_VERS": Keyword("used", "1.0, 2.0 and 3.0 are read, others refused"),
    "OBJECT_NAME": Keyword("used", "all segments have to be of one object"),
    "OBJECT_ID": Keyword("used", "all segments have to be of one object"),
    "CENTER_NAME": Keyword("used", "has to be the body of the measurements"),
    "REF_FRAME": Keyword("used", f"{', '.join(FRAMES)} are read, others refused"),
    "REF_FRAME_EPOCH": Keyword(
        "refused",
        "ICRF and EME2000 are the same at all times; remove it, or turn the states to ICRF",
        J2000_EPOCHS,
    ),
    "TIME_SYSTEM": Keyword("used", f"{', '.join(TIME_SYSTEMS)} are converted, others refused"),
    "START_TIME": Keyword("used", "no state may lie before it"),
    "STOP_TIME": Keyword("used", "no state may lie after it, and the last one has to reach it"),
    "USEABLE_START_TIME": Keyword("used", "states before it serve interpolation alone"),
    "USEABLE_STOP_TIME": Keyword("used", "states after it serve interpolation alone"),
    "INTERPOLATION": Keyword("used", f"{', '.join(METHODS)}; others are refused"),
    "INTERPOLATION_DEGREE": Keyword("used", "of the polynomials inside of the segment"),
    "EPOCH": Keyword("used", "time of a covariance"),
    "COV_REF_FRAME": Keyword("used", "axes of a covariance; where absent, those of the segment"),
    "COMMENT": Keyword("harmless", "is for people"),
    "CREATION_DATE": Keyword("harmless", "when the file was written"),
    "ORIGINATOR": Keyword("harmless", "who wrote the file"),
    "MESSAGE_ID": Keyword("harmless", "number of the message"),
    "CLASSIFICATION": Keyword("harmless", "who may read the file"),
}

# First words of other files that people take for an OEM, and what they are.
OTHER_FILES = {
    b"<?xml": "XML: wanted the keyword form; write it so, or convert it as ccsds-ndm does",
    b"<ndm": "an NDM in XML: wanted the keyword form; convert it as ccsds-ndm does",
    b"<oem": "an OEM in XML: wanted the keyword form; convert it as ccsds-ndm does",
    b"CCSDS_OPM_VERS": "a CCSDS OPM: state its one state as utc, position_m and velocity_m_s",
    b"CCSDS_OMM_VERS": "a CCSDS OMM, of mean elements: write an OEM with its propagator",
    b"CCSDS_OCM_VERS": "a CCSDS OCM: wanted an OEM; write it so",
    b"CCSDS_AEM_VERS": "a CCSDS AEM, of attitudes: wanted an OEM, of states",
    b"stk.v": "an ephemeris of STK: wanted an OEM; export it as CCSDS OEM",
    b"DAF/SPK": "a SPICE kernel: wanted an OEM",
}


def read_oem(path: Path, body: Body | str) -> Oem:
    """Read the states of all segments and their covariances, turned to inertial axes.

    body  that the states have to be about, or its name

    Raises DataError for another centre, damage, or a keyword that cannot be used.
    """
    raw = read_input(path, "orbit", "name a CCSDS OEM", limit=MAX_BYTES)
    raw = raw.removeprefix(b"\xef\xbb\xbf").lstrip()
    if not raw.startswith(BEGINNING):
        known = next((what for start, what in OTHER_FILES.items() if raw.startswith(start)), "")
        fault = f"is {known}" if known else "is no CCSDS OEM in keyword form"
        raise DataError(f"{path}: {fault}; an OEM begins with CCSDS_OEM_VERS")
    try:
        lines = raw.decode("utf-8").splitlines()
    except UnicodeDecodeError:
        raise DataError(f"{path}: is not plain text; name a CCSDS OEM in keyword form") from None
    reader = _OemReader(path, load_body(body) if isinstance(body, str) else body)
    for number, line in enumerate(lines, start=1):
        reader.take(number, line.strip())
    return reader.finish()


@dataclass(eq=False)
class _Covariance:
    """A covariance as the file has it: TDB s, its axes, the numbers of its triangle, a line."""

    line: int
    tdb_s: float
    axes: str = ""
    triangle: list[float] = field(default_factory=list)


@dataclass(eq=False)
class _Block:
    """A segment while it is read: keywords, rows of 7 or 10 numbers with TDB s, covariances."""

    meta: dict[str, str] = field(default_factory=dict)
    rows: list[list[float]] = field(default_factory=list)
    covariances: list[_Covariance] = field(default_factory=list)


class _OemReader:
    """Takes a file line by line."""

    def __init__(self, path: Path, body: Body) -> None:
        self._path, self._body = path, body
        self._header: dict[str, str] = {}
        self._blocks: list[_Block] = []
        self._within = ""  # META, COVARIANCE, or empty: states

    def take(self, number: int, line: str) -> None:
        word = re.split(r"[\s=]", line, maxsplit=1)[0].upper()
        if not line or word == "COMMENT":
            return
        if word in STRUCTURE and "=" not in line:
            self._enter(number, word)
        elif "=" in line:
            key, _, value = (part.strip() for part in line.partition("="))
            self._keyword(number, key.upper(), value)
        elif self._within == "META" or not self._blocks:
            raise self._error(number, f"wanted KEYWORD = value, found '{line[:40]}'")
        elif self._within == "COVARIANCE":
            self._covariance(number, line.split())
        else:
            self._state(number, line.split())

    def _enter(self, number: int, word: str) -> None:
        part, _, side = word.partition("_")
        if side == "STOP" and self._within != part:
            raise self._error(number, f"{word} without a {part}_START; the file is damaged")
        if side == "START" and (self._within or (part == "COVARIANCE" and not self._blocks)):
            raise self._error(number, f"{word} inside of {self._within or 'the header'}")
        if word == "META_START":
            self._blocks.append(_Block())
        elif word == "META_STOP":
            self._check_meta(self._blocks[-1].meta)
        self._within = part if side == "START" else ""

    def _keyword(self, number: int, key: str, value: str) -> None:
        if key not in KEYWORDS:
            near = nearest_name(key, list(KEYWORDS))
            hint = f"; did you mean {near}?" if near else "; remove it, or make it a COMMENT"
            raise self._error(number, f"{key} is no keyword of an OEM{hint}")
        check_keywords(self._path, [(key, value)], KEYWORDS)
        if self._within == "COVARIANCE":
            self._covariance_keyword(number, key, value)
        elif self._within == "META":
            self._once(number, self._blocks[-1].meta, key, value)
        elif self._blocks:
            raise self._error(number, f"{key} stands among states; wanted META_START before it")
        else:
            self._once(number, self._header, key, value)

    def _once(self, number: int, stated: dict[str, str], key: str, value: str) -> None:
        if stated.setdefault(key, value) != value:
            raise self._error(number, f"{key} is '{value}', and '{stated[key]}' above; keep one")

    def _covariance_keyword(self, number: int, key: str, value: str) -> None:
        kept = self._blocks[-1].covariances
        if key == "EPOCH":
            kept.append(_Covariance(number, self._time(number, value)))
        elif key == "COV_REF_FRAME" and kept and not kept[-1].triangle:
            kept[-1].axes = value.upper().removesuffix("_INERTIAL")
        else:
            raise self._error(number, f"{key} stands in a covariance; wanted EPOCH before it")

    def _covariance(self, number: int, words: Sequence[str]) -> None:
        kept = self._blocks[-1].covariances
        if not kept:
            raise self._error(number, "a covariance without an EPOCH; add its time")
        kept[-1].triangle += self._floats(number, words)
        if len(kept[-1].triangle) > len(LOWER[0]):
            raise self._error(number, "a covariance of more than 21 numbers; each needs its EPOCH")

    def _state(self, number: int, words: Sequence[str]) -> None:
        rows = self._blocks[-1].rows
        if len(words) not in (7, 10):
            raise self._error(number, "wanted a time and six numbers, or nine with accelerations")
        if rows and len(rows[-1]) != len(words):
            raise self._error(number, "only some states have accelerations; give all or none")
        row = [self._time(number, words[0]), *self._floats(number, words[1:])]
        if rows and not row[0] > rows[-1][0]:
            raise self._error(
                number, f"{words[0]} is not after the state above: times are not in order"
            )
        rows.append(row)

    def _floats(self, number: int, words: Sequence[str]) -> list[float]:
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if len(numbers) < len(words) or "_" in "".join(words):  # Python takes 1_0 for 10
            raise self._error(number, "has a word where a number belongs")
        if not np.isfinite(numbers).all():
            raise self._error(number, "has a number that is not finite")
        return numbers

    def _time(self, number: int, text: str) -> float:
        try:
            return system_to_tdb_s(text, self._blocks[-1].meta.get("TIME_SYSTEM", "").upper())
        except DataError as error:
            raise self._error(number, str(error)) from None

    def _error(self, number: int, text: str) -> DataError:
        return DataError(f"{self._path}, line {number}: {text}")

    def _check_meta(self, meta: dict[str, str]) -> None:
        """Raise DataError for a segment about another body, or in axes or times not known."""
        centre, frame = meta.get("CENTER_NAME", ""), meta.get("REF_FRAME", "")
        spice = self._body.spice
        numbers = () if spice is None else spice.naif
        names = {_plain(self._body.name), *map(str, numbers)}
        if _plain(centre) not in names:
            hint = "move the states to it"
            if "BARYCENT" in centre.upper():
                hint = "a barycentre is another place than the body's centre: move the states to it"
            raise DataError(
                f"{self._path}: CENTER_NAME is '{centre}'; wanted {self._body.name.upper()}, about "
                f"which the fixes are: {hint}"
            )
        if frame.upper() not in FRAMES:
            raise DataError(
                f"{self._path}: REF_FRAME is '{frame}'; wanted ICRF or EME2000: turn the states"
            )
        system = meta.get("TIME_SYSTEM", "")
        if system.upper() not in TIME_SYSTEMS:
            raise DataError(
                f"{self._path}: TIME_SYSTEM is '{system}'; wanted {', '.join(TIME_SYSTEMS)}: "
                "write the times so"
            )

    def finish(self) -> Oem:
        version = self._header.get("CCSDS_OEM_VERS", "")
        if version not in VERSIONS:
            raise DataError(
                f"{self._path}: CCSDS_OEM_VERS is '{version}'; wanted {', '.join(VERSIONS)}"
            )
        if self._within:
            raise DataError(f"{self._path}: ends inside of {self._within}; it is cut short")
        if not any(block.rows for block in self._blocks):
            raise DataError(f"{self._path}: has no states; it may be cut short")
        for key in ("OBJECT_NAME", "OBJECT_ID"):
            names = Counter(block.meta.get(key, "") for block in self._blocks)
            if len(names) > 1:
                raise DataError(
                    f"{self._path}: segments have {key} {', '.join(sorted(names))}; keep those of "
                    "one craft"
                )
        return self._joined([self._segment(block) for block in self._blocks])

    def _segment(self, block: _Block) -> tuple[OemSegment, _Block]:
        if not block.rows:
            raise DataError(f"{self._path}: a segment has no states; it may be cut short")
        rows = np.array(block.rows)
        times, numbers = rows[:, 0], 1e3 * rows[:, 1:]
        span = self._span(block.meta, times)
        method, degree = self._interpolation(block.meta, len(times))
        segment = OemSegment(
            times,
            numbers[:, :6],
            numbers[:, 6:].reshape(-1, 3) if numbers.shape[1] > 6 else np.empty((0, 3)),
            method,
            degree,
            span,
        )
        return segment, block

    def _span(self, meta: dict[str, str], times: FloatArray) -> tuple[float, float]:
        """The usable one of a segment. Raises DataError where what is stated contradicts states."""
        system = meta.get("TIME_SYSTEM", "").upper()
        stated = {}
        for key in ("START_TIME", "STOP_TIME", "USEABLE_START_TIME", "USEABLE_STOP_TIME"):
            if key in meta:
                try:
                    stated[key] = system_to_tdb_s(meta[key], system)
                except DataError as error:
                    raise DataError(f"{self._path}: {key}: {error}") from None
        first, last = float(times[0]), float(times[-1])
        start, stop = stated.get("START_TIME", first), stated.get("STOP_TIME", last)
        if first < start - ROUNDED_S or last > stop + ROUNDED_S:
            key = "START_TIME" if first < start - ROUNDED_S else "STOP_TIME"
            raise DataError(
                f"{self._path}: states lie outside of {key} = {meta[key]}; mend it, or remove them"
            )
        step = float(np.diff(times).max(initial=0.0))
        if stop > last + step + ROUNDED_S:
            raise DataError(
                f"{self._path}: STOP_TIME is {meta['STOP_TIME']}, and the last state is "
                f"{stop - last:.0f} s before it; the file is cut short"
            )
        usable = (
            max(first, stated.get("USEABLE_START_TIME", first)),
            min(last, stated.get("USEABLE_STOP_TIME", last)),
        )
        if usable[0] > usable[1] + SAME_TIME_S:
            raise DataError(
                f"{self._path}: no state lies from USEABLE_START_TIME to USEABLE_STOP_TIME; mend "
                "them"
            )
        return usable

    def _interpolation(self, meta: dict[str, str], count: int) -> tuple[str, int]:
        method, text = meta.get("INTERPOLATION", "").upper(), meta.get("INTERPOLATION_DEGREE", "")
        if not method and not text:
            return "HERMITE", min(DEGREE, 2 * count - 1)
        if method not in METHODS:
            raise DataError(
                f"{self._path}: INTERPOLATION is '{method}'; wanted {', '.join(METHODS)}: write "
                "the states so near that one of these serves"
            )
        degree = 1 if method == "LINEAR" and not text else None
        if text.isdecimal() and 1 <= int(text[:9]) <= MAX_DEGREE:
            degree = int(text)
        if degree is None or (method == "LINEAR" and degree != 1):
            wanted = "1" if method == "LINEAR" else f"1 to {MAX_DEGREE}"
            raise DataError(
                f"{self._path}: INTERPOLATION = {method} has INTERPOLATION_DEGREE '{text}'; wanted "
                f"{wanted}"
            )
        return method, degree

    def _joined(self, read: Sequence[tuple[OemSegment, _Block]]) -> Oem:
        read = sorted(read, key=lambda one: one[0].usable)
        for (before, _), (after, _) in pairwise(read):
            if after.usable[0] < before.usable[1] - SAME_TIME_S:
                ends = (utc_from_tdb_s(t, 0) for t in (after.usable[0], before.usable[1]))
                raise DataError(
                    f"{self._path}: two segments have states from {' to '.join(ends)}; state "
                    "USEABLE_START_TIME and USEABLE_STOP_TIME, so that each time is of one"
                )
        times: dict[float, FloatArray] = {}
        covariances: dict[float, FloatArray] = {}
        for segment, block in read:
            times |= {
                float(t): s
                for t, s in zip(segment.times, segment.states, strict=True)
                if segment.contains(float(t))
            }
            covariances |= self._turned(segment, block)
        order, stated = sorted(times), sorted(covariances)
        return Oem(
            self._body.name,
            np.array(order),
            np.array([times[t] for t in order]).reshape(-1, 6),
            np.array(stated),
            np.array([covariances[t] for t in stated]).reshape(-1, 6, 6),
            [segment for segment, _ in read],
        )

    def _turned(self, segment: OemSegment, block: _Block) -> dict[float, FloatArray]:
        """Covariances of a segment's usable span, inertial, by their times."""
        turned = {}
        for stated in block.covariances:
            if len(stated.triangle) < len(LOWER[0]):
                raise self._error(stated.line, "this covariance is cut short; write the file again")
            if (
                not segment.times[0] - SAME_TIME_S
                <= stated.tdb_s
                <= segment.times[-1] + SAME_TIME_S
            ):
                raise self._error(stated.line, "the covariance is of a time outside of its states")
            if not segment.contains(stated.tdb_s):
                continue
            try:
                state = segment.state_at(stated.tdb_s)
            except DataError as error:
                raise self._error(stated.line, str(error)) from None
            matrix = np.zeros((6, 6))
            matrix[LOWER] = stated.triangle
            turn = np.kron(np.eye(2), self._axes(stated, state)).T
            inertial = 1e6 * turn @ (matrix + np.tril(matrix, -1).T) @ turn.T
            turned[stated.tdb_s] = 0.5 * (inertial + inertial.T)
        return turned

    def _axes(self, one: _Covariance, state: FloatArray) -> FloatArray:
        """Axes (3, 3) of a covariance as rows, inertial. Raises DataError for others than these."""
        if one.axes in ("", *FRAMES):
            return np.eye(3)
        across = float(np.linalg.norm(np.cross(state[:3], state[3:])))
        if not across > RADIAL_SINE * np.linalg.norm(state[:3]) * np.linalg.norm(state[3:]):
            raise self._error(
                one.line,
                f"COV_REF_FRAME = {one.axes}, and the motion is radial: it has no such axes",
            )
        radial = rnb_axes(state[:3], state[3:])
        if one.axes in RADIAL:
            return radial
        if one.axes in (TANGENTIAL, NORMAL):
            tangent = state[3:] / np.linalg.norm(state[3:])
            # TNW and NTW are right-handed both, so that their N are opposite to each other
            if one.axes == TANGENTIAL:
                return np.array([tangent, np.cross(radial[2], tangent), radial[2]])
            return np.array([np.cross(tangent, radial[2]), tangent, radial[2]])
        wanted = ", ".join((*RADIAL, TANGENTIAL, NORMAL, "ICRF", "EME2000"))
        raise self._error(
            one.line, f"COV_REF_FRAME = {one.axes}; wanted {wanted}: turn the covariance to one"
        )


def _plain(name: str) -> str:
    return re.sub(r"[\s_-]", "", name).lower()
