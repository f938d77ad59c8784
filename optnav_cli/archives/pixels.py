"""The pixels of an archive's picture, put into a picture folder with their mask and full scale."""

import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from catalog.arrays import BoolArray, FloatArray
from catalog.errors import DataError
from catalog.keywords import check_keywords
from catalog.rasters import PICTURES, handle_read_errors, open_raster
from catalog.special_values import SpecialValues
from optnav_cli.archives.frame import ImportTable
from optnav_cli.archives.label_pixels import (
    KEYWORDS,
    collect_keywords,
    is_bottom_first,
    read_specials,
)
from optnav_cli.archives.pds3_picture import read_pds3_pixels
from optnav_cli.archives.source import ImportSource
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.fits_picture import find_unit, get_fits_shape, is_fits, read_fits
from optnav_cli.frames.full_scale import find_full_scale
from optnav_cli.frames.raster_pixels import FULL_SCALE, apply_special, find_mask, read_raster
from optnav_cli.frames.stored_pixels import StoredPixels

VIEWED = (".png", ".jpg", ".jpeg")  # made to be looked at, their first line uppermost
COPIED = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".pgm")
# Brightness as I/F is far below 1, where a navigator that thinks in counts sees nothing.
HIGHEST = 60_000.0
NO_VALUE = -1e30  # what ISIS and PDS write for pixels without a value is below


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
