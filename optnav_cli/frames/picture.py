"""One picture file: PNG, TIFF, PGM, ISIS cube or what else rasterio reads, checked for use.

GDAL reads all of them, because it fails where a file breaks off, while some other readers fill the
rest with zeros. With a PNG it does not fail, so the checksums of a PNG's chunks are checked here.
"""

import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.errors import DataError
from catalog.inputs import check_input
from catalog.rasters import PICTURES, open_raster, reading_raster
from catalog.special_values import ISIS, SpecialValues
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import MAX_PIXELS
from optnav_cli.frames.frames import picture_path
from optnav_cli.frames.full_scale import find_full_scale

# the highest value of the integer types pictures are stored in
_SATURATION = {"uint8": 255.0, "uint16": 65535.0}
# No camera's counts end so low, and no surface but a specular one is as bright as I/F.
HIGHEST_FRACTION = 16.0
MAX_VALUE = 1e30  # beyond it squares of single precision overflow in places
PIECE = 1 << 20  # bytes that are read at once
ISIS_DRIVERS = ("ISIS3", "ISIS2")
_RGBA = ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha
_PNG = b"\x89PNG\r\n\x1a\n"


class _Pixels(NamedTuple):
    """Pixels of a file.

    values   (h, w) as stored;  kind  name of the stored type
    missing  (h, w) marks those without a value; None for none
    full     full scale as the file states it; None where it does not
    """

    values: NDArray[np.generic]
    kind: str
    missing: BoolArray | None
    full: float | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture's values and where they saturate.

    values      (height, width) float32, in the units of the file, or counts of 16 bits where those
                are fractions; NaN where a pixel has no value
    saturation  full scale, from which on a pixel is full: as stated, else as clipped pixels show
                it, else the highest value of the file's type; None where that has no such limit
    valid       (height, width) False where a pixel has no value: it is neither sky nor ground;
                None where all have one
    """

    values: Float32Array
    saturation: float | None
    valid: BoolArray | None = None

    def loaded(self) -> "Picture":
        """The picture itself, read by now."""
        return self


class LaterPicture(Picture):
    """A picture that is read when it is needed; until then it has no values.

    read  gives the picture, again and again; it raises DataError where that cannot be used
    """

    def __init__(self, read: Callable[[], Picture]) -> None:
        self._read: Callable[[], Picture]
        vars(self)["_read"] = read

    def loaded(self) -> Picture:
        return self._read()


def load_picture(path: str | Path, camera: Camera | None) -> Picture:
    """Read a picture of a camera; of any size where there is none yet.

    Raises DataError, with the reason, for a file that is missing, broken, of another size than the
    camera's pictures, in colours other than gray, or without content: all black, all white, all of
    one value, without a pixel that has a value.
    """
    path = Path(path)
    if check_input(path, "picture", "add it to the folder") == 0:
        raise DataError(f"{path}: the picture is an empty file")
    _check_png(path)
    pixels = _read(path, camera)
    missing = _missing(pixels, camera)
    saturation = _saturation(path, pixels, missing, camera)
    values, factor = _counts(pixels.values, missing)
    counts = values.astype(np.float32)
    saturation = None if saturation is None else saturation * factor
    if missing is None:
        return Picture(counts, saturation)
    counts[missing] = np.nan
    return Picture(counts, saturation, ~missing)


def frame_picture(folder: Path, file: str, camera: Camera) -> Picture:
    """The picture of a row of a folder's table, which names it as `file`.

    Raises DataError as `load_picture` does; its text names the picture as the row does, so that
    what is written does not depend on where the folder lies.
    """
    path = picture_path(folder, file)
    try:
        return load_picture(path, camera)
    except DataError as error:
        raise DataError(str(error).replace(str(path), file)) from None


def _missing(pixels: _Pixels, camera: Camera | None) -> BoolArray | None:
    """Mark the pixels (h, w) that have no value, by the file or outside the usable area."""
    missing = pixels.missing
    if camera is not None and camera.valid_area_px is not None:
        left, top, right, bottom = camera.valid_area_px
        outside = np.ones(pixels.values.shape, np.bool_)
        outside[top : bottom + 1, left : right + 1] = False
        missing = outside if missing is None else missing | outside
    return missing if missing is not None and missing.any() else None


def _saturation(
    path: Path, pixels: _Pixels, missing: BoolArray | None, camera: Camera | None
) -> float | None:
    """Full scale of a picture: stated, else as clipped pixels show it, else of the file's type.

    Raises DataError for a picture without content.
    """
    valid = pixels.values if missing is None else pixels.values[~missing]
    if valid.size == 0:
        raise DataError(
            f"{path}: no pixel of the picture has a value: all are masked, transparent, no-data "
            "or outside the camera's valid_area_px"
        )
    largest = _SATURATION.get(pixels.kind)
    _check_content(path, valid, largest)
    if camera is not None and camera.saturation_counts is not None:
        return camera.saturation_counts
    if pixels.full is not None:
        return pixels.full
    clipped = find_full_scale(valid)
    return largest if clipped is None else clipped


def _counts(
    values: NDArray[np.generic], missing: BoolArray | None
) -> tuple[NDArray[np.generic], float]:
    """Values as they are, or brightness as I/F brought to counts; and the factor, a power of two.

    What is lit is told from the sky's noise, which is taken for a rounding to whole counts at
    least.
    """
    if values.dtype.kind != "f":
        return values, 1.0
    if missing is not None:
        values = np.where(missing, values.dtype.type(0), values)
    highest = float(values.max())
    fractions = bool((values != np.rint(values)).any())
    if not fractions or not 0.0 < highest < HIGHEST_FRACTION:
        return values, 1.0
    exponent = 16 - math.frexp(highest)[1]
    scaled: FloatArray = np.ldexp(values.astype(np.float64), exponent)
    return scaled, math.ldexp(1.0, exponent)


def _check_png(path: Path) -> None:
    """Refuse a PNG that does not reach its end or holds a chunk with a wrong checksum."""
    try:
        with path.open("rb") as file:
            if file.read(len(_PNG)) == _PNG:
                _check_chunks(path, file)
    except OSError as error:
        raise DataError(f"{path}: the picture cannot be read: {error.strerror}") from None


def _check_chunks(path: Path, file: BinaryIO) -> None:
    kind = b""
    while kind != b"IEND":
        place = file.tell()
        head = file.read(8)
        length, kind = struct.unpack(">I4s", head) if len(head) == 8 else (0, b"")
        checksum = zlib.crc32(kind)
        while length and (piece := file.read(min(length, PIECE))):
            checksum = zlib.crc32(piece, checksum)
            length -= len(piece)
        stated = file.read(4)
        if length or len(stated) < 4:
            raise DataError(f"{path}: the picture is broken: it ends after {file.tell()} bytes")
        if checksum != struct.unpack(">I", stated)[0]:
            raise DataError(f"{path}: the picture is broken: wrong checksum at byte {place}")


def _read(path: Path, camera: Camera | None) -> _Pixels:
    """The pixels, all bands being the same."""
    with open_raster(path, PICTURES) as dataset, reading_raster(path, siblings=False):
        # before its pixels are decoded: a small file can hold a huge picture
        if camera is None:
            _check_size(path, dataset.width, dataset.height)
        elif dataset.shape != camera.shape:
            raise DataError(
                f"{path}: the picture is {dataset.width} x {dataset.height}; camera "
                f"'{camera.name}' takes {camera.width_px} x {camera.height_px}"
            )
        values, missing = _gray(path, dataset), _masked(dataset)
        kind, full = dataset.dtypes[0], None
        scale, offset = dataset.scales[0], dataset.offsets[0]
        if dataset.driver in ISIS_DRIVERS and kind in ISIS:
            values, missing, full = _without_special(values, missing, ISIS[kind])
        if values.dtype.kind == "f":
            missing = missing | np.isnan(values)
        if (scale, offset) != (1.0, 0.0):
            values = (values.astype(np.float64) * scale + offset).astype(np.float32)
            full = None if full is None else full * scale + offset
        return _Pixels(values, kind, missing if missing.any() else None, full)


def _without_special(
    stored: NDArray[np.generic], missing: BoolArray, special: SpecialValues
) -> tuple[NDArray[np.generic], BoolArray, float | None]:
    """Values with the highest valid one where they are saturated, what is missing, full scale."""
    missing = missing | special.is_missing(stored)
    full = special.is_saturated(stored)
    valid = stored[~(missing | full)]
    if not full.any() or not valid.size:
        return stored, missing | full, None
    highest = valid.max()
    return np.where(full, highest, stored), missing, float(highest)


def _masked(dataset: Any) -> BoolArray:
    """Mark the pixels (h, w) that GDAL's mask leaves out: alpha, mask band, no-data value."""
    plain = dataset.colorinterp[0] != ColorInterp.palette
    if plain and dataset.mask_flag_enums[0] == [MaskFlags.all_valid]:
        return np.zeros((1, 1), np.bool_)
    masked: BoolArray = dataset.read_masks(1) != 255
    if dataset.colorinterp[0] == ColorInterp.palette:
        opaque = np.ones(256, np.bool_)
        for index, colour in dataset.colormap(1).items():
            opaque[index] = colour[3] == 255
        masked = masked | ~opaque[dataset.read(1)]
    return masked


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise DataError(
            f"{path}: the picture is {width} x {height}; wanted at most {MAX_PIXELS:,} pixels: "
            "scale it down"
        )


def _gray(path: Path, dataset: Any) -> NDArray[np.generic]:
    """The values (h, w) of a picture whose bands are all the same."""
    values: NDArray[np.generic] = dataset.read(1)
    if dataset.colorinterp[0] == ColorInterp.palette:
        colours = np.zeros((256, 4), np.uint8)
        for index, colour in dataset.colormap(1).items():
            colours[index] = colour
        bands = [(colours[:, number][values], kind) for number, kind in enumerate(_RGBA)]
        values = bands[0][0]
    else:
        numbered = zip(dataset.indexes[1:], dataset.colorinterp[1:], strict=True)
        bands = [(dataset.read(number), kind) for number, kind in numbered]
    for band, kind in bands:
        if kind != ColorInterp.alpha and not np.array_equal(band, values):
            row, column = (int(places[0]) for places in np.nonzero(band != values))
            raise DataError(
                f"{path}: the picture is in colour: at pixel ({column}, {row}) one band is "
                f"{values[row, column]} and another {band[row, column]}; wanted gray: convert it"
            )
    return values


def _check_content(path: Path, values: NDArray[np.generic], saturation: float | None) -> None:
    if np.iscomplexobj(values) or not np.isfinite(values).all():
        raise DataError(f"{path}: the picture holds values that are not finite numbers")
    lowest, highest = float(values.min()), float(values.max())
    if max(highest, -lowest) > MAX_VALUE:
        raise DataError(
            f"{path}: the picture holds values of {lowest:.3g} to {highest:.3g}; wanted at most "
            f"{MAX_VALUE:.0e}: the file is damaged"
        )
    if highest <= 0.0 and lowest == highest:
        raise DataError(f"{path}: the picture is all black")
    if lowest == saturation:
        raise DataError(f"{path}: the picture is all white")
    if lowest == highest:
        raise DataError(f"{path}: all pixels of the picture have the same value, {lowest:g}")
