"""Render: candidates of each cell, shortlisted by the Hessian's worst-azimuth eigenvalue."""

from collections.abc import Sequence

import msgspec
import numpy as np

from catalog.selection.localisation import hessian_eigenvalue_map
from catalog.selection.spacing import strongest_peaks
from catalog.stages.context import StageContext


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[render]. candidates: places of a cell that go on to selection."""

    candidates: int = 4


class Record(msgspec.Struct, frozen=True):
    """Candidates of a cell, strongest first."""

    cell: int
    lat_deg: tuple[float, ...]
    lon_deg: tuple[float, ...]
    score: tuple[float, ...]


def render_chunk(context: StageContext, cells: Sequence[int]) -> list[Record]:
    """Candidates of cells; a cell without whole patches is left out."""
    records = []
    for cell in cells:
        lat_deg, lon_deg = context.grid.centre_deg(cell)
        projection = context.projection(lat_deg, lon_deg)
        step_m = np.radians(context.grid.step_deg) * context.body.radius_m
        side = int(step_m / context.posting_m) + context.size
        heights = context.mosaic.local_grid(projection, context.posting_m, side)
        window = context.size
        scores = hessian_eigenvalue_map(heights, context.posting_m, window, step=4)
        found = strongest_peaks(scores, 8.0, context.config.render.candidates)
        if not found:
            continue
        rows = np.array([4 * r + (window - 1) / 2.0 for r, _ in found])
        cols = np.array([4 * c + (window - 1) / 2.0 for _, c in found])
        x = (cols - (side - 1) / 2.0) * context.posting_m
        y = ((side - 1) / 2.0 - rows) * context.posting_m
        lat, lon = projection.latlon(x, y)
        inside = context.grid.cell_of(np.degrees(lat), np.degrees(lon)) == cell
        if inside.any():
            values = [float(scores[r, c]) for r, c in found]
            records.append(
                Record(
                    cell=int(cell),
                    lat_deg=tuple(float(v) for v in np.degrees(lat)[inside]),
                    lon_deg=tuple(float(v) for v in np.degrees(lon)[inside]),
                    score=tuple(np.array(values)[inside].tolist()),
                )
            )
    return records
