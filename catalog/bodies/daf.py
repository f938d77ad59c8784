"""Binary SPICE kernels of orbits (SPK) and rotation (PCK): whether their structure holds.

The toolkit trusts it: a damaged count overruns its buffers and ends the process. Sources: NAIF,
"DAF Required Reading" (file record, summary records), "SPK Required Reading" and "PCK Required
Reading" (what the data of a segment end with).
"""

import math
import struct
from pathlib import Path
from typing import BinaryIO

from catalog.errors import DataError

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
