"""The shortlist of every cell: places with the strongest response, best first.

Cells share sweeps over zones. A zone is some bands of cells with one graticule; all its nodes and
tiles have places that are fixed for the whole body, so a cell's shortlist is the same, bit by bit,
whichever cells are asked for with it. Cells about the poles, where a graticule crowds, and cells
beside holes have a local map grid each (cell_map.py).
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.geometry.cells import Graticule, Part
from catalog.geometry.latlon import wrap_longitude_deg
from catalog.pipeline.cell_map import (
    compute_place_step,
    cut_cell_ground,
    find_strongest,
    has_whole_patches,
    sample_suns,
)
from catalog.pipeline.context import StageContext
from catalog.selection.localisation import compute_sun_products
from catalog.selection.sweep import (
    MARGIN,
    compute_window_eigenvalues,
    find_strongest_windows,
    sum_tiles,
)
from catalog.terrain.terrain import Terrain

ZONE_BANDS = 8  # as high as a block of cells that are in work together
ZONE_DEG = 16.0  # fewer bands of large cells
# Parallels through a zone's cells may differ in length by this much, for so do its columns' widths
# on the ground; those of all that its windows reach by more.
MAX_CROWDED, MAX_CROWDED_REACH = 2.1, 5.0
MAX_PART = 1 << 26  # nodes: 256 MB


class Shortlist(NamedTuple):
    """Candidate places of one cell.

    places    (n, 2) latitude and longitude, deg, best first
    complete  whether the patches of all places of the cell have ground everywhere
    """

    places: FloatArray
    complete: bool


class Zone(NamedTuple):
    """Bands of cells that share a graticule.

    latitudes  rad, south and north of all that windows of these cells reach
    step       nodes a side of a tile
    tall       tiles that a window is high
    """

    graticule: Graticule
    latitudes: tuple[float, float]
    step: int
    tall: int

    def row_tiles(self, lat: FloatArray) -> FloatArray:
        """Tiles from the south pole to latitudes (rad)."""
        return (lat + np.pi / 2.0) / (self.step * self.graticule.row_angle)

    def col_tiles(self, lon: FloatArray) -> FloatArray:
        """Tiles from -180° to longitudes (rad) of any turn."""
        return (lon + np.pi) / (self.step * self.graticule.column_angle)

    def _lat(self, row: IntArray) -> FloatArray:
        angle = self.step * self.graticule.row_angle
        return np.add(row, self.tall / 2.0, dtype=np.float64) * angle - np.pi / 2.0

    def places(self, row: IntArray, col: IntArray) -> tuple[FloatArray, FloatArray]:
        """Latitudes and longitudes (deg) of the middles of windows, by their first tiles."""
        lon = (col + self.wide(row) / 2.0) * self.step * self.graticule.column_angle - np.pi
        return np.degrees(self._lat(row)), wrap_longitude_deg(np.degrees(lon))

    def aspect(self, row: IntArray) -> FloatArray:
        """Width over height of a tile in the middle of windows, by their first row of tiles."""
        return np.cos(self._lat(row)) * self.graticule.column_angle / self.graticule.row_angle

    def wide(self, row: IntArray) -> IntArray:
        """Tiles that windows are wide, so that they are about square on the ground."""
        return np.maximum(1, np.rint(self.tall / self.aspect(row))).astype(np.int64)


class Spans(NamedTuple):
    """Where windows of cells (n,) lie: those whose middles lie in a cell, away from its borders.

    cells
    top, bottom  the first row of such windows, and the one after the last, by their first tiles
    west, east   tiles from -180° between which the middles lie
    first, end   columns of the tiles that these windows take, and the one after
    """

    cells: IntArray
    top: IntArray
    bottom: IntArray
    west: FloatArray
    east: FloatArray
    first: IntArray
    end: IntArray

    def select(self, chosen: IntArray | BoolArray) -> "Spans":
        """Some of the cells."""
        return Spans._make(values[chosen] for values in self)


def make_shortlists(context: StageContext, cells: Sequence[int]) -> dict[int, Shortlist]:
    """Shortlists by cell, in the order of the cells; without cells that have no ground at all."""
    asked = np.asarray(cells, dtype=np.int64)
    zone_of = _find_zones(context, context.grid.find_bands(asked))
    by_cell: dict[int, Shortlist] = {}
    mosaic = context.mosaic
    # without graticules each cell has a map grid of its own
    swept = mosaic.has_graticules and context.image is None
    zones = np.unique(zone_of).tolist() if swept else []
    for number in zones:
        zone = _make_zone(context, number)
        if zone is not None:
            spans = _find_spans(context, zone, asked[zone_of == number])
            for group in _group_spans(zone, spans):
                by_cell.update(_search_group(context, mosaic, zone, group))
    for cell in asked.tolist():
        alone = None if cell in by_cell else _search_cell(context, cell)
        if alone is not None:
            by_cell[cell] = alone
    return {cell: by_cell[cell] for cell in asked.tolist() if cell in by_cell}


def _search_cell(context: StageContext, cell: int) -> Shortlist | None:
    """The shortlist from a cell's own map grid."""
    ground = cut_cell_ground(context, cell)
    if ground is None:
        return None
    peaks = find_strongest(context, cell, ground)
    places = np.array([(ground.lat[peak], ground.lon[peak]) for peak in peaks])
    if (context.grid.find_cells(*places.T) != cell).any():
        # in a hollow or under a cliff the middle of a ground without one height may lie elsewhere
        places = np.array([context.grid.centre_deg(cell)])
    return Shortlist(places, ground.complete)


def _find_zones(context: StageContext, bands: IntArray) -> IntArray:
    """Zones of bands of cells, counted from both poles: 0, 1, ... and -1, -2, ... in the north.

    The first two are half as high as the others: about a pole, where no graticule serves, are few
    cells then.
    """
    high = int(np.clip(ZONE_DEG // context.grid.step_deg, 1, ZONE_BANDS))
    from_north = context.grid.bands - 1 - bands
    from_pole = np.minimum(bands, from_north)
    number = np.where(from_pole < high, 2 * from_pole // high, 1 + from_pole // high)
    return np.where(bands <= from_north, number, -1 - number)


def _make_zone(context: StageContext, number: int) -> Zone | None:
    """A zone by its number; None where no graticule serves."""
    window = context.config.render.window_nodes
    step = compute_place_step(window)
    row_angle = context.posting_m / context.body.radius_m
    bands = np.arange(context.grid.bands)
    zone_bands = bands[_find_zones(context, bands) == number]
    south = float(np.radians(zone_bands[0] * context.grid.step_deg - 90.0))
    north = min(float(np.radians((zone_bands[-1] + 1) * context.grid.step_deg - 90.0)), np.pi / 2.0)
    halo = (window / 2.0 + step + MARGIN) * row_angle
    reach = south - halo, north + halo
    served = (
        _compute_crowding(south, north) <= MAX_CROWDED
        and _compute_crowding(*reach) <= MAX_CROWDED_REACH
    )
    # whole tiles in a turn, so that they too have fixed places across ±180°
    tiles = round(2.0 * np.pi * np.cos((south + north) / 2.0) / (step * row_angle))
    if not served or tiles < 1:
        return None
    return Zone(Graticule(row_angle, step * tiles), reach, step, window // step)


def _compute_crowding(south: float, north: float) -> float:
    """Length of the longest over that of the shortest parallel between two latitudes (rad)."""
    farthest = max(abs(south), abs(north))
    nearest = 0.0 if south * north < 0.0 else min(abs(south), abs(north))
    shortest = np.cos(farthest) if farthest < np.pi / 2.0 else 0.0
    return float(np.cos(nearest) / shortest) if shortest > 0.0 else float("inf")


def _find_spans(context: StageContext, zone: Zone, cells: IntArray) -> Spans:
    """Spans of cells; without those that hold no window's middle, or lack ground."""
    if not context.mosaic.covers_body:
        cells = cells[[has_whole_patches(context, cell) for cell in cells.tolist()]]
    west, south, east, north = context.grid.compute_bounds_deg(cells)
    inset = context.config.render.inset_cell
    down, along = inset * (north - south), inset * (east - west)
    half = zone.tall / 2.0
    top = np.ceil(zone.row_tiles(np.radians(south + down)) - half).astype(np.int64)
    bottom = np.floor(zone.row_tiles(np.radians(north - down)) - half).astype(np.int64) + 1
    left = zone.col_tiles(np.radians(west + along))
    right = zone.col_tiles(np.radians(east - along))
    reach = np.maximum(zone.wide(top), zone.wide(bottom - 1)) / 2.0 + 1.0
    first, end = np.floor(left - reach).astype(np.int64), np.ceil(right + reach).astype(np.int64)
    return Spans(cells, top, bottom, left, right, first, end).select(top < bottom)


def _group_spans(zone: Zone, spans: Spans) -> Iterator[Spans]:
    """Cells that are swept together: those whose windows overlap, as long as memory allows."""
    if not spans.cells.size:
        return
    spans = spans.select(np.argsort(spans.first, kind="stable"))
    height = (spans.bottom.max() - spans.top.min() + zone.tall) * zone.step
    widest = max(1, MAX_PART // (int(height) * zone.step))  # tiles
    begin, reached = 0, int(spans.end[0])
    for i in range(1, spans.cells.size):
        first, end = int(spans.first[i]), int(spans.end[i])
        if first > reached or end - int(spans.first[begin]) > widest:
            yield spans.select(np.arange(begin, i))
            begin, reached = i, end
        reached = max(reached, end)
    yield spans.select(np.arange(begin, spans.cells.size))


def _search_group(
    context: StageContext, mosaic: Terrain, zone: Zone, group: Spans
) -> Iterator[tuple[int, Shortlist]]:
    """Shortlists of cells from one sweep; without cells that have holes, or no relief at all."""
    settings = context.config.render
    step = zone.step
    row, col = int(group.top.min()), int(group.first.min())
    height = int(group.bottom.max()) + zone.tall - 1 - row
    width = int(group.end.max()) - col
    size = height * step + 2 * MARGIN, width * step + 2 * MARGIN
    part = Part(row * step - MARGIN, col * step - MARGIN, *size)
    heights = mosaic.graticule_heights(zone.graticule, part, context.posting_m, zone.latitudes)
    across = np.cos(zone.graticule.lat(part.rows[MARGIN:-MARGIN]))
    stretch = zone.graticule.row_angle / (zone.graticule.column_angle * across)
    tiles = sum_tiles(heights, context.posting_m, stretch, step)
    separation = settings.separation_cell * np.radians(context.grid.step_deg)
    for top in np.unique(group.top).tolist():  # a band of cells has one set of Suns
        band = group.select(group.top == top)
        firsts = np.arange(top, band.bottom[0])
        wide = zone.wide(firsts)
        band_tiles = tiles[:, top - row : int(band.bottom[0]) - row + zone.tall - 1]
        suns = sample_suns(settings, context.grid.centre_deg(int(band.cells[0]))[0])
        peaks = find_strongest_windows(
            compute_window_eigenvalues(band_tiles, zone.tall, wide, compute_sun_products(suns)),
            wide,
            band.west - col,
            band.east - col,
            zone.aspect(firsts),
            float(separation / (step * zone.graticule.row_angle)),
            settings.candidates,
        )
        lat_deg, lon_deg = zone.places(peaks[..., 0] + top, peaks[..., 1] + col)
        places = np.stack([lat_deg, lon_deg], axis=-1)
        counts = (peaks[..., 0] >= 0).sum(axis=1).tolist()
        # holes would leave a cell with some of its places: such cells are looked at one by one
        complete = bool(np.isfinite(band_tiles).all())
        for i, cell in enumerate(band.cells.tolist()):
            cut = band_tiles[:, :, band.first[i] - col : band.end[i] - col]
            if counts[i] and (complete or np.isfinite(cut).all()):
                yield cell, Shortlist(places[i, : counts[i]], complete=True)
