"""Records as rows of the feature layer, and back."""

import json
import struct
from collections.abc import Sequence

import numpy as np

from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Flag
from catalog.errors import DataError
from catalog.store.records import (
    Record,
    checksum,
    record_from_point,
    record_type,
    unknown_as_none,
)
from catalog.store.schema import POINT_COLUMNS

_GEOMETRY = struct.Struct("<2sBBiBIdd")


def point_geometry(lon_deg: float, lat_deg: float, srs_id: int) -> bytes:
    """GeoPackage geometry of a point: header without envelope, then little-endian WKB."""
    return _GEOMETRY.pack(b"GP", 0, 1, srs_id, 1, 1, lon_deg, lat_deg)


def reasons_text(flags: Flag) -> str:
    """Flags in words, comma-separated: "flat, not unique"."""
    names = [name.lower().replace("_", " ") for name in Flag.__members__ if name != "NONE"]
    bits = [flag for flag in Flag.__members__.values() if flag]
    return ", ".join(name for name, bit in zip(names, bits, strict=True) if flags & bit)


def _list_text(values: Sequence[float]) -> str:
    return json.dumps([unknown_as_none(v) for v in values], separators=(",", ":"))


def _extreme(values: Sequence[float], largest: bool) -> float | None:
    known = [float(v) for v in values if np.isfinite(v)]
    if not known:
        return None
    return max(known) if largest else min(known)


def feature_row(point: ControlPoint, record: Record, srs_id: int) -> tuple[object, ...]:
    """A row of `control_points` in the order of POINT_COLUMNS."""
    return (
        point.id,
        point_geometry(point.lon_deg, point.lat_deg, srs_id),
        point.lat_deg,
        point.lon_deg,
        unknown_as_none(point.radius_m),
        int(point.usable),
        int(point.flags),
        reasons_text(point.flags),
        unknown_as_none(point.localisation_px),
        unknown_as_none(point.hessian_eigenvalue),
        unknown_as_none(point.recognition_rate),
        point.trials,
        _extreme(point.uniqueness, largest=False),
        _list_text(point.uniqueness),
        _extreme(point.shadow_limit_deg, largest=True),
        _list_text(point.shadow_limit_deg),
        point.source,
        int(record["levels"]),
        checksum(record.tobytes(), point.source.encode()),
    )


def record_from_row(
    row: Sequence[object], levels: int, sources: Sequence[str], srs_id: int
) -> Record:
    """The record that a row of the feature layer stands for.

    Raises DataError, naming what is wrong, when the row does not fit its own checksum.
    """
    cells = dict(zip(POINT_COLUMNS, row, strict=True))
    try:
        uniqueness = json.loads(_text(cells["uniqueness"]))
        shadows = json.loads(_text(cells["shadow_limit_deg"]))
        if len(uniqueness) not in (0, levels) or len(shadows) not in (0, SHADOW_AZIMUTHS):
            raise ValueError("a list of the wrong length")
        source = _text(cells["source"])
        point = ControlPoint(
            id=_whole(cells["id"]),
            lat_deg=_number(cells["lat_deg"]),
            lon_deg=_number(cells["lon_deg"]),
            radius_m=_number(cells["radius_m"]),
            localisation_px=_number(cells["localisation_px"]),
            hessian_eigenvalue=_number(cells["hessian_eigenvalue"]),
            recognition_rate=_number(cells["recognition_rate"]),
            trials=_whole(cells["trials"]),
            uniqueness=tuple(_number(v) for v in uniqueness),
            shadow_limit_deg=tuple(_number(v) for v in shadows),
            usable=bool(_whole(cells["usable"])),
            flags=Flag(_whole(cells["flags"])),
            source=source,
        )
        stored = _whole(cells["levels"])
        record = record_from_point(point, stored, sources.index(source), record_type(levels))
    except (ValueError, TypeError, OverflowError) as error:
        raise DataError(f"row of control_points cannot be read: {error}") from None
    # every column counts, those too that only repeat others for people's eyes
    if tuple(row) != feature_row(point, record, srs_id):
        raise DataError("row of control_points does not fit its checksum")
    return record


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{type(value).__name__} where text should be")
    return value


def _whole(value: object) -> int:
    if not isinstance(value, int):
        raise ValueError(f"{type(value).__name__} where a whole number should be")
    return value


def _number(value: object) -> float:
    if value is None:
        return float("nan")
    if not isinstance(value, int | float):
        raise ValueError(f"{type(value).__name__} where a number should be")
    return float(value)
