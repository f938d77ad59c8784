"""SPICE kernels made from nothing: a craft that spins about z, its clock, frames and orbit.

Binary files are put together word by word, in either byte order and under either identification
word, so that forms which no library writes can be tried.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

CRAFT, BUS = -999, -999000
RATE = 0.01  # rad/s of the spin about z
TICKS_S = 256.0  # of the clock, which stands at zero at J2000
STEP_S, COUNT = 10.0, 60
TIMES_S = STEP_S * np.arange(COUNT)  # of attitudes and states
BEGIN_S, END_S = 0.0, float(TIMES_S[-1])
CLOCK = """KPL/SCLK
\\begindata
SCLK_KERNEL_ID = ( @2009-01-01 )
SCLK_DATA_TYPE_999 = ( 1 )
SCLK01_TIME_SYSTEM_999 = ( 1 )
SCLK01_N_FIELDS_999 = ( 2 )
SCLK01_MODULI_999 = ( 4294967296 256 )
SCLK01_OFFSETS_999 = ( 0 0 )
SCLK01_OUTPUT_DELIM_999 = ( 1 )
SCLK_PARTITION_START_999 = ( 0.0 )
SCLK_PARTITION_END_999 = ( 1.0E12 )
SCLK01_COEFFICIENTS_999 = ( 0.0 0.0 1.0 )
\\begintext
"""
FRAMES = """KPL/FK
\\begindata
FRAME_MADE_BUS = -999000
FRAME_-999000_NAME = 'MADE_BUS'
FRAME_-999000_CLASS = 3
FRAME_-999000_CLASS_ID = -999000
FRAME_-999000_CENTER = -999
CK_-999000_SCLK = -999
CK_-999000_SPK = -999
FRAME_MADE_CAMERA = -999001
FRAME_-999001_NAME = 'MADE_CAMERA'
FRAME_-999001_CLASS = 4
FRAME_-999001_CLASS_ID = -999001
FRAME_-999001_CENTER = -999
TKFRAME_-999001_SPEC = 'MATRIX'
TKFRAME_-999001_RELATIVE = 'MADE_BUS'
TKFRAME_-999001_MATRIX = ( 0 1 0 -1 0 0 0 0 1 )
\\begintext
"""
LEAP_SECONDS = """KPL/LSK
\\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996 1.99096871D-7 )
DELTET/DELTA_AT = ( 32 @1999-JAN-1 33 @2006-JAN-1 )
\\begintext
"""
Segment = tuple[float, float, tuple[int, ...], Sequence[float]]


def daf(segments: Sequence[Segment], word: bytes = b"DAF/CK  ", order: str = "<") -> bytes:
    """A DAF file: summaries in its second record, names in its third, data behind them.

    segments  begin, end, integers before the addresses, doubles
    """
    address = 3 * 128 + 1
    summaries, data = b"", b""
    for begin, end, integers, values in segments:
        last = address + len(values) - 1
        words = (*integers, address, last)
        summaries += struct.pack(f"{order}2d{len(words)}i", begin, end, *words).ljust(40, b"\0")
        data += struct.pack(f"{order}{len(values)}d", *values)
        address = last + 1
    head = word + struct.pack(f"{order}2i", 2, 6) + b"made".ljust(60)
    head += struct.pack(f"{order}3i", 2, 2, address)
    head = (head + (b"LTL-IEEE" if order == "<" else b"BIG-IEEE")).ljust(1024, b"\0")
    control = struct.pack(f"{order}3d", 0.0, 0.0, float(len(segments)))
    names = b"made".ljust(40) * len(segments)
    whole = head + (control + summaries).ljust(1024, b"\0") + names.ljust(1024) + data
    return whole.ljust(-(-len(whole) // 1024) * 1024, b"\0")


def quaternion(time_s: float) -> list[float]:
    """The attitude, scalar first: of the turn of the craft's axes, as SPICE has quaternions."""
    half = -0.5 * RATE * time_s
    return [float(np.cos(half)), 0.0, 0.0, float(np.sin(half))]


def _directory(values: Sequence[float]) -> list[float]:
    return [float(value) for value in values[99:-1:100]]


def _packets(times_s: Sequence[float], subtype: int) -> list[float]:
    """Packets of CK types 5 and 6: quaternion; rates of it and angular rates where they belong."""
    rows = []
    for t in times_s:
        q = quaternion(t)
        dq = [0.5 * RATE * q[3], 0.0, 0.0, -0.5 * RATE * q[0]]
        rate = [0.0, 0.0, RATE]
        rows += {0: q + dq, 1: q, 2: q + dq + rate + [0.0] * 3, 3: q + rate}[subtype]
    return rows


def attitude_segment(type_: int, subtype: int = 1, times_s: Sequence[float] = ()) -> Segment:
    """A segment of a C-kernel of one type; with rates where the type or subtype has them."""
    times = [float(t) for t in (times_s if len(times_s) else TIMES_S)]
    ticks = [t * TICKS_S for t in times]
    has_rates = type_ in (1, 2, 3) or subtype in (2, 3)
    rows: list[float] = []
    if type_ == 2:
        for t in times[:-1]:
            rows += [*quaternion(t), 0.0, 0.0, RATE, 1.0 / TICKS_S]
        rows += [*ticks[:-1], *ticks[1:], *_directory(ticks[:-1])]
    elif type_ in (1, 3):
        for t in times:
            rows += [*quaternion(t), 0.0, 0.0, RATE]
        rows += [*ticks, *_directory(ticks)]
        rows += [float(len(times))] if type_ == 1 else [ticks[0], 1.0, float(len(times))]
    else:
        window = 4.0
        mini = [*_packets(times, subtype), *ticks, *_directory(ticks), 1.0 / TICKS_S]
        if type_ == 5:
            rows = [*mini[:-1], ticks[0], mini[-1], subtype, window, 1.0, float(len(times))]
        else:
            mini += [subtype, window, float(len(times))]
            rows = [*mini, ticks[0], ticks[-1], 1.0, len(mini) + 1.0, 1.0, 1.0]
    return ticks[0], ticks[-1], (BUS, 1, type_, int(has_rates)), rows


def orbit_segment(times_s: Sequence[float] = (), centre: int = 301) -> Segment:
    """A segment of an orbit kernel, type 13: a craft on a straight line from 3000 km, 1 km/s."""
    times = [float(t) for t in (times_s if len(times_s) else TIMES_S)]
    states = [word for t in times for word in (3000.0, t, 0.0, 0.0, 1.0, 0.0)]
    values = [*states, *times, *_directory(times), 3.0, float(len(times))]
    return times[0], times[-1], (CRAFT, centre, 1, 13), values


def write_kernels(folder: Path, attitude: bytes, orbit: bytes = b"") -> list[Path]:
    """Write leap seconds, clock, frames, attitudes and orbit into a folder; their paths."""
    files = {"made.tls": LEAP_SECONDS, "made.tsc": CLOCK, "made.tf": FRAMES}
    for name, text in files.items():
        (folder / name).write_text(text)
    (folder / "made.bc").write_bytes(attitude)
    (folder / "made.bsp").write_bytes(orbit or daf([orbit_segment()], b"DAF/SPK "))
    return [folder / name for name in (*files, "made.bc", "made.bsp")]
