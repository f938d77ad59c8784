"""Read the pixels of an uncompressed PDS3 picture by its label's pointer and IMAGE object.

For labels that GDAL cannot open: with keywords without a value, or a pointer to a file whose name
is written in other letters. Source: PDS Standards Reference 3.8, appendix A.20 and chapter 14.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from catalog.errors import DataError
from catalog.inputs import MEGABYTE, read_input
from optnav_cli.archives.label import ArchiveLabel

MAX_BYTES = 256 * MEGABYTE
MAX_SIDE = 65_536
# SAMPLE_TYPE by its byte order and kind; the synonyms of appendix C.
_KINDS = {
    **dict.fromkeys(("MSB_UNSIGNED_INTEGER", "UNSIGNED_INTEGER", "SUN_UNSIGNED_INTEGER",
                     "MAC_UNSIGNED_INTEGER", "IBM_UNSIGNED_INTEGER"), ">u"),
    **dict.fromkeys(("LSB_UNSIGNED_INTEGER", "PC_UNSIGNED_INTEGER", "VAX_UNSIGNED_INTEGER"), "<u"),
    **dict.fromkeys(("MSB_INTEGER", "INTEGER", "SUN_INTEGER", "MAC_INTEGER", "IBM_INTEGER"), ">i"),
    **dict.fromkeys(("LSB_INTEGER", "PC_INTEGER", "VAX_INTEGER"), "<i"),
    **dict.fromkeys(("IEEE_REAL", "MAC_REAL", "REAL", "SUN_REAL", "FLOAT"), ">f"),
    "PC_REAL": "<f",
}  # fmt: skip
_SIZES = {"u": ("8", "16", "32"), "i": ("8", "16", "32"), "f": ("32", "64")}
_PLAIN = ("N/A", "NONE", "UNCOMPRESSED", "")


def read_pds3_pixels(label: ArchiveLabel) -> NDArray[np.generic]:
    """Read the band (rows, columns) of a label's IMAGE object, as they are stored.

    Raises DataError for a label without one, for coded pixels, and for a file that is cut short.
    """
    path = label.path
    rows, columns = (_count(label, f"IMAGE.{key}", None) for key in ("LINES", "LINE_SAMPLES"))
    layout = _find_layout(label)
    coding = label.text("IMAGE.ENCODING_TYPE") if label.is_stated("IMAGE.ENCODING_TYPE") else ""
    bands = _count(label, "IMAGE.BANDS", 1)
    if coding.upper() not in _PLAIN or bands != 1:
        raise DataError(
            f"{path}: its IMAGE has {bands} bands, ENCODING_TYPE {coding or 'none'}; wanted one "
            "uncompressed band: name a converted picture with --picture"
        )
    before, after = (_count(label, f"IMAGE.LINE_{key}_BYTES", 0) for key in ("PREFIX", "SUFFIX"))
    file, start = _read_pointer(label)
    raw = read_input(file, limit=MAX_BYTES)
    row_bytes = before + columns * layout.itemsize + after
    if len(raw) < start + rows * row_bytes:
        raise DataError(f"{file}: is cut short: {columns} x {rows} pixels do not fit")
    lines = np.frombuffer(raw, np.uint8, rows * row_bytes, start).reshape(rows, row_bytes)
    used = np.ascontiguousarray(lines[:, before : row_bytes - after])
    return used.view(layout).astype(layout.newbyteorder("="))


def _find_layout(label: ArchiveLabel) -> np.dtype[np.generic]:
    kind = label.text("IMAGE.SAMPLE_TYPE").upper()
    bits = label.text("IMAGE.SAMPLE_BITS")
    form = _KINDS.get(kind, "")
    if not form or bits not in _SIZES[form[1]]:
        raise DataError(
            f"{label.path}: its pixels are {kind} of {bits} bits, which is not known; name a "
            "converted picture with --picture"
        )
    return np.dtype(f"{form}{int(bits) // 8}")


def _count(label: ArchiveLabel, key: str, default: int | None) -> int:
    if default is not None and not label.is_stated(key):
        return default
    value = float(label.numbers((key,))[0])
    if not (0.0 <= value <= MAX_SIDE and value == int(value)) or (default is None and value == 0.0):
        raise DataError(f"{label.path}: {key} is {value:g}; wanted a count up to {MAX_SIDE}")
    return int(value)


def _read_pointer(label: ArchiveLabel) -> tuple[Path, int]:
    """The file that ^IMAGE points to and the byte of it where the pixels begin.

    A pointer is a record, counted from 1, or a byte with the unit <BYTES>; in the label's own file
    or in one that it names.
    """
    texts, units = label.texts("^IMAGE"), label.unit("^IMAGE")
    number = texts[-1] if texts[-1].isdigit() else "1"
    if len(texts) > 2 or (len(texts) == 2 and not texts[1].isdigit()) or len(number) > 12:
        raise DataError(f"{label.path}: ^IMAGE is {', '.join(texts)[:60]}, no file and record")
    file = label.path if texts[0].isdigit() else _find_file(label.path, texts[0])
    if units[-1].upper() in ("BYTES", "BYTE"):
        return file, int(number) - 1
    if units[-1]:
        raise DataError(f"{label.path}: ^IMAGE has the unit {units[-1]}; wanted records or BYTES")
    record = 0 if number == "1" else _record_bytes(label)
    return file, (int(number) - 1) * record


def _record_bytes(label: ArchiveLabel) -> int:
    value = float(label.numbers(("RECORD_BYTES",))[0])
    if not 1.0 <= value <= MAX_BYTES:
        raise DataError(f"{label.path}: RECORD_BYTES is {value:g}; wanted a count")
    return int(value)


def _find_file(path: Path, name: str) -> Path:
    """The file of a name in the folder of a label, in whatever letters it is written."""
    if Path(name).name != name:
        raise DataError(f"{path}: ^IMAGE names {name[:60]}; wanted a file beside the label")
    exact = path.parent / name
    if exact.exists():
        return exact
    others = [file for file in path.parent.iterdir() if file.name.lower() == name.lower()]
    if not others:
        raise DataError(
            f"{path}: ^IMAGE points to {name[:60]}, and there is no such file beside the label; "
            "name the picture with --picture"
        )
    return others[0]
