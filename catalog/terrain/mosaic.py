"""Several terrain models as one surface: the first by priority that knows a place gives its height.

A height is an area mean about as wide as the posting asked for: it is read from the overview that
fits, and where the raster is finer than that (columns crowd toward the poles of a cylindrical map)
several samples over the footprint are averaged, never one picked.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from catalog.bodies.body import Body
from catalog.geometry.grid import bicubic_at
from catalog.geometry.kernel import kernel
from catalog.geometry.projection import Stereographic
from catalog.progress import Progress
from catalog.terrain.level_window import LevelWindows, TileCache
from catalog.terrain.pyramid import HeightPyramid
from catalog.terrain.source import DemSettings

FloatArray = NDArray[np.float64]
HeightGrid = NDArray[np.float32]

# A window larger than this (pixels, 64 MB) is cut into pieces: scattered points must not pull the
# whole raster into memory.
LARGEST_WINDOW = 16 << 20
PIECE = 512  # pixels a side of the raster that pieces are sorted by
# Columns averaged into one node. Beyond it (the last postings about a pole) samples are spread:
# rasters are oversampled there, so neighbours in a row say the same.
MOST_COLUMNS = 64


class Mosaic:
    """Pyramids in order of priority, sampled as one. Not safe across threads; pickles by path."""

    def __init__(self, pyramids: Sequence[HeightPyramid]) -> None:
        if not pyramids:
            raise ValueError("a mosaic needs at least one terrain model")
        self.pyramids = tuple(pyramids)
        self.body = pyramids[0].source.body
        self._reset()

    def _reset(self) -> None:
        self._cache = TileCache()
        self._sheets: dict[tuple[int, int], LevelWindows] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"pyramids": self.pyramids, "body": self.body}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._reset()

    @classmethod
    def from_files(
        cls,
        settings: Sequence[DemSettings],
        base_dir: Path,
        body: Body,
        overview_dir: Path,
        workers: int = 1,
        progress: Progress | None = None,
    ) -> "Mosaic":
        """A mosaic of [[dem]] sections; overviews that `overview_dir` does not hold yet are made.

        Raises DataError for a file that cannot be used and OutputError for an unwritable folder.
        """
        ordered = sorted(settings, key=lambda s: s.priority)
        return cls(
            [
                HeightPyramid.load_or_build(
                    one, base_dir, body, overview_dir / f"dem-{i:02d}", workers, progress
                )
                for i, one in enumerate(ordered)
            ]
        )

    @property
    def posting_m(self) -> float:
        """The finest posting of all sources."""
        return min(p.source.posting_m for p in self.pyramids)

    @property
    def names(self) -> tuple[str, ...]:
        """File names in order of priority, as `source_index` counts them."""
        return tuple(p.source.path.name for p in self.pyramids)

    def heights(self, lat: ArrayLike, lon: ArrayLike, posting_m: float) -> HeightGrid:
        """Heights (float32, m above the reference sphere, NaN for none) of points (rad).

        lat, lon   (...)  planetocentric latitude, east longitude of any turn
        posting_m  the spacing these points stand for: what is finer is averaged
        """
        return self._sample(lat, lon, posting_m)[0]

    def source_index(self, lat: ArrayLike, lon: ArrayLike) -> NDArray[np.int8]:
        """Which source (from 0, by priority) gives the height of points (rad); -1 for none."""
        return self._sample(lat, lon, self.posting_m)[1]

    def covers(
        self, lat: ArrayLike, lon: ArrayLike, posting_m: float | None = None
    ) -> NDArray[np.bool_]:
        """Whether points (rad) have a height; a coarser posting answers from overviews, quicker."""
        return np.isfinite(self.heights(lat, lon, posting_m or self.posting_m))

    def local_grid(self, projection: Stereographic, posting_m: float, size: int) -> HeightGrid:
        """Heights (size, size) of a centred map grid; row 0 north, column 0 west."""
        lat, lon = np.empty(size * size), np.empty(size * size)
        _nodes(projection.body_from_local, size, posting_m, projection.radius_m, lat, lon)
        return self._sample(lat, lon, posting_m)[0].reshape(size, size)

    def close(self) -> None:
        """Let go of files and cached tiles."""
        for pyramid in self.pyramids:
            pyramid.close()
        self._reset()

    def _sample(
        self, lat: ArrayLike, lon: ArrayLike, posting_m: float
    ) -> tuple[HeightGrid, NDArray[np.int8]]:
        lat, lon = np.broadcast_arrays(
            np.asarray(lat, dtype=np.float64), np.asarray(lon, dtype=np.float64)
        )
        shape = lat.shape
        lat, lon = lat.ravel(), lon.ravel()
        out = np.full(lat.size, np.nan, dtype=np.float32)
        index = np.full(lat.size, -1, dtype=np.int8)
        for i, pyramid in enumerate(self.pyramids):
            missing = np.flatnonzero(np.isnan(out))
            if missing.size == 0:
                break
            found = self._sample_one(i, pyramid, lat[missing], lon[missing], posting_m)
            out[missing] = found
            index[missing] = np.where(np.isnan(found), -1, i)
        return out.reshape(shape), index.reshape(shape)

    def _sample_one(
        self, i: int, pyramid: HeightPyramid, lat: FloatArray, lon: FloatArray, posting_m: float
    ) -> HeightGrid:
        level = pyramid.level_for(posting_m)
        sheet = self._sheet(i, pyramid, level)
        col, row = pyramid.source.pixel_from_latlon(lat, lon)
        # pixel centres of a level that averages 2^level pixels a side
        col, row = (col + 0.5) / sheet.scale - 0.5, (row + 0.5) / sheet.scale - 0.5
        rows_wide = posting_m / (pyramid.source.posting_m * sheet.scale)
        wide = pyramid.source.place.columns_per_posting(rows_wide, lat)
        if sheet.period:
            wide = np.minimum(wide, sheet.period)
            # continuous about the points (or about the raster, which then has no seam inside)
            middle = col[0] if sheet.wraps and col.size else (sheet.shape[1] - 1) / 2.0
            turns = np.floor((col - middle) / sheet.period + 0.5)
            col = col - turns * sheet.period
        out = np.full(lat.size, np.nan, dtype=np.float32)
        rows, cols = sheet.shape
        inside = (row >= -0.5) & (row <= rows - 0.5)
        if not sheet.wraps:
            inside &= (col >= -0.5 - wide / 2.0) & (col <= cols - 0.5 + wide / 2.0)
        chosen = np.flatnonzero(inside)
        if chosen.size == lat.size > 0:
            self._in_pieces(sheet, row, col, wide, rows_wide, out)
        elif chosen.size:
            part = np.full(chosen.size, np.nan, dtype=np.float32)
            self._in_pieces(sheet, row[chosen], col[chosen], wide[chosen], rows_wide, part)
            out[chosen] = part
        return out

    def _in_pieces(
        self,
        sheet: LevelWindows,
        row: FloatArray,
        col: FloatArray,
        wide: FloatArray,
        rows_wide: float,
        out: HeightGrid,
    ) -> None:
        """Sample through one window, or through one for each part of the raster that is touched."""
        if _window_size(row, col, wide, rows_wide) <= LARGEST_WINDOW:
            _through_window(sheet, row, col, wide, rows_wide, out)
            return
        key = np.floor(row / PIECE) * 1e6 + np.floor(col / PIECE)
        order = np.argsort(key, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
            piece = np.empty(part.size, dtype=np.float32)
            _through_window(sheet, row[part], col[part], wide[part], rows_wide, piece)
            out[part] = piece

    def _sheet(self, i: int, pyramid: HeightPyramid, level: int) -> LevelWindows:
        if (i, level) not in self._sheets:
            self._sheets[i, level] = LevelWindows(i, pyramid, level, self._cache)
        return self._sheets[i, level]


def _bounds(
    row: FloatArray, col: FloatArray, wide: FloatArray, rows_wide: float
) -> tuple[int, int, int, int]:
    """First row, first column, height and width of the window that all footprints need."""
    half = rows_wide / 2.0 + 2.0  # two more pixels for the cubic's neighbours
    row0 = int(np.floor(row.min() - half))
    row1 = int(np.ceil(row.max() + half))
    col0 = int(np.floor((col - wide / 2.0).min() - 2.0))
    col1 = int(np.ceil((col + wide / 2.0).max() + 2.0))
    return row0, col0, row1 - row0 + 1, col1 - col0 + 1


def _window_size(row: FloatArray, col: FloatArray, wide: FloatArray, rows_wide: float) -> int:
    _, _, height, width = _bounds(row, col, wide, rows_wide)
    return height * width


def _through_window(
    sheet: LevelWindows,
    row: FloatArray,
    col: FloatArray,
    wide: FloatArray,
    rows_wide: float,
    out: HeightGrid,
) -> None:
    row0, col0, height, width = _bounds(row, col, wide, rows_wide)
    window = sheet.window(row0, col0, height, width)
    _mean_over_footprints(window, row - row0, col - col0, wide, rows_wide, MOST_COLUMNS, out)


@kernel
def _mean_over_footprints(
    window: HeightGrid,
    row: FloatArray,
    col: FloatArray,
    wide: FloatArray,
    rows_wide: float,
    most_columns: int,
    out: HeightGrid,
) -> None:
    """Means of cubic samples over footprints of `wide` columns and `rows_wide` rows.

    A footprint below 1.5 pixels is one sample: the level was chosen to fit.
    """
    down = max(1, int(np.floor(rows_wide + 0.5)))
    for i in range(row.size):
        along = min(max(1, int(np.floor(wide[i] + 0.5))), most_columns)
        total, valid = 0.0, 0
        for r in range(down):
            at_row = row[i] + ((r + 0.5) / down - 0.5) * rows_wide
            for c in range(along):
                at_col = col[i] + ((c + 0.5) / along - 0.5) * wide[i]
                value = bicubic_at(window, at_row, at_col)
                if value == value:
                    total += value
                    valid += 1
        out[i] = total / valid if 2 * valid >= down * along and valid > 0 else np.nan


@kernel
def _nodes(
    body_from_local: FloatArray,
    size: int,
    posting_m: float,
    radius_m: float,
    lat: FloatArray,
    lon: FloatArray,
) -> None:
    """Latitude and longitude of a map grid's nodes (see catalog.geometry.projection)."""
    m = body_from_local
    half = (size - 1) / 2.0
    for i in range(size):
        v = (half - i) * posting_m / (2.0 * radius_m)
        for j in range(size):
            u = (j - half) * posting_m / (2.0 * radius_m)
            squared = u * u + v * v
            scale = 1.0 / (1.0 + squared)
            e, n, up = 2.0 * u * scale, 2.0 * v * scale, (1.0 - squared) * scale
            x = m[0, 0] * e + m[0, 1] * n + m[0, 2] * up
            y = m[1, 0] * e + m[1, 1] * n + m[1, 2] * up
            z = m[2, 0] * e + m[2, 1] * n + m[2, 2] * up
            lat[i * size + j] = np.arctan2(z, np.sqrt(x * x + y * y))
            lon[i * size + j] = np.arctan2(y, x)
