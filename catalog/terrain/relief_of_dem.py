"""The relief of a whole body from a terrain model that shows all of it."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from catalog.bodies.body import Body
from catalog.errors import DataError
from catalog.progress import Progress, SilentProgress
from catalog.terrain.relief import GlobalRelief
from catalog.terrain.relief_sums import CellSums, Layer
from catalog.terrain.source import DemSettings, DemSource

ROWS = 2880  # 16 a degree: 1.9 km of lunar ground, as fine as a horizon asks for
LEAST_COVERAGE = 0.99  # of the sphere; the rest is filled from its surroundings


def relief_from_dem(source: DemSource, rows: int | None = None) -> GlobalRelief:
    """The relief of a terrain model that shows the whole body, read once, window by window.

    rows  of the relief; without it the model's own, but no more than ROWS
    Raises DataError for a damaged file, one of a part of the body or with impossible heights.
    """
    check_share(share_within_bounds(source), source.path, source.body)  # before all of it is read
    sums = CellSums(rows or rows_of(source.place.row_angle))
    lay_whole(sums, source, SilentProgress())
    check_share(sums.coverage, source.path, source.body)
    return finished(sums, source.body.radius_m, source.path.name)


def share_within_bounds(source: DemSource) -> float:
    """Share of the body within a terrain model's bounds, 1 if unknown: it shows no more."""
    west, south, east, north = source.latlon_bounds()
    if not np.isfinite([west, south, east, north]).all():  # a map with corners beyond the body
        return 1.0
    return float((np.sin(north) - np.sin(south)) * (east - west) / (4.0 * np.pi))


def check_share(share: float, who: object, body: Body) -> None:
    """Raise DataError unless this share of a body, which `who` shows, is enough for a relief."""
    if share < LEAST_COVERAGE:
        raise DataError(
            f"{who}: {100.0 * share:.3g} % of {body.name} is shown; a relief wants "
            f"{100.0 * LEAST_COVERAGE:g} %: name a terrain model of the whole body"
        )


def lay_whole(sums: CellSums, source: DemSource, progress: Progress) -> None:
    """Lay a terrain model, at its own posting, under what the cells have.

    Raises DataError for a damaged file or one with impossible heights.
    """
    layer = Layer(source.place, 0, source.shape, source.block_shape, source.read_window)
    lowest_m, highest_m = sums.lay_under(layer, progress)
    if lowest_m <= highest_m:
        source.check_heights(lowest_m, highest_m)


def rows_of(row_angle: float) -> int:
    """Rows of the relief of a terrain model with so much of latitude (rad) between its rows."""
    return min(ROWS, round(np.pi / row_angle))


def finished(sums: CellSums, radius_m: float, source: str) -> GlobalRelief:
    """The relief of sums over nearly all cells; holes are filled."""
    sums.fill()
    # a mean rounded to float32 may pass the pixels that it is of
    return GlobalRelief(sums.means, np.maximum(sums.tops, sums.means), radius_m, source)


@lru_cache(maxsize=2)
def load_relief(path: str, body: Body) -> GlobalRelief:
    """The relief of a terrain model file, "bundled:NAME" for one that travels with optnav.

    A process that asks again gets the same one. Raises DataError.
    """
    try:
        source = DemSource.open(DemSettings(path=path), Path(), body)
        try:
            return relief_from_dem(source)
        finally:
            source.close()
    except DataError as error:
        # a file by itself has no section that could say what it does not
        reason = str(error).replace("check `path` in its [[dem]] section", "check the path")
        section = "[relief] dem of a build config, whose catalog carries the relief"
        raise DataError(reason.replace("its [[dem]] section", section)) from None
