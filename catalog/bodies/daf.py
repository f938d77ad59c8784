"""Binary SPICE kernels (DAF files): checked to be whole before the toolkit reads them.

The toolkit trusts the counts of binary kernels: a damaged one overruns its buffers and ends the
process. Sources: NAIF, "DAF Required Reading" (file record, summary records), "SPK", "PCK" and "CK
Required Reading" (segments; each count below stands there).
"""

import itertools
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.keywords import Keyword

RECORD_BYTES = 1024
DOUBLE = 8
SUMMARY_DOUBLES = 125  # of a record, beside its three words of control
MAX_SUMMARY_RECORDS = 100_000
MAX_MINI_SEGMENTS = 100_000
# Doubles of one record that the toolkit has room for (parameters MAXREC of the SPK readers and the
# buffer of the PCK readers), and the highest degree of its interpolations.
MAX_SPK_RECORD, MAX_PCK_RECORD, MAX_DEGREE, MAX_DIFFERENCES = 198, 130, 27, 25
# Degrees that the writers spkw18 and ckw05 of toolkit N0067 accept; their readers hold as many.
MAX_SPK_PACKET_DEGREE, MAX_CK_PACKET_DEGREE = 15, 23
MAX_SECONDS = 1e12  # 30 000 years
MAX_TICKS = 1e18  # of a spacecraft's clock: 30 000 years of microseconds
FORMATS = {b"BIG-IEEE": ">", b"LTL-IEEE": "<"}
CK_BELOW = -1000  # instruments of CKs have numbers below, targets of orbits above

_CONVERT = "make it a type that is read here, for example with NAIF's spkmerge, ckslicer or cksmrg"
KEYWORDS = {
    "DAF/SPK": Keyword("used", "orbits"),
    "DAF/CK": Keyword("used", "attitudes"),
    "DAF/PCK": Keyword("used", "rotations of bodies"),
    "NAIF/DAF": Keyword("used", "orbits, rotations or attitudes of former days"),
    "BIG-IEEE": Keyword("used", "byte order, also another one than this machine's"),
    "LTL-IEEE": Keyword("used", "byte order, also another one than this machine's"),
    "VAX-GFLT": Keyword("refused", "convert it to IEEE numbers with NAIF's toxfr and tobin"),
    "VAX-DFLT": Keyword("refused", "convert it to IEEE numbers with NAIF's toxfr and tobin"),
    "DAS/DSK": Keyword("refused", "a shape: give the body's mesh as an .obj file"),
    "DAS/EK": Keyword("refused", "a table of events holds no geometry: leave it out"),
    "DAF/EK": Keyword("refused", "a table of events holds no geometry: leave it out"),
    "DAFETF": Keyword("refused", "a transfer file: make it binary with NAIF's tobin"),
    "DASETF": Keyword("refused", "a transfer file: make it binary with NAIF's tobin"),
    "SPK type 10": Keyword("refused", f"two-line elements; {_CONVERT}"),
    "SPK type 14": Keyword("refused", f"unequal Chebyshev records; {_CONVERT}"),
    "CK type 4": Keyword("refused", f"unequal Chebyshev records; {_CONVERT}"),
}  # fmt: skip


class Segment(NamedTuple):
    """The part of a summary that says where a segment's data are; addresses count doubles."""

    type: int
    first: int
    last: int
    has_rates: bool  # of attitudes

    @property
    def size(self) -> int:
        return self.last - self.first + 1


class _Daf(NamedTuple):
    """An open file. `free` is the first unused address."""

    file: BinaryIO
    order: str
    kind: str
    integers: int
    free: int

    def read_doubles(self, address: int, count: int) -> tuple[float, ...]:
        """Read doubles. Raises ValueError for numbers that are not finite."""
        self.file.seek(DOUBLE * (address - 1))
        values = struct.unpack(f"{self.order}{count}d", self.file.read(DOUBLE * count))
        if not all(map(math.isfinite, values)):
            raise ValueError("a count of a segment")
        return values

    def read_times(self, address: int, count: int) -> FloatArray:
        """Read an increasing list and the directory behind it. Raises ValueError for another one.

        The toolkit searches such lists, and runs past the end of one that does not increase.
        """
        size = count + _count_directory(count)
        if not 1 <= address <= address + size <= self.free:
            raise ValueError("a segment's number of records")
        self.file.seek(DOUBLE * (address - 1))
        values = np.frombuffer(self.file.read(DOUBLE * size), f"{self.order}f8")
        times, directory = values[:count], values[count:]
        if not (np.isfinite(times).all() and (np.diff(times) > 0.0).all()):
            raise ValueError("a list of times")
        if not np.array_equal(directory, times[99:-1:100]):
            raise ValueError("a directory of times")
        return times.astype(np.float64)

    def count(self, address: int) -> int:
        """Read a double that counts something. Raises ValueError where it counts nothing."""
        (value,) = self.read_doubles(address, 1)
        if value != int(value) or not 0 < value < self.free:
            raise ValueError("a segment's number of records")
        return int(value)


def check_daf(path: Path, head: bytes, size: int) -> None:
    """Refuse a binary kernel that is cut short or whose summaries and counts contradict it.

    head  its first record;  size  of the file, bytes
    Raises DataError.
    """
    word = head[:8].decode("latin-1").strip()
    word = word[:6] if word[:6] in KEYWORDS else word
    stated = head[88:96].decode("latin-1").strip(" \0")
    for name in (word, stated):
        if name in KEYWORDS and KEYWORDS[name].fate == "refused":
            raise DataError(f"{path}: is a SPICE kernel of kind {name}; {KEYWORDS[name].why}")
    if len(head) < RECORD_BYTES:
        raise _cut_short(path, size, RECORD_BYTES)
    order = FORMATS.get(head[88:96]) or ("<" if head[8:12] == b"\2\0\0\0" else ">")
    doubles, integers = struct.unpack_from(f"{order}2i", head, 8)
    first, _, free = struct.unpack_from(f"{order}3i", head, 76)
    if size < DOUBLE * (free - 1):
        raise _cut_short(path, size, DOUBLE * (free - 1))
    if word not in KEYWORDS:
        raise DataError(
            f"{path}: is a SPICE kernel of another kind ({word}); wanted orbits (SPK), attitudes "
            "(CK), orientations (PCK) or text"
        )
    try:
        if (doubles, integers) not in ((2, 6), (2, 5)) or free < 1:
            raise ValueError("its file record")
        with path.open("rb") as file:
            daf = _Daf(file, order, word.removeprefix("DAF/"), integers, free)
            if word == "NAIF/DAF":
                daf = daf._replace(kind=_identify_kind(daf, first))
            if (integers == 5) != (daf.kind == "PCK"):
                raise ValueError("its file record")
            _check_summaries(path, daf, first)
    except (ValueError, OverflowError, struct.error) as error:
        raise DataError(
            f"{path}: the SPICE kernel is damaged ({error} is impossible); fetch it again"
        ) from None


def _cut_short(path: Path, size: int, least: int) -> DataError:
    return DataError(
        f"{path}: the SPICE kernel is cut short: {size} of at least {least} bytes; fetch it again"
    )


def _identify_kind(daf: _Daf, record: int) -> str:
    """The kind of a NAIF/DAF file, which only its first summary tells."""
    if daf.integers == 5:
        return "PCK"
    raw = _read_record(daf, record)
    number, _, _, flag = struct.unpack_from(f"{daf.order}4i", raw, 5 * DOUBLE)
    return "CK" if number <= CK_BELOW and flag in (0, 1) else "SPK"


def _read_record(daf: _Daf, record: int) -> bytes:
    if record < 2:
        raise ValueError("a record of summaries")
    daf.file.seek((record - 1) * RECORD_BYTES)
    return daf.file.read(RECORD_BYTES)


def _check_summaries(path: Path, daf: _Daf, record: int) -> None:
    """Walk along the records of summaries. Raises ValueError naming what cannot be."""
    step = DOUBLE * (2 + (daf.integers + 1) // 2)
    most = MAX_TICKS if daf.kind == "CK" else MAX_SECONDS
    for _ in range(MAX_SUMMARY_RECORDS):
        if record == 0:
            return
        raw = _read_record(daf, record)
        following, _, count = struct.unpack_from(f"{daf.order}3d", raw)
        if not 0 <= count <= SUMMARY_DOUBLES * DOUBLE // step or count != int(count):
            raise ValueError("a number of summaries")
        for number in range(int(count)):
            begin, end, *words = struct.unpack_from(
                f"{daf.order}2d{daf.integers}i", raw, 3 * DOUBLE + number * step
            )
            if not -most < begin <= end < most:
                raise ValueError("a span of time")
            type_ = words[2] if daf.kind == "CK" else words[-3]
            segment = Segment(type_, words[-2], words[-1], daf.kind == "CK" and words[3] == 1)
            _check_segment(path, daf, segment)
        if following != int(following):
            raise ValueError("a record of summaries")
        record = int(following)
    raise ValueError("a chain of summaries without an end")


def _check_segment(path: Path, daf: _Daf, segment: Segment) -> None:
    """Compare the counts at the end of a segment's data with its length."""
    if not 1 <= segment.first <= segment.last < daf.free:
        raise ValueError("a segment's place")
    known = KEYWORDS.get(name := f"{daf.kind} type {segment.type}")
    if known is not None:
        raise DataError(f"{path}: has a segment of {name}, which is not read; {known.why}")
    check = _CHECKS[daf.kind].get(segment.type)
    if check is None:
        raise ValueError(f"a segment's type ({segment.type})")
    if not check(daf, segment):
        raise ValueError("a segment's number of records")


def _count_directory(count: int) -> int:
    """Length of the directory of a list: each hundredth element, but not the last."""
    return (count - 1) // 100


def _check_records(daf: _Daf, segment: Segment) -> bool:
    """Records of one length behind each other, their epochs, a directory, words of the end."""
    tail = daf.read_doubles(max(segment.last - 3, 1), 4)
    count = daf.count(segment.last)
    record, slack, possible = _describe_record(segment.type, tail, daf.kind == "PCK")
    least = count * record
    return possible and least < segment.size <= least + slack * count + 8


def _describe_record(type_: int, tail: tuple[float, ...], is_pck: bool) -> tuple[float, int, bool]:
    """Doubles of a record, doubles beside each record, and whether the toolkit can hold it."""
    match type_:
        case 2 | 3:
            _, length, record, _ = tail
            most = MAX_PCK_RECORD if is_pck else MAX_SPK_RECORD
            components = 3 if type_ == 2 else 6
            divides = (record - 2.0) % components == 0.0
            return record, 0, divides and 2 + components <= record <= most and length > 0.0
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


def _check_velocities(daf: _Daf, segment: Segment) -> bool:
    """SPK type 20: Chebyshev polynomials of velocities."""
    record, count = daf.count(segment.last - 1), daf.count(segment.last)
    return record % 3 == 0 and 6 <= record <= MAX_SPK_RECORD and segment.size == record * count + 7


def _packet_sizes(kind: str) -> tuple[tuple[int, ...], int, int]:
    """Doubles of a packet by subtype, even subtypes being Hermite's; the highest degree; words."""
    return ((12, 6, 6), MAX_SPK_PACKET_DEGREE, 3) if kind == "SPK" else (
        (8, 4, 14, 7), MAX_CK_PACKET_DEGREE, 4)  # fmt: skip


def _check_window(daf: _Daf, address: int) -> int:
    """Doubles of a packet by the subtype and window that stand at an address. Raises ValueError."""
    sizes, highest, _ = _packet_sizes(daf.kind)
    subtype, window = daf.read_doubles(address, 2)
    # odd subtypes interpolate by Lagrange, even ones by Hermite, which has two values a node
    degree = 2.0 * window - 1.0 if subtype in (0.0, 2.0) else window - 1.0
    if subtype not in range(len(sizes)) or not 1.0 <= degree <= highest or window != int(window):
        raise ValueError("a segment's interpolation")
    return sizes[int(subtype)]


def _check_packets(daf: _Daf, segment: Segment) -> bool:
    """SPK type 18: packets, their epochs, a directory; subtype, window, number."""
    packet, count = _check_window(daf, segment.last - 2), daf.count(segment.last)
    if segment.size != count * (packet + 1) + _count_directory(count) + 3:
        return False
    daf.read_times(segment.first + count * packet, count)
    return True


def _check_mini_segments(daf: _Daf, segment: Segment) -> bool:
    """SPK type 19 and CK type 6: segments of packets inside of the segment, with pointers."""
    count = daf.count(segment.last)
    if count > MAX_MINI_SEGMENTS or 2 * count + 5 > segment.size:
        return False
    words = _packet_sizes(daf.kind)[2]
    pointers = daf.read_doubles(segment.last - 2 - count, count + 1)
    if pointers[0] != 1.0 or pointers[-1] + 2 * count + 3 + count // 100 != segment.size:
        return False
    bounds = daf.read_times(segment.first + int(pointers[-1]) - 1, count + 1)
    for index, (begin, following) in enumerate(itertools.pairwise(pointers)):
        last = segment.first + int(following) - 2
        length = int(following) - int(begin)
        if following != int(following) or length < words + 2 or last >= segment.last:
            return False
        packet, number = _check_window(daf, last - 2), daf.count(last)
        if length != number * (packet + 1) + _count_directory(number) + words:
            return False
        times = daf.read_times(segment.first + int(begin) - 1 + number * packet, number)
        if not times[0] <= bounds[index] or not bounds[index + 1] <= times[-1]:
            return False
    return True


def _check_attitudes(daf: _Daf, segment: Segment) -> bool:
    """CK type 1: quaternions, with rates or without, their times, a directory, their number."""
    count = daf.count(segment.last)
    lists = count * _count_quaternion_doubles(segment)
    if segment.size != lists + count + _count_directory(count) + 1:
        return False
    daf.read_times(segment.first + lists, count)
    return True


def _check_rates(daf: _Daf, segment: Segment) -> bool:
    """CK type 2: intervals of constant rates, whose number follows from the length alone."""
    count = 100 * (segment.size + 1) // 1001
    if count < 1 or segment.size != 10 * count + _count_directory(count):
        return False
    stops = daf.read_doubles(segment.first + 9 * count, count)
    starts = daf.read_doubles(segment.first + 8 * count, count)
    increasing = all(a < b for a, b in itertools.pairwise(starts))
    return increasing and all(a < b for a, b in zip(starts, stops, strict=True))


def _check_intervals(daf: _Daf, segment: Segment) -> bool:
    """CK type 3: quaternions and their times, starts of intervals; both numbers at the end."""
    return _check_lists(daf, segment, _count_quaternion_doubles(segment), 2)


def _check_attitude_packets(daf: _Daf, segment: Segment) -> bool:
    """CK type 5: packets and epochs, starts of intervals; rate, subtype, window, numbers."""
    return _check_lists(daf, segment, _check_window(daf, segment.last - 3), 5)


def _check_lists(daf: _Daf, segment: Segment, packet: int, words: int) -> bool:
    """Packets with their times, starts of intervals that are such times; words at the end."""
    intervals, count = daf.count(segment.last - 1), daf.count(segment.last)
    lists = count * (packet + 1) + _count_directory(count)
    if segment.size != lists + intervals + _count_directory(intervals) + words:
        return False
    times = daf.read_times(segment.first + count * packet, count)
    starts = daf.read_times(segment.first + lists, intervals)
    return bool(starts[0] == times[0] and np.isin(starts, times).all())


def _count_quaternion_doubles(segment: Segment) -> int:
    return 7 if segment.has_rates else 4


_Check = Callable[[_Daf, Segment], bool]
_CHECKS: dict[str, dict[int, _Check]] = {
    "SPK": {
        **dict.fromkeys((1, 2, 3, 5, 8, 9, 12, 13, 21), _check_records),
        15: lambda _, segment: segment.size == 16,
        17: lambda _, segment: segment.size == 12,
        18: _check_packets,
        19: _check_mini_segments,
        20: _check_velocities,
    },
    "PCK": dict.fromkeys((2, 3), _check_records),
    "CK": {
        1: _check_attitudes,
        2: _check_rates,
        3: _check_intervals,
        5: _check_attitude_packets,
        6: _check_mini_segments,
    },
}
