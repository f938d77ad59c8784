"""Writes the overviews of a terrain model in one pass over it, window by window.

Memory stays bounded by the windows in work; a damaged block anywhere in the file is met here,
before anything is built on it.
"""

import math
import tempfile
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.windows import Window

from catalog.arrays import BoolArray, Float32Array
from catalog.errors import DataError, OutputError
from catalog.geometry.kernel import kernel
from catalog.progress import Progress
from catalog.rasters import OWN, extract_gdal_reason, reopen_raster
from catalog.terrain.dem.file import HEIGHTS, Conversion, is_height
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.dem.validity import HeightSample

FORMAT = 3  # of the overview folder; another number means: make it again
BLOCK = 256  # pixels a side of the overviews' tiles
WINDOW = 4096  # pixels of the source read at once, a side: 32 MB of int16
CASCADE = 4  # levels made from one window: 4096 halves to a whole tile of 256
SMALLEST = 48  # a level with a side shorter than this ends the pyramid
# Heights are rounded to a power of two near this part of the posting (1/16 m at 118 m, far below a
# tenth of any DEM's error): overviews are then the same to the last bit however sums are ordered.
ROUNDING = 1.0 / 1500.0
# A source with blocks longer than this and no thicker than 16 rows is copied into tiles first:
# a square window would decode whole strips.
MAX_STRIP = 4096
PROBE_BYTES = 1 << 22  # more than a part of a file that did not fit
WHOLE_BLOCK = 8  # pixels a side of the blocks that are known to be without holes or not


class PyramidRecord(msgspec.Struct, frozen=True):
    """Facts about a source from reading all of it; pyramid.json of an overview folder."""

    format: int
    settings: DemSettings
    source_bytes: int
    source_mtime_ns: int
    shape: tuple[int, int]
    levels: int
    tiled_copy: bool
    heights: str
    units: str
    posting_m: float
    lowest_m: float
    highest_m: float
    valid_share: float


@dataclass
class _Statistics:
    """Statistics of a source's heights, gathered while it is read.

    hole_free  blocks of WHOLE_BLOCK pixels a side that have all their pixels
    sample     some of its heights
    """

    hole_free: BoolArray
    sample: HeightSample
    lowest: float = math.inf
    highest: float = -math.inf
    valid: int = 0
    total: int = 0

    def add(self, part: tuple[float, float, int, int]) -> None:
        self.lowest, self.highest = min(self.lowest, part[0]), max(self.highest, part[1])
        self.valid, self.total = self.valid + part[2], self.total + part[3]


def level_shape(shape: tuple[int, int], level: int) -> tuple[int, int]:
    """Rows and columns after `level` halvings; an odd last row or column makes one of its own."""
    return -(-shape[0] >> level), -(-shape[1] >> level)


def level_path(folder: Path, level: int) -> Path:
    """The file of a level; level 0 exists only as the tiled copy of a source made of strips."""
    return folder / f"level-{level:02d}.tif"


def whole_blocks_path(folder: Path) -> Path:
    """Which blocks of the source have all their pixels; only for a source with holes."""
    return folder / "whole-blocks.npy"


def write_levels(
    source: DemSource, folder: Path, workers: int, progress: Progress
) -> PyramidRecord:
    """Write all overviews of a source into a folder; returns what reading it found.

    Raises DataError for a damaged file, one without data or with impossible heights, OutputError
    when the folder cannot be written.
    """
    # down to a side of about SMALLEST, the source's own included
    levels = max(1, 1 + math.floor(math.log2(max(1.0, min(source.shape) / SMALLEST))))
    copied = _is_copied(source)
    blocks = tuple(-(-side // WHOLE_BLOCK) for side in source.shape)
    statistics = _Statistics(np.ones(blocks, dtype=bool), HeightSample(source.shape))
    try:
        if copied:
            _copy_into_tiles(source, folder, progress)
        for first in range(0, max(1, levels - 1), CASCADE):
            made = min(CASCADE, levels - 1 - first)
            _write_cascade(source, folder, first, made, statistics, workers, progress)
    except RasterioError as error:
        reason = _explain_unwritten(folder, error)
        raise OutputError(f"{folder}: overviews cannot be written ({reason}); free space") from None
    if statistics.valid == 0:
        raise DataError(f"{source.path}: has no data at all; check `nodata` and the file")
    source.check_sample(statistics.sample.heights)
    source.check_heights(statistics.lowest, statistics.highest)
    if statistics.valid < statistics.total:
        np.save(whole_blocks_path(folder), statistics.hole_free)
    return PyramidRecord(
        format=FORMAT,
        settings=source.settings,
        source_bytes=source.path.stat().st_size,
        source_mtime_ns=source.path.stat().st_mtime_ns,
        shape=source.shape,
        levels=levels,
        tiled_copy=copied,
        heights=source.heights,
        units=source.units,
        posting_m=source.posting_m,
        lowest_m=statistics.lowest,
        highest_m=statistics.highest,
        valid_share=statistics.valid / statistics.total,
    )


def _is_copied(source: DemSource) -> bool:
    """Whether a source made of strips is copied into tiles first."""
    rows, cols = source.block_shape
    return cols > MAX_STRIP and rows <= 16


def _write_cascade(
    source: DemSource,
    folder: Path,
    first: int,
    made: int,
    statistics: _Statistics,
    workers: int,
    progress: Progress,
) -> None:
    """Make `made` levels above level `first` in one pass over it; statistics come from level 0."""
    shape = level_shape(source.shape, first)
    step = 2.0 ** math.floor(math.log2(source.posting_m * ROUNDING))
    convert = source.convert if first == 0 else HEIGHTS
    path = level_path(folder, first) if first > 0 or _is_copied(source) else None
    windows = [
        (row, col, min(WINDOW, shape[0] - row), min(WINDOW, shape[1] - col))
        for row in range(0, shape[0], WINDOW)
        for col in range(0, shape[1], WINDOW)
    ]

    def work(window: tuple[int, int, int, int]) -> tuple[Any, list[Float32Array]]:
        # every window has its own handle: GDAL's are not safe across threads, and opening is cheap
        if path is None:
            reader = source.reopen()
            raw = reader.read_raw(*window)
            reader.close()
        else:
            with reopen_raster(path, OWN) as dataset:
                row, col, height, width = window
                raw = dataset.read(1, window=Window(col, row, width, height))
        part = find_extremes(raw, convert)
        if first == 0:
            every = statistics.sample.step
            statistics.sample.add_thinned(convert(raw[::every, ::every]))
        if first == 0 and part[2] < part[3]:
            # windows begin at whole blocks: each writes its own part
            at = window[0] // WHOLE_BLOCK, window[1] // WHOLE_BLOCK
            mark_holes(raw, convert, WHOLE_BLOCK, statistics.hole_free[at[0] :, at[1] :])
        grids = []
        if made > 0:
            grids.append(downsample_raw(raw, convert, step))
        while len(grids) < made:
            grids.append(downsample_raw(grids[-1], HEIGHTS, step))
        return part, grids

    outputs = [_create(source, folder, first + 1 + k) for k in range(made)]
    name = "overviews" if first == 0 else f"overviews from level {first}"
    try:
        with progress.stage(name, total=len(windows), unit="window") as stage:
            for window, (part, grids) in _process_in_order(work, windows, workers):
                if first == 0:
                    statistics.add(part)
                for k, grid in enumerate(grids):
                    row, col = window[0] >> (k + 1), window[1] >> (k + 1)
                    outputs[k].write(grid, 1, window=Window(col, row, grid.shape[1], grid.shape[0]))
                stage.advance()
    finally:
        for output in outputs:
            output.close()


def _explain_unwritten(folder: Path, error: RasterioError) -> str:
    """Explain why the folder takes no more; GDAL's own words name a line of the file only."""
    try:
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(bytes(PROBE_BYTES))
            probe.flush()
    except OSError as reason:
        return reason.strerror or str(reason)
    return extract_gdal_reason(error)


def _process_in_order(
    work: Any, windows: list[tuple[int, int, int, int]], workers: int
) -> Iterator[tuple[tuple[int, int, int, int], tuple[Any, list[Float32Array]]]]:
    """Results in order; no more windows in memory than threads and one."""
    if workers <= 1:
        for window in windows:
            yield window, work(window)
        return
    with ThreadPoolExecutor(workers) as pool:
        waiting = iter(windows)
        under_way: list[tuple[tuple[int, int, int, int], Future[Any]]] = [
            (w, pool.submit(work, w)) for w in islice(waiting, workers + 1)
        ]
        try:
            while under_way:
                window, future = under_way.pop(0)
                yield window, future.result()
                under_way.extend((w, pool.submit(work, w)) for w in islice(waiting, 1))
        finally:
            for _, future in under_way:
                future.cancel()


def _create(source: DemSource, folder: Path, level: int) -> Any:
    """A tiled file to write a level to: heights, or counts as they are for level 0."""
    rows, cols = level_shape(source.shape, level)
    a, b, c, d, e, f = source.georeference.affine
    step = 2.0**level
    dtype = "float32" if level else source.dtype
    # Overviews are not packed: that took half of the time of making them, on one core, and half of
    # that of every later reading, to save less than half of their size.
    packing: dict[str, Any] = {}
    if level == 0:
        packing = {"compress": "zstd", "zstd_level": 1, "predictor": _choose_predictor(dtype)}
    return rasterio.open(
        level_path(folder, level),
        "w",
        driver="GTiff",
        height=rows,
        width=cols,
        count=1,
        dtype=dtype,
        nodata=math.nan if level else None,
        crs=rasterio.CRS.from_wkt(source.georeference.wkt),
        transform=rasterio.Affine(a * step, b * step, c, d * step, e * step, f),
        tiled=True,
        blockxsize=BLOCK,
        blockysize=BLOCK,
        bigtiff="if_safer",
        **packing,
    )


def _choose_predictor(dtype: str) -> int:
    """Choose the predictor of packed tiles: one for floats would double the time of each read."""
    return 1 if np.dtype(dtype).kind == "f" else 2


def _copy_into_tiles(source: DemSource, folder: Path, progress: Progress) -> None:
    """Level 0 as tiles, counts unchanged, read in bands of whole rows."""
    rows, cols = source.shape
    with (
        _create(source, folder, 0) as copy,
        progress.stage("tiles", total=-(-rows // BLOCK), unit="band") as stage,
    ):
        for row in range(0, rows, BLOCK):
            height = min(BLOCK, rows - row)
            raw = source.read_raw(row, 0, height, cols)
            copy.write(raw, 1, window=Window(0, row, cols, height))
            stage.advance()


@kernel
def find_extremes(raw: NDArray[Any], convert: Conversion) -> tuple[float, float, int, int]:
    """Lowest and highest height, number of valid and of all values."""
    rows, cols = raw.shape
    first, last = convert.first_nodata, convert.last_nodata
    # by columns, and without a branch: compiled to vector instructions
    low, high = np.full(cols, np.inf), np.full(cols, -np.inf)
    valid = 0
    for i in range(rows):
        line = raw[i]
        for j in range(cols):
            value = np.float64(line[j])
            known = (abs(value) < np.inf) & (not ((value >= first) & (value <= last)))
            low[j] = value if known & (value < low[j]) else low[j]
            high[j] = value if known & (value > high[j]) else high[j]
            valid += 1 if known else 0
    if valid == 0:
        return np.inf, -np.inf, 0, raw.size
    least = low.min() * convert.scale_m + convert.offset_m
    other = high.max() * convert.scale_m + convert.offset_m
    return min(least, other), max(least, other), valid, raw.size


@kernel
def mark_holes(raw: NDArray[Any], convert: Conversion, block: int, whole: BoolArray) -> None:
    """Clear the blocks that have a pixel without data."""
    for i in range(raw.shape[0]):
        for j in range(raw.shape[1]):
            if not is_height(float(raw[i, j]), convert):
                whole[i // block, j // block] = False


@kernel
def _average_row_pair(
    upper: NDArray[Any], lower: NDArray[Any], convert: Conversion, step: float, out: Float32Array
) -> None:
    """`downsample_raw` of two whole rows, without branches: a fifth of the time."""
    first, last = convert.first_nodata, convert.last_nodata
    scale, offset = convert.scale_m, convert.offset_m
    total, known = np.zeros(out.size), np.zeros(out.size)
    for line in (upper, lower):
        for side in range(2):
            for j in range(line.size // 2):
                value = np.float64(line[2 * j + side])
                is_known = (abs(value) < np.inf) & (not ((value >= first) & (value <= last)))
                total[j] += value if is_known else 0.0
                known[j] += 1.0 if is_known else 0.0
    for j in range(upper.size // 2):
        mean = total[j] / known[j] * scale + offset
        out[j] = np.rint(mean / step) * step if known[j] >= 2.0 else np.nan


@kernel
def downsample_raw(raw: NDArray[Any], convert: Conversion, step: float) -> Float32Array:
    """Means of 2 x 2 counts as heights rounded to `step`; at least half of what is there is valid.

    An odd last row or column has fewer than four counts to average.
    """
    rows, cols = raw.shape
    out = np.empty(((rows + 1) // 2, (cols + 1) // 2), np.float32)
    for i in range(rows // 2):
        _average_row_pair(raw[2 * i], raw[2 * i + 1], convert, step, out[i])
    for i in range(out.shape[0]):
        for j in range(cols // 2 if i < rows // 2 else 0, out.shape[1]):
            total, valid, there = 0.0, 0, 0
            for r in range(2 * i, min(2 * i + 2, rows)):
                for c in range(2 * j, min(2 * j + 2, cols)):
                    value = float(raw[r, c])
                    there += 1
                    if is_height(value, convert):
                        total += value
                        valid += 1
            if 2 * valid >= there and valid > 0:
                mean = total / valid * convert.scale_m + convert.offset_m
                out[i, j] = np.round(mean / step) * step
            else:
                out[i, j] = np.nan
    return out
