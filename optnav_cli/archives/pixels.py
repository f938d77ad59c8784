"""The pixels of an archive's picture, put into a picture folder with their mask and full scale.

PDS3, PDS4 and ISIS labels state special values, row order and coding; uncompressed PDS3 pictures
that GDAL cannot open are read here.
"""

import shutil
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from catalog.inputs import MEGABYTE, read_input
from catalog.keywords import Keyword, check_keywords
from catalog.rasters import PICTURES, handle_read_errors, open_raster
from catalog.special_values import (
    MISSING_KEYWORDS,
    SATURATED_KEYWORDS,
    SpecialValues,
    read_stored_value,
)
from optnav_cli.archives.frame import ImportTable
from optnav_cli.archives.isis_cube import Label, read_cube_label
from optnav_cli.archives.label import ArchiveLabel, detect_format, read_label
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.fits_picture import find_unit, get_fits_shape, is_fits, read_fits
from optnav_cli.frames.raster_pixels import (
    FULL_SCALE,
    StoredPixels,
    apply_special,
    find_full_scale,
    find_mask,
    read_raster,
)
from optnav_cli.frames.tables import TIMES

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
_CODED = (
    "the counts are coded by the camera's own table or cut to 8 bits: state the table in the "
    "[coding] of the camera file, or take another product"
)
KEYWORDS = {
    # 8LSB, too: its counts begin at 0 again above 255
    "DATA_CONVERSION_TYPE": Keyword("refused", _CODED, ("", "12BIT", "N/A", "UNK")),
    "DataConversionType": Keyword("refused", _CODED, ("", "12BIT", "N/A", "UNK")),
    "MESS:COMP12_8": Keyword("refused", _CODED, ("", "0", "N/A", "UNK")),
    "COMP12_8": Keyword("refused", _CODED, ("", "0", "N/A", "UNK")),
    "IMAGE.ENCODING_TYPE": Keyword(  # others are the telemetry's, as Galileo's
        "refused", "the pixels are compressed: unpack the picture", ("", "N/A", "NONE", "UNK")
    ),
    "LINE_DISPLAY_DIRECTION": Keyword("used", "which line is uppermost"),
    "vertical_display_direction": Keyword("used", "which line is uppermost"),
    **{name: Keyword("used", "no value") for name in MISSING_KEYWORDS},
    **{name: Keyword("used", "saturated") for name in SATURATED_KEYWORDS},
    "UNIT": Keyword("harmless", "brightness is compared with itself alone"),
    "SCALING_FACTOR": Keyword("used", "GDAL hands it on as a scale"),
    "OFFSET": Keyword("used", "GDAL hands it on as an offset"),
}
CODING_KEYWORDS = ("DATA_CONVERSION_TYPE", "DataConversionType", "MESS:COMP12_8", "COMP12_8")
_BOTTOM_FIRST = ("UP", "BOTTOM TO TOP")  # of PDS3 and PDS4
VIEWED = (".png", ".jpg", ".jpeg")  # made to be looked at, their first line uppermost
COPIED = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".pgm")
# Brightness as I/F is far below 1, where a navigator that thinks in counts sees nothing.
HIGHEST = 60_000.0
NO_VALUE = -1e30  # what ISIS and PDS write for pixels without a value is below


@dataclass(frozen=True, eq=False)
class ImportSource:
    """One picture: the file that describes it, and what was read of it.

    kind   a format of import tables
    label  of FITS and PDS;  cube  the label of an ISIS cube;  utc  of a row in a list of times
    file   the name of the picture, of a row;  where  "FILE, line N" of it
    """

    path: Path
    kind: str
    label: ArchiveLabel | None = None
    cube: Label | None = None
    utc: str = ""
    file: str = ""
    where: str = ""

    def text(self, key: str) -> str:
        """Return the label's value of a keyword, "" where it states none."""
        if self.label is not None:
            try:
                return self.label.text(key)
            except DataError:
                return ""
        if self.cube is not None:
            return str(self.cube.get("IsisCube", {}).get("Instrument", {}).get(key, ""))
        return ""


def read_sources(path: Path) -> Iterator[ImportSource]:
    """Read what a file describes: one picture, or those of a list of times. Raises DataError."""
    if path.suffix.lower() == ".csv":
        for row in TIMES.rows(path):
            yield ImportSource(path, "times", utc=row["utc"], file=row["file"], where=row.where)
        return
    kind = detect_format(path)
    if kind is not None:
        yield ImportSource(path, kind, label=read_label(path, kind))
        return
    try:
        cube = read_cube_label(path)
    except DataError:
        raise DataError(
            f"{path}: no label with a geometry in it; wanted an ISIS cube, a PDS label, a FITS "
            "file, a list of settings, or a .csv with the times of pictures"
        ) from None
    yield ImportSource(path, "isis", cube=cube)


def check_row_time(source: ImportSource) -> None:
    """Refuse a time of a list that is none, by its line and column. Raises DataError."""
    try:
        utc_to_tdb_s(source.utc, "utc")
    except DataError as error:
        raise DataError(f"{source.where}: {error}") from None


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


def read_specials(path: Path, text: Callable[[str], str], dtype: str) -> SpecialValues | None:
    """Special values that a label names; None for none.

    text   gives a keyword's value, empty where it is not stated
    dtype  of the pixels as stored
    Raises DataError for one that is no number.
    """
    specials: dict[bool, list[float]] = {False: [], True: []}
    for names, saturated in ((MISSING_KEYWORDS, False), (SATURATED_KEYWORDS, True)):
        for name in names:
            stated = text(name) or text(f"Special_Constants/{name.lower()}")
            if not stated:
                continue
            value = read_stored_value(stated, dtype)
            if value is None:
                raise DataError(
                    f"{path}: {name} = {stated[:40]}; wanted a number of the type {dtype}: correct "
                    "the label"
                )
            specials[saturated].append(value)
    if not (specials[False] or specials[True]):
        return None
    return SpecialValues(tuple(specials[False]), tuple(specials[True]))


def is_bottom_first(text: Callable[[str], str]) -> bool:
    """Whether a label's first line is the lowest on a screen."""
    stated = text("LINE_DISPLAY_DIRECTION") or text("vertical_display_direction")
    return stated.upper() in _BOTTOM_FIRST


def collect_keywords(text: Callable[[str], str], *, coded: bool) -> list[tuple[str, str]]:
    """Collect the stated KEYWORDS of a label, without coding where the camera file has it."""
    names = [name for name in KEYWORDS if not (coded and name in CODING_KEYWORDS)]
    return [(name, value) for name in names if (value := text(name))]


def read_picture_shape(source: ImportSource, picture: Path) -> tuple[int, int]:
    """Read rows and columns of a picture. Raises DataError."""
    if is_fits(picture):
        return get_fits_shape(find_unit(picture))
    try:
        return _read_shape(picture)
    except DataError:
        if source.label is None or source.kind != "pds3" or picture != source.path:
            raise
    rows, columns = read_pds3_pixels(source.label).shape
    return rows, columns


def store_picture(
    source: ImportSource,
    table: ImportTable,
    picture: Path,
    camera: Camera,
    place: Path,
    flipped: bool,
) -> list[str]:
    """Put a picture into the folder, as it is or as a TIFF; return remarks.

    A TIFF keeps which pixels have no value as its mask, and the full scale as a tag.
    flipped  whether the rows change their order
    """
    if picture.suffix.lower() in COPIED and not flipped:
        _check_size(picture, _read_shape(picture), camera)
        shutil.copyfile(picture, place)
        mask = find_mask(picture)
        if mask is not None:
            shutil.copyfile(mask, place.with_name(f"{place.name}.msk"))
        return []
    named = collect_keywords(source.text, coded=camera.coding is not None)
    remarks = check_keywords(source.path, named, KEYWORDS)
    pixels = _read_stored(source, table, picture, camera)
    numbers = pixels.values.astype(np.float64)
    bad = np.zeros(numbers.shape, np.bool_) if pixels.missing is None else pixels.missing
    bad = bad | ~np.isfinite(numbers) | (numbers < NO_VALUE)
    full = camera.saturation_counts or pixels.full
    if full is None and not bad.all():
        full = find_full_scale(numbers[~bad])
    kind = pixels.values.dtype.name
    if kind not in ("uint8", "uint16"):
        if camera.coding is not None:
            raise DataError(
                f"{picture}: its pixels are {kind}, which import stretches over 16 bits, so the "
                f"[coding] of camera '{camera.name}' cannot be applied; wanted 8 or 16 bits "
                "without sign"
            )
        kind = "uint16"
        numbers, full = _rescale_counts(numbers, bad, full)
    numbers[bad] = 0.0
    if flipped:
        numbers, bad = numbers[::-1], bad[::-1]
    tags = {} if full is None else {FULL_SCALE: f"{full!r}"}
    profile = {"driver": "GTiff", "width": camera.width_px, "height": camera.height_px}
    with (
        _skip_warnings(),
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(place, "w", count=1, dtype=kind, compress="deflate", **profile) as to,
    ):
        to.write(np.rint(numbers).astype(kind), 1)
        if bad.any():
            to.write_mask(~bad)
        to.update_tags(**tags)
    if bad.any():
        remarks.append(f"{place.name}: {int(bad.sum())} pixels have no value")
    return remarks


def _rescale_counts(
    numbers: FloatArray, bad: BoolArray, full: float | None
) -> tuple[FloatArray, float | None]:
    """Numbers brought to counts of 16 bits, and full scale with them."""
    if bad.all():
        return numbers, full
    low, high = min(float(numbers[~bad].min()), 0.0), float(numbers[~bad].max())
    if not high > low:
        return numbers, full
    factor = HIGHEST / (high - low)
    return (numbers - low) * factor, None if full is None else (full - low) * factor


def is_flipped(
    source: ImportSource, table: ImportTable, upside_down: bool, own: Path | None = None
) -> tuple[bool, list[str]]:
    """Tell whether the rows change their order, and the remark where only the label says so.

    upside_down  whether a cube's own camera has its lines from below
    own          a picture that the user names in place of the label's
    """
    if upside_down:
        note = "by TRANSX and TRANSY its lines run from the bottom up: its rows are turned over"
        return True, [f"{source.path.name}: {note}"]
    stated = is_bottom_first(source.text)
    if own is not None and own.suffix.lower() in VIEWED:
        turned = table.line_order == "bottom_first" or stated
        note = "its first line is taken for the uppermost; the order of lines that the table or "
        note += "the label states is that of the archive's own picture"
        return False, [f"{own.name}: {note}"] if turned else []
    if table.line_order == "label":
        return stated, []
    if table.line_order is None and stated:
        note = "its label says that its first line is shown lowest; lines are kept as stored "
        note += '(line_order = "label" or "top_first" in the import table decides)'
        return False, [f"{source.path.name}: {note}"]
    return table.line_order == "bottom_first", []


def _read_stored(
    source: ImportSource, table: ImportTable, picture: Path, camera: Camera
) -> StoredPixels:
    """The pixels of a source's picture. Raises DataError."""
    if is_fits(picture):
        unit = find_unit(picture, str(table.extension))
        if unit.is_picture:
            _check_size(picture, get_fits_shape(unit), camera)
        return read_fits(picture, unit)
    try:
        with open_raster(picture, PICTURES) as dataset, handle_read_errors(picture, siblings=False):
            _check_size(picture, dataset.shape, camera)
            special = read_specials(source.path, source.text, dataset.dtypes[0])
            return read_raster(picture, dataset, camera.channel, special)
    except DataError:
        if source.label is None or source.kind != "pds3" or picture != source.path:
            raise
    # a PDS3 label that GDAL cannot read
    values = read_pds3_pixels(source.label)
    _check_size(picture, (values.shape[0], values.shape[1]), camera)
    kind = values.dtype.name
    special = read_specials(source.path, source.text, kind) or SpecialValues()
    values, missing, full = apply_special(values, np.zeros((1, 1), np.bool_), special)
    return StoredPixels(values, kind, missing, full)


def _read_shape(path: Path) -> tuple[int, int]:
    with open_raster(path, PICTURES) as dataset, handle_read_errors(path, siblings=False):
        rows, columns = dataset.shape
        return rows, columns


def _check_size(picture: Path, shape: tuple[int, int], camera: Camera) -> None:
    """Raise DataError for a picture of another size (rows, columns) than the camera's."""
    if shape != camera.shape:
        raise DataError(
            f"{picture}: the picture is {shape[1]} x {shape[0]}; camera '{camera.name}' takes "
            f"{camera.width_px} x {camera.height_px}: name another --camera"
        )


@contextmanager
def _skip_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield
