"""Check: certify the places of each cell and take the best one that passes."""

import math
from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np

from catalog.control_point import ControlPoint, Flag
from catalog.stages import select
from catalog.stages.certificate import Certificate
from catalog.stages.context import StageContext

Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]
Elevation = Annotated[float, msgspec.Meta(gt=0.0, lt=90.0)]


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[check].

    places               of a cell that are tried at most
    max_localisation_px  predicted error above which a place is called flat
    search_km            where a rival may stand at the coarsest level
    min_margin           least uniqueness margin over all levels
    max_shadowed         share of Suns under which foreign shadows may reach the patch
    trials               recognition trials of a place
    min_recognition      share of them that must succeed
    good_recognition     share with which a place is taken without trying the cell's next one
    template_nodes       side of the square that is matched in a trial
    max_error_nodes      a match further from the truth has failed
    min_score, rival_ratio            gate of a match, as navigation has it
    sun_min_deg, sun_max_deg          Suns of the trials
    snr_min, snr_max, scale_error, roll_deg, off_nadir_deg  what the trials' pictures suffer from
    relief_slope_deg     rms slope of the random relief that the picture's ground has beyond the
                         DEM's; craters come on top
    """

    places: Annotated[int, msgspec.Meta(ge=1)] = 3
    max_localisation_px: Positive = 3.0
    search_km: Positive = 10.0
    min_margin: Share = 0.05
    max_shadowed: Share = 0.75
    trials: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 5
    min_recognition: Share = 0.6
    good_recognition: Share = 0.8
    template_nodes: Annotated[int, msgspec.Meta(ge=16, le=256, multiple_of=2)] = 64
    max_error_nodes: Positive = 1.5
    min_score: Share = 0.5
    rival_ratio: Share = 0.9
    sun_min_deg: Elevation = 10.0
    sun_max_deg: Elevation = 45.0
    snr_min: Positive = 10.0
    snr_max: Positive = 50.0
    scale_error: Annotated[float, msgspec.Meta(ge=0.0, le=0.3)] = 0.1
    roll_deg: Annotated[float, msgspec.Meta(ge=0.0, le=20.0)] = 6.0
    off_nadir_deg: Annotated[float, msgspec.Meta(ge=0.0, le=60.0)] = 25.0
    relief_slope_deg: NotNegative = 3.0


class Record(msgspec.Struct, frozen=True):
    """A control point as far as it is known before it is written."""

    cell: int
    lat_deg: float
    lon_deg: float
    height_m: float
    localisation_px: float
    hessian_eigenvalue: float
    recognition_rate: float
    trials: int
    uniqueness: tuple[float, ...]
    shadow_limit_deg: tuple[float, ...]
    usable: bool
    flags: int
    source: str

    def point(self, context: StageContext) -> ControlPoint:
        """The control point of the record."""
        return ControlPoint(
            id=self.cell,
            lat_deg=self.lat_deg,
            lon_deg=self.lon_deg,
            radius_m=context.body.radius_m + self.height_m,
            localisation_px=self.localisation_px,
            hessian_eigenvalue=self.hessian_eigenvalue,
            recognition_rate=self.recognition_rate,
            trials=self.trials,
            uniqueness=self.uniqueness,
            shadow_limit_deg=self.shadow_limit_deg,
            usable=self.usable,
            flags=Flag(self.flags),
            source=self.source,
        )


def check_chunk(context: StageContext, records: Sequence[select.Record]) -> list[Record]:
    """The point of each cell with its certificate."""
    return [check_cell(context, record) for record in records]


def check_cell(context: StageContext, record: select.Record) -> Record:
    """The first place that passes well; else the one recognised most often, usable or not.

    Earlier places win ties: they have the smaller predicted error. A place meets no more trials
    than it takes to see that it is out, or no better than one before it; the one that is kept
    meets them all.
    """
    settings = context.config.check
    best: Certificate | None = None
    for number, place in enumerate(record.places[: settings.places]):
        found = Certificate(context, record, place, number)
        found.try_for(best.successes + 1 if best is not None and best.usable else 0)
        if found.usable and found.recognition_rate >= settings.good_recognition:
            return _record(context, found)
        if best is None or found.merit > best.merit:
            best = found
    if best is None:
        raise ValueError(f"cell {record.cell}: no place to check")
    if not best.usable:
        best.finish()
    return _record(context, best)


def _record(context: StageContext, found: Certificate) -> Record:
    place = found.place
    lat, lon = math.radians(place.lat_deg), math.radians(place.lon_deg)
    return Record(
        cell=found.cell,
        lat_deg=place.lat_deg,
        lon_deg=place.lon_deg,
        height_m=float(np.nan_to_num(context.mosaic.heights(lat, lon, context.posting_m))),
        localisation_px=place.localisation_px,
        hessian_eigenvalue=place.hessian_eigenvalue,
        recognition_rate=found.recognition_rate,
        trials=found.trials,
        uniqueness=found.uniqueness,
        shadow_limit_deg=tuple(float(limit) for limit in found.shadow_limits_deg),
        usable=found.usable,
        flags=int(found.flags),
        source=context.mosaic.provenance(
            context.projection(place.lat_deg, place.lon_deg), context.posting_m, context.size
        ),
    )
