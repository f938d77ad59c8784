"""SPICE kernels that a user names: loaded, checked to be whole, and read.

The toolkit (NAIF; through the optional package spiceypy) holds its kernels once a process, so one
set is in use at a time and each question first puts its own set in place. And it trusts the
structure of binary kernels of orbits (SPK) and rotation (PCK): a damaged count overruns its buffers
and ends the process, so that is checked here. Sources: NAIF, "DAF Required Reading" (file record,
summary records), "SPK Required Reading" and "PCK Required Reading" (segments).
"""

import math
import re
import struct
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import BinaryIO, ClassVar

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import DataError
from catalog.inputs import MAX_TEXT_BYTES, check_input

Span = tuple[float, float]

INERTIAL = "J2000"  # SPICE's name of the ICRF axes
_MAX_PATH = 255  # of the toolkit
ORTHOGONAL = 1e-6  # of rotations
MAX_KM = 1e12
_MAX_OBJECTS = 10_000
_MAX_INTERVALS = 10_000
_DATA = re.compile(rb"^[ \t]*\\begindata[ \t\r]*$(.*?)(?:^[ \t]*\\begintext|\Z)", re.M | re.S)
_OTHER_KERNELS = re.compile(rb"KERNELS_TO_LOAD\s*\+?=", re.I)
_LOCK = threading.RLock()  # the toolkit is not safe to call from two threads
RECORD_BYTES = 1024
DOUBLE = 8
SUMMARY_DOUBLES = 125  # of a record, beside its three words of control
MAX_SUMMARY_RECORDS = 100_000
# Doubles of one record that the toolkit has room for (parameters MAXREC of the SPK readers and the
# buffer of the PCK readers), and the highest degree of its interpolations.
MAX_SPK_RECORD, MAX_PCK_RECORD, MAX_DEGREE, MAX_DIFFERENCES = 198, 130, 27, 25
MAX_SECONDS = 1e12  # 30 000 years
INTEGERS = {b"DAF/SPK ": 6, b"DAF/PCK ": 5}  # of a summary, by the file's kind
SPK_TYPES, PCK_TYPES = (1, 2, 3, 5, 8, 9, 12, 13, 21), (2, 3)


class KernelSet:
    """The kernels of one run, in the order given; later ones win over earlier ones.

    orbits  first and last time, TDB s, of the orbits of bodies, by NAIF number
    turns   the same of the binary orientation kernels
    Raises DataError for a kernel that is missing, cut short or no kernel, and where spiceypy is
    not installed.
    """

    _in_use: ClassVar[tuple[str, ...]] = ()  # files that the toolkit holds

    def __init__(self, paths: Sequence[Path]) -> None:
        for path in paths:
            _check_file(path.absolute())
        self.paths = tuple(str(path.resolve()) for path in paths)
        with self._loaded() as spice:
            self.orbits, self.turns = _cover(spice, "SPK"), _cover(spice, "PCK")

    @property
    def names(self) -> str:
        """The file names, for a log."""
        return ", ".join(Path(path).name for path in self.paths)

    def has_orbit(self, number: int) -> bool:
        """Whether a kernel has the orbit of the body with this NAIF number."""
        return number in self.orbits

    def has_frame(self, frame: str) -> bool:
        """Whether the kernels define a frame of this name, with data or without."""
        with self._loaded() as spice:
            number = spice.namfrm(frame)
            try:
                return bool(number) and spice.frinfo(number) is not None
            except spice.exceptions.SpiceyError:
                return False

    def body_frame(self, body: str) -> str:
        """The frame that the kernels tie to a body; IAU_NAME by default."""
        with self._loaded() as spice:
            return str(spice.cnmfrm(body.upper())[1])

    def rotation(self, frame: str, tdb_s: float) -> FloatArray:
        """Rotation (3, 3) taking inertial vectors to a frame. Raises DataError without data."""
        with self._loaded() as spice:
            try:
                matrix: FloatArray = spice.pxform(INERTIAL, frame, tdb_s)
            except spice.exceptions.SpiceyError as error:
                span = common_span(self.turns.values())
                raise self._no_data(f"the frame {frame}", tdb_s, span, error) from None
        if not np.abs(matrix @ matrix.T - np.eye(3)).max() < ORTHOGONAL:
            raise self._not_finite(f"the frame {frame}", tdb_s)
        return matrix

    def position_m(self, of: int, seen_from: int, tdb_s: float, *, apparent: bool) -> FloatArray:
        """Position (3,) of a body from another one, inertial, m.

        of, seen_from  NAIF numbers
        apparent       with light time and stellar aberration; else at the very time
        Raises DataError where the kernels do not reach.
        """
        correction = "LT+S" if apparent else "NONE"
        with self._loaded() as spice:
            try:
                km, _ = spice.spkpos(str(of), tdb_s, INERTIAL, correction, str(seen_from))
            except spice.exceptions.SpiceyError as error:
                pair = (self.orbits[n] for n in (of, seen_from) if n in self.orbits)
                what = f"body {of} seen from {seen_from}"
                raise self._no_data(what, tdb_s, common_span(pair), error) from None
        if not np.abs(km).max() < MAX_KM:
            raise self._not_finite(f"body {of} seen from {seen_from}", tdb_s)
        return np.asarray(km) * 1e3

    def orbit_span(self, numbers: Sequence[int]) -> Span | None:
        """First and last time, TDB s, of the orbits of all these bodies."""
        return common_span(self.orbits[n] for n in numbers if n in self.orbits)

    def _not_finite(self, what: str, tdb_s: float) -> DataError:
        return DataError(
            f"SPICE kernels ({self.names}): impossible numbers about {what} at "
            f"{utc_from_tdb_s(tdb_s, 0)}; a kernel is damaged: fetch it again"
        )

    def _no_data(self, what: str, tdb_s: float, span: Span | None, error: Exception) -> DataError:
        at = utc_from_tdb_s(tdb_s, 0)
        short = str(getattr(error, "short", "")) or type(error).__name__
        if span is None:
            return DataError(
                f"SPICE kernels ({self.names}): nothing about {what} at {at} ({short}); "
                "add the kernel that has it to [spice] kernels"
            )
        first, last = (utc_from_tdb_s(t, 0) for t in span)
        reach = f"they cover {first} to {last}"
        return DataError(
            f"SPICE kernels ({self.names}): nothing about {what} at {at} ({short}); {reach}; "
            "name kernels that reach further, or leave [spice] out"
        )

    @contextmanager
    def _loaded(self) -> Iterator[ModuleType]:
        """The toolkit with this set in place, for one thread at a time."""
        try:
            spice = import_module("spiceypy")
        except ImportError:
            raise DataError(
                "SPICE kernels are named, but the package spiceypy is not installed; "
                "install it with `pip install 'optnav[spice]'`, or leave [spice] out"
            ) from None
        with _LOCK:
            if KernelSet._in_use != self.paths:
                for path in KernelSet._in_use:
                    spice.unload(path)
                KernelSet._in_use = ()
                for number, path in enumerate(self.paths):
                    try:
                        spice.furnsh(path)
                    except spice.exceptions.SpiceyError as error:
                        for loaded in self.paths[:number]:
                            spice.unload(loaded)
                        text = getattr(error, "long", "") or str(error)
                        raise DataError(
                            f"{path}: SPICE cannot load this kernel: {text}; fetch it again"
                        ) from None
                KernelSet._in_use = self.paths
            try:
                yield spice
            except spice.exceptions.SpiceyError as error:
                text = getattr(error, "long", "") or str(error)
                raise DataError(f"SPICE kernels ({self.names}): {text}; fetch them again") from None


def _check_file(path: Path) -> None:
    """Refuse what is no kernel or cut short: the toolkit itself loads both without a word."""
    if len(str(path)) > _MAX_PATH:
        raise DataError(f"{path}: the path is longer than the {_MAX_PATH} letters of SPICE")
    size = check_input(path, "SPICE kernel")
    try:
        with path.open("rb") as file:
            head = file.read(RECORD_BYTES)
            binary = head.startswith((b"DAF/", b"NAIF/DAF"))
            # orbits of a century are hundreds of megabytes
            content = b"" if binary else head + file.read(MAX_TEXT_BYTES)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    if binary:
        check_daf(path, head, size)
    elif any(map(_OTHER_KERNELS.search, _DATA.findall(content))):
        raise DataError(f"{path}: names other kernels (KERNELS_TO_LOAD); name these in its place")
    elif b"\\begindata" not in content:
        raise DataError(
            f"{path}: is no SPICE kernel (neither binary nor text with \\begindata); "
            "name .bsp, .bpc, .tpc or .tf files"
        )
    else:
        last = content.rpartition(b"\\begindata")[2].partition(b"\\begintext")[0]
        if last.count(b"(") != last.count(b")"):
            raise DataError(
                f"{path}: the SPICE kernel is cut short: a parenthesis of its last data section "
                "is not closed; fetch it again"
            )


def _cover(spice: ModuleType, kind: str) -> dict[int, Span]:
    """From when to when each body's data reach in the loaded binary kernels of a kind.

    Gaps inside are not looked for: a question into one is answered by the toolkit's own error.
    """
    spans: dict[int, Span] = {}
    for index in range(spice.ktotal(kind)):
        path = spice.kdata(index, kind)[0]
        numbers = spice.cell_int(_MAX_OBJECTS)
        try:
            (spice.spkobj if kind == "SPK" else spice.pckfrm)(path, numbers)
            for number in numbers:
                window = spice.cell_double(2 * _MAX_INTERVALS)
                (spice.spkcov if kind == "SPK" else spice.pckcov)(path, number, window)
                first = spice.wnfetd(window, 0)[0]
                last = spice.wnfetd(window, spice.wncard(window) - 1)[1]
                known = spans.get(number, (first, last))
                spans[number] = (min(first, known[0]), max(last, known[1]))
        except spice.exceptions.SpiceyError as error:
            text = getattr(error, "long", "") or str(error)
            raise DataError(f"{path}: SPICE cannot read it: {text}; fetch it again") from None
    return spans


def common_span(spans: Iterable[Span]) -> Span | None:
    """What all spans share; None without spans."""
    listed = list(spans)
    if not listed:
        return None
    return max(span[0] for span in listed), min(span[1] for span in listed)


def check_daf(path: Path, head: bytes, size: int) -> None:
    """Refuse a binary kernel that is cut short or whose summaries and counts contradict it.

    head  its first record;  size  of the file, bytes
    Raises DataError.
    """
    whole = RECORD_BYTES
    order = ">" if head[88:96] == b"BIG-IEEE" else "<"
    if len(head) == RECORD_BYTES:
        doubles, integers = struct.unpack_from(f"{order}2i", head, 8)
        first, _, free = struct.unpack_from(f"{order}3i", head, 76)
        whole = DOUBLE * (free - 1)
    if size < whole or len(head) < RECORD_BYTES:
        raise DataError(
            f"{path}: the SPICE kernel is cut short: {size} of at least {whole} bytes; "
            "fetch it again"
        )
    kind = head[:8]
    if kind == b"NAIF/DAF":  # of former days: only the summaries tell
        kind = b"DAF/PCK " if integers == INTEGERS[b"DAF/PCK "] else b"DAF/SPK "
    if kind not in INTEGERS:
        raise DataError(
            f"{path}: is a SPICE kernel of another kind ({head[:8].decode('latin-1').strip()}); "
            "wanted orbits (SPK), orientations (PCK) or text"
        )
    try:
        if (doubles, integers) != (2, INTEGERS[kind]) or free < 1:
            raise ValueError("its file record")
        with path.open("rb") as file:
            _check_summaries(file, order, kind == b"DAF/PCK ", first, free)
    except (ValueError, OverflowError, struct.error) as error:
        raise DataError(
            f"{path}: the SPICE kernel is damaged ({error} is impossible); fetch it again"
        ) from None


def _check_summaries(file: BinaryIO, order: str, is_pck: bool, record: int, free: int) -> None:
    """Walk along the records of summaries. Raises ValueError naming what cannot be."""
    integers = 5 if is_pck else 6
    step = DOUBLE * (2 + (integers + 1) // 2)
    for _ in range(MAX_SUMMARY_RECORDS):
        if record == 0:
            return
        if record < 2:
            raise ValueError("a record of summaries")
        file.seek((record - 1) * RECORD_BYTES)
        raw = file.read(RECORD_BYTES)
        following, _, count = struct.unpack_from(f"{order}3d", raw)
        if not 0 <= count <= SUMMARY_DOUBLES * DOUBLE // step or count != int(count):
            raise ValueError("a number of summaries")
        for number in range(int(count)):
            begin, end, *words = struct.unpack_from(
                f"{order}2d{integers}i", raw, 3 * DOUBLE + number * step
            )
            if not -MAX_SECONDS < begin <= end < MAX_SECONDS:
                raise ValueError("a span of time")
            _check_segment(file, order, is_pck, (words[-3], words[-2], words[-1]), free)
        if following != int(following):
            raise ValueError("a record of summaries")
        record = int(following)
    raise ValueError("a chain of summaries without an end")


def _check_segment(
    file: BinaryIO, order: str, is_pck: bool, segment: tuple[int, int, int], free: int
) -> None:
    """Compare the counts at the end of a segment's data with its length."""
    type_, first, last = segment
    if not 1 <= first <= last < free:
        raise ValueError("a segment's place")
    if type_ not in (PCK_TYPES if is_pck else SPK_TYPES):
        raise ValueError(f"a segment's type ({type_})")
    file.seek(DOUBLE * max(last - 4, 0))
    tail = struct.unpack(f"{order}4d", file.read(4 * DOUBLE))
    if not all(map(math.isfinite, tail)):
        raise ValueError("a segment's end")
    size, count = last - first + 1, tail[3]
    record, slack, possible = _record(type_, tail, is_pck)
    # behind the records stand their epochs, a directory of these and the words of the end
    least = count * record
    fits = count == int(count) and count > 0 and least < size <= least + slack * count + 8
    if not (fits and possible):
        raise ValueError("a segment's number of records")


def _record(type_: int, tail: tuple[float, ...], is_pck: bool) -> tuple[float, int, bool]:
    """Doubles of a record, doubles beside each record, and whether the toolkit can hold it."""
    match type_:
        case 2 | 3:
            _, length, record, _ = tail
            most = MAX_PCK_RECORD if is_pck else MAX_SPK_RECORD
            components = 3 if type_ == 2 else 6
            whole = (record - 2.0) % components == 0.0
            return record, 0, whole and 2 + components <= record <= most and length > 0.0
        case 1:
            return 71.0, 2, True
        case 21:
            return 4.0 * tail[2] + 11.0, 2, tail[2] in range(1, MAX_DIFFERENCES + 1)
        case 8 | 12:
            return 6.0, 0, tail[2] in range(1, MAX_DEGREE + 1) and tail[1] > 0.0
        case 9 | 13:
            return 6.0, 2, tail[2] in range(1, MAX_DEGREE + 1)
        case _:  # 5: states and their epochs, the mass of the centre
            return 6.0, 2, True
