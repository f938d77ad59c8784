"""The seal of a catalog file: a hash of all its bytes, those that nobody reads among them.

SQLite leaves room in its pages, most of a small file. A bit that flips there harms nothing, yet the
medium that flipped it is not to be trusted. The seal is a row of the manifest, `COUNTER:SHA-256`,
both in hexadecimal: the change counter of SQLite's header and the hash of the file with the
seal's own characters taken as zeros. It holds until another program, such as a GIS that keeps its
styles in the file, writes to it through SQLite, which moves the counter on. SQLite keeps the
counter twice, so that one flipped bit never looks like such a visit.
"""

import hashlib
from enum import Enum
from pathlib import Path
from typing import BinaryIO

SEAL = "seal"
COUNTER_DIGITS, HASH_DIGITS = 8, 64
OPEN_SEAL = "0" * COUNTER_DIGITS + ":" + "0" * HASH_DIGITS
# Where SQLite's header keeps its change counter, and the counter that its page count goes with.
COUNTER, COUNTER_AGAIN = slice(24, 28), slice(92, 96)
PIECE = 1 << 20


def put_seal(path: Path) -> None:
    """Write the seal into a closed catalog file whose manifest has OPEN_SEAL in its place."""
    with path.open("r+b") as file:
        place = _find(file, f"{SEAL}{OPEN_SEAL}".encode("ascii"))
        if place < 0:
            raise ValueError(f"{path}: its manifest has no place for a seal")
        place += len(SEAL)
        counter, _ = _counters(file)
        seal = f"{counter}:{_hash(file, place)}".encode("ascii")
        file.seek(place)
        file.write(seal)


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
    with path.open("rb") as file:
        place = _find(file, f"{SEAL}{seal}".encode("utf-8", "surrogatepass"))
        whole = place >= 0 and _hash(file, place + len(SEAL)) == seal[COUNTER_DIGITS + 1 :]
        counter, again = _counters(file)
    moved = counter != seal[:COUNTER_DIGITS]
    if whole and not moved:
        return SealState.WHOLE
    return SealState.OPENED if moved and not whole and counter == again else SealState.BROKEN


def _counters(file: BinaryIO) -> tuple[str, str]:
    """Both change counters of the header, hexadecimal."""
    file.seek(0)
    header = file.read(COUNTER_AGAIN.stop)
    return header[COUNTER].hex(), header[COUNTER_AGAIN].hex()


# Read piece by piece: a mapped file would count as memory of the process, all of it.
def _find(file: BinaryIO, text: bytes) -> int:
    """Where a text first stands in a file; -1 for nowhere."""
    file.seek(0)
    start, data = 0, b""
    while piece := file.read(PIECE):
        data += piece
        found = data.find(text)
        if found >= 0:
            return start + found
        kept = min(len(text) - 1, len(data))
        start, data = start + len(data) - kept, data[len(data) - kept :]
    return -1


def _hash(file: BinaryIO, place: int) -> str:
    """SHA-256 of a file with the seal at `place` taken as open."""
    whole = hashlib.sha256()
    file.seek(0)
    left = place
    while piece := file.read(min(PIECE, left)):
        whole.update(piece)
        left -= len(piece)
    whole.update(OPEN_SEAL.encode("ascii"))
    file.seek(place + len(OPEN_SEAL))
    while piece := file.read(PIECE):
        whole.update(piece)
    return whole.hexdigest()
