"""States of a path as a CCSDS orbit ephemeris message (OEM 2.0, keyword = value)."""

from collections.abc import Sequence

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_from_tdb_s

CREATED = "2000-01-01T00:00:00.000"  # no clock: the same input gives the same bytes


def oem_text(
    name: str, centre: str, tdb_s: Sequence[float] | FloatArray, states: FloatArray
) -> str:
    """The file of states (n, 6), m and m/s, inertial (ICRF axes) about a body, at times TDB s.

    Times are UTC; lengths km, as the standard has them.
    """
    times = [utc_from_tdb_s(float(t)).removesuffix("Z") for t in tdb_s]
    head = [
        "CCSDS_OEM_VERS = 2.0",
        f"CREATION_DATE = {CREATED}",
        "ORIGINATOR = OPTNAV",
        "",
        "META_START",
        f"OBJECT_NAME = {name}",
        f"OBJECT_ID = {name}",
        f"CENTER_NAME = {centre.upper()}",
        "REF_FRAME = ICRF",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {times[0]}",
        f"STOP_TIME = {times[-1]}",
        "INTERPOLATION = HERMITE",
        "INTERPOLATION_DEGREE = 7",
        "META_STOP",
        "",
    ]
    lines = [
        " ".join([time, *(f"{value:.9f}" for value in state / 1e3)])
        for time, state in zip(times, states, strict=True)
    ]
    return "\n".join([*head, *lines, ""])
