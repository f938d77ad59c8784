"""The ground of a cell: a local map grid, and the places in it that a control point may take.

Where a cell's ground is cut by itself: about the poles, beside holes and where cells are few and
wide. All other cells share sweeps (shortlist.py).
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from catalog.arrays import BoolArray, Float32Array, FloatArray, IntArray
from catalog.geometry.latlon import wrap_longitude_deg, xyz_from_latlon
from catalog.geometry.projection import MapProjection
from catalog.pipeline.config import RenderSettings
from catalog.pipeline.context import StageContext
from catalog.rendering.sun_samples import sun_samples
from catalog.selection.localisation import (
    compute_brightness_eigenvalue_map,
    compute_hessian_eigenvalue_map,
    compute_sun_products,
)

RELAXED = 0.5  # of the spacing: what a cell may fall back to that would have no point otherwise
STEPS_PER_WINDOW = 16  # the response hardly changes over a sixteenth of its window
BLUR_NODES = 1.0  # optics of 0.7 px, the pixel itself and resampling
# A patch of the finest levels may miss this share of its nodes.
FINE_LEVELS = 3
MAX_MISSING = 0.03
COVERAGE_LATTICE = 24
POLAR_DEG = 75.0
POLAR_AZIMUTHS = 8


class Choice(NamedTuple):
    """Candidates of one cell in the order in which they should be tried.

    spacing  the share of the wanted spacing that they keep from other cells' points: 1, RELAXED,
             or 0 where even that leaves none, and then they are all the cell has
    """

    order: tuple[int, ...]
    spacing: float


def find_peaks(response: Float32Array, radius: float, count: int) -> list[tuple[int, int]]:
    """Up to `count` nodes of the largest response, no two nearer than `radius` nodes.

    response (rows, cols), NaN where unknown; nodes of response <= 0 are never taken.
    Equal responses are taken in row order, so the answer does not depend on anything else.
    """
    left = np.where(np.isfinite(response) & (response > 0.0), response, -np.inf)
    rows, cols = np.ogrid[: left.shape[0], : left.shape[1]]
    peaks: list[tuple[int, int]] = []
    while len(peaks) < count and left.size:
        row, col = divmod(int(np.argmax(left)), left.shape[1])
        if not np.isfinite(left[row, col]):
            break
        peaks.append((row, col))
        left[(rows - row) ** 2 + (cols - col) ** 2 < radius * radius] = -np.inf
    return peaks


def choose_spaced(
    cells: Sequence[int],
    lat_deg: FloatArray,
    lon_deg: FloatArray,
    score: FloatArray,
    spacing_deg: float,
) -> dict[int, Choice]:
    """Order every cell's candidates so that any may be taken without crowding another cell's.

    cells      (n,)  cell of each candidate; lat_deg, lon_deg (n,) its place
    score      (n,)  smaller is better; infinite scores come last
    Cells take turns, the ones with the worst best candidate first, for they lose most by a
    neighbour's choice (cells without a finite score come last). A cell takes its best candidate
    that has no accepted candidate of *another* cell nearer than `spacing_deg`; when all had their
    turn, they take a second one, and so on. So the alternatives of a cell are as free as its first
    choice, and cells can be checked independently. A cell none of whose candidates is free tries
    again with a part of the spacing. Ties go to the lower cell and the earlier candidate.
    Returns indices into the inputs by cell.
    """
    cell_of = np.asarray(cells, dtype=np.int64)
    places = xyz_from_latlon(np.radians(lat_deg), np.radians(lon_deg), 1.0).reshape(-1, 3)
    ranked: dict[int, list[int]] = {}
    worth = np.nan_to_num(np.asarray(score, dtype=np.float64), nan=np.inf)
    for i in np.lexsort((np.arange(cell_of.size), worth)):
        ranked.setdefault(int(cell_of[i]), []).append(int(i))

    best = {cell: float(worth[those[0]]) for cell, those in ranked.items()}
    turns = sorted(ranked, key=lambda cell: (not np.isfinite(best[cell]), -best[cell], cell))
    # in lists, whose elements the interpreter reads in a third of the time of an array's
    owner = cell_of.tolist()
    taken: dict[int, list[int]] = {cell: [] for cell in turns}
    spacing: dict[int, float] = dict.fromkeys(turns, 0.0)
    tree = cKDTree(places)
    for share in (1.0, RELAXED):
        chord = 2.0 * np.sin(np.radians(share * spacing_deg) / 2.0)
        accepted = {i for those in taken.values() for i in those}
        waiting = {cell: iter(ranked[cell]) for cell in turns if not taken[cell]}
        asked = [i for cell in waiting for i in ranked[cell]]
        near = dict(zip(asked, tree.query_ball_point(places[asked], chord) if asked else []))
        # by an accepted candidate of another cell
        crowded = [False] * len(owner)
        for i in asked if accepted else ():
            crowded[i] = not accepted.isdisjoint(near[i])  # a waiting cell has none of its own
        while waiting:
            for cell, those in list(waiting.items()):
                # a candidate that is not free now never will be: accepted ones stay
                i = next((i for i in those if not crowded[i]), None)
                if i is None:
                    del waiting[cell]
                    continue
                taken[cell].append(i)
                spacing[cell] = share
                for j in near[i]:
                    if owner[j] != cell:
                        crowded[j] = True
    return {
        cell: Choice(tuple(taken[cell] or ranked[cell]), spacing[cell]) for cell in sorted(turns)
    }


class CellGround(NamedTuple):
    """The ground of a cell and the places in it.

    projection  about the cell's middle; heights (n, n) m at the finest posting, or brightness
    step        nodes between places; place [i, j] is the middle of the window of `window` nodes
                whose first node is (i step, j step)
    lat, lon    (m, m) of the places, deg
    inside      (m, m) whether a place lies in the cell, away from its borders
    covered     (m, m) whether its finest patches have ground
    complete    whether the patches of all places have
    """

    projection: MapProjection
    heights: Float32Array
    window: int
    step: int
    lat: FloatArray
    lon: FloatArray
    inside: BoolArray
    covered: BoolArray
    complete: bool


def compute_place_step(window: int) -> int:
    """Nodes between places, and a side of the tiles that windows are summed from."""
    return max(1, window // STEPS_PER_WINDOW)


def cut_cell_ground(context: StageContext, cell: int) -> CellGround | None:
    """The ground of a cell; None where there is none at all."""
    settings = context.config.render
    projection = context.projection(*context.grid.centre_deg(cell))
    window = settings.window_nodes
    side = _compute_ground_side(context, cell, window)
    heights = context.texture.local_grid(projection, context.posting_m, side)
    if not np.isfinite(heights).any():
        return None
    step = compute_place_step(window)
    places = np.arange((side - window) // step + 1) * step
    offsets = (places + (window - 1) / 2.0 - (side - 1) / 2.0) * context.posting_m
    x, y = np.meshgrid(offsets, -offsets)
    nodes = places + window // 2
    middles = np.nan_to_num(heights[np.ix_(nodes, nodes)])
    lat, lon = (np.degrees(angle) for angle in projection.latlon(x, y, middles))
    inside = _mark_inside(context, cell, lat, lon, settings.inset_cell)
    missing = _measure_fine_holes(context, projection, x, y)
    covered, complete = missing <= MAX_MISSING, not missing.any()
    return CellGround(projection, heights, window, step, lat, lon, inside, covered, complete)


def find_strongest(context: StageContext, cell: int, ground: CellGround) -> list[tuple[int, int]]:
    """Places of a cell's ground with the strongest response under its worst Sun, best first."""
    latitude = context.sun_latitude_deg(*context.grid.centre_deg(cell))
    grid = blur_grid(ground.heights)
    if context.image is not None:
        response = compute_brightness_eigenvalue_map(grid, ground.window, ground.step)
    else:
        products = compute_sun_products(sample_suns(context.config.render, latitude))
        response = compute_hessian_eigenvalue_map(
            grid, context.posting_m, ground.window, products, ground.step
        )
    radius = compute_separation(context, ground)
    free = np.where(ground.inside & ground.covered, response, np.nan)
    peaks = find_peaks(free, radius, context.config.render.candidates)
    if not peaks:  # holes everywhere, or ground without any relief: kept, for the record
        known = np.where(ground.inside, response + np.float32(1e-30), np.nan)
        middle = response.shape[0] // 2
        peaks = find_peaks(known, radius, 1) or [(middle, middle)]
    return peaks


def blur_grid(grid: Float32Array) -> Float32Array:
    """A grid as a camera's optics and pixels leave it: detail finer than that helps no match."""
    return cv2.GaussianBlur(grid, (0, 0), BLUR_NODES).astype(np.float32, copy=False)


def sample_suns(settings: RenderSettings, lat_deg: float) -> FloatArray:
    """The Suns (n, 3), east, north, up, under which places at a latitude are rendered."""
    # near a pole an elevation leaves azimuths all around
    polar = abs(lat_deg) > POLAR_DEG
    return sun_samples(
        np.radians(lat_deg),
        settings.sun_elevations,
        max(settings.sun_azimuths, POLAR_AZIMUTHS) if polar else settings.sun_azimuths,
        max_declination=np.radians(settings.sun_declination_deg),
        lowest=np.radians(settings.sun_min_deg),
        highest=np.radians(settings.sun_max_deg),
    )


def measure_missing_share(
    context: StageContext, projection: MapProjection, posting_m: float
) -> float:
    """Share of a patch without ground, from a lattice over it."""
    spread = posting_m * (context.size - 1) / (COVERAGE_LATTICE - 1)
    x, y = np.meshgrid(*(2 * [spread * (np.arange(COVERAGE_LATTICE) - (COVERAGE_LATTICE - 1) / 2)]))
    lat, lon = projection.latlon(x, y)
    return float(1.0 - context.texture.covers(lat, lon, posting_m).mean())


def compute_separation(context: StageContext, ground: CellGround) -> float:
    """Least distance between the candidates of a cell, in places of its ground."""
    cell_m = np.radians(context.grid.step_deg) * context.body.radius_m
    share = context.config.render.separation_cell
    return float(share * cell_m / (ground.step * context.posting_m))


def _compute_ground_side(context: StageContext, cell: int, window: int) -> int:
    """Nodes of the square map grid that holds a cell and half a window around it."""
    west, south, east, north = context.grid.bounds_deg(cell)
    # a cell is widest at its border nearer to the equator; a cap is as wide as its circle
    parallel = np.cos(np.radians(min(abs(south), abs(north)) if south * north > 0.0 else 0.0))
    width = 2.0 * np.sin(np.radians(min(east - west, 180.0)) / 2.0) * parallel
    radius = max(context.body.radius_m, *context.body.radii_m)
    metres = max(np.radians(north - south), width) * radius
    return int(np.ceil(1.02 * metres / context.posting_m)) + window


def _mark_inside(
    context: StageContext, cell: int, lat: FloatArray, lon: FloatArray, inset: float
) -> BoolArray:
    """Which places (deg) lie in a cell, away from its borders."""
    west, south, east, north = context.grid.bounds_deg(cell)
    margin = inset * (north - south)
    low = south + margin if south > -90.0 else -90.0
    high = north - margin if north < 90.0 else 90.0
    inside = (lat >= low) & (lat <= high)
    if east - west < 360.0:
        half = (east - west) / 2.0
        offset = np.abs(wrap_longitude_deg(lon - (west + half)))
        inside &= offset <= half * (1.0 - 2.0 * inset)
    return inside


def _mark_fine_ground(
    context: StageContext, projection: MapProjection, extent_m: float
) -> tuple[BoolArray, float, float]:
    """Where there is ground for the fine patches of places within `extent_m` of the middle.

    Returns a square lattice about the middle, its spacing and half a patch's side, m.
    """
    level = min(FINE_LEVELS, context.levels) - 1
    half = context.postings_m[level] * (context.size - 1) / 2.0
    reach = extent_m + half
    nodes = COVERAGE_LATTICE * max(1, round(reach / half))
    spacing = 2.0 * reach / (nodes - 1)
    lattice = spacing * (np.arange(nodes) - (nodes - 1) / 2.0)
    lat, lon = projection.latlon(*np.meshgrid(lattice, -lattice))
    return context.texture.covers(lat, lon, context.postings_m[level]), spacing, half


def has_whole_patches(context: StageContext, cell: int) -> bool:
    """Whether the fine patches of all places of a cell have ground everywhere."""
    side = _compute_ground_side(context, cell, 0)
    projection = context.projection(*context.grid.centre_deg(cell))
    return bool(_mark_fine_ground(context, projection, side * context.posting_m / 2.0)[0].all())


def _measure_fine_holes(
    context: StageContext, projection: MapProjection, x: FloatArray, y: FloatArray
) -> FloatArray:
    """Share of the patch of the coarsest of the finest levels, at places (map m), that is holes."""
    covered, spacing, half = _mark_fine_ground(context, projection, float(np.abs(x).max()))
    if covered.all():
        return np.zeros(x.shape)
    nodes = covered.shape[0]
    sums = np.pad(np.cumsum(np.cumsum(covered, axis=0), axis=1), ((1, 0), (1, 0)))

    def index(offset: FloatArray) -> IntArray:
        at: IntArray = np.rint(offset / spacing + (nodes - 1) / 2.0).astype(np.int64)
        return at.clip(0, nodes - 1)

    top, bottom = index(-y - half), index(-y + half) + 1
    left, right = index(x - half), index(x + half) + 1
    total = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return 1.0 - total / ((bottom - top) * (right - left))
