"""Render and select: the places of each cell, and how well each matches under many Suns.

The Hessian's eigenvalue, worst over the Suns that can occur, is computed at every place of the
cell's ground; the ground of its strongest peaks is rendered by Hapke's law with cast shadows, and
the predicted error of a match under each Sun is kept.
"""

from collections.abc import Iterator, Sequence

import msgspec
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.projection import MapProjection
from catalog.photometry.laws import find_law
from catalog.pipeline.cell_map import (
    FINE_LEVELS,
    MAX_MISSING,
    blur_grid,
    choose_spaced,
    measure_missing_share,
    sample_suns,
)
from catalog.pipeline.context import StageContext
from catalog.pipeline.shortlist import make_shortlists
from catalog.rasters import keep_gdal_settings
from catalog.rendering.map_view import render_map_quickly
from catalog.selection.localisation import (
    compute_brightness_eigenvalue_map,
    compute_hessian_eigenvalue,
    predict_match,
)
from catalog.store.records import round_latlon
from catalog.terrain.dem.mosaic import Mosaic

# Ground about all windows that throws shadows into them. Farther relief is left out: under a Sun of
# 8 deg what stands higher than a seventh of its distance would count.
SHADOW_NODES = 16
# Places are rendered on one ground that has at most this many times the nodes of their own.
WIDE_GROUND = 2.0


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


class RenderedCell(msgspec.Struct, frozen=True):
    """Candidates of a cell, in the order of the closed-form response."""

    cell: int
    candidates: tuple[Candidate, ...]


def render_chunk(context: StageContext, cells: Sequence[int]) -> list[RenderedCell]:
    """Candidates of cells; a cell whose ground is all holes is left out."""
    with keep_gdal_settings():
        return _render_cells(context, cells)


def _render_cells(context: StageContext, cells: Sequence[int]) -> list[RenderedCell]:
    records = []
    for cell, shortlist in make_shortlists(context, cells).items():
        latitude = context.sun_latitude_deg(*context.grid.centre_deg(cell))
        suns = sample_suns(context.config.render, latitude)
        scores = [
            score
            for group in _group_places(context, shortlist.places)
            for score in _score_places(context, suns, group)
        ]
        candidates = [
            Candidate(lat, lon, *score, _measure_holes(context, lat, lon, shortlist.complete))
            for (lat, lon), score in zip(shortlist.places.tolist(), scores, strict=True)
        ]
        records.append(RenderedCell(cell, tuple(candidates)))
    return records


def _group_places(context: StageContext, places: FloatArray) -> list[FloatArray]:
    """Places that are rendered on one ground: all, or each alone where they lie far apart.

    Or where each has a plane of its own.
    """
    if context.mosaic.own_planes:
        return [places[i : i + 1] for i in range(len(places))]
    offsets = _compute_offsets(context, places)[1]
    alone = context.config.render.window_nodes + 2 * SHADOW_NODES
    together = 2.0 * np.abs(offsets).max() + alone
    if together**2 <= WIDE_GROUND * len(places) * alone**2:
        return [places]
    return [places[i : i + 1] for i in range(len(places))]


def _compute_offsets(context: StageContext, places: FloatArray) -> tuple[MapProjection, FloatArray]:
    """A map projection in the middle of places, and the nodes (n, 2) from there down and along."""
    lat, lon = np.radians(places).T
    xyz = context.mosaic.points(lat, lon)
    middle = xyz.min(axis=0) + np.ptp(xyz, axis=0) / 2.0
    centre_lat, centre_lon, _ = latlon_from_xyz(middle)
    projection = context.mosaic.projection(float(centre_lat), float(centre_lon))
    x, y = projection.xy_from_xyz(xyz)
    return projection, np.stack([-y, x], axis=1) / context.posting_m


def _score_places(
    context: StageContext, suns: FloatArray, places: FloatArray
) -> Iterator[tuple[float, Float32Array]]:
    """Hessian eigenvalue, and predicted 1-sigma errors (levels, suns) over correlation, of places.

    One ground holds them all, rendered once a level and Sun, with what throws shadows from about.
    """
    if context.image is not None:
        yield from _score_brightness(context, context.image, places)
        return
    settings = context.config.render
    law, window = find_law(settings.law, context.body.photometry.surface), settings.window_nodes
    projection, offsets = _compute_offsets(context, places)
    postings = context.postings_m[: settings.levels]
    grids, windows = [], []
    for level, posting in enumerate(postings):
        # nodes of this level's ground; the windows stand on whole nodes
        half = int(np.rint(np.abs(offsets).max() / 2**level)) + SHADOW_NODES
        side = 2 * half + window
        grids.append(context.mosaic.local_grid(projection, posting, side))
        corners = np.rint(offsets / 2**level + (side - window) / 2.0).astype(np.int64).tolist()
        windows.append([(slice(r, r + window), slice(c, c + window)) for r, c in corners])
    errors = np.empty((len(places), len(postings), len(suns)), np.float32)
    beyond = context.mosaic.make_outer_grids(projection, postings[-1], grids[-1].shape[0])
    for level, (grid, posting) in enumerate(zip(grids, postings, strict=True)):
        outer = [*zip(grids[level + 1 :], postings[level + 1 :], strict=True), *beyond]
        for k, sun in enumerate(suns):
            picture = blur_grid(
                render_map_quickly(
                    grid, posting, sun, radius_m=projection.radius_m, law=law, outer=outer
                )
            )
            for i, inside in enumerate(windows[level]):
                errors[i, level, k] = predict_match(picture[inside], settings.snr).score
    for inside, error in zip(windows[0], errors, strict=True):
        yield compute_hessian_eigenvalue(grids[0][inside], context.posting_m), error


def _score_brightness(
    context: StageContext, image: Mosaic, places: FloatArray
) -> Iterator[tuple[float, Float32Array]]:
    """Structure eigenvalue, and predicted 1-sigma errors (levels, 1), of places in an image."""
    settings = context.config.render
    for lat, lon in places.tolist():
        projection = context.projection(lat, lon)
        errors = np.empty((settings.levels, 1), np.float32)
        grids = []
        for level, posting in enumerate(context.postings_m[: settings.levels]):
            grids.append(blur_grid(image.local_grid(projection, posting, settings.window_nodes)))
            errors[level, 0] = predict_match(grids[-1], settings.snr).score
        yield (
            float(compute_brightness_eigenvalue_map(grids[0], settings.window_nodes)[0, 0]),
            errors,
        )


def _measure_holes(
    context: StageContext, lat_deg: float, lon_deg: float, complete: bool
) -> tuple[float, ...]:
    """Share of holes in the finest patches of a place."""
    postings = context.postings_m[:FINE_LEVELS]
    if complete:
        return (0.0,) * len(postings)
    # the whole patches are cut later; their holes are counted on a few nodes
    projection = context.projection(lat_deg, lon_deg)
    return tuple(measure_missing_share(context, projection, posting) for posting in postings)


class Place(msgspec.Struct, frozen=True):
    """A candidate that may become a cell's point, where the catalog would state it.

    localisation_nodes  predicted 1-sigma error: the percentile over Suns, worst over levels, nodes
    """

    lat_deg: float
    lon_deg: float
    localisation_nodes: float
    hessian_eigenvalue: float
    missing: float


class SelectedCell(msgspec.Struct, frozen=True):
    """Places of a cell in the order in which they are to be checked.

    spacing  share of the wanted distance that all of them keep from other cells' points
    """

    cell: int
    places: tuple[Place, ...]
    spacing: float


def select(context: StageContext, records: Sequence[RenderedCell]) -> list[SelectedCell]:
    """Places of every cell, in the order of cells; the answer does not depend on chunks."""
    settings = context.config.select
    ordered = sorted(records, key=lambda record: record.cell)
    cells = [record.cell for record in ordered for _ in record.candidates]
    dark = context.config.check.max_shadowed if context.mosaic.own_planes else 0.0
    places = [
        candidate
        for record in ordered
        for candidate in _rank_places(record, settings.percentile, dark)
    ]
    choices = choose_spaced(
        cells,
        np.array([candidate.lat_deg for candidate in places]),
        np.array([candidate.lon_deg for candidate in places]),
        # places with holes in their fine patches come after all others
        np.array([p.localisation_nodes + 1e6 * (p.missing > MAX_MISSING) for p in places]),
        settings.spacing_cell * context.grid.step_deg,
    )
    return [
        SelectedCell(cell, tuple(places[i] for i in choice.order), choice.spacing)
        for cell, choice in sorted(choices.items())
    ]


def _rank_places(record: RenderedCell, percentile: float, dark: float) -> list[Place]:
    """A cell's candidates, each with the percentile of its errors over Suns, at its worst level.

    dark  share of the Suns that may leave a place without any light; these do not count
    """
    if not record.candidates:
        return []
    errors = np.sort([candidate.error_px for candidate in record.candidates], axis=2)
    # nearest rank, not interpolated: an infinite error beside a finite one has no mean
    suns = errors.shape[2]
    lit = np.isfinite(errors).sum(axis=2)
    counted = np.where(lit >= (1.0 - dark) * suns, np.maximum(lit, 1), suns)
    ranks = np.ceil((counted - 1) * (percentile / 100.0)).astype(np.int64)
    worst = np.take_along_axis(errors, ranks[..., None], axis=2)[..., 0].max(axis=1).tolist()
    return [
        Place(
            *round_latlon(candidate.lat_deg, candidate.lon_deg),
            localisation_nodes=error,
            hessian_eigenvalue=candidate.hessian_eigenvalue,
            missing=max(candidate.missing),
        )
        for candidate, error in zip(record.candidates, worst, strict=True)
    ]
