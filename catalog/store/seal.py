"""The seal of a catalog file: a hash of all its bytes, those that nobody reads among them.

SQLite leaves room in its pages, most of a small file. A bit that flips there harms nothing, yet the
medium that flipped it is not to be trusted. The seal is a row of the manifest, `COUNTER:SHA-256`,
both in hexadecimal: the change counter of SQLite's header and the hash of the file with the
seal's own characters taken as zeros. It holds until another program, such as a GIS that keeps its
styles in the file, writes to it through SQLite, which moves the counter on. SQLite keeps the
counter twice, so that one flipped bit never looks like such a visit.
"""

import hashlib
import mmap
from enum import Enum
from pathlib import Path

SEAL = "seal"
COUNTER_DIGITS, HASH_DIGITS = 8, 64
OPEN_SEAL = "0" * COUNTER_DIGITS + ":" + "0" * HASH_DIGITS
# Where SQLite's header keeps its change counter, and the counter that its page count goes with.
COUNTER, COUNTER_AGAIN = slice(24, 28), slice(92, 96)
PIECE = 1 << 20


def put_seal(path: Path) -> None:
    """Write the seal into a closed catalog file whose manifest has OPEN_SEAL in its place."""
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as data:
        place = data.find(f"{SEAL}{OPEN_SEAL}".encode("ascii"))
        if place < 0:
            raise ValueError(f"{path}: its manifest has no place for a seal")
        place += len(SEAL)
        seal = f"{data[COUNTER].hex()}:{_hash(data, place)}".encode("ascii")
        data[place : place + len(seal)] = seal


class SealState(Enum):
    """What a seal says about the bytes of its file."""

    NONE = "the file carries no seal"
    WHOLE = "as it was written, byte for byte"
    OPENED = "whole in content; another program, such as a GIS, wrote to the file since"
    BROKEN = "bytes between the data are not as they were written; its medium may be failing"


def seal_state(path: Path, seal: str) -> SealState:
    """Compare a closed file with the seal that its manifest states; "" is no seal."""
    if not seal:
        return SealState.NONE
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        place = data.find(f"{SEAL}{seal}".encode("utf-8", "surrogatepass"))
        whole = place >= 0 and _hash(data, place + len(SEAL)) == seal[COUNTER_DIGITS + 1 :]
        counter, again = data[COUNTER].hex(), data[COUNTER_AGAIN].hex()
    moved = counter != seal[:COUNTER_DIGITS]
    if whole and not moved:
        return SealState.WHOLE
    return SealState.OPENED if moved and not whole and counter == again else SealState.BROKEN


def _hash(data: mmap.mmap, place: int) -> str:
    """SHA-256 of a file with the seal at `place` taken as open."""
    end = place + len(OPEN_SEAL)
    whole = hashlib.sha256()
    for first, last in ((0, place), (end, len(data))):
        if first == end:
            whole.update(OPEN_SEAL.encode("ascii"))
        for start in range(first, last, PIECE):
            whole.update(data[start : min(start + PIECE, last)])
    return whole.hexdigest()
