"""Select: order every cell's candidates by predicted error, kept apart from other cells' points."""

from collections.abc import Sequence

import msgspec
import numpy as np

from catalog.pipeline.cell_map import MAX_MISSING
from catalog.pipeline.context import StageContext
from catalog.pipeline.render import RenderedCell
from catalog.selection.spacing import choose_spaced
from catalog.store.records import round_latlon


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
