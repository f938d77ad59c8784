"""Patches as rows of the table `optnav_patches` and back, and the content digest.

The digest is a SHA-256 over what a catalog says, not over how it is stored:

    patches digest  SHA-256 of  each patch of a point in the order of layer and level: its header,
                    then its counts (int16, row by row from the north-west)
    header          point id, layer, level, size (int64), posting, step, offset (float64)
    point digest    SHA-256 of  the point's record (see `records`), then its patches digest
    catalog digest  SHA-256 of  the manifest's content as canonical JSON, a newline, then the
                    digests of all points in id order

All numbers are little-endian.
"""

import hashlib
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from catalog.arrays import Int16Array
from catalog.control_point import ControlPoint, Patch
from catalog.errors import DataError
from catalog.store.codec import Encoded, decode, encode
from catalog.store.manifest import CatalogMeta, format_content
from catalog.store.records import compute_checksum, round_point
from catalog.store.schema import HEIGHT_LAYER, IMAGE_LAYER, compute_patch_key

PatchRow = tuple[int, int, int, int, float, int, float, float, int, bytes]  # as PATCH_COLUMNS

POSTING_DECIMALS = 6
BRIGHTNESS_STEPS = 2048.0  # of a posting: the brightest pixels are about as high as one is wide
_HEADER = struct.Struct("<4q3d")


@dataclass(frozen=True)
class PreparedPoint:
    """A point ready for the file: numbers rounded, patches compressed.

    Made by `prepare_point` in whichever process has the heights; small enough to be sent.
    """

    point: ControlPoint
    rows: tuple[PatchRow, ...]
    patches_digest: bytes

    @property
    def levels(self) -> int:
        """Number of grids of heights; those of brightness stand beside them."""
        return sum(row[2] == HEIGHT_LAYER for row in self.rows)


class StoredPatch(NamedTuple):
    """A patch as the file holds it; `header` is what checksum and digest cover beside its data."""

    posting_m: float
    encoded: Encoded
    header: bytes


def prepare_point(
    point: ControlPoint, patches: Sequence[Patch], steps_m: Sequence[float]
) -> PreparedPoint:
    """Round a point's numbers and compress its patches, finest first, each with its height step."""
    rounded = round_point(point)
    rows, contents = [], []
    grids = [
        (HEIGHT_LAYER, level, patch, patch.heights_m, step)
        for level, (patch, step) in enumerate(zip(patches, steps_m, strict=True))
    ]
    grids += [
        (IMAGE_LAYER, level, patch, patch.brightness, patches[0].posting_m / BRIGHTNESS_STEPS)
        for level, patch in enumerate(patches)
        if patch.brightness is not None
    ]
    for layer, level, patch, grid, step in grids:
        encoded, counts = encode(grid, step)
        posting = round(float(patch.posting_m), POSTING_DECIMALS)
        header = pack_header(rounded.id, level, posting, encoded, layer)
        key = compute_patch_key(rounded.id, layer, level)
        rows.append((key, rounded.id, layer, level, posting, *encoded.columns(header)))
        contents.append((header, counts))
    return PreparedPoint(rounded, tuple(rows), hash_patches(contents))


def check_patch(row: Sequence[object], level: int, meta: CatalogMeta) -> None:
    """Raise DataError unless a row (as PATCH_COLUMNS) has the size and posting of its level."""
    posting, size = row[4], row[5]
    wanted = meta.posting_m * 2**level
    known = isinstance(posting, float) and 0.1 * wanted < posting < 10.0 * wanted
    if not known or size != meta.size:
        raise DataError(
            f"level {level} has {size} nodes a side, {posting} m apart; wanted {meta.size}, "
            f"{wanted:g} m"
        )


def stored_patch_from_row(
    row: Sequence[object], point_id: int, level: int, layer: int = HEIGHT_LAYER
) -> StoredPatch:
    """A row (columns as PATCH_COLUMNS) as it is. Raises DataError unless its checksum fits."""
    *keys, posting, size, step, offset, stored, data = row
    wanted = [compute_patch_key(point_id, layer, level), point_id, layer, level]
    encoded = Encoded.parse_row(size, step, offset, data)
    if keys != wanted or encoded is None or not isinstance(posting, float):
        raise DataError("row of optnav_patches is damaged")
    header = pack_header(point_id, level, posting, encoded, layer)
    if stored != compute_checksum(header, encoded.data):
        raise DataError("row of optnav_patches does not fit its checksum")
    return StoredPatch(posting, encoded, header)


def patch_from_row(row: Sequence[object], point_id: int, level: int) -> Patch:
    """The patch of a row (columns as PATCH_COLUMNS). Raises DataError for a damaged one."""
    patch = stored_patch_from_row(row, point_id, level)
    return Patch(patch.posting_m, decode(patch.encoded))


def pack_header(
    point_id: int, level: int, posting_m: float, encoded: Encoded, layer: int = HEIGHT_LAYER
) -> bytes:
    """Pack the part of a patch, besides its data, that checksum and digest cover."""
    numbers = encoded.size, posting_m, encoded.step, encoded.offset
    return _HEADER.pack(point_id, layer, level, *numbers)


def hash_patches(patches: Iterable[tuple[bytes, Int16Array]]) -> bytes:
    """Digest (32 bytes) of the headers and counts of some grids, such as one point's patches."""
    digest = hashlib.sha256()
    for header, counts in patches:
        digest.update(header)
        digest.update(np.ascontiguousarray(counts, dtype="<i2").data)
    return digest.digest()


def hash_point(record: bytes, patches: bytes) -> bytes:
    """Digest (32 bytes) of a point's record and its patches digest."""
    return hashlib.sha256(record + patches).digest()


def hash_catalog(meta: CatalogMeta, points: bytes | bytearray) -> str:
    """The catalog's digest, of the digests of its points in id order (1.3 MB for 41 252 of them).

    `meta.count` and `meta.point_sources` must be filled in.
    """
    return hashlib.sha256(format_content(meta).encode() + b"\n" + points).hexdigest()
