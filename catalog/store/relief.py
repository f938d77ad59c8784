"""The relief of the whole body as rows of the table `optnav_relief`, and back.

The grid (n, 2n) is cut into square tiles, beginning at the north pole and longitude -180; the last
ones repeat their edge where the grid ends within them. Layer 0 holds the cells' mean heights,
layer 1 how far their highest places stand above the stored means.
"""

import sqlite3
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from catalog.arrays import Float32Array, Int16Array
from catalog.errors import DataError
from catalog.store.codec import Encoded, decode, decode_counts, encode
from catalog.store.manifest import CatalogMeta, ReliefMeta
from catalog.store.patches import hash_patches
from catalog.store.records import compute_checksum
from catalog.store.schema import RELIEF, RELIEF_COLUMNS
from catalog.terrain.relief.relief import GlobalRelief

ReliefRow = tuple[int, int, int, int, int, float, float, int, bytes]  # as RELIEF_COLUMNS

MEANS, TOPS = 0, 1
LAYERS = ("means", "tops")
# Whole metres are what the models are made of; a top is a bound, and bounds may be coarser.
MEAN_STEP_M = 1.0
TOP_STEP_M = 4.0
TILE = 720  # cells a side: a row of some 500 kB wastes little of its last page

SELECT_TILE = f"SELECT {', '.join(RELIEF_COLUMNS)} FROM {RELIEF} WHERE id = ?"
_HEADER = struct.Struct("<4q2d")


@dataclass(frozen=True)
class PreparedRelief:
    """A relief ready for the file."""

    meta: ReliefMeta
    rows: tuple[ReliefRow, ...]


class TilePlace(NamedTuple):
    """Where a tile lies: its layer, and its row and column among the tiles."""

    layer: int
    row: int
    col: int

    @property
    def key(self) -> int:
        """Primary key of the tile."""
        return (self.layer * 256 + self.row) * 256 + self.col

    def __str__(self) -> str:
        return f"relief, {LAYERS[self.layer]}, tile {self.row}, {self.col}"


def prepare_relief(relief: GlobalRelief) -> PreparedRelief:
    """Round a relief's heights and compress them.

    Means are rounded to MEAN_STEP_M. Tops are rounded up to TOP_STEP_M above the stored mean, so
    that they stay bounds, but for half of a mean's step.
    """
    number = relief.heights.shape[0]
    means = [
        _encode_tile(relief.heights, tile, MEAN_STEP_M) for tile in _iterate_tiles(number, MEANS)
    ]
    stored = _join_tiles([encoded for encoded, _ in means], number)
    above = np.maximum(relief.max_heights - stored - np.float32(MEAN_STEP_M / 2.0), 0.0)
    above = np.ceil(above / np.float32(TOP_STEP_M)) * np.float32(TOP_STEP_M)
    max_heights = [_encode_tile(above, tile, TOP_STEP_M) for tile in _iterate_tiles(number, TOPS)]
    rows, contents = [], []
    places = [*_iterate_tiles(number, MEANS), *_iterate_tiles(number, TOPS)]
    for tile, (encoded, counts) in zip(places, means + max_heights, strict=True):
        header = _pack_header(tile, encoded)
        contents.append((header, counts))
        rows.append((tile.key, *tile, *encoded.columns(header)))
    digest = hash_patches(contents).hex()
    return PreparedRelief(ReliefMeta(number, relief.source, digest), tuple(rows))


def read_relief(db: sqlite3.Connection, meta: CatalogMeta) -> GlobalRelief | None:
    """The relief of an open catalog, None where it carries none.

    Raises DataError naming the first tile that is missing or damaged.
    """
    if meta.relief is None:
        return None
    number = meta.relief.rows
    means, max_heights = (
        _join_tiles(
            [read_tile(db, position)[0] for position in _iterate_tiles(number, layer)], number
        )
        for layer in (MEANS, TOPS)
    )
    max_heights += means
    source = meta.relief.source
    error = meta.find_error(source)
    stated = None if error is None else error.error_m
    return GlobalRelief(means, max_heights, meta.radius_m, source, stated)


def list_tiles(meta: ReliefMeta) -> list[TilePlace]:
    """All tiles of a relief in the order of their keys."""
    return [*_iterate_tiles(meta.rows, MEANS), *_iterate_tiles(meta.rows, TOPS)]


def read_tile(db: sqlite3.Connection, place: TilePlace) -> tuple[Encoded, bytes]:
    """A tile as it is stored, and what checksum and digest cover beside its data.

    Raises DataError unless it is there and its checksum fits.
    """
    try:
        row = db.execute(SELECT_TILE, (place.key,)).fetchone()
    except (sqlite3.Error, ValueError) as error:
        raise DataError(f"{place}: {error}") from None
    if row is None:
        raise DataError(f"{place}: is missing")
    *where, size, step, offset, stored, data = row
    encoded = Encoded.parse_row(size, step, offset, data)
    if where != [place.key, *place] or encoded is None:
        raise DataError(f"{place}: its row of {RELIEF} is damaged")
    header = _pack_header(place, encoded)
    if stored != compute_checksum(header, encoded.data):
        raise DataError(f"{place}: does not fit its checksum")
    return encoded, header


def hash_relief(
    db: sqlite3.Connection, meta: ReliefMeta, report: Callable[[str, object], None]
) -> str:
    """Digest of the tiles as they are; damage is reported, tile by tile."""

    def contents() -> Iterator[tuple[bytes, Int16Array]]:
        for position in list_tiles(meta):
            try:
                tile, header = read_tile(db, position)
                yield header, decode_counts(tile.data, tile.size)
            except DataError as error:
                report(str(position), str(error).removeprefix(f"{position}: "))

    return hash_patches(contents()).hex()


def _pack_header(place: TilePlace, encoded: Encoded) -> bytes:
    return _HEADER.pack(*place, encoded.size, encoded.step, encoded.offset)


def _iterate_tiles(number: int, layer: int) -> Iterator[TilePlace]:
    size = min(TILE, number)
    for row, col in np.ndindex(-(-number // size), -(-2 * number // size)):
        yield TilePlace(layer, row, col)


def _select_part(grid: Float32Array, place: TilePlace, size: int) -> Float32Array:
    return grid[place.row * size :, place.col * size :][:size, :size]


def _encode_tile(grid: Float32Array, place: TilePlace, step: float) -> tuple[Encoded, Int16Array]:
    size = min(TILE, len(grid))
    part = _select_part(grid, place, size)
    missing = [(0, size - side) for side in part.shape]
    return encode(np.pad(part, missing, mode="edge"), step)


def _join_tiles(tiles: Sequence[Encoded], number: int) -> Float32Array:
    """The grid (number, 2 number) of all tiles of a layer. Raises DataError."""
    size = min(TILE, number)
    grid = np.empty((number, 2 * number), np.float32)
    for position, encoded in zip(_iterate_tiles(number, MEANS), tiles, strict=True):
        if encoded.size != size:
            raise DataError(f"relief: a tile of {encoded.size} cells a side; wanted {size}")
        part = _select_part(grid, position, size)
        part[:] = decode(encoded)[: part.shape[0], : part.shape[1]]
    return grid
