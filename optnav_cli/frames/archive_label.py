"""Labels of archive pictures, read alike: FITS headers, PDS3 and PDS4 labels, lists of settings.

FITS is read here, pixels and all, because the GDAL of the wheels has no driver for it (FITS
standard 4.0, sections 4 and 5: cards of 80 letters in blocks of 2880 bytes, big-endian pixels).
PDS3 labels are those of the PDS Standards Reference 3.8, chapter 12, in the part of it that
archives use.
"""

import configparser
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.inputs import MEGABYTE, check_input, read_input

LabelFormat = Literal["fits", "pds3", "pds4", "settings"]
Values = dict[str, tuple[str, ...]]

MAX_BYTES = 256 * MEGABYTE  # of a FITS picture
MAX_LABEL = MEGABYTE
MAX_NUMBER = 1e18  # km of a far star
MAX_DEPTH = 64  # of elements in elements
_BLOCK, _CARD = 2880, 80
_TYPES = {"8": "u1", "16": ">i2", "32": ">i4", "-32": ">f4", "-64": ">f8"}
_END = re.compile(r"^END\s*$", re.M)
_STATEMENT = re.compile(
    r"^[ \t]*(\^?[\w:]+)[ \t]*=\s*"
    r"(\"[^\"]{0,8000}\"|'[^']{0,8000}'|\([^)]{0,4000}\)|\{[^}]{0,4000}\}|[^\r\n]*)",
    re.M,
)
_NOT_STATED = ("", "N/A", "UNK", "NULL", "NOT APPLICABLE", "UNKNOWN")


@dataclass(frozen=True)
class ArchiveLabel:
    """What a label states: texts by keyword, those of a block as BLOCK.KEYWORD, too.

    Of a PDS4 label keywords are the ends of paths of elements, as "Vector/x_position".
    """

    path: Path
    values: Values

    def text(self, key: str) -> str:
        """The one value of a keyword. Raises DataError where it is not stated."""
        return self.texts(key)[0]

    def texts(self, key: str) -> tuple[str, ...]:
        """The values of a keyword. Raises DataError where it is not stated."""
        found = self.values.get(key, ())
        if "/" in key:
            paths = (name for name in self.values if f"/{name}".endswith(f"/{key}"))
            found = self.values.get(next(paths, ""), ())
        if not found or any(value.upper() in _NOT_STATED for value in found):
            raise DataError(f"{self.path}: its label does not state {key}")
        return found

    def numbers(self, keys: tuple[str, ...]) -> FloatArray:
        """The numbers of some keywords, one after another; "-KEY" is its number negated.

        Raises DataError where one is not stated, is no number or beyond all that labels hold.
        """
        found = []
        for key in keys:
            name = key.removeprefix("-")
            try:
                numbers = [float(text) for text in self.texts(name)]
            except ValueError:
                raise DataError(
                    f"{self.path}: {name} is '{self.values[name][0][:40]}'; wanted a number"
                ) from None
            found += [-number for number in numbers] if key != name else numbers
        if not (np.abs(found) < MAX_NUMBER).all():
            raise DataError(f"{self.path}: {', '.join(keys)} are not numbers below {MAX_NUMBER:g}")
        return np.array(found)


def read_label(path: Path, kind: LabelFormat) -> ArchiveLabel:
    """Read the label of a picture. Raises DataError for a file that is no label of its kind."""
    raw = _head(path, MAX_LABEL)
    if kind == "fits":
        return ArchiveLabel(path, _fits_cards(path, raw))
    head = raw.decode("latin-1" if kind == "pds3" else "utf-8-sig", "replace")
    read = {"pds3": _pds3_values, "pds4": _pds4_values, "settings": _settings_values}[kind]
    return ArchiveLabel(path, read(path, head))


def format_of(path: Path) -> LabelFormat | None:
    """Which kind of label a file begins with; None for none of these."""
    head = _head(path, 4096)
    if head.startswith(b"SIMPLE  ="):
        return "fits"
    if re.search(rb"^\s*(CCSD\S*\s+)?PDS_VERSION_ID\s*=\s*\"?PDS3|^ODL_VERSION_ID", head, re.M):
        return "pds3"
    if b"<Product_Observational" in head:
        return "pds4"
    return "settings" if re.match(rb"\s*\[[\w ]+\]\s", head) else None


def _head(path: Path, size: int) -> bytes:
    """The first bytes of a file. Raises DataError for a file that cannot be read."""
    check_input(path)
    try:
        with path.open("rb") as file:
            return file.read(size)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None


def fits_picture(label: ArchiveLabel) -> NDArray[np.generic]:
    """The picture (rows, columns) of a FITS file, its first row first. Raises DataError."""
    path = label.path
    axes = [label.text("NAXIS")] + [label.values.get(f"NAXIS{i}", ("",))[0] for i in (1, 2)]
    kind = label.text("BITPIX")
    if axes[0] != "2" or kind not in _TYPES or not all(size.isdigit() for size in axes[1:]):
        raise DataError(
            f"{path}: has {axes[0]} axes of {'x'.join(axes[1:])} numbers, BITPIX {kind}; wanted a "
            "FITS picture of two axes"
        )
    columns, rows = int(axes[1]), int(axes[2])
    raw = read_input(path, limit=MAX_BYTES)
    start = _header_bytes(path, raw)
    layout = np.dtype(_TYPES[kind])
    if rows * columns == 0 or len(raw) < start + rows * columns * layout.itemsize:
        raise DataError(f"{path}: is cut short: {columns} x {rows} pixels do not fit")
    stored = np.frombuffer(raw, layout, rows * columns, start).reshape(rows, columns)
    scale, zero = (
        label.numbers((key,))[0] if key in label.values else default
        for key, default in (("BSCALE", 1.0), ("BZERO", 0.0))
    )
    if (scale, zero) == (1.0, 0.0):
        return stored.astype(layout.newbyteorder("="))
    with np.errstate(over="ignore"):  # pixels without a value
        return (stored * scale + zero).astype(np.float32)


def _header_bytes(path: Path, raw: bytes) -> int:
    """Where the header of a FITS file ends."""
    for start in range(0, min(len(raw), MAX_LABEL), _CARD):
        if raw[start : start + 8] == b"END     ":
            return (start // _BLOCK + 1) * _BLOCK
    raise DataError(f"{path}: its FITS header has no end; get the file again")


def _fits_cards(path: Path, raw: bytes) -> Values:
    values: Values = {}
    if not raw.startswith(b"SIMPLE  ="):
        raise DataError(f"{path}: is no FITS file")
    for start in range(0, _header_bytes(path, raw), _CARD):
        card = raw[start : start + _CARD].decode("latin-1")
        if card[8:10] != "= ":
            continue
        text = card[10:].strip()
        quoted = re.match(r"'((?:[^']|'')*)'", text)
        text = quoted[1].replace("''", "'") if quoted else text.partition("/")[0]
        values.setdefault(card[:8].strip(), (text.strip(),))
    return values


def _pds3_values(path: Path, text: str) -> Values:
    first, *rest = _END.split(text, maxsplit=1)[0].split("/*")
    text = first + "".join(" " + part.partition("*/")[2] for part in rest)
    values: Values = {}
    blocks: list[str] = []
    for key, value in _STATEMENT.findall(text):
        key, value = key.upper(), value.strip()
        if key in ("OBJECT", "GROUP"):
            blocks.append(value)
        elif key in ("END_OBJECT", "END_GROUP"):
            blocks = blocks[:-1]
        else:
            parts = value[1:-1].split(",") if value[:1] in ("(", "{") else [value]
            texts = tuple(map(_plain, parts))
            values.setdefault(key, texts)
            values.setdefault(".".join([*blocks, key]), texts)
    if not values:
        raise DataError(f"{path}: is no PDS3 label")
    return values


def _plain(text: str) -> str:
    """A value without its quotes and its unit."""
    text = re.sub(r"<[^>]*>\s*$", "", text.strip()).strip()
    return " ".join(text.strip("\"'").split())


def _pds4_values(path: Path, text: str) -> Values:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DataError(f"{path}: is no plain PDS4 label")
    try:
        root = ElementTree.fromstring(text.encode("utf-8"))
    except ElementTree.ParseError as error:
        raise DataError(f"{path}: is a damaged PDS4 label ({error})") from None
    values: Values = {}
    waiting = [(root, "")]
    while waiting:
        element, above = waiting.pop(0)
        name = f"{above}/{element.tag.rpartition('}')[2]}".strip("/")
        if name.count("/") > MAX_DEPTH:
            raise DataError(f"{path}: is no PDS4 label: elements in elements, too deep")
        if len(element) == 0:
            values.setdefault(name, ((element.text or "").strip(),))
        waiting += [(child, name) for child in element]
    return values


def _settings_values(path: Path, text: str) -> Values:
    """Of lists of settings in sections, as SECTION.KEY; lists of numbers stand in brackets."""
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
