"""Pictures in FITS files, which the GDAL of the wheels has no driver for.

Source: FITS standard 4.0, sections 3 to 7: units of a header and data each, cards of 80 letters in
blocks of 2880 bytes, big-endian pixels, value = BZERO + BSCALE * stored, BLANK and NaN for pixels
without a value. The first row of the data is the picture's uppermost unless ROWORDER says that it
is the lowest, as some capture programs write.
"""

import math
import re
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from catalog.errors import DataError
from catalog.inputs import MEGABYTE, check_input
from catalog.keywords import Keyword, check_keywords
from optnav_cli.frames.raster_pixels import StoredPixels

CARD = 80  # bytes
_HIERARCH = re.compile(r"HIERARCH +([^=/']*[^=/' ]) *=(.*)", re.DOTALL)
_QUOTED = re.compile(r"'((?:[^']|'')*)'")
BLOCK = 2880  # bytes
MAX_BYTES = 256 * MEGABYTE  # of a picture
MAX_HEADER = MEGABYTE
MAX_UNITS = 1000
MAX_AXES = 999  # the standard's
_TYPES = {"8": "u1", "16": ">i2", "32": ">i4", "64": ">i8", "-32": ">f4", "-64": ">f8"}
# Kinds of 16 and 32 bits with an offset are unsigned (standard, 4.4.2.5).
_UNSIGNED = {("16", 32768.0): "uint16", ("32", 2147483648.0): "uint32", ("8", -128.0): "int8"}

KEYWORDS = {
    "BITPIX": Keyword("used", "the type of the pixels"),
    "NAXIS": Keyword("used", "a picture has two axes, others of one pixel beside them"),
    "BSCALE": Keyword("used", "multiplies the stored values"),
    "BZERO": Keyword("used", "is added to the stored values"),
    "BLANK": Keyword("used", "a stored value of pixels without a value"),
    "ROWORDER": Keyword("used", "which row is uppermost"),
    "SATURATE": Keyword("used", "full scale"),
    "SATLEVEL": Keyword("used", "full scale"),
    "EXTNAME": Keyword("used", "the name by which an extension is chosen"),
    "ZIMAGE": Keyword("refused", "the picture is compressed: unpack it (funpack)", ("F",)),
    "GROUPS": Keyword("refused", "random groups hold no picture: write an image", ("F",)),
    "BAYERPAT": Keyword(
        "refused", "each pixel has one colour of a filter mosaic: make it gray", ("", "NONE")
    ),
    "FLIPSTAT": Keyword(
        "refused", "the picture was mirrored: write it as the sensor had it", ("",)
    ),
    "BUNIT": Keyword("harmless", "brightness is compared with itself alone"),
    "DATAMAX": Keyword("harmless", "the picture's highest value, not the sensor's"),
    "DATAMIN": Keyword("harmless", "the picture's lowest value"),
    "PEDESTAL": Keyword("harmless", "a level that all pixels share"),
    "CTYPE1": Keyword("harmless", "the pose comes from frames.csv or the import table"),
    "CTYPE2": Keyword("harmless", "as CTYPE1"),
    "PCOUNT": Keyword("harmless", "0 in images"),
    "GCOUNT": Keyword("harmless", "1 in images"),
}
_TOP_FIRST, _BOTTOM_FIRST = ("TOP-DOWN", "TOP_DOWN"), ("BOTTOM-UP", "BOTTOM_UP")


def read_cards(header: bytes) -> Iterator[tuple[str, str, str]]:
    """Keyword, value as text without its quotes, and comment of the cards that have a value."""
    held: tuple[str, str, str] | None = None  # a text that a card more may continue
    for start in range(0, len(header), CARD):
        card = header[start : start + CARD].decode("latin-1")
        if card.startswith("CONTINUE  ") and held is not None and held[1].endswith("&"):
            text, comment, _ = _split_value(card[10:])
            held = held[0], held[1][:-1] + text, f"{held[2]} {comment}".strip()
            continue
        if held is not None:
            yield held[0], held[1].strip(), held[2]
            held = None
        long = _HIERARCH.fullmatch(card)
        if card[8:10] != "= " and long is None:
            continue
        key, after = (long[1], long[2]) if long is not None else (card[:8].strip(), card[10:])
        text, comment, is_text = _split_value(after)
        if is_text:
            held = " ".join(key.split()), text, comment
        else:
            yield " ".join(key.split()), text, comment
    if held is not None:
        yield held[0], held[1].strip(), held[2]


def _split_value(text: str) -> tuple[str, str, bool]:
    """Value and comment of the part of a card after the sign, and whether it is a quoted text."""
    text = text.strip()
    quoted = _QUOTED.match(text)
    if quoted is None:
        text, _, comment = text.partition("/")
        return text.strip(), comment.strip(), False
    comment = text[quoted.end() :].partition("/")[2].strip()
    # spaces before a text count, those after it do not (4.2.1.1)
    return quoted[1].replace("''", "'").rstrip(), comment, True


class FitsUnit(NamedTuple):
    """One header and data unit.

    cards  the header's values as text by keyword;  header  its cards as bytes, without END
    start  byte at which the data begin
    """

    number: int
    cards: dict[str, str]
    header: bytes
    start: int

    @property
    def axes(self) -> list[int]:
        """Lengths of the axes."""
        return [_read_integer(self.cards, f"NAXIS{i + 1}") for i in range(_count_axes(self.cards))]

    @property
    def is_picture(self) -> bool:
        """Whether the unit is an image of two axes, longer ones beside them having one pixel."""
        kind = self.cards.get("XTENSION", "IMAGE")
        axes = self.axes
        return kind == "IMAGE" and len(axes) >= 2 and all(axes[:2]) and set(axes[2:]) <= {1}

    @property
    def is_compressed(self) -> bool:
        """Whether the unit is a table that holds a compressed picture."""
        return self.cards.get("ZIMAGE", "F") == "T"


def is_fits(path: Path) -> bool:
    """Whether a file begins as FITS does."""
    check_input(path)
    with path.open("rb") as file:
        return file.read(9) == b"SIMPLE  ="


def find_unit(path: Path, extension: str = "") -> FitsUnit:
    """Find the unit of a FITS file that holds the picture.

    extension  its number, 0 being the first unit, or its EXTNAME; empty: the first with a picture
    Raises DataError for a file that is cut short and for one without that picture.
    """
    units = []
    try:
        with path.open("rb") as file:
            for unit in _read_units(path, file):
                units.append(unit)
                if _is_wanted(unit, extension):
                    return unit
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    if not extension:
        compressed = [unit for unit in units if unit.is_compressed]
        if compressed:
            return compressed[0]
    there = ", ".join(_describe_unit(unit) for unit in units[:8])
    wanted = f"no extension '{extension}'" if extension else "no picture of two axes"
    raise DataError(f"{path}: has {wanted}; there are {there}")


def read_fits_headers(path: Path, extension: str = "") -> bytes:
    """Cards of the unit with the picture, then those of the first unit, with the END card.

    Those of the first alone where no extension is named and none has a picture.
    """
    unit = first = find_unit(path, "0")
    with suppress(DataError) if not extension else nullcontext():
        unit = find_unit(path, extension)
    if unit.number == 0:
        return first.header + b"END".ljust(CARD)
    every = [first.header[at : at + CARD] for at in range(0, len(first.header), CARD)]
    # what both state is the picture's
    others = [
        card for card in every[1:] if not unit.cards.keys() & {c[0] for c in read_cards(card)}
    ]
    return b"".join([every[0], unit.header, *others, b"END".ljust(CARD)])


def get_fits_shape(unit: FitsUnit) -> tuple[int, int]:
    """Rows and columns of a unit's picture."""
    columns, rows = unit.axes[:2]
    return rows, columns


def read_fits(path: Path, unit: FitsUnit) -> StoredPixels:
    """Read the picture of a unit.

    Raises DataError for one that is cut short, compressed, of a kind that is not read, or that
    states what cannot be applied.
    """
    check_keywords(path, unit.cards.items(), KEYWORDS)
    if not unit.is_picture:
        raise DataError(
            f"{path}: {_describe_unit(unit)} is no picture; wanted an image of two axes"
        )
    bitpix = unit.cards.get("BITPIX", "")
    if bitpix not in _TYPES:
        raise DataError(f"{path}: states BITPIX = {bitpix}; wanted {', '.join(_TYPES)}")
    layout, (rows, columns) = np.dtype(_TYPES[bitpix]), get_fits_shape(unit)
    size = rows * columns * layout.itemsize
    if size > MAX_BYTES:
        raise DataError(
            f"{path}: the picture is {columns} x {rows}; wanted at most {MAX_BYTES // MEGABYTE} MiB"
        )
    with path.open("rb") as file:
        file.seek(unit.start)
        raw = file.read(size)
    if len(raw) < size:
        raise DataError(f"{path}: is cut short: {columns} x {rows} pixels do not fit")
    stored = np.frombuffer(raw, layout).reshape(rows, columns)
    stored = stored.astype(layout.newbyteorder("="))
    missing = np.isnan(stored) if stored.dtype.kind == "f" else np.zeros((1, 1), np.bool_)
    if "BLANK" in unit.cards and stored.dtype.kind != "f":
        missing = stored == _read_number(path, unit, "BLANK")
    scale, zero = (
        _read_number(path, unit, key) if key in unit.cards else default
        for key, default in (("BSCALE", 1.0), ("BZERO", 0.0))
    )
    if scale == 0.0:
        raise DataError(f"{path}: states BSCALE = 0; wanted another number")
    kind = _UNSIGNED.get((bitpix, zero), stored.dtype.name) if scale == 1.0 else "float32"
    values = stored
    if (scale, zero) != (1.0, 0.0):
        wide = stored.astype(np.float64) * scale + zero
        values = wide.astype(kind if scale == 1.0 and kind.startswith(("u", "int8")) else "f4")
    levels = [
        _read_number(path, unit, key) for key in ("SATURATE", "SATLEVEL") if key in unit.cards
    ]
    full = min((level for level in levels if level > 0.0), default=None)
    if _is_bottom_first(path, unit):
        values, missing = values[::-1], missing[::-1]
    return StoredPixels(
        np.ascontiguousarray(values), kind, missing if missing.any() else None, full
    )


def _read_units(path: Path, file: BinaryIO) -> Iterator[FitsUnit]:
    """The units of a file, one after another. Raises DataError for a header without an end."""
    start = 0
    for number in range(MAX_UNITS):
        file.seek(start)
        header = _read_header(path, file, number)
        if header is None:
            return
        cards = _collect_cards(header)
        data = start + (len(header) // BLOCK + 1) * BLOCK
        unit = FitsUnit(number, cards, header, data)
        if number == 0 and not header.startswith(b"SIMPLE  ="):
            raise DataError(f"{path}: is no FITS file")
        yield unit
        axes = unit.axes
        # random groups have a first axis of 0
        count = math.prod(axes[1:] if axes[:1] == [0] else axes) if axes else 0
        width = abs(_read_integer(cards, "BITPIX")) // 8
        count = (
            _read_integer(cards, "GCOUNT", 1) * (_read_integer(cards, "PCOUNT") + count)
            if axes
            else 0
        )
        start = data + -(-width * count // BLOCK) * BLOCK


def _read_header(path: Path, file: BinaryIO, number: int) -> bytes | None:
    """The cards of a header without END; None after the last unit."""
    header = b""
    while len(header) < MAX_HEADER:
        block = file.read(BLOCK)
        if number and not header and not block.startswith(b"XTENSION="):
            return None
        for at in range(0, len(block), CARD):
            if block[at : at + 8] in (b"END     ", b"END"):
                return header + block[:at]
        header += block
        if len(block) < BLOCK:
            break
    raise DataError(f"{path}: its FITS header has no end; get the file again")


def _collect_cards(header: bytes) -> dict[str, str]:
    values: dict[str, str] = {}
    for key, text, _ in read_cards(header):
        values.setdefault(key, text)
    return values


def _count_axes(cards: dict[str, str]) -> int:
    return min(_read_integer(cards, "NAXIS"), MAX_AXES)


def _read_integer(cards: dict[str, str], key: str, default: int = 0) -> int:
    """A card's whole number, at least 0 and at most 2^40; the default where it has none."""
    text = cards.get(key, "")
    negative = text.startswith("-") and key == "BITPIX"
    digits = text[1:] if negative else text
    return min(int(digits[:13]), 1 << 40) if re.fullmatch(r"[0-9]+", digits) else default


def _read_number(path: Path, unit: FitsUnit, key: str) -> float:
    text = unit.cards[key]
    try:
        number = float(text.upper().replace("D", "E"))
    except ValueError:
        number = math.nan
    if not abs(number) < 1e30:
        raise DataError(f"{path}: states {key} = {text[:40]}; wanted a number")
    return number


def _is_wanted(unit: FitsUnit, extension: str) -> bool:
    if not extension:
        return unit.is_picture
    name = unit.cards.get("EXTNAME", "").casefold()
    return extension.strip().casefold() == name or extension.strip() == str(unit.number)


def _describe_unit(unit: FitsUnit) -> str:
    size = " x ".join(str(length) for length in unit.axes) or "no data"
    name = unit.cards.get("EXTNAME", unit.cards.get("XTENSION", ""))
    return f"{unit.number} {name} ({size})".replace("  ", " ")


def _is_bottom_first(path: Path, unit: FitsUnit) -> bool:
    order = unit.cards.get("ROWORDER", "").upper()
    if order and order not in _TOP_FIRST + _BOTTOM_FIRST:
        raise DataError(f"{path}: states ROWORDER = {order[:40]}; wanted TOP-DOWN or BOTTOM-UP")
    return order in _BOTTOM_FIRST
