"""Keeping chosen points apart: peaks of a response within a cell, and choices across cells.

Best-per-cell alone picks one crater from several neighbouring cells, which then counts several
times in a resection: points are kept at least a share of a cell apart.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.latlon import xyz_from_latlon

RELAXED = 0.5  # of the spacing: what a cell may fall back to that would have no point otherwise


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
