"""Picture files: damaged, of other sizes and types, and other things under a picture's name."""

import os
import random
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning

from tests.fuzz.cases import DATA, NOTHING, OK, OPEN, Case, Place, kind
from tests.fuzz.damage import MAGICS, damaged
from tests.fuzz.materials import SIDE_PX

Array = NDArray[np.generic]
BAD = frozenset({NOTHING})  # the only frame is no picture: nothing is solved
VRT = """<VRTDataset rasterXSize="{side}" rasterYSize="{side}">
 <VRTRasterBand dataType="Byte" band="1">
  <SimpleSource><SourceFilename relativeToVRT="{relative}">{source}</SourceFilename>
   <SourceBand>1</SourceBand></SimpleSource>
 </VRTRasterBand>
</VRTDataset>"""
WMS = """<GDAL_WMS><Service name="TMS"><ServerUrl>{url}${{z}}/${{x}}/${{y}}.png</ServerUrl></Service>
<DataWindow><UpperLeftX>-180</UpperLeftX><UpperLeftY>90</UpperLeftY><LowerRightX>180</LowerRightX>
<LowerRightY>-90</LowerRightY><SizeX>64</SizeX><SizeY>64</SizeY></DataWindow></GDAL_WMS>"""
WCS = "<WCS_GDAL><ServiceURL>{url}?</ServiceURL><CoverageName>x</CoverageName></WCS_GDAL>"
RAWVRT = """<VRTDataset rasterXSize="64" rasterYSize="64">
<VRTRasterBand dataType="Byte" band="1" subClass="VRTRawRasterBand">
<SourceFilename relativeToVRT="0">/etc/passwd</SourceFilename><ImageOffset>0</ImageOffset>
<PixelOffset>1</PixelOffset><LineOffset>8</LineOffset></VRTRasterBand></VRTDataset>"""
PYTHON = """<VRTDataset rasterXSize="64" rasterYSize="64">
<VRTRasterBand dataType="Byte" band="1" subClass="VRTDerivedRasterBand">
<PixelFunctionLanguage>Python</PixelFunctionLanguage><PixelFunctionType>os.getpid</PixelFunctionType>
<SimpleSource><SourceFilename relativeToVRT="1">frame_0001.png</SourceFilename></SimpleSource>
</VRTRasterBand></VRTDataset>"""


def _one_frame(place: Place, name: str = "frame_0000.png") -> None:
    """A folder of one frame, whose picture is not there yet."""
    place.take("pictures", "moon.gpkg")
    header, first, *_ = place.material("pictures/frames.csv").decode().splitlines()
    place.write("pictures/frames.csv", f"{header}\n{first.replace('frame_0000.png', name)}\n")
    (place.folder / "pictures/frame_0000.png").unlink()


def _navigate(codes: frozenset[int], note: str) -> Case:
    args = ("-q", "navigate", "pictures", "--catalog", "moon.gpkg", "-o", "new")
    return Case(args, codes, "new", frozenset({OK, NOTHING}), note=note)


def _grey(place: Place) -> NDArray[np.uint8]:
    picture = cv2.imread(str(place.materials / "pictures/frame_0000.png"), cv2.IMREAD_UNCHANGED)
    return np.asarray(picture, np.uint8)


@kind("picture-damaged", 1.2)
def damaged_picture(place: Place) -> Case:
    """One of two frames is damaged: the other is solved all the same."""
    place.take("pictures", "moon.gpkg")
    path, rng = "pictures/frame_0000.png", place.rng
    if rng.random() < 0.6:
        data, note = damaged(place.material(path), rng)
    else:
        ending = rng.choice((".tif", ".pgm", ".jpg", ".bmp", ".webp"))
        _, encoded = cv2.imencode(ending, _grey(place))
        data, note = damaged(encoded.tobytes(), rng)
        note = f"{ending}: {note}"
    place.write(path, data)
    return _navigate(frozenset({OK}), note)


@kind("picture-chunks", 0.7)
def chunks(place: Place) -> Case:
    """A PNG whose checksums fit, with another header or content."""
    _one_frame(place)
    rng = place.rng
    data = place.material("pictures/frame_0000.png")
    width, height, depth, colour, pack, filter_, interlace = struct.unpack_from(
        ">IIBBBBB", data, 16
    )
    field = rng.randrange(7)
    values = [width, height, depth, colour, pack, filter_, interlace]
    options: list[tuple[int, ...]] = [
        (0, 1, 63, 65, 128, 40000, 2**31 - 1, 2**31, 2**32 - 1), (0, 1, 63, 65, 40000, 2**31 - 1),
        (0, 1, 2, 4, 16, 255), (2, 3, 4, 6, 255), (1, 255), (1, 255), (1, 255),
    ]  # fmt: skip
    values[field] = rng.choice(options[field])
    body = struct.pack(">IIBBBBB", *values)
    head = data[:8] + _chunk(b"IHDR", body)
    place.write("pictures/frame_0000.png", head + data[33:])
    return _navigate(OPEN - {DATA}, f"IHDR {values}")


@kind("picture-bomb", 0.2)
def bomb(place: Place) -> Case:
    """A picture that is small as a file and large in the memory."""
    _one_frame(place)
    side = place.rng.choice((20_000, 40_000, 65_000))
    if place.rng.random() < 0.5:
        row = zlib.compress(bytes((side + 1) * 4), 9)
        data = b"\x89PNG\r\n\x1a\n" + _chunk(
            b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
        )
        data += _chunk(b"IDAT", row) + _chunk(b"IEND", b"")
        place.write("pictures/frame_0000.png", data)
    else:
        path = place.folder / "pictures/frame_0000.png"
        profile = {"driver": "GTiff", "dtype": "uint8", "count": 1, "width": side, "height": side}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path, "w", sparse_ok=True, **profile):
                pass
    return _navigate(BAD, f"{side} x {side} pixels")


@kind("picture-type", 1.2)
def types(place: Place) -> Case:
    """A whole picture of another type, size, number of bands or content."""
    _one_frame(place)
    rng = place.rng
    grey = _grey(place)
    ways: dict[str, tuple[Callable[[], Array], frozenset[int]]] = {
        "16 bit": (lambda: grey.astype(np.uint16) * 257, frozenset({OK})),
        "of one pixel": (lambda: grey[:1, :1], BAD),
        "a row short": (lambda: grey[:-1], BAD),
        "twice the size": (lambda: np.kron(grey, np.ones((2, 2), np.uint8)), BAD),
        "black": (lambda: grey * 0, BAD),
        "white": (lambda: grey * 0 + np.uint8(255), BAD),
        "noise": (
            lambda: np.random.default_rng(rng.randrange(99)).integers(0, 256, grey.shape, np.uint8),
            BAD,
        ),
        "one bright pixel": (lambda: _spot(grey), OPEN - {DATA}),
        "negative": (lambda: np.uint8(255) - grey, OPEN - {DATA}),
        "mirrored": (lambda: np.ascontiguousarray(grey[:, ::-1]), OPEN - {DATA}),
        "two values": (lambda: (grey > 20).astype(np.uint8), OPEN - {DATA}),
        "colour, bands equal": (lambda: np.dstack([grey] * 3), OPEN - {DATA}),
        "colour": (lambda: np.dstack([grey, grey // 2, grey // 3]), OPEN - {DATA}),
        "with alpha": (lambda: np.dstack([grey] * 3 + [grey * 0]), OPEN - {DATA}),
    }
    name = rng.choice(sorted(ways))
    make, codes = ways[name]
    ending = rng.choice((".png", ".png", ".tif"))
    _, data = cv2.imencode(ending, make())
    place.write("pictures/frame_0000.png", data.tobytes())
    return _navigate(codes, f"{name}, as {ending}")


@kind("picture-float", 0.7)
def floats(place: Place) -> Case:
    """A TIFF of numbers: huge, negative, not numbers, complex."""
    _one_frame(place)
    rng, grey = place.rng, _grey(place)
    dtype = rng.choice(
        ("float32", "float64", "int16", "uint32", "int32", "int8", "complex64", "uint16")
    )
    values = grey.astype(dtype) * rng.choice((1, 1, 3))
    real = dtype.startswith(("float", "complex"))
    content = rng.choice(
        ("plain", "nan", "inf", "huge", "negative", "all nan") if real else ("plain",)
    )
    spots = np.random.default_rng(rng.randrange(99)).random(grey.shape) < rng.choice((0.001, 0.3))
    filling = {"nan": np.nan, "inf": np.inf, "huge": 1e38, "negative": -1e30}
    if content in filling:
        values[spots] = filling[content]
    elif content == "all nan":
        values[:] = np.nan
    path = place.folder / "pictures/frame_0000.png"
    profile = {"driver": "GTiff", "dtype": dtype, "count": 1, "width": SIDE_PX, "height": SIDE_PX}
    profile |= rng.choice(
        (
            {},
            {"nodata": 0},
            {"compress": "lzw"},
            {"tiled": True, "blockxsize": 16, "blockysize": 16},
        )
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **profile) as file:
            file.write(values, 1)
    if rng.random() < 0.3:
        data, note = damaged(path.read_bytes(), rng)
        path.write_bytes(data)
        content = f"{content}, {note}"
    return _navigate(OPEN - {DATA}, f"{dtype}, {content}")


@kind("picture-disguised", 1.0)
def disguised(place: Place) -> Case:
    """Under the picture's name lies something that leads elsewhere."""
    _one_frame(place)
    rng = place.rng
    place.write("secret.png", place.material("pictures/frame_0000.png"))
    outside = str(place.folder / "secret.png")
    texts = {
        "VRT of a file outside": VRT.format(side=SIDE_PX, relative=0, source=outside),
        "VRT of a file above": VRT.format(side=SIDE_PX, relative=1, source="../secret.png"),
        "VRT of /etc/passwd": RAWVRT,
        "VRT of an address": VRT.format(
            side=SIDE_PX, relative=0, source=f"/vsicurl/{place.url}a.png"
        ),
        "VRT of itself": VRT.format(side=SIDE_PX, relative=1, source="frame_0000.png"),
        "VRT of Python": PYTHON,
        "VRT, huge": VRT.format(side=2_000_000_000, relative=1, source="frame_0001.png"),
        "WMS": WMS.format(url=place.url),
        "WCS": WCS.format(url=place.url),
        "a list of tiles": "<WMS_Tile_Service></WMS_Tile_Service>",
        "HTML": "<!DOCTYPE html><html></html>",
        "JSON": '{"type": "FeatureCollection"}',
        "an address": place.url,
        "XML with an entity": f'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "{place.url}">]><a>&b;</a>',
        "STAC": '{"stac_version": "1.0.0", "type": "Feature", "assets": {"a": {"href": "'
        + place.url
        + '"}}}',
        "Zarr": '{"zarr_format": 2}',
        "a DERIVED name": "DERIVED_SUBDATASET:LOGAMPLITUDE:secret.png",
    }
    name = rng.choice(sorted(texts))
    place.write("pictures/frame_0000.png", texts[name])
    return _navigate(BAD, name)


@kind("picture-place", 0.6)
def places(place: Place) -> Case:
    """Under the picture's name lies no file, or a name is strange."""
    rng = place.rng
    ways: dict[str, Callable[[Path], object]] = {
        "nothing": lambda path: None,
        "a folder": lambda path: path.mkdir(),
        "a pipe": lambda path: os.mkfifo(path),
        "a link to itself": lambda path: path.symlink_to(path.name),
        "a link to nothing": lambda path: path.symlink_to("nowhere.png"),
        "a link to a device": lambda path: path.symlink_to("/dev/zero"),
        "a magic number": lambda path: path.write_bytes(rng.choice(MAGICS)),
        "noise": lambda path: path.write_bytes(rng.randbytes(rng.choice((1, 100, 9000)))),
    }
    name = rng.choice(sorted(ways))
    _one_frame(place)
    ways[name](place.folder / "pictures/frame_0000.png")
    return _navigate(BAD, name)


@kind("picture-name", 0.5)
def names(place: Place) -> Case:
    """A picture with a strange name is read like any other."""
    name = place.rng.choice(
        ("a" * 200 + ".png", "a" * 251 + ".png", "ä ö.png", "-o.png", "a%20b.png", "a#b?.png", "日本.png", "a'b.png",
         "sub/a.png", "sub\\a.png", "a;b.png", "a&b<i>.png", "[a].png", "*.png", "a.PNG", "noending", "x" * 255)
    )  # fmt: skip
    _one_frame(place, name)
    place.write(f"pictures/{name.replace(chr(92), '/')}", place.material("pictures/frame_0000.png"))
    return _navigate(frozenset({OK}), f"named {name[:60]}")


def _chunk(kind_: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind_ + body + struct.pack(">I", zlib.crc32(kind_ + body))


def _spot(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    spot = grey * np.uint8(0)
    spot[20:22, 30:33] = 200
    return spot


def folder_name(rng: random.Random) -> bytes:
    """A name that is no UTF-8."""
    return rng.choice((b"pict\xff", b"\xe9t\xe9", b"a\x80\x81"))


@kind("picture-bytes-name", 0.4)
def bytes_names(place: Place) -> Case:
    """A folder or a picture whose name is not UTF-8."""
    place.take("moon.gpkg", "pictures")
    name = os.fsdecode(folder_name(place.rng))
    (place.folder / "pictures").rename(place.folder / name)
    args = ("-q", "navigate", name, "--catalog", "moon.gpkg", "-o", "new")
    codes = frozenset({OK, DATA, NOTHING})
    return Case(args, codes, "new", frozenset({OK, NOTHING}), note=f"folder {name!a}")


@kind("picture-mask", 1.0)
def masked(place: Place) -> Case:
    """Pixels without a value: by a mask, alpha, no-data, the camera's area; margins, lost lines."""
    _one_frame(place)
    rng, values = place.rng, _grey(place)
    gap = np.random.default_rng(rng.randrange(99)).random(values.shape) < rng.choice((0.001, 0.5))
    if rng.random() < 0.7:
        gap[:] = False
        gap[rng.randrange(SIDE_PX) :, rng.randrange(SIDE_PX) :] = True
    how = rng.choice(
        ("mask", "alpha", "nodata", "constant", "area", "mask picture", "all", "beside")
    )
    path = place.folder / "pictures/frame_0000.png"
    profile = {"driver": "GTiff", "dtype": "uint8", "count": 1, "width": SIDE_PX, "height": SIDE_PX}
    if how == "all":
        gap[:] = True
    if how == "nodata":
        profile["nodata"] = int(values[0, 0])
    elif how == "constant":
        values[gap] = rng.choice((0, 1, 255))
    bands = [values]
    if how == "alpha":
        profile |= {"count": 2, "alpha": "yes", "photometric": "minisblack"}
        bands.append(np.where(gap, rng.choice((0, 128)), 255).astype(np.uint8))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
            rasterio.open(path, "w", **profile) as file,
        ):
            file.write(np.stack(bands))
            if how in ("mask", "all"):
                file.write_mask(~gap)
        if how == "beside":
            with rasterio.open(f"{path}.msk", "w", **profile) as file:
                file.write(np.where(gap, 0, 255).astype(np.uint8), 1)
    if how == "beside" and rng.random() < 0.6:
        changed, note = damaged(path.with_name(f"{path.name}.msk").read_bytes(), rng)
        place.write("pictures/frame_0000.png.msk", changed)
        return _navigate(OPEN - {DATA}, f"{how}: {note}")
    if how in ("area", "mask picture"):
        key = f"valid_area_px = {[rng.randrange(-1, SIDE_PX + 2) for _ in range(4)]}\n"
        if how == "mask picture":
            key = f'valid_mask = "{rng.choice(("mask.png", "none.png", "../frame_0001.png"))}"\n'
            place.write("pictures/cameras/mask.png", cv2.imencode(".png", values)[1].tobytes())
        return _with_camera_key(place, key, f"{how}: {key.strip()}")
    codes = BAD if how == "all" else OPEN - {DATA}
    return _navigate(codes, how)


def _with_camera_key(place: Place, key: str, note: str) -> Case:
    """Navigate with one key more in the camera file, which may be wrong."""
    (path,) = (place.folder / "pictures/cameras").glob("*.toml")
    path.write_text(path.read_text() + key)
    return _navigate(OPEN, note)


@kind("picture-keys", 0.7)
def keys(place: Place) -> Case:
    """Keys of the camera file for reading pictures, right and wrong ones."""
    _one_frame(place)
    place.write("pictures/frame_0000.png", place.material("pictures/frame_0000.png"))
    number = place.rng.choice(("0", "-1", "1e-9", "200", "4095", "1e31", "nan", "true"))
    key = place.rng.choice(
        (
            f"saturation_counts = {number}\n",
            'channel = "luminance"\n',
            'channel = "infrared"\n',
            'exif_orientation = "apply"\n',
            "exif_orientation = 3\n",
            'line_order = "bottom_first"\n',
            f"extension = {number}\n",
            '[coding]\ncurve = "square"\n',
            f'[coding]\ncurve = "gamma"\ngamma = {number}\n',
            f'[coding]\ncurve = "table"\ncounts = [0, {number}]\nlinear = [0, 9]\n',
            f'[coding]\ncurve = "table"\ncounts = [0, 255]\nlinear = [{number}, 9]\n',
        )
    )
    return _with_camera_key(place, key, key.strip().replace("\n", "; "))


FITS_CARDS = (
    *("BSCALE  = 2.0", "BSCALE  = 0", "BSCALE  = x", "BZERO   = 32768", "BZERO   = 1E300"),
    *("BLANK   = 0", "BLANK   = 7", "ZIMAGE  = T", "BAYERPAT= 'RGGB'", "ROWORDER= 'BOTTOM-UP'"),
    *("ROWORDER= 'x'", "SATURATE= 200", "GROUPS  = T", "PCOUNT  = 99999999999", "GCOUNT  = 0"),
    *(
        "CONTINUE  'x&'",
        "HIERARCH ESO TEL ALT = 1",
        "HIERARCH = '&'",
        "OBJECT  = 'a&'",
        "CONTINUE  &",
    ),
    *("NAXIS1  = 99999999", "NAXIS   = 3", "NAXIS   = 999", "BITPIX  = 12", "BITPIX  = -64"),
)


@kind("picture-fits", 1.0)
def fits(place: Place) -> Case:
    """A FITS picture, perhaps in an extension, of odd cards, damaged."""
    _one_frame(place)
    rng, grey = place.rng, _grey(place)
    bitpix, dtype = rng.choice(((8, "u1"), (16, ">i2"), (32, ">i4"), (-32, ">f4"), (-64, ">f8")))
    first = rng.random() < 0.6
    cards = [f"BITPIX  = {bitpix}", "NAXIS   = 2", f"NAXIS1  = {SIDE_PX}", f"NAXIS2  = {SIDE_PX}"]
    odd = rng.choice(("", *FITS_CARDS))
    # the first of two cards of a name counts
    cards = [*([odd] if odd and rng.random() < 0.5 else []), *cards, *([odd] if odd else [])]
    begin = "SIMPLE  = T" if first else "XTENSION= 'IMAGE   '"
    head = _fits_block([begin, *cards])
    if not first:
        head = _fits_block(["SIMPLE  = T", "BITPIX  = 8", "NAXIS   = 0"]) + head
    pixels = grey.astype(dtype).tobytes()
    data = head + pixels + bytes(-len(pixels) % 2880)
    note = f"BITPIX {bitpix}, {odd or 'no odd card'}"
    if rng.random() < 0.4:
        data, how = damaged(data, rng)
        note = f"{note}, {how}"
    place.write("pictures/frame_0000.png", data)
    return _navigate(OPEN - {DATA}, note)


def _fits_block(cards: list[str]) -> bytes:
    text = "".join(card.ljust(80) for card in [*cards, "END"])
    return text.ljust(-(-len(text) // 2880) * 2880).encode()


@kind("picture-tags", 0.8)
def tags(place: Place) -> Case:
    """EXIF directories of a JPEG or PNG: orientations, cut short, pointing anywhere, of any type."""
    _one_frame(place)
    rng = place.rng
    order, kind_, many = rng.choice("<>"), rng.randrange(14), rng.choice((1, 2, 1 << 31))
    entries = b"".join(
        struct.pack(order + "HHI", rng.choice((274, 262, 34665, 0xA500, 301)), kind_, many)
        + struct.pack(order + "I", rng.choice((1, 3, 8, 1 << 16, (1 << 32) - 1)))
        for _ in range(rng.randrange(4))
    )
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    exif = head + struct.pack(order + "H", rng.choice((len(entries) // 12, 60000))) + entries
    exif = exif[: rng.choice((len(exif), rng.randrange(len(exif))))]
    ending = rng.choice((".jpg", ".png"))
    raw = cv2.imencode(ending, _grey(place))[1].tobytes()
    if ending == ".jpg":
        segment = b"Exif\0\0" + exif
        data = raw[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + raw[2:]
    else:
        data = raw[:33] + _chunk(b"eXIf", exif) + raw[33:]
    place.write("pictures/frame_0000.png", data)
    return _navigate(OPEN - {DATA}, f"{ending}, {len(entries) // 12} tags")
