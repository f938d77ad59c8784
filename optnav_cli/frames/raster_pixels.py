"""Pixels of picture files that GDAL reads, brought to one band, and the count at full scale.

GDAL reads all of them, because it fails where a file breaks off, while some other readers fill the
rest with zeros. GDAL's mask decides which pixels have a value: alpha, mask band, no-data value, or
a mask of the dataset in a file beside it.
"""

from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.errors import DataError
from catalog.rasters import OWN, handle_read_errors, open_raster
from catalog.special_values import ISIS, SpecialValues

Channel = Literal["red", "green", "blue", "luminance"]
# Luminance of ITU-R BT.601, as OpenCV and others make a picture gray.
LUMINANCE = (0.299, 0.587, 0.114)
FULL_SCALE = "SATURATION_COUNTS"  # tag of the pictures that `import` writes
_ISIS_DRIVERS = ("ISIS3", "ISIS2")
_RGB = ColorInterp.red, ColorInterp.green, ColorInterp.blue
MIN_FULL_PX = 5  # pixels that share the highest count: fewer do so by chance
LEVELS_BELOW = 8  # counts below the full one that together hold fewer pixels where it is clipped
MAX_BELOW_SHARE = 0.5  # of the clipped pixels, in those counts
# Lossy compression spreads clipped pixels over so many counts, each with this share of the highest.
SPREAD_LEVELS, MIN_SPREAD_SHARE = 3, 0.2
# Pixels above the clipped count, per pixel at it: hot pixels, and marks that were drawn later.
MAX_ABOVE_SHARE = 1e-3


class StoredPixels(NamedTuple):
    """One band of a picture, its first row being the picture's uppermost.

    values   (h, w), scaled as the file states
    kind     name of the stored type, as numpy has it
    missing  (h, w) marks those without a value; None for none
    full     full scale as the file states it; None where it does not
    remarks  what people must know, a line each
    imported whether `import` wrote the file: its full scale is that of the camera file already
    """

    values: NDArray[np.generic]
    kind: str
    missing: BoolArray | None
    full: float | None = None
    remarks: tuple[str, ...] = ()
    imported: bool = False


def read_raster(
    path: Path, dataset: Any, channel: Channel | None, special: SpecialValues | None = None
) -> StoredPixels:
    """Read an open file's picture as one band.

    channel  of a colour picture; None: its luminance, with a remark
    special  values as stored that a label beside the file names; of ISIS cubes their own
    Raises DataError for bands that are neither gray nor red, green and blue.
    """
    kind = dataset.dtypes[0]
    if dataset.colorinterp[0] == ColorInterp.palette:
        bands, missing = _read_palette_bands(dataset)
    else:
        bands, missing = _read_plain_bands(path, dataset), _mark_masked(dataset)
    missing = missing | _read_mask_beside(path, dataset.shape)
    values, remarks = _merge_bands(path, bands, channel)
    full = _read_full_scale(dataset)
    if dataset.driver in _ISIS_DRIVERS:
        special = ISIS.get(kind)
    if special is not None:
        values, missing, marked = apply_special(values, missing, special)
        full = marked if full is None else full
    if values.dtype.kind == "f":
        missing = missing | np.isnan(values)
    if dataset.tags(ns="IMAGE_STRUCTURE").get("MINISWHITE") == "YES":
        values = np.subtract(_find_highest(dataset), values)
    scale, offset = dataset.scales[0], dataset.offsets[0]
    if (scale, offset) != (1.0, 0.0):
        values = (values.astype(np.float64) * scale + offset).astype(np.float32)
        full = None if full is None else full * scale + offset
    known = missing if missing.any() else None
    return StoredPixels(values, kind, known, full, remarks, FULL_SCALE in dataset.tags())


def _read_plain_bands(path: Path, dataset: Any) -> list[NDArray[np.generic]]:
    """Bands of gray, or of red, green and blue; those of the same content once."""
    kinds = dataset.colorinterp
    numbers = [
        n for n, kind in zip(dataset.indexes, kinds, strict=True) if kind != ColorInterp.alpha
    ]
    bands = [dataset.read(number) for number in numbers]
    others = [band for band in bands[1:] if not np.array_equal(band, bands[0])]
    if not others:
        return bands[:1]
    if tuple(kinds[:3]) != _RGB or len(bands) != 3:
        names = ", ".join(kind.name for kind in kinds)
        raise DataError(
            f"{path}: the picture has {len(bands)} bands ({names}) of different content; wanted "
            "gray, or red, green and blue: write one band"
        )
    return bands


def _read_palette_bands(dataset: Any) -> tuple[list[NDArray[np.generic]], BoolArray]:
    """Red, green and blue of a picture of a palette, once where they are the same."""
    index = dataset.read(1)
    colours = np.zeros((256, 4), np.uint8)
    for number, colour in dataset.colormap(1).items():
        colours[number] = colour
    missing: BoolArray = colours[:, 3][index] != 255
    bands: list[NDArray[np.generic]] = [colours[:, k][index] for k in range(3)]
    same = all(np.array_equal(band, bands[0]) for band in bands[1:])
    return bands[:1] if same else bands, missing


def _merge_bands(
    path: Path, bands: list[NDArray[np.generic]], channel: Channel | None
) -> tuple[NDArray[np.generic], tuple[str, ...]]:
    """One band of a picture, and the remark to show."""
    if len(bands) == 1:
        return bands[0], ()
    names = ("red", "green", "blue")
    if channel in names:
        return bands[names.index(channel)], ()
    luminance = np.tensordot(np.array(LUMINANCE), np.stack(bands).astype(np.float64), axes=1)
    remark = (
        f"{path.name} is in colour: its luminance is used (0.299 red + 0.587 green + 0.114 blue; "
        'channel = "red", "green", "blue" or "luminance" in the camera file states another)'
    )
    return np.asarray(luminance, np.float32), () if channel else (remark,)


def _mark_masked(dataset: Any) -> BoolArray:
    """Mark the pixels (h, w) that GDAL's mask leaves out."""
    # GDAL takes 0 for no value in unsigned PDS3 pictures whose label names none: a dark sky is 0
    is_invented = dataset.driver == "PDS" and dataset.nodata == 0.0
    if is_invented or dataset.mask_flag_enums[0] == [MaskFlags.all_valid]:
        return np.zeros((1, 1), np.bool_)
    masked: BoolArray = dataset.read_masks(1) != 255
    return masked


def find_mask(path: Path) -> Path | None:
    """The file in which GDAL keeps the mask of a picture that cannot hold one; None without it."""
    name = f"{path.name}.msk"
    try:
        return path.with_name(name) if path.with_name(name).is_file() else None
    except OSError:  # a name of 252 letters, to which no more can be added
        return None


def _read_mask_beside(path: Path, shape: tuple[int, int]) -> BoolArray:
    """Mark the pixels (h, w) where the mask beside a file is 0. Raises DataError for another's."""
    file = find_mask(path)
    if file is None:
        return np.zeros((1, 1), np.bool_)
    with open_raster(file, OWN) as mask, handle_read_errors(file, siblings=False):
        if mask.shape != shape:
            raise DataError(
                f"{file}: the mask is {mask.width} x {mask.height}; wanted the picture's size, "
                f"{shape[1]} x {shape[0]}: remove it, or make it anew"
            )
        outside: BoolArray = mask.read(1) == 0
        return outside


def _read_full_scale(dataset: Any) -> float | None:
    """Full scale that the file states: of `import`, or by fewer bits than its type has."""
    try:
        return float(dataset.tags()[FULL_SCALE])
    except (KeyError, ValueError):
        pass
    bits = dataset.tags(1, ns="IMAGE_STRUCTURE").get("NBITS", "")
    return float(2 ** int(bits) - 1) if bits in {str(n) for n in range(2, 32)} else None


def _find_highest(dataset: Any) -> NDArray[np.generic]:
    """The value that is black where white is zero, of the file's type and bits."""
    kind = np.dtype(dataset.dtypes[0])
    if kind.kind != "u":
        return np.zeros(1, kind)
    bits = dataset.tags(1, ns="IMAGE_STRUCTURE").get("NBITS", "")
    highest = 2 ** int(bits) - 1 if bits.isdigit() else np.iinfo(kind).max
    return np.array([highest], kind)


def apply_special(
    stored: NDArray[np.generic], missing: BoolArray, special: SpecialValues
) -> tuple[NDArray[np.generic], BoolArray, float | None]:
    """Apply special values: saturated pixels get the highest valid value.

    Returns the values, what has no value, and the full scale; None where no pixel is saturated.
    """
    missing = missing | special.is_missing(stored)
    full = special.is_saturated(stored)
    valid = stored[~(missing | full)]
    if not full.any() or not valid.size:
        return stored, missing | full, None
    highest = valid.max()
    return np.where(full, highest, stored), missing, float(highest)


def find_full_scale(values: NDArray[np.generic]) -> float | None:
    """Find the count that clipped pixels share; None where the highest counts thin out smoothly.

    values  of pixels that have one, of any shape and real type
    """
    levels, many = _count_upper_levels(values)
    if len(levels) < 2:
        return None
    above = np.cumsum(many[::-1])[::-1] - many
    highest = np.flatnonzero((many >= MIN_FULL_PX) & (above <= MAX_ABOVE_SHARE * many))
    if not highest.size:
        return None
    top = int(highest[-1])
    quantum = _find_quantum(levels)
    low = top
    while (
        low > 0
        and top - low < SPREAD_LEVELS
        and many[low - 1] >= MIN_SPREAD_SHARE * many[top]
        and levels[low] - levels[low - 1] < 1.5 * quantum
    ):
        low -= 1
    near = (levels < levels[low]) & (levels > levels[low] - (LEVELS_BELOW + 0.5) * quantum)
    clipped = int(many[low : top + 1].sum())
    return None if many[near].sum() > MAX_BELOW_SHARE * clipped else float(levels[low])


def _count_upper_levels(values: NDArray[np.generic]) -> tuple[FloatArray, IntArray]:
    """Different values in rising order and how many pixels have each; of the upper half alone."""
    flat = values.ravel()
    if values.dtype.kind == "u" and values.dtype.itemsize <= 2:
        many = np.bincount(flat)
        counts = np.flatnonzero(many)
        counts = counts[counts > 0.5 * (counts[0] + counts[-1])]
        return counts.astype(np.float64), many[counts].astype(np.int64)
    numbers = flat.astype(np.float64)
    middle = 0.5 * (float(numbers.min()) + float(numbers.max()))
    levels, many = np.unique(numbers[numbers > middle], return_counts=True)
    return levels, many.astype(np.int64)


def _find_quantum(levels: FloatArray) -> float:
    """The step that values are whole multiples of, as 257 of 8 bits that were spread over 16."""
    steps = np.diff(levels)
    if (steps == np.rint(steps)).all() and steps.max() < 2**53:
        return float(np.gcd.reduce(steps.astype(np.int64)))
    return float(steps.min())
