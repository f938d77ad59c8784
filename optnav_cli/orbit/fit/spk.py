"""States of an orbit as a SPICE kernel (.bsp): type 13, Hermite polynomials of unequal steps.

Needs the extra `spice`. Times are TDB, as SPICE's own; axes J2000, which SPICE has as ICRF.
"""

from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError, UsageError

SPK_BEGINNING = b"DAF/SPK"
CRAFT = -999  # NAIF number of a craft that has none
DEGREE = 7  # through 4 states: 1e-6 m at 60 s over the Moon
# States nearer to each other, as of two cameras, would be divided by their gap's cube.
MIN_GAP_S = 1.0
SEGMENT, INTERNAL_NAME = "optnav orbit", "optnav"


def write_spk(path: Path, tdb_s: FloatArray, states: FloatArray, craft: int, centre: int) -> None:
    """Write states (n, 6), m and m/s, inertial about a body, at times (n,), TDB s.

    craft, centre  NAIF numbers
    Of states nearer to each other than MIN_GAP_S one is written.
    Raises UsageError without the extra, DataError for fewer than two states.
    """
    try:
        import spiceypy
    except ImportError:
        raise UsageError(
            "a .bsp is written by SPICE: pip install 'optnav[spice]', or write an .oem"
        ) from None
    kept = _apart(tdb_s)
    tdb_s, states = tdb_s[kept], states[kept]
    if len(tdb_s) < 2:
        raise DataError(f"a .bsp needs two states or more; there are {len(tdb_s)}")
    degree = DEGREE if len(tdb_s) >= (DEGREE + 1) // 2 else 3
    handle = spiceypy.spkopn(str(path), INTERNAL_NAME, 0)
    try:
        ends = float(tdb_s[0]), float(tdb_s[-1])
        in_km = np.ascontiguousarray(states) / 1e3
        epochs = np.ascontiguousarray(tdb_s, dtype=np.float64)
        spiceypy.spkw13(
            handle, craft, centre, "J2000", *ends, SEGMENT, degree, len(epochs), in_km, epochs
        )
    finally:
        spiceypy.spkcls(handle)


def _apart(tdb_s: FloatArray) -> list[int]:
    """Numbers of the times that lie apart; the first and the last among them."""
    kept = [0]
    for number, time in enumerate(tdb_s):
        if time - tdb_s[kept[-1]] >= MIN_GAP_S:
            kept.append(number)
    last = len(tdb_s) - 1
    if kept[-1] != last:
        kept[-1:] = [last] if len(kept) > 1 else [0, last]
    return kept
