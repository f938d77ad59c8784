"""The one place that opens rasters of others: no network, and no file but those named.

GDAL takes what a file holds for what it is, whatever its name: a picture may be a description of a
server, a mosaic may name any file of the machine. So each purpose has a short list of formats, and
every file that a mosaic (VRT) or a label (PDS, ISIS) names is checked before GDAL sees it: it must
lie in the folder of the file that names it, and be no description of something elsewhere.
"""

import html
import os
import re
import stat
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio._err import CPLE_BaseError
from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError
from rasterio.io import MemoryFile

from catalog.errors import DataError
from catalog.inputs import MEGABYTE, check_input

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
HEAD_BYTES = MEGABYTE  # of a file, in which its kind shows and a label ends
MAX_VRT_BYTES = 64 * MEGABYTE
MAX_NESTING = 8  # mosaics of mosaics

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
_VRT = re.compile(rb"\s*<VRTDataset[\s>]")
_PDS4 = re.compile(rb"(\s*<\?xml[^>]*>|\s*<\?[^>]*>|\s*<!--.*?-->)*\s*<Product_Observational", re.S)
# what describes a place to read from, in XML or JSON; pixels do not begin so by chance
_DESCRIPTION = re.compile(rb"(\xef\xbb\xbf)?\s*(<[?!]?[A-Za-z_]{3}|\{\s*[\"}])")
_LABEL = re.compile(rb"\s*(/\*|PDS_VERSION_ID|CCSD|ODL_VERSION_ID|Object\s*=|NJPL|FILE_TYPE|\^)")
_LABEL_END = re.compile(rb"\n(?:END|End)\r?\n")
_POINTER = re.compile(rb"(?:\^\s*\w+|FILE_NAME)\s*=\s*\(?\s*(\"[^\"]*\"|'[^']*'|[^\s,()\"']+)")
_PDS4_NAME = re.compile(rb"file_name\s*>([^<]*)<")
_TIFF = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
# A part of a mosaic is opened as whatever it is, so it must be of a kind that shows at its start.
_PART = re.compile(
    rb"(II[*+]\0|MM\0[*+]|\x89PNG|\xff\xd8\xff|BM|P[2-6]\s|\0\0\0\x0cjP|EHFA_HEADER_TAG|LBLSIZE=|"
    rb"SIMPLE  =|\s*(ncols|nrows|xll|yll|cellsize|dx|dy|nodata_value)\s)",
    re.I,
)
_SIDECARS = ".ovr .msk .aux .aux.xml .xml .rrd .ige .prj .hdr .wld .tfw .tifw .pgw .jgw .bpw"
_ELSEWHERE = re.compile(r"://|/vsi|grids\s*=|overview_file", re.I)

# Elements of a mosaic, as gdalbuildvrt, gdal_translate and gdalwarp write them, in lower case.
_VRT_ELEMENTS = """
    vrtdataset srs geotransform metadata mdi blockxsize blockysize vrtrasterband description
    nodatavalue hidenodatavalue unittype offset scale colorinterp colortable entry categorynames
    category histograms histitem histmin histmax bucketcount includeoutofrange approximate
    histcounts simplesource complexsource averagedsource kernelfilteredsource nodatafrommasksource
    sourcefilename sourceband sourceproperties srcrect dstrect nodata scaleoffset scaleratio
    exponent srcmin srcmax dstmin dstmax lut usemaskband kernel size coefs maskband overviewlist
    overview gdalwarpoptions warpmemorylimit resamplealg workingdatatype option sourcedataset
    transformer approxtransformer maxerror basetransformer genimgprojtransformer srcgeotransform
    srcinvgeotransform dstgeotransform dstinvgeotransform reprojecttransformer
    reprojectiontransformer sourcesrs targetsrs bandlist bandmapping srcnodatareal srcnodataimag
    dstnodatareal dstnodataimag
"""
_FILE_ELEMENTS = ("sourcefilename", "sourcedataset")


def open_raster(path: Path, drivers: tuple[str, ...], remedy: str = "check the path") -> Any:
    """A rasterio dataset of one of some formats, its files and sizes checked.

    Raises DataError for what is missing, empty or no such raster, for a file that names one
    elsewhere, and for declared sizes that no file of its kind has.
    """
    if check_input(path, remedy=remedy) == 0:
        raise DataError(f"{path}: is empty; get the file again")
    _RasterFiles(_resolve_link(path).parent.resolve()).check(_resolve_link(path), drivers)
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
            return rasterio.DatasetReader(_resolve_link(path), driver=list(drivers))
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
    settings = {
        "GDAL_CACHEMAX": CACHE_BYTES,
        "GDAL_DISABLE_READDIR_ON_OPEN": beside,
        **OFFLINE,
    }
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


def _resolve_link(path: Path) -> Path:
    """An absolute path; of a link, the file that it leads to, as GDAL takes it for mosaics.

    An absolute path is never taken for a connection, such as "NETCDF:..." or "WMS:...".
    """
    return path.resolve() if path.is_symlink() else path.absolute()


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


def _is_pipe_or_device(path: Path) -> bool:
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except OSError:  # a link to nothing is not read
        return False
    return kind not in (stat.S_IFREG, stat.S_IFDIR)


class _RasterFiles:
    """The files that a raster is read from, each looked at once, all inside one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.seen: set[Path] = set()
        self.listings: dict[Path, dict[str, list[Path]]] = {}

    def check(self, path: Path, drivers: tuple[str, ...], depth: int = 0) -> None:
        """Check a file, those that it names and those beside it that belong to it."""
        if path in self.seen:
            return
        self.seen.add(path)
        if depth > MAX_NESTING:
            raise DataError(f"{path}: mosaics of mosaics, more than {MAX_NESTING} deep; merge them")
        check_input(path)
        try:
            with path.open("rb") as file:
                head = file.read(HEAD_BYTES)
        except OSError as error:
            raise DataError(
                f"{path}: cannot be read ({error.strerror}); check its permissions"
            ) from None
        if "VRT" in drivers:
            self._check_siblings(path)
        if b"<VRTDataset" in head.partition(b"\0")[0] and "VRT" in drivers:
            for name in _read_vrt_sources(path, self.folder):
                self.check(name, drivers, depth + 1)
        elif _PDS4.match(head):
            self._check_pointed(path, _PDS4_NAME.findall(head))
        elif _DESCRIPTION.match(head):
            raise DataError(
                f"{path}: describes a picture elsewhere, or is no raster; wanted a file with the "
                "pixels in it"
            )
        elif _LABEL.match(head):
            head = _LABEL_END.split(head, maxsplit=1)[0]
            self._check_pointed(path, [name.strip(b"\"'") for name in _POINTER.findall(head)])
            if re.search(rb"(?<!UN)COMPRESSED_FILE", head):  # which GDAL opens, whatever it is
                raise DataError(
                    f"{path}: is the label of a compressed file; name the compressed file itself"
                )
        elif depth and not _PART.match(head):
            raise DataError(f"{path}: is no part of a mosaic that optnav reads; make it a GeoTIFF")

    def _check_pointed(self, label: Path, names: list[bytes]) -> None:
        """Check the files that a label names; some, as of explanations, are often left out."""
        for raw in names:
            try:
                name = html.unescape(raw.decode()).strip()
            except UnicodeDecodeError:  # rasterio prints a traceback where GDAL's words hold it
                raise DataError(
                    f"{label}: the name of a file in it is not UTF-8 text; get the file again"
                ) from None
            if re.fullmatch(r"[\d.]*(\s*<\w+>)?", name):  # a place in the same file
                continue
            if "/" in name or "\\" in name or name == "..":
                raise DataError(
                    f"{label}: names '{name}', a file elsewhere; wanted its pixels in the folder "
                    "of the label"
                )
            for path in self._list_folder(label.parent).get(name.casefold(), []):
                self._check_inside(path, label)
                if path != label:
                    self._check_no_description(path)

    def _check_no_description(self, path: Path) -> None:
        with path.open("rb") as file:
            if _DESCRIPTION.match(file.read(1024)):
                raise DataError(f"{path}: holds no pixels but a description; get the file again")

    def _check_siblings(self, path: Path) -> None:
        """Check what GDAL reads beside a file: overviews, masks, world files, metadata."""
        stem, name = path.stem.casefold(), path.name.casefold()
        for key, paths in self._list_folder(path.parent).items():
            if key.removeprefix(name if key.startswith(name) else stem) not in _SIDECARS.split():
                # readers of satellites' metadata try many more names
                if key.startswith(stem) and any(map(_is_pipe_or_device, paths)):
                    raise DataError(f"{paths[0]}: is a pipe or a device beside a raster; remove it")
                continue
            for sibling in paths:
                if sibling.is_dir():
                    continue
                self._check_inside(sibling, path)
                _check_sidecar(sibling)

    def _check_inside(self, path: Path, named_by: Path) -> None:
        try:
            real = path.resolve(strict=True)
            regular = stat.S_ISREG(real.stat().st_mode)
        except (OSError, RuntimeError):
            real, regular = path, False
        if not (regular and real.is_relative_to(self.folder)):
            raise DataError(
                f"{named_by}: is read with {path.name}, which is no file in its folder (nor under "
                "it); copy it there or remove it"
            )

    def _list_folder(self, folder: Path) -> dict[str, list[Path]]:
        if folder not in self.listings:
            names: dict[str, list[Path]] = {}
            for path in folder.iterdir():
                names.setdefault(path.name.casefold(), []).append(path)
            self.listings[folder] = names
        return self.listings[folder]


def _check_sidecar(path: Path) -> None:
    """Refuse overviews and masks that are no TIFF, and metadata that name another file."""
    ending = path.name.casefold()
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    if ending.endswith((".ovr", ".msk")) and not head.startswith(_TIFF):
        raise DataError(f"{path}: is no TIFF; remove it, optnav does not need it")
    if _PDS4.match(head):  # the label of a product of its own, which no driver reads beside others
        return
    if ending.endswith(".xml") and _ELSEWHERE.search(head.decode("utf-8", "replace")):
        raise DataError(f"{path}: names a file elsewhere; remove it")


def _read_vrt_sources(path: Path, folder: Path) -> list[Path]:
    """The files that a mosaic is made of. Raises DataError for one outside of a folder."""
    check_size = path.stat().st_size
    if check_size > MAX_VRT_BYTES:
        raise DataError(f"{path}: a mosaic of {check_size / MEGABYTE:.0f} MiB; split it")
    raw = path.read_bytes()
    # GDAL's reader of XML is not this one: what they might take in two ways is refused
    if not _VRT.match(raw) or b"<!" in raw or b"\0" in raw:
        raise DataError(f"{path}: is no plain VRT mosaic; make it anew with gdalbuildvrt")
    try:
        root = ElementTree.fromstring(raw)
    except ElementTree.ParseError as error:
        raise DataError(f"{path}: is a damaged VRT mosaic ({error}); make it anew") from None
    sources = []
    for element in root.iter():
        kind = element.tag.lower()
        if kind in _FILE_ELEMENTS:
            sources.append(_resolve_source(path, folder, element))
            continue
        words = " ".join([element.text or "", *element.attrib.values()])
        if kind not in _VRT_ELEMENTS.split() or _ELSEWHERE.search(words) or "<" in words:
            raise DataError(
                f"{path}: has <{element.tag}> in a way that optnav does not read; make it anew "
                "with gdalbuildvrt, or write a GeoTIFF with gdal_translate"
            )
        if element.get("subClass", "VRTSourcedRasterBand") not in (
            *("VRTSourcedRasterBand", "VRTWarpedDataset", "VRTWarpedRasterBand"),
        ):
            raise DataError(
                f"{path}: is a VRT of the kind {element.get('subClass')}; write a GeoTIFF with "
                "gdal_translate"
            )
    return sources


def _resolve_source(path: Path, folder: Path, element: ElementTree.Element) -> Path:
    """The file of a mosaic's element, which must lie in the folder, links followed."""
    attributes = {key.lower(): value for key, value in element.attrib.items()}
    name = element.text or ""
    relative = attributes.get("relativetovrt", "0") != "0"
    source = (path.parent if relative else Path()) / name
    try:
        real = source.resolve(strict=True)
        inside = real.is_relative_to(folder) and stat.S_ISREG(real.stat().st_mode)
    except (OSError, RuntimeError, ValueError):
        inside = False
    if not inside or ":" in name or name != name.strip() or len(element):
        raise DataError(
            f"{path}: is made of '{name}', which is no file in its folder (nor under it); put all "
            "parts of a mosaic there"
        )
    return source.absolute()
