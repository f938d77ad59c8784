"""The one place that opens rasters of others: no network, and no file but those named.

GDAL takes what a file holds for what it is, whatever its name: a picture may be a description of a
server, a mosaic may name any file of the machine. So each purpose has a short list of formats, and
every file that a mosaic (VRT) or a label (PDS, ISIS) names is checked before GDAL sees it: it must
lie in the folder of the file that names it, and be no description of something elsewhere.
"""

import os
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError
from rasterio.io import MemoryFile

from catalog.errors import DataError
from catalog.inputs import check_input
from catalog.raster_files import RasterFiles, resolve_link

OWN = ("GTiff",)  # what optnav writes
PICTURES = (
    *("PNG", "JPEG", "GTiff", "PNM", "BMP", "JP2OpenJPEG"),
    *("ISIS3", "ISIS2", "PDS", "PDS4", "VICAR", "FITS"),
)
# No netCDF: HDF5 below it reads whatever other files a file names.
TERRAIN = (*PICTURES, "VRT", "AAIGrid", "HFA", "ENVI", "EHdr")

# GDAL keeps decoded blocks; its default is 5 % of the machine, which is no bound for a worker.
CACHE_BYTES = 96 << 20
# A raster is read in blocks, each held whole: 40,000 rows of a strip of 90,000 floats are 1.4 GB.
MAX_BLOCK_BYTES = 1 << 30
MAX_PIXELS = 4 * 10**12  # the whole Moon at 4.4 m
# GDAL reads some of a header only when asked for it, so any property of a damaged file may raise
# one of these; rasterio hands some of GDAL's own errors on as they are.
RASTER_ERRORS = (RasterioError, CRSError, CPLE_BaseError)

# Remote files are opened by none of the formats above; this closes GDAL's own file systems, too.
OFFLINE = {
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",
    "GDAL_VRT_ENABLE_PYTHON": "NO",
    "GDAL_HTTP_TIMEOUT": "1",
    "GDAL_HTTP_MAX_RETRY": "0",
    "PROJ_NETWORK": "OFF",
}
_held = threading.local()  # GDAL's settings are a thread's own
DESCRIPTION = "TIFFTAG_IMAGEDESCRIPTION"  # the tag by which a file of ours is known again
DATA_FOLDERS = ("GDAL_DATA", "PROJ_DATA", "PROJ_LIB")  # variables of the environment


def open_raster(path: Path, drivers: tuple[str, ...], remedy: str = "check the path") -> Any:
    """A rasterio dataset of one of some formats, its files and sizes checked.

    Raises DataError for what is missing, empty or no such raster, for a file that names one
    elsewhere, and for declared sizes that no file of its kind has.
    """
    if check_input(path, remedy=remedy) == 0:
        raise DataError(f"{path}: is empty; get the file again")
    RasterFiles(resolve_link(path).parent.resolve()).check(resolve_link(path), drivers)
    dataset = reopen_raster(path, drivers)
    try:
        _check_sizes(path, dataset)
    except DataError:
        dataset.close()
        raise
    return dataset


def reopen_raster(path: Path, drivers: tuple[str, ...]) -> Any:
    """A rasterio dataset of a file that `open_raster` has checked before. Raises DataError."""
    try:
        with (
            _set_gdal(siblings="VRT" in drivers),
            _skip_text_tracebacks(),
            warnings.catch_warnings(),
        ):
            # a file without a place on the map gets an error of our own, with a remedy
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            return rasterio.DatasetReader(resolve_link(path), driver=list(drivers))
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path}: a text of its header is not UTF-8 ({error.reason}); get the file again"
        ) from None
    except RASTER_ERRORS as error:
        kinds = "GeoTIFF, PDS3, PDS4, ISIS cube"
        kinds += ", VRT" if "VRT" in drivers else ", PNG"
        remedy = f"broken or of no known kind; optnav reads {kinds}"
        if _is_fits(path):
            remedy = "FITS is not read as a map; make it a GeoTIFF or an ISIS cube"
        elif path.suffix.lower() == ".img":
            remedy = f"a PDS3 image needs its label {path.with_suffix('.LBL').name} beside it"
        raise DataError(
            f"{path}: cannot be opened ({extract_gdal_reason(error)}); {remedy}"
        ) from None


@contextmanager
def _skip_text_tracebacks() -> Iterator[None]:
    """Keep quiet what rasterio prints where words of GDAL hold a file's text that is not UTF-8.

    It cannot raise from within GDAL, and prints the error by the interpreter's hooks instead. Those
    are the process's: other threads, which open again what the main one has opened, leave them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    printing, unraisable = sys.excepthook, sys.unraisablehook

    def print_others(kind: type[BaseException], error: BaseException, trace: Any) -> None:
        if not issubclass(kind, UnicodeDecodeError):
            printing(kind, error, trace)

    def report_others(event: Any) -> None:
        if not issubclass(event.exc_type, UnicodeDecodeError):
            unraisable(event)

    sys.excepthook, sys.unraisablehook = print_others, report_others
    try:
        yield
    finally:
        sys.excepthook, sys.unraisablehook = printing, unraisable


def _is_fits(path: Path) -> bool:
    """Whether a file begins as FITS does."""
    try:
        with path.open("rb") as file:
            return file.read(9) == b"SIMPLE  ="
    except OSError:
        return False


@contextmanager
def handle_read_errors(path: Path, siblings: bool = True, what: str = "") -> Iterator[None]:
    """GDAL's settings while an open file is read: offline, with a bounded cache.

    what  is read of it, for the message
    Raises DataError for a file that turns out to be damaged, in its header too.
    """
    try:
        with _set_gdal(siblings):
            yield
    except RASTER_ERRORS as error:
        raise DataError(
            f"{path}: {what}cannot be read ({extract_gdal_reason(error)}); the file is damaged or "
            "cut short, get it again"
        ) from None


def encode_geotiff(
    bands: Mapping[str, NDArray[Any]],
    profile: Mapping[str, Any],
    tags: Mapping[str, str] | None = None,
    unit: str = "",
) -> bytes:
    """A GeoTIFF of grids of one shape and type, deflated, as bytes.

    bands    grids (rows, cols) by their descriptions
    profile  `crs`, `transform`, `nodata` and the like, as rasterio names them
    unit     of all bands

    Made in memory: GDAL takes no name that is not UTF-8, and tells no full disk from damage.
    """
    first = next(iter(bands.values()))
    (rows, cols), kind = first.shape, first.dtype.name
    options = {"driver": "GTiff", "compress": "deflate", "dtype": kind, "count": len(bands)}
    options |= {"predictor": 3} if kind == "float32" else {}
    with _set_gdal(siblings=True), MemoryFile() as memory:
        with memory.open(**options, height=rows, width=cols, **profile) as file:
            file.update_tags(**(tags or {}))
            if unit:
                file.units = (unit,) * len(bands)
            for band, (text, grid) in enumerate(bands.items(), 1):
                file.write(grid, band)
                file.set_band_description(band, text)
        return bytes(memory.getbuffer())


def is_described(path: Path, *beginnings: str) -> bool:
    """Whether a file is a GeoTIFF whose description begins with one of some words."""
    try:
        with open_raster(path, OWN) as file:
            return str(file.tags().get(DESCRIPTION, "")).startswith(beginnings)
    except DataError:
        return False


@contextmanager
def keep_gdal_settings() -> Iterator[None]:
    """GDAL's settings of this thread for many readings of rasters; setting them takes 30 us each.

    `handle_read_errors` within does not set them again, unless it wants others.
    """
    with _set_gdal(siblings=True):
        _held.siblings = True
        try:
            yield
        finally:
            _held.siblings = None


@contextmanager
def _set_gdal(siblings: bool) -> Iterator[None]:
    if siblings and getattr(_held, "siblings", None):
        yield
        return
    # pictures need no files beside them: world files, masks, metadata
    beside = "FALSE" if siblings else "EMPTY_DIR"
    settings = {"GDAL_CACHEMAX": CACHE_BYTES, "GDAL_DISABLE_READDIR_ON_OPEN": beside, **OFFLINE}
    # GDAL takes settings from the environment; rasterio reads them as UTF-8, and fails if they
    # are not
    for name in (*DATA_FOLDERS, *settings):
        if not _is_utf8(os.environ.get(name, "")):
            del os.environ[name]
    with rasterio.Env(**settings):
        yield


def _is_utf8(text: str) -> bool:
    return not any("\udc80" <= letter <= "\udcff" for letter in text)


def extract_gdal_reason(error: BaseException) -> str:
    """GDAL's own words, which rasterio keeps as the cause of its error."""
    deepest: BaseException = error
    while deepest.__cause__ is not None:
        deepest = deepest.__cause__
    return str(deepest).strip().rstrip(".")


def _check_sizes(path: Path, dataset: Any) -> None:
    rows, cols = dataset.shape
    if rows * cols > MAX_PIXELS:
        raise DataError(
            f"{path}: is {cols} x {rows} pixels by its header; wanted at most {MAX_PIXELS:.0e}: "
            "the file is damaged, or cut the ground that is needed out of it"
        )
    if any(name.startswith("complex") for name in dataset.dtypes):
        raise DataError(f"{path}: holds complex numbers; wanted a raster of real ones")
    tall, wide = dataset.block_shapes[0] if dataset.count else (1, 1)
    size = tall * wide * np.dtype(dataset.dtypes[0]).itemsize if dataset.count else 0
    if size > MAX_BLOCK_BYTES:
        raise DataError(
            f"{path}: keeps {cols} x {rows} pixels in blocks of {wide} x {tall}, "
            f"{size / 2**30:.3g} GiB each; wanted at most {MAX_BLOCK_BYTES >> 30}: write it in "
            "tiles (gdal_translate -co TILED=YES)"
        )
