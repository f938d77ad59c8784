"""One picture file: PNG, TIFF, PGM, FITS, ISIS cube or what else is read, checked for use."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from catalog.errors import DataError
from catalog.inputs import check_input
from catalog.rasters import PICTURES, handle_read_errors, open_raster
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import MAX_PIXELS
from optnav_cli.frames.fits_picture import find_unit, get_fits_shape, is_fits, read_fits
from optnav_cli.frames.frames import picture_path
from optnav_cli.frames.picture_tags import check_tags, read_tags
from optnav_cli.frames.raster_pixels import StoredPixels, find_full_scale, read_raster

# Of one value along a row or column: noise makes no such run; odd, so that it has a middle.
RUN_PX = 33
# Dark is what lies so near to the margin's value, of the way to bright ground.
DARK_SHARE = 0.25
# The sky that is no margin: so much of the picture; of it so few pixels have the margin's value,
# and so many lie so near to its middle. Dark ground at a terminator spreads evenly over dark.
MIN_SKY_SHARE, MAX_SAME_SHARE, MIN_FLAT_SHARE, FLAT_SHARE = 0.02, 0.02, 0.6, 0.04
# Along a margin's straight edge so much of the first line is bright, and so bright by the fourth.
MIN_LIT_SHARE, MIN_STEP_SHARE, BEHIND_PX = 0.5, 0.7, 3
STEP = 7  # between the pixels that levels are measured from
# the highest value of the integer types pictures are stored in
_SATURATION = {"uint8": 255.0, "uint16": 65535.0}
# No camera's counts end so low, and no surface but a specular one is as bright as I/F.
HIGHEST_FRACTION = 16.0
MAX_EXPONENT = 1000  # of two, by which counts are multiplied: larger is no number
MAX_VALUE = 1e30  # beyond it squares of single precision overflow in places
# What viewers do with stored pixels, by the number of EXIF's tag (EXIF 2.3, 4.6.4 A).
_TURNS: dict[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "2": np.fliplr,
    "3": partial(np.rot90, k=2),
    "4": np.flipud,
    "5": np.transpose,
    "6": partial(np.rot90, k=-1),
    "7": lambda stored: np.rot90(stored, k=2).T,
    "8": np.rot90,
}
_SIDEWAYS = ("5", "6", "7", "8")


def find_margins(values: NDArray[np.generic], missing: BoolArray | None) -> BoolArray | None:
    """Mark margins and lost lines of one dark value; None where none are.

    values   (h, w) counts;  missing  (h, w) pixels that are known to have no value
    """
    if min(values.shape) <= RUN_PX:
        return None
    inside = np.ones(values[::STEP, ::STEP].shape, np.bool_)
    if missing is not None:
        inside = ~missing[::STEP, ::STEP]
    sample = values[::STEP, ::STEP][inside].astype(np.float64)
    if sample.size == 0:
        return None
    low, bright = (float(level) for level in np.quantile(sample, (0.01, 0.995)))
    for value in _list_candidates(values, float(sample.min())):
        if not value <= low + 0.1 * (bright - low) < bright:
            continue
        dark = value + DARK_SHARE * (bright - value)
        same = np.asarray(values == value)
        if missing is not None:
            same &= ~missing
        margin = _find_straight(values, same, dark)
        if _is_no_sky(sample[sample != value], sample.size, dark, bright - value):
            margin |= _find_ragged(values, same, sample.size, dark, bright - value)
        if margin.any():
            return margin
    return None


def _list_candidates(values: NDArray[np.generic], lowest: float) -> list[float]:
    """The lowest value, and those of several corners and middles of the border, darkest first."""
    height, width = values.shape
    rows, columns = (0, height // 2, height - 1), (0, width // 2, width - 1)
    places = [float(values[r, c]) for r in rows for c in columns if (r, c) != (rows[1], columns[1])]
    several = {value for value in places if places.count(value) > 1}
    return sorted(several | {lowest})[:2]


def _find_straight(values: NDArray[np.generic], same: BoolArray, dark: float) -> BoolArray:
    """Whole lines at the border of one value, behind which bright ground begins at once."""
    margin = np.zeros(same.shape, np.bool_)
    for marked, lines, shown in _iterate_sides(same, values, margin):
        full = np.asarray(marked.all(axis=1), np.bool_)
        count = len(full) if full.all() else int(np.argmin(full))
        if not 0 < count < len(full) - BEHIND_PX:
            continue
        first = lines[count].astype(np.float64)
        behind = lines[count + BEHIND_PX].astype(np.float64)
        lit = first > dark
        if lit.mean() > MIN_LIT_SHARE and np.median(first[lit]) > MIN_STEP_SHARE * np.median(
            behind[lit]
        ):
            shown[:count] = True
    return margin


def _iterate_sides(
    same: BoolArray, values: NDArray[np.generic], margin: BoolArray
) -> Iterator[tuple[BoolArray, NDArray[np.generic], BoolArray]]:
    """Views of three pictures, the lines of each side of the border first."""
    for turned in ((same, values, margin), (same.T, values.T, margin.T)):
        yield turned
        yield turned[0][::-1], turned[1][::-1], turned[2][::-1]


def _find_ragged(
    values: NDArray[np.generic], same: BoolArray, count: int, dark: float, span: float
) -> BoolArray:
    """Pixels in long runs of one value along rows or columns that are not the sky."""
    pixels: ByteArray = same.astype(np.uint8)
    runs = np.zeros_like(pixels)
    for shape in ((1, RUN_PX), (RUN_PX, 1)):
        opened = cv2.morphologyEx(
            pixels,
            cv2.MORPH_OPEN,
            np.ones(shape, np.uint8),
            borderType=cv2.BORDER_CONSTANT,
            borderValue=0,
        )
        runs |= np.asarray(opened, np.uint8)
    margin: BoolArray = (runs & pixels) > 0
    left = values[::STEP, ::STEP][~margin[::STEP, ::STEP]].astype(np.float64)
    return margin if _is_no_sky(left, count, dark, span) else np.zeros(same.shape, np.bool_)


def _is_no_sky(left: FloatArray, count: int, dark: float, span: float) -> bool:
    """Whether pixels beside a margin (n,), of a sample of a count, show a sky of other values."""
    value = dark - DARK_SHARE * span
    sky = left[left < dark]
    if sky.size < MIN_SKY_SHARE * count:
        return False
    flat = np.abs(sky - np.median(sky)) < FLAT_SHARE * span
    return bool(
        (np.abs(sky - value) < 1e-9 * max(span, 1.0)).mean() < MAX_SAME_SHARE
        and flat.mean() > MIN_FLAT_SHARE
    )


class PictureSizeError(DataError):
    """A picture is of another size than its camera's."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture's values and where they saturate.

    values      (height, width) float32, in the units of the file, or counts of 16 bits where those
                are fractions; NaN where a pixel has no value
    saturation  full scale, from which on a pixel is full: as stated, else as clipped pixels show
                it, else the highest value of the file's type; None where that has no such limit
    valid       (height, width) False where a pixel has no value: it is neither sky nor ground;
                None where all have one
    remarks     what people must know of it, a line each
    """

    values: Float32Array
    saturation: float | None
    valid: BoolArray | None = None
    remarks: tuple[str, ...] = ()

    def load(self) -> "Picture":
        """The picture itself, read by now."""
        return self


class LaterPicture(Picture):
    """A picture that is read when it is needed; until then it has no values.

    read  gives the picture, again and again; it raises DataError where that cannot be used
    """

    def __init__(self, read: Callable[[], Picture]) -> None:
        self._read: Callable[[], Picture]
        vars(self)["_read"] = read

    def load(self) -> Picture:
        return self._read()


def load_picture(path: str | Path, camera: Camera | None) -> Picture:
    """Read a picture of a camera; of any size where there is none yet.

    Raises DataError, with the reason, for a file that is missing, broken, of another size than the
    camera's pictures, that states what cannot be applied, or without content: all black, all
    white, all of one value, without a pixel that has a value.
    """
    path = Path(path)
    if check_input(path, "picture", "add it to the folder") == 0:
        raise DataError(f"{path}: the picture is an empty file")
    tags = read_tags(path)
    oriented = camera is not None and camera.exif_orientation is not None
    coded = camera is not None and camera.coding is not None
    remarks = check_tags(path, tags, oriented=oriented, coded=coded)
    turn = tags.get("Orientation", "1") if camera and camera.exif_orientation == "apply" else "1"
    pixels = _orient_pixels(_read(path, camera, turn), turn, camera)
    missing = _mark_missing(pixels, camera)
    margins = find_margins(pixels.values, missing)
    if margins is not None:
        missing = margins if missing is None else missing | margins
        remarks.append(
            f"{path.name}: {100.0 * margins.mean():.1f} % of its pixels are margins or lost lines "
            "of one value, and count as pixels without one"
        )
    saturation = _find_saturation(path, pixels, missing, camera)
    values, saturation = _decode_counts(pixels, saturation, camera)
    values, factor = _scale_counts(values, missing)
    counts = values.astype(np.float32)
    saturation = None if saturation is None else saturation * factor
    remarks += pixels.remarks
    if missing is None:
        return Picture(counts, saturation, None, tuple(remarks))
    counts[missing] = np.nan
    return Picture(counts, saturation, ~missing, tuple(remarks))


def load_frame_picture(folder: Path, file: str, camera: Camera) -> Picture:
    """The picture of a row of a folder's table, which names it as `file`.

    Raises DataError as `load_picture` does; its text names the picture as the row does, so that
    what is written does not depend on where the folder lies.
    """
    path = picture_path(folder, file)
    try:
        return load_picture(path, camera)
    except DataError as error:
        raise type(error)(str(error).replace(str(path), file)) from None


def _mark_missing(pixels: StoredPixels, camera: Camera | None) -> BoolArray | None:
    """Mark the pixels (h, w) that have no value, by the file or outside the usable area."""
    missing = pixels.missing
    if camera is not None and camera.valid_mask is not None:
        outside = _read_mask(Path(camera.valid_mask), camera.shape)
        missing = outside if missing is None else missing | outside
    if camera is not None and camera.valid_area_px is not None:
        left, top, right, bottom = camera.valid_area_px
        outside = np.ones(pixels.values.shape, np.bool_)
        outside[top : bottom + 1, left : right + 1] = False
        missing = outside if missing is None else missing | outside
    return missing if missing is not None and missing.any() else None


def _read_mask(path: Path, shape: tuple[int, int]) -> BoolArray:
    """Mark the pixels (h, w) where a camera's mask picture is 0. Raises DataError."""
    check_input(path, "mask picture", "correct valid_mask of the camera file")
    with open_raster(path, PICTURES) as dataset, handle_read_errors(path, siblings=False):
        if dataset.shape != shape:
            raise DataError(
                f"{path}: the mask is {dataset.width} x {dataset.height}; wanted the size of the "
                f"camera's pictures, {shape[1]} x {shape[0]}"
            )
        outside: BoolArray = dataset.read(1) == 0
        return outside


def _find_saturation(
    path: Path, pixels: StoredPixels, missing: BoolArray | None, camera: Camera | None
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
    if camera is not None and camera.saturation_counts is not None and not pixels.imported:
        return camera.saturation_counts
    if pixels.full is not None:
        return pixels.full
    clipped = find_full_scale(valid)
    return largest if clipped is None else clipped


def _scale_counts(
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
    exponent = min(16 - math.frexp(highest)[1], MAX_EXPONENT)
    scaled: FloatArray = np.ldexp(values.astype(np.float64), exponent)
    return scaled, math.ldexp(1.0, exponent)


def _read(path: Path, camera: Camera | None, turn: str) -> StoredPixels:
    """The pixels of a file, one band, as it has them."""
    if is_fits(path):
        unit = find_unit(path, "" if camera is None else camera.extension)
        if unit.is_picture:  # else reading it says what it is
            _check_size(path, get_fits_shape(unit), camera, turn)
        return read_fits(path, unit)
    with open_raster(path, PICTURES) as dataset, handle_read_errors(path, siblings=False):
        # before its pixels are decoded: a small file can hold a huge picture
        _check_size(path, dataset.shape, camera, turn)
        return read_raster(path, dataset, None if camera is None else camera.channel)


def _check_size(path: Path, shape: tuple[int, int], camera: Camera | None, turn: str) -> None:
    """Raise DataError for a picture, as stored, of another size than the camera's, or too large."""
    height, width = shape[::-1] if turn in _SIDEWAYS else shape
    if camera is not None and (height, width) != camera.shape:
        raise PictureSizeError(
            f"{path}: the picture is {width} x {height}; camera "
            f"'{camera.name}' takes {camera.width_px} x {camera.height_px}"
        )
    if camera is None and width * height > MAX_PIXELS:
        raise DataError(
            f"{path}: the picture is {width} x {height}; wanted at most {MAX_PIXELS:,} pixels: "
            "scale it down"
        )


def _orient_pixels(pixels: StoredPixels, turn: str, camera: Camera | None) -> StoredPixels:
    """Pixels in the order of the camera's rows, and turned as an EXIF orientation says."""
    values, missing = pixels.values, pixels.missing
    if camera is not None and camera.line_order == "bottom_first":
        values, missing = values[::-1], None if missing is None else missing[::-1]
    turned = _TURNS.get(turn)
    if turned is not None:
        values, missing = turned(values), None if missing is None else turned(missing)
    return pixels._replace(values=values, missing=missing)


def _decode_counts(
    pixels: StoredPixels, saturation: float | None, camera: Camera | None
) -> tuple[NDArray[np.generic], float | None]:
    """Counts that are linear in light, and their full scale."""
    if camera is None or camera.coding is None:
        return pixels.values, saturation
    full = camera.saturation_counts or _SATURATION.get(pixels.kind) or 1.0
    values = camera.coding.decode(pixels.values, full)
    if saturation is not None:
        saturation = float(camera.coding.decode(np.array([saturation]), full)[0])
    return values, saturation


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
