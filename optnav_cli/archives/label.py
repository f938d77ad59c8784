"""Labels of archive pictures, read alike: FITS, PDS3, PDS4, VICAR, lists of settings.

PDS3 labels are read in odl.py, their units in label_units.py.
"""

import configparser
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
from optnav_cli.archives.label_units import EXAMPLES, Quantity, extract_unit, find_unit
from optnav_cli.archives.odl import OdlError, Statement, read_statements
from optnav_cli.archives.pds4_label import find_elements, read_elements
from optnav_cli.archives.vicar_label import BEGINNING as VICAR_BEGINNING
from optnav_cli.archives.vicar_label import read_pairs
from optnav_cli.frames.fits_cards import CARD, read_cards
from optnav_cli.frames.fits_picture import BLOCK, read_fits_headers

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
