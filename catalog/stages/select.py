"""Select: the candidate of each cell that goes to the checks."""

from collections.abc import Sequence

import msgspec

from catalog.stages import render
from catalog.stages.context import StageContext


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[select]."""


class Record(msgspec.Struct, frozen=True):
    """The chosen place of a cell."""

    cell: int
    lat_deg: float
    lon_deg: float
    score: float


def select(context: StageContext, records: Sequence[render.Record]) -> list[Record]:
    """One place a cell, in the order of cells."""
    return [Record(r.cell, r.lat_deg[0], r.lon_deg[0], r.score[0]) for r in records]
