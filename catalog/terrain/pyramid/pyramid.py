"""A terrain model with its averaged overviews: area means at 2, 4, 8, ... times its posting.

Level 0 is read from the file itself; the overviews are tiled GeoTIFFs in a folder of the workspace.
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
from catalog.errors import DataError, OutputError
from catalog.files import decode_stored_json, replace_work_folder
from catalog.progress import Progress, SilentProgress
from catalog.rasters import OWN, handle_read_errors, reopen_raster
from catalog.terrain.dem.file import HEIGHTS, Conversion
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
