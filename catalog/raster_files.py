"""The files that a raster is read from: each looked at once, all inside one folder."""

import html
import re
import stat
from pathlib import Path
from xml.etree import ElementTree

from catalog.errors import DataError
from catalog.inputs import MEGABYTE, check_input

_PDS4 = re.compile(rb"(\s*<\?xml[^>]*>|\s*<\?[^>]*>|\s*<!--.*?-->)*\s*<Product_Observational", re.S)
_PDS4_NAME = re.compile(rb"file_name\s*>([^<]*)<")

HEAD_BYTES = MEGABYTE  # of a file, in which its kind shows and a label ends
MAX_VRT_BYTES = 64 * MEGABYTE
MAX_NESTING = 8  # mosaics of mosaics
_VRT = re.compile(rb"\s*<VRTDataset[\s>]")
# what describes a place to read from, in XML or JSON; pixels do not begin so by chance
_DESCRIPTION = re.compile(rb"(\xef\xbb\xbf)?\s*(<[?!]?[A-Za-z_]{3}|\{\s*[\"}])")
_LABEL = re.compile(rb"\s*(/\*|PDS_VERSION_ID|CCSD|ODL_VERSION_ID|Object\s*=|NJPL|FILE_TYPE|\^)")
_LABEL_END = re.compile(rb"\n(?:END|End)\r?\n")
_POINTER = re.compile(rb"(?:\^\s*\w+|FILE_NAME)\s*=\s*\(?\s*(\"[^\"]*\"|'[^']*'|[^\s,()\"']+)")
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


def resolve_link(path: Path) -> Path:
    """An absolute path; of a link, the file that it leads to, as GDAL takes it for mosaics.

    An absolute path is never taken for a connection, such as "NETCDF:..." or "WMS:...".
    """
    return path.resolve() if path.is_symlink() else path.absolute()


def _is_pipe_or_device(path: Path) -> bool:
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except OSError:  # a link to nothing is not read
        return False
    return kind not in (stat.S_IFREG, stat.S_IFDIR)


class RasterFiles:
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
