"""A control point as one record of fixed layout: what checksums, digest and index are made of.

Numbers are rounded before they are stored, so that a difference in the last bits of a sum cannot
change a catalog's content; what is not finite is stored as unknown (NaN).
"""

import math
import zlib
from collections.abc import Sequence

import numpy as np

from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Flag

Record = np.void  # one of them

LATLON_DECIMALS = 7  # degrees: 3 mm on the Moon
RADIUS_DECIMALS = 3  # metres
SCORE_DECIMALS = 4  # localisation, rates and margins
SHADOW_DECIMALS = 2  # degrees
EIGENVALUE_DIGITS = 6  # significant: it spans many powers of ten


def record_type(levels: int) -> np.dtype[np.void]:
    """Layout of a record, little-endian and unpadded; `levels` uniqueness margins."""
    return np.dtype(
        [
            ("id", "<i8"),
            ("lat_deg", "<f8"),
            ("lon_deg", "<f8"),
            ("radius_m", "<f8"),
            ("localisation_px", "<f8"),
            ("hessian_eigenvalue", "<f8"),
            ("recognition_rate", "<f8"),
            ("trials", "<i4"),
            ("flags", "<i4"),
            ("usable", "<i4"),
            ("levels", "<i4"),
            ("source", "<i4"),
            ("uniqueness", "<f4", (levels,)),
            ("shadow_limit_deg", "<f4", (SHADOW_AZIMUTHS,)),
        ]
    )


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
    record["id"] = point.id
    record["lat_deg"] = point.lat_deg
    record["lon_deg"] = point.lon_deg
    record["radius_m"] = point.radius_m
    record["localisation_px"] = point.localisation_px
    record["hessian_eigenvalue"] = point.hessian_eigenvalue
    record["recognition_rate"] = point.recognition_rate
    record["trials"] = point.trials
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
        id=int(record["id"]),
        lat_deg=float(record["lat_deg"]),
        lon_deg=float(record["lon_deg"]),
        radius_m=float(record["radius_m"]),
        localisation_px=float(record["localisation_px"]),
        hessian_eigenvalue=float(record["hessian_eigenvalue"]),
        recognition_rate=float(record["recognition_rate"]),
        trials=int(record["trials"]),
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
