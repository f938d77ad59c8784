"""Check: certify the chosen places."""

from collections.abc import Sequence

import msgspec
import numpy as np

from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Flag
from catalog.stages import select
from catalog.stages.context import StageContext


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[check]."""


class Record(msgspec.Struct, frozen=True):
    """A control point as far as it is known before it is written."""

    cell: int
    lat_deg: float
    lon_deg: float
    height_m: float
    score: float
    flags: int
    source: str

    def point(self, context: StageContext) -> ControlPoint:
        """The control point of the record."""
        return ControlPoint(
            id=self.cell,
            lat_deg=self.lat_deg,
            lon_deg=self.lon_deg,
            radius_m=context.body.radius_m + self.height_m,
            localisation_px=0.0,
            hessian_eigenvalue=self.score,
            recognition_rate=1.0,
            trials=0,
            uniqueness=(0.0,) * context.levels,
            shadow_limit_deg=(0.0,) * SHADOW_AZIMUTHS,
            usable=not self.flags,
            flags=Flag(self.flags),
            source=self.source,
        )


def check_chunk(context: StageContext, records: Sequence[select.Record]) -> list[Record]:
    """Certificates of places."""
    checked = []
    for record in records:
        place = record.places[0]
        lat, lon = np.radians(place.lat_deg), np.radians(place.lon_deg)
        height = float(context.mosaic.heights(lat, lon, context.posting_m))
        index = int(context.mosaic.source_index(lat, lon))
        finest = context.patches(place.lat_deg, place.lon_deg)[0]
        whole = bool(np.isfinite(finest.heights_m).all())
        flags = Flag.NONE if whole else Flag.NO_DATA
        checked.append(
            Record(
                record.cell,
                place.lat_deg,
                place.lon_deg,
                height,
                place.hessian_eigenvalue,
                int(flags),
                context.mosaic.names[index] if index >= 0 else "",
            )
        )
    return checked
