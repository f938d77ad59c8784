"""A terrain model with its averaged overviews: area means at 2, 4, 8, ... times its posting.

Level 0 is read from the file itself; the overviews are tiled GeoTIFFs in a folder of the workspace.

Windows of a pyramid level that go on across ±180° and the poles; tiles in a bounded cache.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from catalog.arrays import BoolArray, Float32Array
from catalog.bodies.body import Body
from catalog.cache import Cache
from catalog.errors import DataError, OutputError
from catalog.files import decode_stored_json, replace_work_folder
from catalog.geometry.kernel import kernel
from catalog.progress import Progress, SilentProgress
from catalog.rasters import OWN, handle_read_errors, reopen_raster
from catalog.terrain.dem.file import HEIGHTS, Conversion
from catalog.terrain.dem.georeference import Georeference, iterate_column_spans
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.pyramid.overviews import (
    FORMAT,
    WHOLE_BLOCK,
    PyramidRecord,
    level_path,
    level_shape,
    whole_blocks_path,
    write_levels,
)

POLE_TOLERANCE = 0.02  # rows by which a raster's edge may miss a pole that it is meant to reach


@dataclass
class HeightPyramid:
    """A source and its overviews. Level 0 is the source's own grid."""

    source: DemSource
    folder: Path
    record: PyramidRecord
    _open: dict[int, Any] = field(default_factory=dict)

    @property
    def levels(self) -> int:
        """Number of levels, the source's own included."""
        return self.record.levels

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level."""
        return level_shape(self.source.shape, level)

    @property
    def covers_the_body(self) -> bool:
        """Whether every place has a height: pole to pole, all round, no holes."""
        georeference = self.source.georeference
        rows = georeference.shape[0]
        ends = [georeference.find_pole(edge, POLE_TOLERANCE) for edge in (-0.5, rows - 0.5)]
        return self.record.valid_share == 1.0 and sorted(ends) == [-1, 1]

    def load_hole_free_blocks(self) -> BoolArray:
        """Which blocks of WHOLE_BLOCK pixels a side (fewer in the last ones) have no hole."""
        if self.record.valid_share == 1.0:
            return np.ones(tuple(-(-side // WHOLE_BLOCK) for side in self.source.shape), dtype=bool)
        path = whole_blocks_path(self.folder)
        try:
            hole_free: BoolArray = np.load(path)
        except (OSError, ValueError):
            raise DataError(_describe_damage(path, self.folder)) from None
        return hole_free

    def choose_level(self, posting_m: float) -> int:
        """The coarsest level whose posting is at most 1.05 times the wanted one; 0 if none is."""
        ratio = 1.05 * posting_m / self.source.posting_m
        return min(self.levels - 1, max(0, math.floor(math.log2(ratio)))) if ratio > 0.0 else 0

    def read(self, level: int, row: int, col: int, height: int, width: int) -> Float32Array:
        """Heights of a window that lies inside a level. Raises DataError for a damaged file."""
        raw, convert = self.read_raw(level, row, col, height, width)
        return raw if convert is HEIGHTS else convert(raw)

    def read_raw(
        self, level: int, row: int, col: int, height: int, width: int
    ) -> tuple[NDArray[Any], Conversion]:
        """Counts of a window that lies inside a level, and what makes heights of them."""
        if level == 0 and not self.record.tiled_copy:
            return self.source.read_raw(row, col, height, width), self.source.convert
        path = level_path(self.folder, level)
        try:
            with handle_read_errors(path):
                if level not in self._open:
                    self._open[level] = reopen_raster(path, OWN)
                raw = self._open[level].read(1, window=Window(col, row, width, height))
        except DataError:
            raise DataError(_describe_damage(path, self.folder)) from None
        return raw, HEIGHTS if level else self.source.convert

    def close(self) -> None:
        """Let go of all files; they open again when read."""
        for dataset in self._open.values():
            dataset.close()
        self._open = {}
        self.source.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}

    @classmethod
    def load(cls, source: DemSource, folder: Path) -> "HeightPyramid | None":
        """The pyramid that a folder holds, None where there is no whole one of this source."""
        try:
            record = decode_stored_json((folder / "pyramid.json").read_bytes(), PyramidRecord)
        except FileNotFoundError:
            return None
        if record is None:
            return None
        state = source.path.stat()
        same = (
            record.format == FORMAT
            and _strip_presentation(record.settings) == _strip_presentation(source.settings)
            and record.shape == source.shape
            and record.source_bytes == state.st_size
            and record.source_mtime_ns == state.st_mtime_ns
        )
        return cls(source, folder, record) if same else None

    @classmethod
    def build(
        cls, source: DemSource, folder: Path, workers: int = 1, progress: Progress | None = None
    ) -> "HeightPyramid":
        """Read a source whole and write its overviews; the folder appears when all is done.

        Raises DataError for a damaged file, one without data or with impossible heights, and
        OutputError when the place cannot be written.
        """
        try:
            with replace_work_folder(folder) as new:
                record = write_levels(source, new, workers, progress or SilentProgress())
                (new / "pyramid.json").write_bytes(msgspec.json.encode(record))
        except OSError as error:
            raise OutputError(
                f"{folder}: overviews cannot be written ({error.strerror or error}); "
                "free space or choose another work folder"
            ) from None
        return cls(source, folder, record)

    @classmethod
    def load_or_build(
        cls, settings: DemSettings, base_dir: Path, body: Body, folder: Path, workers: int = 1
    ) -> "HeightPyramid":
        """The pyramid of a [[dem]] section, made if the folder does not hold it yet."""
        source = DemSource.open(settings, base_dir, body)
        return cls.load(source, folder) or cls.build(source, folder, workers)


def _strip_presentation(settings: DemSettings) -> DemSettings:
    """Settings without those that do not change what is read from a file."""
    return msgspec.structs.replace(settings, priority=1, feather_km=0.0)


def _describe_damage(path: Path, folder: Path) -> str:
    return f"{path}: cannot be read; remove the folder {folder} to have it made again"


TILE = 256  # pixels a side; whole tiles of the overviews
CACHE_BYTES = 128 << 20  # 512 tiles: the ground of some 60 cells of 1° at 118 m, all levels
READ_COLUMNS = 4096  # read at once when columns are averaged
MIN_COLUMNS = 16  # left of a level whose columns are averaged


TileCache = Cache[tuple[int, ...], Float32Array]


def tile_cache() -> TileCache:
    """A cache of tiles for all pyramids of a mosaic."""
    return Cache(CACHE_BYTES, lambda tile: int(tile.nbytes))


def find_mirrored_poles(place: Georeference) -> tuple[bool, bool]:
    """Whether a raster's upper and lower edge are a pole, beyond which it goes on."""
    edges = (-0.5, place.shape[0] - 0.5)
    top, bottom = (place.find_pole(edge, POLE_TOLERANCE) != 0 for edge in edges)
    return top, bottom


class LevelWindows:
    """One level of a pyramid, going on across ±180° and the poles.

    Its columns are averaged 2^halvings at a time.
    """

    def __init__(
        self,
        index: int,
        pyramid: HeightPyramid,
        level: int,
        cache: TileCache,
        base: "LevelWindows | None" = None,
        halvings: int = 0,
    ) -> None:
        self.index, self.pyramid, self.level, self.cache = index, pyramid, level, cache
        self.halvings = halvings
        self._base = base or self
        self._halved = {0: self} if base is None else {}
        georeference = pyramid.source.georeference
        self.raster_shape = georeference.shape
        rows, cols = pyramid.shape(level)
        full_turn = georeference.wraps and cols << level == georeference.shape[1]
        cols = -(-cols >> halvings)
        self.shape = rows, cols
        self.scale = 2.0**level
        self.squeeze = 2.0**halvings
        self.period = georeference.period / (self.scale * self.squeeze)
        # mirroring needs an edge exactly at the pole and a column half a turn away
        even = full_turn and cols % 2 == 0 and rows << level == georeference.shape[0]
        self.wraps = full_turn
        top, bottom = find_mirrored_poles(georeference)
        self.mirrors_top, self.mirrors_bottom = even and top, even and bottom
        self.most_halvings = 0
        # halvings leave some columns, and an even number of whole ones in a ring
        while base is None and cols >= 2 * MIN_COLUMNS and not (full_turn and cols % 4):
            cols, self.most_halvings = -(-cols // 2), self.most_halvings + 1

    def get_halved(self, halvings: int) -> "LevelWindows":
        """Return this level with columns averaged 2^halvings at a time."""
        if halvings not in self._halved:
            self._halved[halvings] = LevelWindows(
                self.index, self.pyramid, self.level, self.cache, self, halvings
            )
        return self._halved[halvings]

    def window(self, row0: int, col0: int, height: int, width: int) -> Float32Array:
        """Heights (height, width); NaN where the level has none.

        Rows beyond a pole are those of the meridian on its other side.
        """
        rows, cols = self.shape
        out = np.empty((height, width), np.float32)
        across = self.wraps or 0 <= col0 <= cols - width
        if not (across and 0 <= row0 <= rows - height):  # else all of it is filled
            out[:] = np.nan
        top = min(max(-row0, 0), height)
        bottom = max(min(rows - row0, height), top)
        self._fill(out[top:bottom], row0 + top, col0)
        if top > 0 and self.mirrors_top:
            # row -1 is row 0 seen from the other side
            mirrored = np.full((top, width), np.nan, dtype=np.float32)
            self._fill(mirrored, -(row0 + top - 1) - 1, col0 + cols // 2)
            out[:top] = mirrored[::-1]
        if bottom < height and self.mirrors_bottom:
            mirrored = np.full((height - bottom, width), np.nan, dtype=np.float32)
            self._fill(mirrored, 2 * rows - (row0 + height), col0 + cols // 2)
            out[bottom:] = mirrored[::-1]
        return out

    def _fill(self, out: Float32Array, row0: int, col0: int) -> None:
        """Copy from tiles into `out`, whose rows lie inside the raster; columns wrap."""
        rows, cols = self.shape
        height, width = out.shape
        for at, col, count in iterate_column_spans(col0, width, cols, self.wraps, TILE):
            along, inner = divmod(col, TILE)
            row = max(row0, 0)
            while row < min(row0 + height, rows):
                down, inner_row = divmod(row, TILE)
                lines = min(row0 + height - row, TILE - inner_row, rows - row)
                tile = self._tile(down, along)
                out[row - row0 : row - row0 + lines, at : at + count] = tile[
                    inner_row : inner_row + lines, inner : inner + count
                ]
                row += lines

    def _tile(self, down: int, along: int) -> Float32Array:
        """Tile (down, along); shorter at the raster's far edges."""
        key = (self.index, self.level, self.halvings, down, along)
        return self.cache.get(key, lambda: self._make(down, along))

    def _make(self, down: int, along: int) -> Float32Array:
        rows, cols = self.shape
        row, col = down * TILE, along * TILE
        height, width = min(TILE, rows - row), min(TILE, cols - col)
        if self.halvings == 0:
            return self.pyramid.read(self.level, row, col, height, width)
        out = np.empty((height, width), np.float32)
        if self.halvings > self._base.find_least_halvings(down):
            finer = self._base.get_halved(self.halvings - 1)
            for part in range(2 * along, min(2 * along + 2, -(-finer.shape[1] // TILE))):
                at = (part - 2 * along) * (TILE // 2)
                HEIGHTS.average_columns(finer._tile(down, part), 2, out[:, at : at + TILE // 2])
            return out
        # straight from the level: what lies between is not used elsewhere
        many = 1 << self.halvings
        step = max(1, READ_COLUMNS >> self.halvings)
        last = self._base.shape[1]
        for at in range(0, width, step):
            first = (col + at) * many
            count = min(min(step, width - at) * many, last - first)
            raw, convert = self.pyramid.read_raw(self.level, row, first, height, count)
            convert.average_columns(raw, many, out[:, at : at + step])
        return out

    def find_least_halvings(self, down: int) -> int:
        """The fewest halvings that any footprint in a row of tiles needs, but for rare ones.

        Footprints are about as high as the level's rows, half as high at the finest level.
        """
        georeference = self.pyramid.source.georeference
        edges = np.array([down * TILE, min((down + 1) * TILE, self.shape[0])]) * self.scale - 0.5
        lat, _ = georeference.latlon_from_pixel(np.zeros(2), edges)
        wide = (1.0 if self.level else 0.5) * float(
            georeference.columns_per_posting(1.0, lat).min()
        )
        return int(count_halvings(wide, self.most_halvings))


@kernel
def count_halvings(wide: float, most: int) -> int:
    """Count the halvings of columns under a footprint `wide` columns wide: 1.5 to 3 are left."""
    count = 0
    while wide >= 3.0 and count < most:
        wide, count = wide * 0.5, count + 1
    return count
