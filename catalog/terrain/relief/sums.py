"""Sums over the cells of a whole-body grid, from rasters of any map: means and highest pixels.

A pixel of a cylindrical raster counts in each cell by the share of the cell that it covers, so that
neither its posting nor its first longitude need fit the grid. Pixels of other maps count whole in
the cell that their middle lies in.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.bodies.body import Body
from catalog.errors import DataError
from catalog.geometry.kernel import kernel
from catalog.progress import Progress, SilentProgress
from catalog.terrain.dem.georeference import CYLINDRICAL, Georeference
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.dem.validity import HeightSample
from catalog.terrain.error_model import StatedError, TerrainErrorModel
from catalog.terrain.relief.relief import GlobalRelief

Window = tuple[int, int, int, int]  # first row, first column, height, width

WINDOW = 2048  # pixels a side that are read at once: 25 MB as counts and heights
MAX_STRIP = 4096  # blocks longer than this and few rows thick are read by whole rows
# A pixel reaches into a cell by more than this share of itself, or not at all: writers round
# postings, which moves the far edge of a global raster by some hundredths of a pixel.
SLIVER = 0.02
ROWS = 2880  # 16 a degree: 1.9 km of lunar ground, fine enough for a horizon
MIN_COVERAGE = 0.99  # of the sphere; the rest is filled from its surroundings


class Layer(NamedTuple):
    """Heights of one raster, perhaps of an overview of it.

    georeference  of the raster at its own posting
    level         halvings of it that `read` gives
    shape         rows and columns at that level
    block         rows and columns that its file keeps together
    read          heights (height, width) m of a window
    """

    georeference: Georeference
    level: int
    shape: tuple[int, int]
    block: tuple[int, int]
    read: Callable[[int, int, int, int], Float32Array]

    def windows(self) -> list[Window]:
        """Windows that make up the raster, no larger than WINDOW squared."""
        rows, cols = self.shape
        tall = wide = WINDOW
        if self.block[1] > MAX_STRIP and self.block[0] <= 16:
            tall, wide = max(self.block[0], WINDOW * WINDOW // cols), cols
        return [
            (row, col, min(tall, rows - row), min(wide, cols - col))
            for row in range(0, rows, tall)
            for col in range(0, cols, wide)
        ]


class Cells(NamedTuple):
    """The cells (n, 2n) of a grid as kernels take them.

    heights      m: sums over pixels by the share of the cell that each covers, or means
    shares       of the cell that has heights
    max_heights  m
    """

    heights: FloatArray | Float32Array
    shares: Float32Array
    max_heights: Float32Array


class CellSums:
    """Mean and greatest heights of the cells (n, 2n) of a whole-body grid.

    Row 0 lies at the north pole, column 0 at longitude -180.
    means        (n, 2n) m, 0 where `shares` is 0
    shares       (n, 2n) share of the cell that has heights, 0 to 1
    max_heights  (n, 2n) m, of the pixels
    """

    def __init__(self, rows: int) -> None:
        self.means = np.zeros((rows, 2 * rows), np.float32)
        self.shares = np.zeros((rows, 2 * rows), np.float32)
        self.max_heights = np.full((rows, 2 * rows), -np.inf, np.float32)

    @property
    def coverage(self) -> float:
        """Share of the sphere's surface that has heights."""
        edges = np.sin(np.linspace(np.pi / 2.0, -np.pi / 2.0, self.shares.shape[0] + 1))
        return float((edges[:-1] - edges[1:]) @ self.shares.mean(axis=1, dtype=np.float64) / 2.0)

    def fill_from(self, layer: Layer, progress: Progress) -> tuple[float, float]:
        """Add the heights of a raster where the cells have none yet.

        Returns the lowest and the highest of the raster, m. Raises DataError for a damaged file.
        """
        lowest, highest = np.inf, -np.inf
        max_heights = np.full_like(self.max_heights, -np.inf)
        new = Cells(np.zeros(self.means.shape), np.zeros_like(self.shares), max_heights)
        windows = layer.windows()
        with progress.stage("relief", total=len(windows), unit="window") as stage:
            for window in windows:
                pixels = layer.read(*window)
                if layer.georeference.kind == CYLINDRICAL:
                    low, high = _add_overlaps(
                        pixels, *_locate_edges(layer, len(self.means), window), new
                    )
                else:
                    low, high = _add_middles(
                        pixels, *_locate_middles(layer, len(self.means), window), new
                    )
                lowest, highest = min(lowest, low), max(highest, high)
                stage.advance()
        _join(new, Cells(self.means, self.shares, self.max_heights))
        return lowest, highest

    def fill(self) -> None:
        """Give cells without a height that of their neighbours, ring by ring from the holes' edges.

        Greatest heights are filled in the same way: ground that was not measured is taken to be as
        high as the ground about it.
        """
        holes = np.argwhere(self.shares == 0.0)
        while holes.size:
            estimates = _average_neighbours(holes, self.means, self.shares, self.max_heights)
            known = np.isfinite(estimates[:, 0])
            if not known.any():
                return
            row, col = holes[known].T
            self.means[row, col], self.max_heights[row, col] = estimates[known].T
            self.shares[row, col] = 1.0
            holes = holes[~known]


def build_relief(source: DemSource, rows: int | None = None) -> GlobalRelief:
    """The relief of a terrain model that shows the whole body, read once, window by window.

    rows  of the relief; without it the model's own, but no more than ROWS
    Raises DataError for a damaged file, one of a part of the body or with impossible heights.
    """
    check_share(
        measure_share_within_bounds(source), source.path, source.body
    )  # before all of it is read
    sums = CellSums(rows or count_rows(source.georeference.row_angle))
    add_dem(sums, source, SilentProgress())
    check_share(sums.coverage, source.path, source.body)
    return finish_relief(sums, source.body.radius_m, source.path.name)


def measure_share_within_bounds(source: DemSource) -> float:
    """Share of the body within a terrain model's bounds, 1 if unknown: it shows no more."""
    west, south, east, north = source.latlon_bounds()
    if not np.isfinite([west, south, east, north]).all():  # a map with corners beyond the body
        return 1.0
    return float((np.sin(north) - np.sin(south)) * (east - west) / (4.0 * np.pi))


def check_share(share: float, who: object, body: Body) -> None:
    """Raise DataError unless this share of a body, which `who` shows, is enough for a relief."""
    if share < MIN_COVERAGE:
        raise DataError(
            f"{who}: {100.0 * share:.3g} % of {body.name} is shown; a relief wants "
            f"{100.0 * MIN_COVERAGE:g} %: name a terrain model of the whole body"
        )


def add_dem(sums: CellSums, source: DemSource, progress: Progress) -> None:
    """Lay a terrain model, at its own posting, under what the cells have.

    Raises DataError for a damaged file or one with impossible heights.
    """
    sample = HeightSample(source.shape)

    def read(row: int, col: int, height: int, width: int) -> Float32Array:
        heights = source.read_window(row, col, height, width)
        sample.add(heights)
        return heights

    layer = Layer(source.georeference, 0, source.shape, source.block_shape, read)
    lowest_m, highest_m = sums.fill_from(layer, progress)
    if lowest_m <= highest_m:
        source.check_sample(sample.heights)
        source.check_heights(lowest_m, highest_m)


def count_rows(row_angle: float) -> int:
    """Rows of the relief of a terrain model with so much of latitude (rad) between its rows."""
    return min(ROWS, round(np.pi / row_angle))


def finish_relief(sums: CellSums, radius_m: float, source: str) -> GlobalRelief:
    """The relief of sums over nearly all cells; holes are filled."""
    sums.fill()
    # a mean rounded to float32 may pass the pixels that it is of
    return GlobalRelief(sums.means, np.maximum(sums.max_heights, sums.means), radius_m, source)


@lru_cache(maxsize=2)
def load_relief(path: str, body: Body, stated: StatedError | None = None) -> GlobalRelief:
    """The relief of a terrain model file, "bundled:NAME" for one that travels with optnav.

    stated  of the model's error
    Read once a process. Raises DataError.
    """
    # a file by itself has no section in which more could be stated
    section = "[relief] dem of a build config, whose catalog carries the relief"
    source = DemSource.open(DemSettings(path=path), Path(), body, section, "check the path")
    try:
        relief = build_relief(source)
        error = TerrainErrorModel.make(stated or StatedError(), relief.posting_m)
        return relief if error is None else replace(relief, error_m=error.error_m)
    finally:
        source.close()


def _locate_edges(layer: Layer, rows: int, window: Window) -> tuple[FloatArray, FloatArray]:
    """Cell rows (height + 1) and columns (width + 1) of a window's pixel edges, fractional."""
    row, col, height, width = window
    col0, cols_per_rad, row0, rows_per_rad, _ = layer.georeference.parameters
    step = 2.0**layer.level
    edge_row = np.minimum((row + np.arange(height + 1)) * step, layer.georeference.shape[0]) - 0.5
    edge_col = np.minimum((col + np.arange(width + 1)) * step, layer.georeference.shape[1]) - 0.5
    lat = (edge_row - row0) / rows_per_rad
    lon = (edge_col - col0) / cols_per_rad * layer.georeference.longitude_sign
    return (np.pi / 2.0 - lat) * (rows / np.pi), (lon + np.pi) * (rows / np.pi)


def _locate_middles(layer: Layer, rows: int, window: Window) -> tuple[FloatArray, FloatArray]:
    """Cell row and column (height, width) of a window's pixel centres, fractional; NaN for none."""
    row, col, height, width = window
    step = 2.0**layer.level
    at_row, at_col = np.mgrid[row : row + height, col : col + width] + 0.5
    lat, lon = layer.georeference.latlon_from_pixel(at_col * step - 0.5, at_row * step - 0.5)
    return (np.pi / 2.0 - lat) * (rows / np.pi), (lon + np.pi) * (rows / np.pi)


@kernel
def _add_overlaps(
    pixels: Float32Array, down: FloatArray, along: FloatArray, cells: Cells
) -> tuple[float, float]:
    """Add pixels to all cells that they reach into; returns their lowest and highest height."""
    rows, cols = cells.heights.shape
    lowest, highest = np.inf, -np.inf
    for i in range(pixels.shape[0]):
        north = min(max(min(down[i], down[i + 1]), 0.0), float(rows))
        south = min(max(max(down[i], down[i + 1]), 0.0), float(rows))
        for r in range(int(np.floor(north)), int(np.ceil(south))):
            tall = min(south, r + 1.0) - max(north, float(r))
            if tall <= SLIVER * (south - north):
                continue
            for j in range(pixels.shape[1]):
                value = pixels[i, j]
                if np.isnan(value):
                    continue
                lowest, highest = min(lowest, value), max(highest, value)
                west, east = min(along[j], along[j + 1]), max(along[j], along[j + 1])
                for c in range(int(np.floor(west)), int(np.ceil(east))):
                    wide = min(east, c + 1.0) - max(west, float(c))
                    if wide <= SLIVER * (east - west):
                        continue
                    _add_height(value, tall * wide, r, c % cols, cells)
    return lowest, highest


@kernel
def _add_middles(
    pixels: Float32Array, down: FloatArray, along: FloatArray, cells: Cells
) -> tuple[float, float]:
    """Add each pixel whole to the cell of its middle; returns their lowest and highest height."""
    rows, cols = cells.heights.shape
    lowest, highest = np.inf, -np.inf
    for i in range(pixels.shape[0]):
        for j in range(pixels.shape[1]):
            value = pixels[i, j]
            if np.isnan(value) or not np.isfinite(down[i, j] + along[i, j]):
                continue
            lowest, highest = min(lowest, value), max(highest, value)
            r = min(max(int(np.floor(down[i, j])), 0), rows - 1)
            _add_height(value, 1.0, r, int(np.floor(along[i, j])) % cols, cells)
    return lowest, highest


@kernel
def _add_height(height: float, weight: float, row: int, col: int, cells: Cells) -> None:
    """Add a pixel's height to one cell."""
    cells.heights[row, col] += height * weight
    cells.shares[row, col] += weight
    cells.max_heights[row, col] = max(cells.max_heights[row, col], height)


@kernel
def _join(new: Cells, kept: Cells) -> None:
    """Let new sums fill what kept means still lack; a cell's greatest height is that of both."""
    means, shares, max_heights = kept
    for i in range(means.shape[0]):
        for j in range(means.shape[1]):
            weight = float(new.shares[i, j])
            share = float(shares[i, j])
            taken = min(weight, 1.0 - share)
            if taken <= SLIVER and (share > 0.0 or weight == 0.0):
                continue
            mean = new.heights[i, j] / weight
            means[i, j] += (mean - means[i, j]) * (taken / (share + taken))
            shares[i, j] = share + taken
            max_heights[i, j] = max(max_heights[i, j], new.max_heights[i, j])


@kernel
def _average_neighbours(
    holes: IntArray, means: Float32Array, shares: Float32Array, max_heights: Float32Array
) -> FloatArray:
    """Mean and greatest height (holes, 2) of the eight cells around, averaged; NaN without any."""
    rows, cols = means.shape
    estimates = np.full((holes.shape[0], 2), np.nan)
    for n in range(holes.shape[0]):
        height, top, count = 0.0, 0.0, 0
        for i in range(max(holes[n, 0] - 1, 0), min(holes[n, 0] + 2, rows)):
            for j in range(holes[n, 1] - 1, holes[n, 1] + 2):
                k = j % cols
                if shares[i, k] > 0.0:
                    height += means[i, k]
                    top += max_heights[i, k]
                    count += 1
        if count:
            estimates[n, 0], estimates[n, 1] = height / count, top / count
    return estimates
