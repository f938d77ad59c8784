"""One picture file: PNG, TIFF, PGM, ISIS cube or what else rasterio reads, checked for use.

GDAL reads all of them, because it fails where a file breaks off, while some other readers fill the
rest with zeros. With a PNG it does not fail, so the checksums of a PNG's chunks are checked here.
"""

import struct
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from catalog.arrays import Float32Array
from catalog.errors import DataError
from optnav_cli.camera.camera import Camera

# the highest value of the integer types pictures are taken with
_SATURATION = {"uint8": 255.0, "uint16": 65535.0}
_PNG = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture's values and where they saturate.

    values      (height, width) float32, in the units of the file
    saturation  the highest value the file can hold; None where its type has no such limit
    """

    values: Float32Array
    saturation: float | None


def load_picture(path: str | Path, camera: Camera) -> Picture:
    """Read a picture of a camera.

    Raises DataError, with the reason, for a file that is missing, broken, of another size than the
    camera's pictures, in colour, or without content: all black, all white, all of one value.
    """
    path = Path(path)
    if not path.is_file():
        raise DataError(f"{path}: there is no such picture")
    if path.stat().st_size == 0:
        raise DataError(f"{path}: the picture is an empty file")
    _check_png(path)
    values, kind = _read(path, camera)
    saturation = _SATURATION.get(kind)
    _check_content(path, values, saturation)
    return Picture(values.astype(np.float32), saturation)


def _check_png(path: Path) -> None:
    """Refuse a PNG that does not reach its end or holds a chunk with a wrong checksum."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: the picture cannot be read: {error.strerror}") from None
    if not raw.startswith(_PNG):
        return
    place, kind = len(_PNG), b""
    while kind != b"IEND":
        if place + 12 > len(raw):
            raise DataError(f"{path}: the picture is broken: it ends after {len(raw)} bytes")
        length, kind = struct.unpack_from(">I4s", raw, place)
        end = place + 8 + length
        if end + 4 > len(raw):
            raise DataError(f"{path}: the picture is broken: it ends after {len(raw)} bytes")
        if zlib.crc32(raw[place + 4 : end]) != struct.unpack_from(">I", raw, end)[0]:
            raise DataError(f"{path}: the picture is broken: wrong checksum at byte {place}")
        place = end + 4


def _read(path: Path, camera: Camera) -> tuple[NDArray[np.generic], str]:
    """The only band and the name of its type."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as dataset:
                if dataset.count > 1 or dataset.colorinterp[0] == ColorInterp.palette:
                    raise DataError(
                        f"{path}: the picture is in colour or has {dataset.count} bands; "
                        "wanted one grey band: convert it"
                    )
                if dataset.shape != camera.shape:
                    raise DataError(
                        f"{path}: the picture is {dataset.width} x {dataset.height}; camera "
                        f"'{camera.name}' takes {camera.width_px} x {camera.height_px}"
                    )
                return dataset.read(1), dataset.dtypes[0]
    except (RasterioError, OSError) as error:
        reason = str(error.__cause__ or error).splitlines()[0].replace(f"{path}: ", "")
        raise DataError(f"{path}: the picture is broken or of no known kind: {reason}") from None


def _check_content(path: Path, values: NDArray[np.generic], saturation: float | None) -> None:
    if np.iscomplexobj(values) or not np.isfinite(values).all():
        raise DataError(f"{path}: the picture holds values that are not finite numbers")
    lowest, highest = float(values.min()), float(values.max())
    if highest <= 0.0 and lowest == highest:
        raise DataError(f"{path}: the picture is all black")
    if lowest == saturation:
        raise DataError(f"{path}: the picture is all white")
    if lowest == highest:
        raise DataError(f"{path}: all pixels of the picture have the same value, {lowest:g}")
