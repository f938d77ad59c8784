"""A control point as one record of fixed layout, and as a row of the feature layer.

Checksums, digest and index are made of the records; the feature layer is what GIS programs show.
Numbers are rounded before they are stored, so that a difference in the last bits of a sum cannot
change a catalog's content; what is not finite is stored as unknown (NaN).
"""

import json
import math
import struct
import zlib
from collections.abc import Sequence

import numpy as np

from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Flag
from catalog.errors import DataError
from catalog.store.schema import POINT_COLUMNS

Record = np.void  # one of them

LATLON_DECIMALS = 7  # degrees: 3 mm on the Moon
RADIUS_DECIMALS = 3  # metres
SCORE_DECIMALS = 4  # localisation, rates and margins
SHADOW_DECIMALS = 2  # degrees
EIGENVALUE_DIGITS = 6  # significant: it spans many powers of ten

# fields that a record has under the names, and with the numbers, of a control point
SAME = {
    "id": "<i8",
    "lat_deg": "<f8",
    "lon_deg": "<f8",
    "radius_m": "<f8",
    "localisation_px": "<f8",
    "hessian_eigenvalue": "<f8",
    "recognition_rate": "<f8",
    "trials": "<i4",
}
_GEOMETRY = struct.Struct("<2sBBiBIdd")


def record_type(levels: int) -> np.dtype[np.void]:
    """Layout of a record, little-endian and unpadded; `levels` uniqueness margins."""
    own = dict.fromkeys(("flags", "usable", "levels", "source"), "<i4")
    lists = [("uniqueness", "<f4", (levels,)), ("shadow_limit_deg", "<f4", (SHADOW_AZIMUTHS,))]
    return np.dtype([*SAME.items(), *own.items(), *lists])


def _rounded(value: float, decimals: int) -> float:
    value = float(value)
    # + 0.0 makes -0.0 a 0.0
    return round(value, decimals) + 0.0 if math.isfinite(value) else math.nan


def _significant(value: float, digits: int) -> float:
    value = float(value)
    return float(f"{value:.{digits}g}") + 0.0 if math.isfinite(value) else math.nan


def rounded_point(point: ControlPoint) -> ControlPoint:
    """A point with all numbers as the catalog keeps them."""
    lon = _rounded(point.lon_deg, LATLON_DECIMALS)
    return ControlPoint(
        id=int(point.id),
        lat_deg=_rounded(point.lat_deg, LATLON_DECIMALS),
        lon_deg=lon - 360.0 if lon >= 180.0 else lon,
        radius_m=_rounded(point.radius_m, RADIUS_DECIMALS),
        localisation_px=_rounded(point.localisation_px, SCORE_DECIMALS),
        hessian_eigenvalue=_significant(point.hessian_eigenvalue, EIGENVALUE_DIGITS),
        recognition_rate=_rounded(point.recognition_rate, SCORE_DECIMALS),
        trials=int(point.trials),
        uniqueness=tuple(_rounded(v, SCORE_DECIMALS) for v in point.uniqueness),
        shadow_limit_deg=tuple(_rounded(v, SHADOW_DECIMALS) for v in point.shadow_limit_deg),
        usable=bool(point.usable),
        flags=Flag(int(point.flags)),
        source=point.source,
    )


def record_from_point(
    point: ControlPoint, stored_levels: int, source: int, layout: np.dtype[np.void]
) -> Record:
    """The record of a point whose numbers are rounded already.

    stored_levels  patches that the catalog holds for the point
    source         place of the point's `source` in the manifest's `point_sources`
    """
    record: Record = np.zeros(1, dtype=layout)[0]
    for name in SAME:
        record[name] = getattr(point, name)
    record["flags"] = int(point.flags)
    record["usable"] = point.usable
    record["levels"] = stored_levels
    record["source"] = source
    record["uniqueness"] = point.uniqueness if point.uniqueness else math.nan
    record["shadow_limit_deg"] = point.shadow_limit_deg if point.shadow_limit_deg else math.nan
    return record


def point_from_record(record: Record, sources: Sequence[str]) -> ControlPoint:
    """The point that a record stands for."""
    return ControlPoint(
        **{name: record[name].item() for name in SAME},
        uniqueness=tuple(_rounded(v, SCORE_DECIMALS) for v in record["uniqueness"]),
        shadow_limit_deg=tuple(_rounded(v, SHADOW_DECIMALS) for v in record["shadow_limit_deg"]),
        usable=bool(record["usable"]),
        flags=Flag(int(record["flags"])),
        source=sources[int(record["source"])],
    )


def unknown_as_none(value: float) -> float | None:
    """A number, or None where it is not finite."""
    return float(value) if math.isfinite(value) else None


def checksum(*parts: bytes) -> int:
    """CRC-32 of some bytes one after the other."""
    value = 0
    for part in parts:
        value = zlib.crc32(part, value)
    return value


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
