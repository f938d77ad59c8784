"""Several terrain models as one surface: the first by priority that knows a place gives its height.

A height is an area mean about as wide as the posting asked for: it is read from the overview that
fits, with columns averaged where they crowd (toward the poles of a cylindrical map); a footprint
that is wider still is averaged from several samples, never one picked.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from catalog.bodies.body import Body
from catalog.geometry.projection import Stereographic
from catalog.progress import Progress
from catalog.terrain.footprint import sample_level
from catalog.terrain.georeference import Georeference
from catalog.terrain.level_window import LevelWindows, TileCache
from catalog.terrain.map_nodes import Pixels, pixels_of_grid, pixels_of_points
from catalog.terrain.pyramid import HeightPyramid
from catalog.terrain.source import DemSettings

HeightGrid = NDArray[np.float32]


class Mosaic:
    """Pyramids in order of priority, sampled as one. Not safe across threads; pickles by path."""

    def __init__(self, pyramids: Sequence[HeightPyramid]) -> None:
        if not pyramids:
            raise ValueError("a mosaic needs at least one terrain model")
        self.pyramids = tuple(pyramids)
        self.body = pyramids[0].source.body
        # one that shows all of the body without a hole: whatever is asked for has ground
        self._whole = any(p.covers_the_body for p in pyramids)
        self._reset()

    def _reset(self) -> None:
        self._cache = TileCache()
        self._sheets: dict[tuple[int, int], LevelWindows] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"pyramids": self.pyramids, "body": self.body, "_whole": self._whole}

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
        return self._at(lat, lon, posting_m)[0]

    def source_index(self, lat: ArrayLike, lon: ArrayLike) -> NDArray[np.int8]:
        """Which source (from 0, by priority) gives the height of points (rad); -1 for none."""
        return self._at(lat, lon, self.posting_m)[1]

    def covers(
        self, lat: ArrayLike, lon: ArrayLike, posting_m: float | None = None
    ) -> NDArray[np.bool_]:
        """Whether points (rad) have a height; a coarser posting answers from overviews, quicker."""
        if self._whole:
            return np.ones(np.broadcast_shapes(np.shape(lat), np.shape(lon)), dtype=bool)
        return np.isfinite(self.heights(lat, lon, posting_m or self.posting_m))

    def local_grid(self, projection: Stereographic, posting_m: float, size: int) -> HeightGrid:
        """Heights (size, size) of a centred map grid; row 0 north, column 0 west."""

        def nodes(place: Georeference) -> Pixels:
            return pixels_of_grid(place, projection, posting_m, size)

        return self._sample(nodes, size * size, posting_m)[0].reshape(size, size)

    def _at(
        self, lat: ArrayLike, lon: ArrayLike, posting_m: float
    ) -> tuple[HeightGrid, NDArray[np.int8]]:
        lat, lon = np.broadcast_arrays(
            np.asarray(lat, dtype=np.float64), np.asarray(lon, dtype=np.float64)
        )
        flat = np.ascontiguousarray(lat).ravel(), np.ascontiguousarray(lon).ravel()
        heights, index = self._sample(lambda p: pixels_of_points(p, *flat), lat.size, posting_m)
        return heights.reshape(lat.shape), index.reshape(lat.shape)

    def close(self) -> None:
        """Let go of files and cached tiles."""
        for pyramid in self.pyramids:
            pyramid.close()
        self._reset()

    def _sample(
        self, places: Callable[[Georeference], Pixels], count: int, posting_m: float
    ) -> tuple[HeightGrid, NDArray[np.int8]]:
        """Heights of `count` points, and the source of each; `places` finds them in a raster."""
        out = np.full(count, np.nan, dtype=np.float32)
        index = np.full(count, -1, dtype=np.int8)
        for i, pyramid in enumerate(self.pyramids):
            pixels = places(pyramid.source.place)
            level = pyramid.level_for(posting_m)
            rows_wide = posting_m / (pyramid.source.posting_m * 2.0**level)
            sheet = self._sheet(i, pyramid, level)
            if i == 0:
                out = sample_level(sheet, pixels, rows_wide)
                index[:] = np.where(np.isnan(out), -1, 0)
            else:
                missing = np.flatnonzero(np.isnan(out))
                found = sample_level(sheet, pixels.part(missing), rows_wide)
                out[missing] = found
                index[missing] = np.where(np.isnan(found), -1, i)
            if not np.isnan(out).any():
                break
        return out, index

    def _sheet(self, i: int, pyramid: HeightPyramid, level: int) -> LevelWindows:
        if (i, level) not in self._sheets:
            self._sheets[i, level] = LevelWindows(i, pyramid, level, self._cache)
        return self._sheets[i, level]
