"""Units of the numbers in labels: lengths, angles and times to m, rad and s.

PDS3 writes a unit as <km> after a number or a sequence, PDS4 as an attribute, FITS in brackets in a
card's comment. Case does not count: <KM> of PDS3 is a kilometre.
"""

import math
import re
from typing import Literal

Quantity = Literal["length", "angle", "time", "speed", "rate", "number"]

_LENGTHS = {"m": 1.0, "km": 1e3, "dm": 0.1, "cm": 0.01, "mm": 1e-3, "um": 1e-6, "nm": 1e-9,
            "au": 149_597_870_700.0}  # fmt: skip
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": math.pi / 180.0,
           "arcmin": math.pi / 10_800.0, "arcsec": math.pi / 648_000.0}  # fmt: skip
_TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86_400.0}
_NAMES = {
    **dict.fromkeys(("meter", "metre"), "m"),
    **dict.fromkeys(("kilometer", "kilometre", "kms"), "km"),
    **dict.fromkeys(("centimeter", "centimetre"), "cm"),
    **dict.fromkeys(("millimeter", "millimetre"), "mm"),
    **dict.fromkeys(("micrometer", "micrometre", "micron", "microns"), "um"),
    **dict.fromkeys(("nanometer", "nanometre"), "nm"),
    **dict.fromkeys(("a.u.", "astronomical unit"), "au"),
    **dict.fromkeys(("radian", "rads"), "rad"),
    **dict.fromkeys(("milliradian", "millirad"), "mrad"),
    **dict.fromkeys(("microradian", "microrad"), "urad"),
    **dict.fromkeys(("degree", "degs", "deg.", "°"), "deg"),
    **dict.fromkeys(("arcminute", "minute of arc"), "arcmin"),
    **dict.fromkeys(("arcsecond", "arcsecs", "second of arc"), "arcsec"),
    **dict.fromkeys(("sec", "secs", "second", "sec."), "s"),
    **dict.fromkeys(("msec", "msecs", "millisecond", "millisec"), "ms"),
    **dict.fromkeys(("usec", "microsecond", "microsec"), "us"),
    **dict.fromkeys(("nanosecond", "nsec"), "ns"),
    **dict.fromkeys(("minute", "mins"), "min"),
    **dict.fromkeys(("hour", "hr", "hrs"), "h"),
    "day": "d",
}
NO_UNIT = ("", "n/a", "none", "null", "unk", "unknown", "1", "dimensionless", "unitless")
EXAMPLES = {"length": "a length, as km or m", "angle": "an angle, as deg or rad",
            "time": "a time, as s or ms", "number": "a number without a unit",
            "speed": "a speed, as km/s", "rate": "a rate, as deg/s"}  # fmt: skip
_BRACKETS = re.compile(r"\[([^\[\]]{1,24})\]")
# A unit in words: "(km)", "in degrees", and "in (x) km" of NEAR's headers.
_IN_WORDS = re.compile(r"(?:^|\s)\(([^()]{1,16})\)|\bin (?:\([^()]{1,8}\) )?([^\W\d]+)", re.I)


def find_unit(name: str) -> tuple[Quantity, float] | None:
    """The quantity that a unit is of and its size in m, rad, s, m/s or rad/s; None: unknown."""
    text = " ".join(name.lower().split())
    if text in NO_UNIT:
        return "number", 1.0
    simple = _find_simple(text)
    if simple is not None:
        return simple
    above, slash, below = text.partition("/")
    top, time = _find_simple(above.strip()), _find_simple(below.strip())
    if slash and top is not None and time is not None and time[0] == "time" != top[0]:
        return ("speed" if top[0] == "length" else "rate"), top[1] / time[1]
    return None


def _find_simple(text: str) -> tuple[Quantity, float] | None:
    tables: tuple[tuple[Quantity, dict[str, float]], ...] = (
        ("length", _LENGTHS), ("angle", _ANGLES), ("time", _TIMES))  # fmt: skip
    for name in (text, text.removesuffix("s"), text.removesuffix("(s)").strip()):
        symbol = _NAMES.get(name, name if name == text else "")
        for quantity, sizes in tables:
            if symbol in sizes:
                return quantity, sizes[symbol]
    return None


def extract_unit(comment: str) -> str:
    """The unit that a FITS comment states, or "".

    A unit is what stands in brackets at the comment's beginning (FITS standard 4.0, section 4.3.2),
    known or not; elsewhere, or in words, only a known one is taken for a unit.
    """
    text = comment.strip()
    bracketed = _BRACKETS.match(text)
    if bracketed is not None:
        return bracketed[1].strip()
    words = [match[1] for match in _BRACKETS.finditer(text)]
    words += [match[1] or match[2] for match in _IN_WORDS.finditer(text)]
    known = ((word.strip(), find_unit(word)) for word in words)
    return next((word for word, unit in known if unit is not None and unit[0] != "number"), "")
