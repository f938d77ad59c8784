"""Render: a shortlist of places in each cell, and how well each could be matched under many Suns.

The Hessian's eigenvalue, worst over the Suns that can occur, is computed at every place of the
cell's ground; its strongest peaks are rendered by Hapke's law with cast shadows, and the predicted
error of a match under each Sun is kept.
"""

from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from catalog.geometry.latlon import wrap_longitude_deg
from catalog.geometry.projection import Stereographic
from catalog.rendering.map_view import render_map
from catalog.rendering.sun_samples import sun_samples
from catalog.selection.localisation import (
    hessian_eigenvalue,
    hessian_eigenvalue_map,
    sun_products,
)
from catalog.selection.match_error import predicted_error_over_correlation
from catalog.selection.spacing import strongest_peaks
from catalog.stages.context import StageContext

Grid = NDArray[np.float32]
FloatArray = NDArray[np.float64]

STEPS_PER_WINDOW = 16  # the response hardly changes over a sixteenth of its window
BLUR_NODES = 1.0  # optics of 0.7 px, the pixel itself and resampling
# A patch of the finest levels may miss this share of its nodes.
FINE_LEVELS = 3
MAX_MISSING = 0.03
COVERAGE_LATTICE = 24
POLAR_DEG = 75.0
POLAR_AZIMUTHS = 8


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[render].

    candidates       places of a cell that are rendered and go on to selection
    separation_cell  least distance between them, share of a cell
    inset_cell       strip along a cell's borders where no candidate is taken, share of a cell
    window_nodes     side of the square that is scored: the template at the finest level
    levels           pyramid levels that are rendered, finest first
    sun_elevations, sun_azimuths, sun_min_deg, sun_max_deg  the Suns, of those that can occur:
                     away from the poles (75 deg) an elevation leaves two narrow bands of azimuth;
                     nearer to them at least eight azimuths are taken
    sun_declination_deg  how far from the body's equator the Sun stands
    law              of the render
    snr              mean brightness over noise, for the predicted error

    The defaults are the cheapest that lose nothing: with 24 candidates, two levels and 32 Suns
    the places were recognised as often (0.8 ± 1.0 points less), at seven times the cost.
    """

    candidates: Annotated[int, msgspec.Meta(ge=1, le=64)] = 8
    separation_cell: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.12
    inset_cell: Annotated[float, msgspec.Meta(ge=0.0, lt=0.5)] = 0.1
    window_nodes: Annotated[int, msgspec.Meta(ge=16, le=256)] = 64
    levels: Annotated[int, msgspec.Meta(ge=1, le=10)] = 1
    sun_elevations: Annotated[int, msgspec.Meta(ge=1, le=32)] = 2
    sun_azimuths: Annotated[int, msgspec.Meta(ge=2, le=64, multiple_of=2)] = 2
    sun_min_deg: Annotated[float, msgspec.Meta(gt=0.0, lt=90.0)] = 8.0
    sun_max_deg: Annotated[float, msgspec.Meta(gt=0.0, lt=90.0)] = 45.0
    sun_declination_deg: Annotated[float, msgspec.Meta(ge=0.0, le=90.0)] = 1.54
    law: Literal["hapke", "lommel_seeliger", "lunar_lambert", "lambert"] = "hapke"
    snr: Annotated[float, msgspec.Meta(gt=0.0)] = 10.0


class Candidate(msgspec.Struct, frozen=True):
    """A place and what its ground promises.

    lat_deg, lon_deg    planetocentric, east
    hessian_eigenvalue  worst azimuth, over the window (dimensionless)
    error_px            (levels, suns) float32, predicted 1-sigma error, nodes, over correlation
    missing             share of holes in each of the finest patches
    """

    lat_deg: float
    lon_deg: float
    hessian_eigenvalue: float
    error_px: np.ndarray
    missing: tuple[float, ...]


class Record(msgspec.Struct, frozen=True):
    """Candidates of a cell, in the order of the closed-form response."""

    cell: int
    candidates: tuple[Candidate, ...]


def render_chunk(context: StageContext, cells: Sequence[int]) -> list[Record]:
    """Candidates of cells; a cell whose ground is all holes is left out."""
    records = [render_cell(context, int(cell)) for cell in cells]
    return [record for record in records if record is not None]


class Ground(NamedTuple):
    """The ground of a cell and the places in it.

    projection  about the cell's middle; heights (n, n) m at the finest posting
    step        nodes between places; place [i, j] is the middle of the window of `window` nodes
                whose first node is (i step, j step)
    lat, lon    (m, m) of the places, deg
    inside      (m, m) whether a place lies in the cell, away from its borders
    whole       (m, m) whether its finest patches have ground
    complete    whether the patches of all places have
    """

    projection: Stereographic
    heights: Grid
    window: int
    step: int
    lat: FloatArray
    lon: FloatArray
    inside: NDArray[np.bool_]
    whole: NDArray[np.bool_]
    complete: bool


def cell_ground(context: StageContext, cell: int) -> Ground | None:
    """The ground of a cell; None where there is none at all."""
    settings = context.config.render
    projection = context.projection(*context.grid.centre_deg(cell))
    window = settings.window_nodes
    side = _ground_side(context, cell, window)
    heights = context.mosaic.local_grid(projection, context.posting_m, side)
    if not np.isfinite(heights).any():
        return None
    step = max(1, window // STEPS_PER_WINDOW)
    places = np.arange((side - window) // step + 1) * step
    offsets = (places + (window - 1) / 2.0 - (side - 1) / 2.0) * context.posting_m
    x, y = np.meshgrid(offsets, -offsets)
    lat, lon = (np.degrees(angle) for angle in projection.latlon(x, y))
    inside = _inside(context, cell, lat, lon, settings.inset_cell)
    missing = _fine_patches_missing(context, projection, x, y)
    return Ground(
        projection, heights, window, step, lat, lon, inside,
        whole=missing <= MAX_MISSING, complete=not missing.any(),
    )  # fmt: skip


def render_cell(context: StageContext, cell: int) -> Record | None:
    """The shortlist of one cell; None where the cell has no ground at all."""
    settings = context.config.render
    ground = cell_ground(context, cell)
    if ground is None:
        return None
    suns = suns_of(settings, context.grid.centre_deg(cell)[0])
    peaks = shortlist(context, ground, suns)
    errors = predicted_errors(context, ground, suns, peaks)
    candidates = [
        _candidate(context, ground, peak, error) for peak, error in zip(peaks, errors, strict=True)
    ]
    return Record(cell, tuple(candidates))


def shortlist(context: StageContext, ground: Ground, suns: FloatArray) -> list[tuple[int, int]]:
    """Places of a cell's ground with the strongest response under its worst Sun, best first."""
    response = hessian_eigenvalue_map(
        blurred(ground.heights),
        context.posting_m,
        ground.window,
        sun_products(suns),
        ground.step,
    )
    radius = separation_places(context, ground)
    free = np.where(ground.inside & ground.whole, response, np.nan)
    peaks = strongest_peaks(free, radius, context.config.render.candidates)
    if not peaks:  # holes everywhere, or ground without any relief: kept, for the record
        known = np.where(ground.inside, response + np.float32(1e-30), np.nan)
        middle = response.shape[0] // 2
        peaks = strongest_peaks(known, radius, 1) or [(middle, middle)]
    return peaks


def predicted_errors(
    context: StageContext, ground: Ground, suns: FloatArray, peaks: Sequence[tuple[int, int]]
) -> NDArray[np.float32]:
    """Predicted 1-sigma error over correlation (places, levels, suns) of places of a ground, nodes.

    The ground is rendered whole, once a level and Sun, so that every place has its neighbours'
    shadows in it.
    """
    settings = context.config.render
    postings = context.postings_m[: settings.levels]
    grids = [ground.heights]
    # of a coarser level as much more ground as its window is wider
    spread = ground.heights.shape[0] - ground.window
    for level, posting in enumerate(postings[1:], start=1):
        side = -(-spread // 2**level) + ground.window
        grids.append(context.mosaic.local_grid(ground.projection, posting, side))
    errors = np.empty((len(peaks), len(postings), len(suns)), np.float32)
    for level, (grid, posting) in enumerate(zip(grids, postings, strict=True)):
        corners = _corners(ground, peaks, 2**level, grid.shape[0])
        outer = list(zip(grids[level + 1 :], postings[level + 1 :], strict=True))
        for k, sun in enumerate(suns):
            picture = blurred(
                render_map(
                    grid,
                    posting,
                    sun,
                    radius_m=context.body.radius_m,
                    law=settings.law,
                    outer=outer,
                    quick=True,
                )
            )
            for i, (row, col) in enumerate(corners):
                template = picture[row : row + ground.window, col : col + ground.window]
                errors[i, level, k] = predicted_error_over_correlation(template, settings.snr)
    return errors


def _corners(
    ground: Ground, peaks: Sequence[tuple[int, int]], scale: int, side: int
) -> NDArray[np.int64]:
    """First row and column of the windows of places in a grid of `scale` times the posting."""
    from_middle = np.array(peaks) * ground.step - (ground.heights.shape[0] - ground.window) / 2.0
    corners = np.rint(from_middle / scale + (side - ground.window) / 2.0)
    return np.asarray(np.clip(corners, 0, side - ground.window), dtype=np.int64)


def blurred(grid: Grid) -> Grid:
    """A grid as a camera's optics and pixels leave it: detail finer than that helps no match."""
    return np.asarray(cv2.GaussianBlur(grid, (0, 0), BLUR_NODES), dtype=np.float32)


def suns_of(settings: Settings, lat_deg: float) -> FloatArray:
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


def _candidate(
    context: StageContext,
    ground: Ground,
    peak: tuple[int, int],
    error_px: NDArray[np.float32],
) -> Candidate:
    lat_deg, lon_deg = float(ground.lat[peak]), float(ground.lon[peak])
    row, col = peak[0] * ground.step, peak[1] * ground.step
    window = ground.heights[row : row + ground.window, col : col + ground.window]
    value = hessian_eigenvalue(window, context.posting_m)
    postings = context.postings_m[:FINE_LEVELS]
    if ground.complete:
        missing = (0.0,) * len(postings)
    else:  # the whole patches are cut later; their holes are counted on a few nodes
        projection = context.projection(lat_deg, lon_deg)
        missing = tuple(_missing(context, projection, posting) for posting in postings)
    return Candidate(lat_deg, lon_deg, value, error_px, missing)


def _missing(context: StageContext, projection: Stereographic, posting_m: float) -> float:
    """Share of a patch without ground, from a lattice over it."""
    spread = posting_m * (context.size - 1) / (COVERAGE_LATTICE - 1)
    x, y = np.meshgrid(*(2 * [spread * (np.arange(COVERAGE_LATTICE) - (COVERAGE_LATTICE - 1) / 2)]))
    lat, lon = projection.latlon(x, y)
    return float(1.0 - context.mosaic.covers(lat, lon, posting_m).mean())


def separation_places(context: StageContext, ground: Ground) -> float:
    """Least distance between the candidates of a cell, in places of its ground."""
    cell_m = np.radians(context.grid.step_deg) * context.body.radius_m
    share = context.config.render.separation_cell
    return float(share * cell_m / (ground.step * context.posting_m))


def _ground_side(context: StageContext, cell: int, window: int) -> int:
    """Nodes of the square map grid that holds a cell and half a window around it."""
    west, south, east, north = context.grid.bounds_deg(cell)
    # a cell is widest at its border nearer to the equator; a cap is as wide as its circle
    parallel = np.cos(np.radians(min(abs(south), abs(north)) if south * north > 0.0 else 0.0))
    width = 2.0 * np.sin(np.radians(min(east - west, 180.0)) / 2.0) * parallel
    metres = max(np.radians(north - south), width) * context.body.radius_m
    return int(np.ceil(1.02 * metres / context.posting_m)) + window


def _inside(
    context: StageContext, cell: int, lat: FloatArray, lon: FloatArray, inset: float
) -> NDArray[np.bool_]:
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
    return np.asarray(inside)


def _fine_patches_missing(
    context: StageContext, projection: Stereographic, x: FloatArray, y: FloatArray
) -> FloatArray:
    """Share of the patch of the coarsest of the finest levels, at places (map m), that is holes."""
    level = min(FINE_LEVELS, context.levels) - 1
    half = context.postings_m[level] * (context.size - 1) / 2.0
    reach = float(np.abs(x).max()) + half
    nodes = COVERAGE_LATTICE * max(1, round(reach / half))
    spacing = 2.0 * reach / (nodes - 1)
    lattice = spacing * (np.arange(nodes) - (nodes - 1) / 2.0)
    lat, lon = projection.latlon(*np.meshgrid(lattice, -lattice))
    covered = context.mosaic.covers(lat, lon, context.postings_m[level])
    if covered.all():
        return np.zeros(x.shape)
    sums = np.pad(np.cumsum(np.cumsum(covered, axis=0), axis=1), ((1, 0), (1, 0)))

    def index(offset: FloatArray) -> NDArray[np.int64]:
        at = np.rint(offset / spacing + (nodes - 1) / 2.0)
        return np.asarray(np.clip(at, 0, nodes - 1), dtype=np.int64)

    top, bottom = index(-y - half), index(-y + half) + 1
    left, right = index(x - half), index(x + half) + 1
    total = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    area = (bottom - top) * (right - left)
    return np.asarray(1.0 - total / area)
