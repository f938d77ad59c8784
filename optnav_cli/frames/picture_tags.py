"""What picture files state beside their pixels: tags of TIFF and EXIF, chunks of PNG.

Sources: TIFF 6.0, section 2 (image file directories) and 8 (tags); EXIF 2.3, 4.6.4; PNG 1.2,
chapter 11. GDAL hands some of them on, of some formats; so they are read here, and the checksums of
a PNG's chunks are checked, which GDAL does not do.
"""

import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from catalog.errors import DataError
from catalog.keywords import Keyword, check_keywords

_LINEAR = "state the [coding] of its counts in the camera file if they are not linear in light"
KEYWORDS = {
    "Orientation": Keyword(
        "refused",
        "viewers turn the picture, the sensor did not: state which of both the camera file "
        'describes (exif_orientation = "apply" or "ignore")',
        ("0", "1"),
    ),
    "PhotometricInterpretation": Keyword(
        "refused",
        "wanted gray, RGB, YCbCr or a palette: convert it",
        ("0", "1", "2", "3", "6"),
    ),
    "TransferFunction": Keyword("reported", _LINEAR),
    "Gamma": Keyword("reported", _LINEAR, ("1",)),
    "gAMA": Keyword("reported", _LINEAR, ("100000",)),
    "BitsPerSample": Keyword("used", "fewer bits than the container's are the full scale"),
    "MinSampleValue": Keyword("harmless", "the lowest value that is used"),
    "MaxSampleValue": Keyword("harmless", "the highest value that is used, not the sensor's"),
    "ExtraSamples": Keyword("used", "an alpha band marks pixels without a value"),
    "SampleFormat": Keyword("used", "integers or real numbers; complex ones are refused"),
    "sBIT": Keyword("harmless", "how many bits the values had before they were stretched"),
    "tRNS": Keyword("used", "transparent pixels have no value"),
    "sRGB": Keyword("harmless", "how colours are shown"),
    "iCCP": Keyword("harmless", "how colours are shown"),
}
_TIFF_TAGS = {
    274: "Orientation",
    262: "PhotometricInterpretation",
    301: "TransferFunction",
    258: "BitsPerSample",
    280: "MinSampleValue",
    281: "MaxSampleValue",
    0xA500: "Gamma",
}
_EXIF_FOLDER = 34665
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8}
_PNG = b"\x89PNG\r\n\x1a\n"
PIECE = 1 << 20  # bytes that are read at once
MAX_KEPT = 1 << 20  # bytes of a chunk or segment that holds tags
MAX_ENTRIES = 1000  # of a directory of tags
MAX_SEGMENTS = 1000  # of a JPEG before its pixels


def read_tags(path: Path) -> dict[str, str]:
    """Read the tags of a picture that KEYWORDS has; a PNG is checked to its end.

    Raises DataError for a PNG that breaks off or holds a chunk with a wrong checksum.
    """
    try:
        with path.open("rb") as file:
            head = file.read(8)
            if head == _PNG:
                return _read_png_tags(path, file)
            if head[:2] == b"\xff\xd8":
                return _read_jpeg_tags(file)
            if head[:4] in (b"II*\0", b"MM\0*"):
                return _read_tiff_tags(file, 0)
    except OSError as error:
        raise DataError(f"{path}: the picture cannot be read: {error.strerror}") from None
    return {}


def check_tags(path: Path, tags: dict[str, str], *, oriented: bool, coded: bool) -> list[str]:
    """Check tags against KEYWORDS; return the remarks to show.

    oriented, coded  whether the camera file says how to take orientation and coding
    Raises DataError for one that is refused.
    """
    settled = {"Orientation"} if oriented else set()
    if coded:
        settled |= {"TransferFunction", "Gamma", "gAMA"}
    stated = [(name, value) for name, value in tags.items() if name not in settled]
    return check_keywords(path, stated, KEYWORDS)


def _read_png_tags(path: Path, file: BinaryIO) -> dict[str, str]:
    tags: dict[str, str] = {}
    kind = b""
    while kind != b"IEND":
        start = file.tell()
        head = file.read(8)
        length, kind = struct.unpack(">I4s", head) if len(head) == 8 else (0, b"")
        checksum = zlib.crc32(kind)
        kept = file.tell() if kind in (b"eXIf", b"gAMA") and length <= MAX_KEPT else None
        size = length
        while length and (piece := file.read(min(length, PIECE))):
            checksum = zlib.crc32(piece, checksum)
            length -= len(piece)
        stated = file.read(4)
        if length or len(stated) < 4:
            raise DataError(f"{path}: the picture is broken: it ends after {file.tell()} bytes")
        if checksum != struct.unpack(">I", stated)[0]:
            raise DataError(f"{path}: the picture is broken: wrong checksum at byte {start}")
        if kept is not None:
            after = file.tell()
            if kind == b"eXIf":
                tags |= _read_tiff_tags(file, kept)
            elif size == 4:
                file.seek(kept)
                tags["gAMA"] = str(struct.unpack(">I", file.read(4))[0])
            file.seek(after)
    return tags


def _read_jpeg_tags(file: BinaryIO) -> dict[str, str]:
    """Tags of the EXIF segment of a JPEG."""
    file.seek(2)
    for _ in range(MAX_SEGMENTS):
        head = file.read(4)
        if len(head) < 4 or head[0] != 0xFF or head[1] == 0xDA:
            return {}
        start = file.tell()
        (size,) = struct.unpack(">H", head[2:])
        if head[1] == 0xE1 and file.read(6) == b"Exif\0\0":
            tags = _read_tiff_tags(file, start + 6)
            # a picture's own colours are those of its frame header
            return {name: tags[name] for name in ("Orientation", "Gamma") if name in tags}
        file.seek(start + max(size, 2) - 2)
    return {}


def _read_tiff_tags(file: BinaryIO, base: int) -> dict[str, str]:
    """Tags of the first directory of a TIFF that begins at a byte, and of its EXIF directory."""
    file.seek(base)
    head = file.read(8)
    if len(head) < 8 or head[:2] not in (b"II", b"MM"):
        return {}
    order = "<" if head[:2] == b"II" else ">"
    (first,) = struct.unpack(order + "I", head[4:])
    tags, below = _read_directory(file, base, first, order)
    if below is not None:
        more, _ = _read_directory(file, base, below, order)
        tags = more | tags
    return tags


def _read_directory(
    file: BinaryIO, base: int, start: int, order: str
) -> tuple[dict[str, str], int | None]:
    """The first value of each known tag as text, and where the EXIF directory stands."""
    tags: dict[str, str] = {}
    below = None
    file.seek(base + start)
    raw = file.read(2)
    count = min(struct.unpack(order + "H", raw)[0], MAX_ENTRIES) if len(raw) == 2 else 0
    entries = file.read(12 * count)
    for at in range(0, len(entries) - 11, 12):
        tag, kind, many = struct.unpack(order + "HHI", entries[at : at + 8])
        field = entries[at + 8 : at + 12]
        if tag == _EXIF_FOLDER:
            (below,) = struct.unpack(order + "I", field)
        if tag in _TIFF_TAGS:
            tags[_TIFF_TAGS[tag]] = _read_first_value(file, base, (kind, many, field), order)
    return tags, below


def _read_first_value(file: BinaryIO, base: int, entry: tuple[int, int, bytes], order: str) -> str:
    kind, many, field = entry
    if _SIZES.get(kind, 1) * many > 4:
        file.seek(base + struct.unpack(order + "I", field)[0])
        field = file.read(8)
    code = {1: "B", 3: "H", 4: "I", 5: "II"}.get(kind)
    if code is None or len(field) < struct.calcsize(order + code):
        return ""
    values = struct.unpack_from(order + code, field)
    if kind == 5:
        return f"{values[0] / values[1]:g}" if values[1] else ""
    return str(values[0])
