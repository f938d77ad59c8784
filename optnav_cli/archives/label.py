"""Labels of archive pictures, read alike: FITS, PDS3, PDS4, VICAR, lists of settings.

The text is read by label_text.py. Units are converted to m, rad and s, or refused.
"""

import configparser
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.inputs import MEGABYTE, check_input
from catalog.keywords import MAX_SHOWN
from catalog.special_values import read_number
from optnav_cli.archives.label_text import BEGINNING as VICAR_BEGINNING
from optnav_cli.archives.label_text import (
    OdlError,
    Statement,
    find_elements,
    read_elements,
    read_pairs,
    read_statements,
)
from optnav_cli.frames.fits_picture import BLOCK, CARD, read_cards, read_fits_headers

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
LabelFormat = Literal["fits", "pds3", "pds4", "vicar", "settings"]
Values = dict[str, tuple[str, ...]]

MAX_LABEL = MEGABYTE
MAX_NUMBER = 1e18  # km of a far star
# Without these values stand for one that is missing (PDS Standards Reference 3.8, section 17.2).
_NOT_STATED = ("", "-", "N/A", "NA", "UNK", "NULL", "NOT APPLICABLE", "NOT_APPLICABLE", "UNKNOWN")
# An SFDU head goes before, or stands instead of, the version; NJPL is that of the first archives.
_PDS3_HEAD = re.compile(
    rb"\A\s*(CCSD|NJPL)\w{8,}|^\s*PDS_VERSION_ID\s*=\s*[\"']?PDS3|^ODL_VERSION_ID", re.M
)


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


@dataclass(frozen=True)
class ArchiveLabel:
    """Texts that a label states by keyword, those of a block as BLOCK.KEYWORD, too.

    Of a PDS4 label keywords are the ends of paths of elements, as "Vector/x_position"; one of
    several elements of a name is told by what it has in it, as "Vector[Frame/name=J2000]/x".

    units    units of the values by keyword, as they are written; "" or no entry: none is stated
    doubled  keywords that are stated twice, differently, where none goes before the other
    """

    path: Path
    values: Values
    units: Values = field(default_factory=dict)
    doubled: frozenset[str] = frozenset()

    def text(self, key: str) -> str:
        """The first value of a keyword. Raises DataError where it is not stated."""
        return self.texts(key)[0]

    def texts(self, key: str) -> tuple[str, ...]:
        """The values of a keyword. Raises DataError where it is not stated, or stated twice."""
        names = self._find_names(key)
        values = {self.values[name]: name for name in names}
        if len(values) > 1 or self.doubled.intersection(names):
            shown = ", ".join(value[0] if value else "nothing" for value in values)
            raise DataError(
                f"{self.path}: its label states {key} several times ({shown[:MAX_SHOWN]}); name "
                "the block that is meant in the table, as BLOCK.KEYWORD or A/B/keyword"
            )
        listed = next(iter(values), ())
        if not listed or any(value.upper() in _NOT_STATED for value in listed):
            raise DataError(f"{self.path}: its label does not state {key}")
        return listed

    def is_stated(self, key: str) -> bool:
        """Whether a keyword has a value and none that stands for a missing one."""
        values = [self.values[name] for name in self._find_names(key.removeprefix("-"))]
        return any(
            value and not any(text.upper() in _NOT_STATED for text in value) for value in values
        )

    def unit(self, key: str) -> tuple[str, ...]:
        """The units of a keyword's values; none where it has none."""
        return next((self.units[name] for name in self._find_names(key) if name in self.units), ())

    def list_frame_keys(self, key: str) -> list[str]:
        """The keywords by which a label names the frame of a keyword's numbers, nearest first.

        PDS3 names one beside the keyword, PDS4 one in an element that holds the keyword's.
        """
        if "/" not in key:
            return [name for name in ("COORDINATE_SYSTEM_NAME",) if name in self.values]
        keys = []
        for name in self._find_names(key)[:1]:
            base = name
            while base := base.rpartition("/")[0]:
                ends = ("Reference_Frame_Identification/name",
                        "Coordinate_System_Identification/coordinate_system_name")  # fmt: skip
                keys += [f"{base}/{end}" for end in ends if f"{base}/{end}" in self.values]
        return keys

    def _find_names(self, key: str) -> list[str]:
        if "/" not in key:
            return [key] if key in self.values else []
        return find_elements(self.values, key)

    def numbers(
        self, keys: Sequence[str], quantity: Quantity = "number", default: float = 1.0
    ) -> FloatArray:
        """Numbers of keywords in m, rad, s or 1, one after another; "-KEY" is its number negated.

        quantity  of which stated units have to be;  default  size of a unit where none is stated
        Raises DataError for a keyword that is not stated or no number, is beyond all that labels
        hold, or has a unit of another quantity.
        """
        converted: list[float] = []
        for key in keys:
            name = key.removeprefix("-")
            sign = -1.0 if key != name else 1.0
            texts = self.texts(name)
            units = self.unit(name) or ("",) * len(texts)
            for text, unit in zip(texts, units, strict=True):
                value = read_number(text)
                if value is None:
                    raise DataError(f"{self.path}: {name} is '{text[:40]}'; wanted a number")
                if not abs(value) < MAX_NUMBER:
                    raise DataError(
                        f"{self.path}: {name} is {text[:40]}, no number below {MAX_NUMBER:g}"
                    )
                converted.append(
                    sign * value * self._find_unit_size(name, text, unit, quantity, default)
                )
        return np.array(converted)

    def _find_unit_size(
        self, key: str, text: str, unit: str, quantity: Quantity, default: float
    ) -> float:
        stated = find_unit(unit)
        if stated is not None and stated[0] == "number":
            return default
        if stated is None or stated[0] != quantity:
            of = f"a unit of {stated[0]}" if stated else "no unit that is known"
            remedy = (
                "leave the unit out"
                if quantity == "number"
                else "convert the value, or leave the unit out and state it in the table"
            )
            raise DataError(
                f"{self.path}: {key} = {text[:MAX_SHOWN]} <{unit[:MAX_SHOWN]}>, which is {of}; "
                f"wanted {EXAMPLES[quantity]}: {remedy}"
            )
        return stated[1]


def read_label(path: Path, kind: LabelFormat, extension: str = "") -> ArchiveLabel:
    """Read the label of a picture. Raises DataError for a file that is no label of its kind.

    extension  number or name of the picture in a FITS file; empty: the first
    """
    if kind == "vicar":
        return _read_vicar_label(path)
    if kind == "fits":
        check_input(path)
        return _read_fits_label(path, read_fits_headers(path, extension))
    raw = _read_head(path, MAX_LABEL)
    if kind == "pds3":
        return _read_pds3_label(path, raw.decode("latin-1"))
    text = raw.decode("utf-8-sig", "replace")
    if kind == "settings":
        return ArchiveLabel(path, _parse_settings(path, text))
    elements = list(read_elements(path, text))
    values: Values = {name: (value,) for name, value, _ in elements}
    return ArchiveLabel(path, values, {name: (unit,) for name, _, unit in elements if unit})


def detect_format(path: Path) -> LabelFormat | None:
    """Which kind of label a file begins with; None for none of these."""
    head = _read_head(path, 4096)
    if head.startswith(b"SIMPLE  ="):
        return "fits"
    if head.startswith(VICAR_BEGINNING):
        return "vicar"
    if _PDS3_HEAD.search(head):
        return "pds3"
    if re.search(rb"<(\w+:)?Product_Observational", head):
        return "pds4"
    return "settings" if re.match(rb"\s*\[[\w ]+\]\s", head) else None


def _read_head(path: Path, size: int) -> bytes:
    """The first bytes of a file. Raises DataError for a file that cannot be read."""
    check_input(path)
    try:
        with path.open("rb") as file:
            return file.read(size)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None


def _find_header_end(path: Path, raw: bytes) -> int:
    """Where the header of a FITS file ends."""
    for start in range(0, min(len(raw), MAX_LABEL), CARD):
        if raw[start : start + 8] == b"END     ":
            return (start // BLOCK + 1) * BLOCK
    raise DataError(f"{path}: its FITS header has no end; get the file again")


def _read_fits_label(path: Path, raw: bytes) -> ArchiveLabel:
    values: Values = {}
    units: Values = {}
    doubled: set[str] = set()
    if not raw.startswith(b"SIMPLE  ="):
        raise DataError(f"{path}: is no FITS file")
    for key, value, comment in read_cards(raw[: _find_header_end(path, raw)]):
        texts = (value,)
        if values.setdefault(key, texts) != texts:
            doubled.add(key)
        elif unit := extract_unit(comment):
            units.setdefault(key, (unit,))
    return ArchiveLabel(path, values, units, frozenset(doubled))


def _read_pds3_label(path: Path, text: str) -> ArchiveLabel:
    """A label of statements: a keyword by itself is that of the outermost block that has it."""
    values: Values = {}
    units: Values = {}
    doubled: set[str] = set()
    try:
        statements = read_statements(text)
    except OdlError as error:
        raise DataError(f"{path}: is a damaged PDS3 label: {error}") from None
    if not statements:
        raise DataError(f"{path}: is no PDS3 label")
    depths: dict[str, int] = {}
    for blocks, key, texts, stated in sorted(statements, key=_count_blocks):
        for name in {key, ".".join((*blocks, key))}:
            if depths.setdefault(name, len(blocks)) == len(blocks) and name in values:
                doubled |= {name} if values[name] != texts else set()
            elif name not in values:
                values[name], units[name] = texts, stated
    return ArchiveLabel(path, values, units, frozenset(doubled))


def _read_vicar_label(path: Path) -> ArchiveLabel:
    values: Values = {}
    doubled: set[str] = set()
    for group, key, texts in read_pairs(path):
        for name in {key, f"{group}.{key}".removeprefix(".")}:
            if values.setdefault(name, texts) != texts:
                doubled.add(name)
    return ArchiveLabel(path, values, doubled=frozenset(doubled))


def _count_blocks(statement: Statement) -> int:
    return len(statement.blocks)


def _parse_settings(path: Path, text: str) -> Values:
    """Parse settings in sections to SECTION.KEY; lists of numbers stand in brackets."""
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    try:
        parser.read_string(text)
    except configparser.Error as error:
        raise DataError(f"{path}: is no list of settings ({str(error).splitlines()[0]})") from None
    return {
        f"{section}.{key}": tuple(value.strip("[] \t").replace(",", " ").split()) or ("",)
        for section in parser.sections()
        for key, value in parser.items(section)
    }
