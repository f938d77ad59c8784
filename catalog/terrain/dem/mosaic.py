"""Several terrain models as one surface: the first by priority that has a place gives its height.

A source may fade into those below it toward its edge and its holes (catalog.terrain.dem.feather).

A height is an area mean about as wide as the wanted posting: it is read from the overview that
fits, with columns averaged where they crowd (toward the poles of a cylindrical map); a footprint
that is wider still is averaged from several samples, never one picked.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, Float32Array, FloatArray, Int8Array, IntArray
from catalog.bodies.body import Body
from catalog.geometry.cells import Graticule, Part
from catalog.geometry.kernel import inplace_kernel, kernel
from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.projection import MapProjection, Stereographic
from catalog.terrain.dem.feather import Feather
from catalog.terrain.dem.georeference import CYLINDRICAL, Georeference
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.pyramid.pyramid import HeightPyramid, LevelWindows, count_halvings, tile_cache
from catalog.terrain.sampling.footprint import (
    MAX_COLUMNS,
    MAX_ROWS,
    add_weights,
    count_samples,
    sample_level,
)
from catalog.terrain.sampling.map_nodes import Pixels, locate_grid, locate_points

BLOCK = 128  # nodes a side: points are read by whole blocks, for any part


def sample_by_blocks(
    heights: Callable[[FloatArray, FloatArray, float], Float32Array],
    graticule: Graticule,
    part: Part,
    posting_m: float,
) -> Float32Array:
    """Heights (height, width) m of a part from those of points; row 0 south, column 0 west.

    heights  heights of points (latitudes and longitudes, rad) at a posting, m
    """
    out = np.empty((part.height, part.width), np.float32)
    down, along = part.rows // BLOCK, np.mod(part.cols, graticule.columns) // BLOCK
    for band in np.unique(down):
        rows = np.arange(band * BLOCK, (band + 1) * BLOCK)
        lat = np.clip(graticule.lat(rows), -np.pi / 2.0, np.pi / 2.0)
        for turn in np.unique(along):
            cols = np.arange(turn * BLOCK, min((turn + 1) * BLOCK, graticule.columns))
            block = heights(lat[:, None], graticule.lon(cols), posting_m)
            i, j = np.flatnonzero(down == band), np.flatnonzero(along == turn)
            own_rows = part.rows[i] - rows[0]
            own_cols = np.mod(part.cols[j], graticule.columns) - cols[0]
            out[np.ix_(i, j)] = block[np.ix_(own_rows, own_cols)]
    return out


def sample_by_weights(
    base: LevelWindows, pyramid: HeightPyramid, graticule: Graticule, part: Part, rows_wide: float
) -> Float32Array:
    """Heights (height, width) m of a part from a level of a cylindrical raster, NaN for none.

    rows_wide  rows of the level that a footprint is high
    A node whose footprint touches a hole has no height.
    """
    georeference = pyramid.source.georeference
    col0, cols_per_rad, row0, rows_per_rad, period = georeference.parameters
    wide = period / (graticule.columns * base.scale)
    level = base.get_halved(int(count_halvings(wide, base.most_halvings)))
    row = (row0 + rows_per_rad * graticule.lat(part.rows) + 0.5) / level.scale - 0.5
    col = col0 + cols_per_rad * georeference.longitude_sign * graticule.lon(part.cols)
    # of that turn which the raster shows
    col -= np.floor((col - (georeference.shape[1] - 1) / 2.0) / period + 0.5) * period
    col = (col + 0.5) / (level.scale * level.squeeze) - 0.5
    first_row, row_weights = _make_weights(row, rows_wide, MAX_ROWS)
    first_col, col_weights = _make_weights(col, wide / level.squeeze, MAX_COLUMNS)
    out = np.empty((part.height, part.width), np.float32)
    # neighbours in the part may be a turn apart in the raster
    most = 4.0 * wide / level.squeeze + 4.0
    cuts = np.flatnonzero(np.abs(np.diff(first_col)) > most) + 1
    top, height = int(first_row.min()), int(np.ptp(first_row)) + row_weights.shape[1]
    for those in np.split(np.arange(part.width), cuts):
        firsts, weights = first_col[those], col_weights[those]
        left, width = int(firsts.min()), int(np.ptp(firsts)) + weights.shape[1]
        window = level.window(top, left, height, width)
        part_out = out[:, those[0] : those[-1] + 1]
        line = np.empty(width, np.float32)
        _combine(window, first_row - top, row_weights, firsts - left, weights, line, part_out)
    return out


@kernel
def _make_weights(at: FloatArray, wide: float, most: int) -> tuple[IntArray, Float32Array]:
    """First pixel and weights (n, taps) of footprints about places, `wide` pixels wide."""
    samples = count_samples(wide, most)
    taps = int(np.ceil(wide)) + 5
    line = np.zeros(taps + 8)
    first = np.empty(at.size, np.int64)
    out = np.zeros((at.size, taps), np.float32)
    used = 0
    for i in range(at.size):
        first[i], count = add_weights(at[i], wide, samples, line)
        for k in range(count):
            out[i, k] = line[k]
        used = max(used, count)
    return first, out[:, :used].copy()


@inplace_kernel
def _combine(
    window: Float32Array,
    first_row: IntArray,
    row_weights: Float32Array,
    first_col: IntArray,
    col_weights: Float32Array,
    line: Float32Array,
    out: Float32Array,
) -> None:
    """Weighted sums down, in `line` (columns of the window,), then along."""
    taps = col_weights.shape[1]
    for i in range(out.shape[0]):
        line[:] = np.float32(0.0)
        for k in range(row_weights.shape[1]):
            weight, source = row_weights[i, k], window[first_row[i] + k]
            if weight != 0.0:
                for c in range(line.size):
                    line[c] += weight * source[c]
        for j in range(out.shape[1]):
            total = np.float32(0.0)
            start = np.uint64(first_col[j])
            for k in range(np.uint64(taps)):
                total += col_weights[j, k] * line[start + k]
            out[i, j] = total


class Sampled(NamedTuple):
    """Points read from a mosaic.

    heights  (n) float32, NaN for none
    source   (n) the source that counts most, -1 for none
    used     (sources that were read, n) whether a source counts at all
    """

    heights: Float32Array
    source: Int8Array
    used: BoolArray


class Mosaic:
    """Pyramids in order of priority, sampled as one. Not safe across threads; pickles by path."""

    has_graticules = True
    own_planes = False
    in_planes = False

    def __init__(self, pyramids: Sequence[HeightPyramid]) -> None:
        if not pyramids:
            raise ValueError("a mosaic needs at least one terrain model")
        self.pyramids = tuple(pyramids)
        self.body = pyramids[0].source.body
        # one that shows all of the body without a hole: every place has ground
        self.covers_body = any(p.covers_the_body for p in pyramids)
        self.posting_m = min(p.source.posting_m for p in pyramids)  # the finest of all
        self._reset()

    def _reset(self) -> None:
        self._cache = tile_cache()
        self._levels: dict[tuple[int, int], LevelWindows] = {}
        self._feathers: dict[int, Feather | None] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if not k.startswith("_")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._reset()

    @classmethod
    def from_files(
        cls, settings: Sequence[DemSettings], base_dir: Path, body: Body, overview_dir: Path
    ) -> "Mosaic":
        """A mosaic of [[dem]] sections; overviews that `overview_dir` does not hold yet are made.

        Raises DataError for a file that cannot be used and OutputError for an unwritable folder.
        """
        pyramids = [
            HeightPyramid.load_or_build(
                source_settings, base_dir, body, overview_dir / f"dem-{i:02d}"
            )
            for i, source_settings in enumerate(sorted(settings, key=lambda s: s.priority))
        ]
        return cls(pyramids)

    @property
    def names(self) -> tuple[str, ...]:
        """File names in order of priority, as `source_index` counts them.

        Of two with one name the second has its priority added.
        """
        names: list[str] = []
        for source in (pyramid.source for pyramid in self.pyramids):
            name = source.path.name
            names.append(name if name not in names else f"{name} ({source.settings.priority})")
        return tuple(names)

    @property
    def extent(self) -> str:
        """The ground that it covers: west, south, east, north of each source."""
        return "; ".join(
            f"{s.path.name} covers {','.join(f'{v:.6g}' for v in np.degrees(s.latlon_bounds()))}"
            for s in (pyramid.source for pyramid in self.pyramids)
        )

    @property
    def latitudes(self) -> tuple[float, float]:
        """The southernmost and northernmost ground, rad."""
        bounds = [pyramid.source.latlon_bounds()[1::2] for pyramid in self.pyramids]
        return min(south for south, _ in bounds), max(north for _, north in bounds)

    def files(self) -> list[Path]:
        """The sources' files and their overviews."""
        paths: set[Path] = set()
        for pyramid in self.pyramids:
            paths.update(pyramid.source.files)
            paths.update(path for path in pyramid.folder.iterdir() if path.is_file())
        return sorted(paths)

    def projection(self, lat: float, lon: float) -> Stereographic:
        """The map projection of patches about a place (rad)."""
        return Stereographic(lat, lon, self.body.radius_m)

    def points(self, lat: ArrayLike, lon: ArrayLike) -> FloatArray:
        """Directions (..., 3) of places (rad): radial heights change no x and y of a map."""
        return xyz_from_latlon(lat, lon, 1.0)

    def overhangs(self, projection: MapProjection, posting_m: float, size: int) -> bool:
        """False: a raster has one height a place."""
        return False

    def make_outer_grids(
        self, projection: MapProjection, posting_m: float, size: int
    ) -> Sequence[tuple[Float32Array, float]]:
        """None: the coarsest patches reach farther than shadows do."""
        return ()

    def heights(self, lat: ArrayLike, lon: ArrayLike, posting_m: float) -> Float32Array:
        """Heights (float32, m above the reference sphere, NaN for none) of points (rad).

        lat, lon   (...)  planetocentric latitude, east longitude of any turn
        posting_m  the spacing of the points: what is finer is averaged
        """
        sampled, shape = self._sample_points(lat, lon, posting_m)
        return sampled.heights.reshape(shape)

    def source_index(self, lat: ArrayLike, lon: ArrayLike) -> Int8Array:
        """Which source (from 0, by priority) counts most at points (rad); -1 for none."""
        sampled, shape = self._sample_points(lat, lon, self.posting_m)
        return sampled.source.reshape(shape)

    def covers(self, lat: ArrayLike, lon: ArrayLike, posting_m: float | None = None) -> BoolArray:
        """Whether points (rad) have a height; a coarser posting answers from overviews, quicker."""
        if self.covers_body:
            return np.ones(np.broadcast_shapes(np.shape(lat), np.shape(lon)), dtype=bool)
        sampled, shape = self._sample_points(lat, lon, posting_m or self.posting_m)
        covered: BoolArray = sampled.source.reshape(shape) >= 0
        return covered

    def local_grid(self, projection: MapProjection, posting_m: float, size: int) -> Float32Array:
        """Heights (size, size) of a centred map grid; row 0 north, column 0 west."""
        return self._sample_grid(projection, posting_m, size).heights.reshape(size, size)

    def graticule_heights(
        self, graticule: Graticule, part: Part, posting_m: float, latitudes: tuple[float, float]
    ) -> Float32Array:
        """Heights (height, width) m of a part of a graticule, see `Terrain.graticule_heights`.

        Where one cylindrical source serves the zone, a node whose footprint touches a hole has no
        height.
        """
        # south and north of each source
        bounds = [p.source.latlon_bounds()[1::2] for p in self.pyramids]
        least, most = latitudes
        meeting = [i for i, (south, north) in enumerate(bounds) if south <= most and north >= least]
        if not meeting:
            return np.full((part.height, part.width), np.nan, dtype=np.float32)
        pyramid = self.pyramids[meeting[0]]
        if len(meeting) > 1 or pyramid.source.georeference.kind != CYLINDRICAL:
            return sample_by_blocks(self.heights, graticule, part, posting_m)
        level = pyramid.choose_level(posting_m)
        rows_wide = posting_m / (pyramid.source.posting_m * 2.0**level)
        windows = self.get_level_windows(meeting[0], level)
        return sample_by_weights(windows, pyramid, graticule, part, rows_wide)

    def provenance(self, projection: MapProjection, posting_m: float, size: int) -> str:
        """Names of the sources that a centred map grid is read from, joined by " + ".

        The one that counts most at its middle comes first, the others by priority; empty where
        there is no ground.
        """
        if len(self.pyramids) == 1:
            return self.names[0] if self.covers(projection.lat, projection.lon, posting_m) else ""
        sampled = self._sample_grid(projection, posting_m, size)
        numbers = np.flatnonzero(sampled.used.any(axis=1)).tolist()
        middle = int(self.source_index(projection.lat, projection.lon))
        return " + ".join(self.names[i] for i in sorted(numbers, key=lambda i: (i != middle, i)))

    def _sample_grid(self, projection: MapProjection, posting_m: float, size: int) -> Sampled:
        if not isinstance(projection, Stereographic):
            raise TypeError("rasters have radial heights: they fill stereographic grids only")

        def nodes(place: Georeference) -> Pixels:
            return locate_grid(place, projection, posting_m, size)

        return self._sample(nodes, size * size, posting_m, size)

    def _sample_points(
        self, lat: ArrayLike, lon: ArrayLike, posting_m: float
    ) -> tuple[Sampled, tuple[int, ...]]:
        lat, lon = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (lat, lon)))
        flat = np.ascontiguousarray(lat).ravel(), np.ascontiguousarray(lon).ravel()
        return self._sample(lambda p: locate_points(p, *flat), lat.size, posting_m), lat.shape

    def close(self) -> None:
        """Close files and drop cached tiles."""
        for pyramid in self.pyramids:
            pyramid.close()
        self._reset()

    def _sample(
        self, places: Callable[[Georeference], Pixels], count: int, posting_m: float, size: int = 0
    ) -> Sampled:
        """Heights of `count` points; `places` finds them in a raster.

        size  nodes a row of the map grid that they are, 0 for scattered ones
        """
        layers: list[tuple[IntArray, Float32Array, FloatArray]] = []
        wanted = np.arange(count if len(self.pyramids) > 1 else 0)  # one source gives all
        for i, pyramid in enumerate(self.pyramids):
            pixels = places(pyramid.source.georeference)
            if layers:
                pixels = pixels.part(wanted)
            level = pyramid.choose_level(posting_m)
            rows_wide = posting_m / (pyramid.source.posting_m * 2.0**level)
            grid_size = size if not layers or wanted.size == count else 0
            sampled = sample_level(self.get_level_windows(i, level), pixels, rows_wide, grid_size)
            known = ~np.isnan(sampled)
            if len(self.pyramids) == 1:
                # nothing to compose: the usual case, and it is on the hot path of a build
                return Sampled(sampled, known.astype(np.int8) - np.int8(1), known[None])
            weight = known.astype(np.float64)
            feather = self._get_feather(i)
            if feather is not None and known.any():
                inside = np.flatnonzero(known)
                weight[inside] = feather.weights(pixels.part(inside))
            if i == 0 and weight.min(initial=1.0) >= 1.0:
                return Sampled(sampled, known.astype(np.int8) - np.int8(1), known[None])
            layers.append((wanted, sampled, weight))
            wanted = wanted[weight < 1.0]
            if not wanted.size:
                break
        return _merge_layers(layers, count)

    def _get_feather(self, i: int) -> Feather | None:
        """The seam of a source; None for a hard edge, one without any and the lowest source."""
        if i not in self._feathers:
            pyramid = self.pyramids[i]
            hard = pyramid.source.settings.feather_km == 0.0 or pyramid.covers_the_body
            last = i == len(self.pyramids) - 1
            self._feathers[i] = None if hard or last else Feather(i, pyramid, self._cache)
        return self._feathers[i]

    def get_level_windows(self, i: int, level: int) -> LevelWindows:
        """One level of a source, by its number."""
        if (i, level) not in self._levels:
            self._levels[i, level] = LevelWindows(i, self.pyramids[i], level, self._cache)
        return self._levels[i, level]


def _merge_layers(
    layers: Sequence[tuple[IntArray, Float32Array, FloatArray]], count: int
) -> Sampled:
    """One height a point from those of the sources: point numbers, heights, weights, in order."""
    heights = np.full(count, np.nan, dtype=np.float32)
    source = np.full(count, -1, dtype=np.int8)
    used = np.zeros((len(layers), count), dtype=bool)
    for i in reversed(range(len(layers))):
        wanted, sampled, weight = layers[i]
        below = heights[wanted]
        known = ~np.isnan(sampled)
        alone = known & (np.isnan(below) | (weight >= 1.0))
        mixed = known & ~alone
        heights[wanted[alone]] = sampled[alone]
        share = weight[mixed]
        # from below upward, so that a weight of 0 leaves exactly what lies below
        upper, lower = sampled[mixed].astype(np.float64), below[mixed].astype(np.float64)
        heights[wanted[mixed]] = lower + share * (upper - lower)
        source[wanted[alone | (mixed & (weight >= 0.5))]] = i
        used[i + 1 :, wanted[alone]] = False
        used[i, wanted[alone | (mixed & (weight > 0.0))]] = True
    return Sampled(heights, source, used)
