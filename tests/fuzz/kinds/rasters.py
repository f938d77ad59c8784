"""Terrain models: GeoTIFFs with every tag changed, VRTs that lead elsewhere, ASCII grids, labels."""

import random
import struct
import warnings
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.transform import Affine

from tests.fuzz.cases import DATA, NOTHING, OK, REFUSED, Case, Place, kind
from tests.fuzz.damage import damaged
from tests.fuzz.materials import BOX, MOON_DEG

READ = frozenset({OK, DATA, NOTHING})
TYPE_BYTES = {
    1: 1,
    2: 1,
    3: 2,
    4: 4,
    5: 8,
    6: 1,
    7: 1,
    8: 2,
    9: 4,
    10: 8,
    11: 4,
    12: 8,
    13: 4,
    16: 8,
}
CRS = [
    None, MOON_DEG, "+proj=longlat +R=1737000 +no_defs", "+proj=longlat +R=3396190 +no_defs", "EPSG:4326", "IAU_2015:30100",
    "+proj=stere +lat_0=90 +R=1737400 +units=m", "+proj=moll +R=1737400", "+proj=eqc +R=1737400 +units=m",
    "+proj=geocent +R=1737400", "+proj=ortho +R=1737400", "+proj=utm +zone=33", 'LOCAL_CS["x",UNIT["m",1]]', "EPSG:5773",
    "+proj=laea +lat_0=20 +lon_0=11 +R=1737400", "+proj=longlat +a=1737400 +b=1 +no_defs", "+proj=gnom +lat_0=20 +R=1737400",
]  # fmt: skip
AFFINES = [
    Affine(1 / 32, 0, 8, 0, -1 / 32, 23), Affine(1 / 32, 0, 8, 0, 1 / 32, 17), Affine(-1 / 32, 0, 14, 0, -1 / 32, 23),
    Affine(1e-12, 0, 8, 0, -1e-12, 23), Affine(1e12, 0, 8, 0, -1e12, 23), Affine(1 / 32, 1e-3, 8, 1e-3, -1 / 32, 23),
    Affine(1 / 32, 0, 8, 0, -1 / 16, 23), Affine(1 / 32, 0, 1e300, 0, -1 / 32, 23), Affine(1 / 32, 0, 368, 0, -1 / 32, 23),
    Affine(0, 1 / 32, 8, 1 / 32, 0, 17), Affine(1 / 32, 0, -400, 0, -1 / 32, 23), Affine(1 / 32, 0, 8, 0, -1 / 32, 123),
    Affine(float("nan"), 0, 8, 0, -1 / 32, 23), Affine(float("inf"), 0, 8, 0, -1 / 32, 23), Affine(1.875, 0, -180, 0, -0.9375, 90),
]  # fmt: skip


@kind("raster-whole", 0.7)
def whole(place: Place) -> Case:
    """A GeoTIFF as GDAL writes it, of any type, size, place and content."""
    rng = place.rng
    aspects = ("size", "dtype", "content", "affine", "crs", "nodata", "scale", "count")
    odd = set(rng.sample(aspects, rng.choice((0, 1, 1, 1, 1, 2, 3))))

    def one(aspect: str, plain: Any, *others: Any) -> Any:
        return rng.choice(others) if aspect in odd else plain

    size = one(
        "size", (192, 192), (1, 1), (3, 3), (4, 4), (1, 500), (5, 192), (2000, 4), (192, 191)
    )
    dtype = one(
        "dtype",
        "float32",
        "int16",
        "uint8",
        "uint16",
        "float64",
        "int32",
        "complex64",
        "int8",
        "uint32",
    )
    content = one(
        "content",
        "rough",
        "flat",
        "nan",
        "some nan",
        "inf",
        "huge",
        "radius",
        "km",
        "zero",
        "no data all",
        "spike",
    )
    affine, crs = one("affine", AFFINES[0], *AFFINES), one("crs", MOON_DEG, *CRS)
    nodata = one("nodata", None, -9999.0, 0.0, 100.0, float("nan"), float("inf"), -3.4e38, 1e300)
    scale = one("scale", 1.0, 0.0, 1e300, -1.0, 1e-300, float("nan"), 1e-3, 2.0)
    rough = np.random.default_rng(rng.randrange(99)).normal(0.0, 300.0, (192, 192))
    values = np.resize(cv2.GaussianBlur(rough, (0, 0), 2.0) * 4.0, size)
    spike = values.copy()
    spike[size[0] // 2, size[1] // 2] = 1e9
    values = {
        "flat": values * 0.0 + 100.0, "nan": values * np.nan, "some nan": np.where(values > 100.0, np.nan, values),
        "inf": np.where(values > 500.0, np.inf, values), "huge": values * 1e30, "radius": values + 1737400.0,
        "km": values / 1e3, "zero": values * 0.0, "no data all": values * 0.0 - 9999.0, "spike": spike,
    }.get(content, values)  # fmt: skip
    profile = {
        "driver": "GTiff", "dtype": dtype, "count": one("count", 1, 2, 5), "height": size[0], "width": size[1],
        "crs": crs, "transform": affine,
    }  # fmt: skip
    if nodata is not None:
        profile["nodata"] = nodata
    profile |= rng.choice(
        ({}, {"compress": "deflate"}, {"tiled": True, "blockxsize": 16, "blockysize": 16})
    )
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            with rasterio.open(place.folder / "dem.tif", "w", **profile) as file:
                for band in range(1, profile["count"] + 1):
                    file.write(values.astype(dtype), band)
                if scale != 1.0:
                    file.scales = [scale] * profile["count"]
    except (rasterio.errors.RasterioError, ValueError, TypeError):
        place.take("dem.tif")
        content = "the plain one"
    note = f"{dtype} {size} {content}, nodata {nodata}, scale {scale}, {crs}, {tuple(affine)[:6]}"
    return _read(place, READ, note)


@kind("raster-tags", 0.9)
def tags(place: Place) -> Case:
    """A GeoTIFF one of whose tags says something else."""
    data, note = changed_tag(place.material("dem.tif"), place.rng)
    place.write("dem.tif", data)
    return _read(place, READ, note)


@kind("raster-damaged", 0.5)
def damaged_raster(place: Place) -> Case:
    """A GeoTIFF with damaged bytes."""
    data, note = damaged(place.material("dem.tif"), place.rng)
    place.write("dem.tif", data)
    return _read(place, READ, note)


def changed_tag(data: bytes, rng: random.Random) -> tuple[bytes, str]:
    """A little-endian TIFF with one entry of its first directory changed."""
    changed = bytearray(data)
    (start,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, start)
    at = start + 2 + 12 * rng.randrange(count)
    tag, type_, number, value = struct.unpack_from("<HHII", data, at)
    what = rng.choice(("value", "value", "value", "pointed", "pointed", "count", "type", "tag"))
    if what == "pointed" and TYPE_BYTES.get(type_, 1) * number > 4:
        step = TYPE_BYTES[type_]
        place = value + step * rng.randrange(number)
        if type_ == 12:
            new = struct.pack(
                "<d",
                rng.choice((0.0, -1.0, 1e300, -1e300, float("nan"), float("inf"), 1e-300, 90.0)),
            )
        else:
            new = rng.randbytes(step)
        changed[place : place + step] = new
        return bytes(changed), f"tag {tag}: {new!r} at {place}"
    if what == "count":
        number = rng.choice((0, 1, 2, 65536, 2**31, 2**32 - 1))
    elif what == "type":
        type_ = rng.choice((0, 1, 2, 3, 4, 5, 11, 12, 16, 99))
    elif what == "tag":
        tag = rng.choice(
            (
                256,
                257,
                258,
                259,
                262,
                273,
                277,
                33550,
                33922,
                34735,
                42112,
                42113,
                330,
                34665,
                65000,
            )
        )
    else:
        value = rng.choice(
            (
                0,
                1,
                2,
                3,
                5,
                7,
                8,
                16,
                32,
                64,
                191,
                193,
                65535,
                65536,
                2**31 - 1,
                2**31,
                2**32 - 1,
                rng.randrange(2**32),
            )
        )
    struct.pack_into("<HHII", changed, at, tag, type_, number, value)
    return bytes(
        changed
    ), f"entry {(at - start - 2) // 12}: {what}, now {tag} {type_} {number} {value}"


VRT = """<VRTDataset rasterXSize="{x}" rasterYSize="{y}">
<SRS>{srs}</SRS><GeoTransform>8, 0.03125, 0, 23, 0, -0.03125</GeoTransform>
<VRTRasterBand dataType="Float32" band="1"{more}>{body}</VRTRasterBand></VRTDataset>"""
SOURCE = """<SimpleSource><SourceFilename relativeToVRT="{relative}">{name}</SourceFilename><SourceBand>1</SourceBand>
<SrcRect xOff="0" yOff="0" xSize="192" ySize="192"/><DstRect xOff="0" yOff="0" xSize="192" ySize="192"/></SimpleSource>"""
GRID = (
    "ncols {cols}\nnrows {rows}\nxllcorner 8\nyllcorner 17\ncellsize {cell}\nNODATA_value -9999\n"
)


@kind("raster-vrt", 0.9)
def vrts(place: Place) -> Case:
    """A VRT: one that is right, and others that lead elsewhere or are huge."""
    rng = place.rng
    place.take("dem.tif")
    (place.folder / "models").mkdir()
    place.write("models/inside.tif", place.material("dem.tif"))
    inside = SOURCE.format(relative=1, name="inside.tif")
    form = {"x": 192, "y": 192, "srs": MOON_DEG, "more": "", "body": inside}
    ways: dict[str, tuple[dict[str, object], frozenset[int]]] = {
        "of a file beside it": ({}, frozenset({OK})),
        "of a file above": ({"body": SOURCE.format(relative=1, name="../dem.tif")}, REFUSED),
        "of a file by its path": ({"body": SOURCE.format(relative=0, name=place.folder / "dem.tif")}, REFUSED),
        "of an address": ({"body": SOURCE.format(relative=0, name=f"/vsicurl/{place.url}a.tif")}, REFUSED),
        "of an address alone": ({"body": SOURCE.format(relative=1, name=f"{place.url}a.tif")}, REFUSED),
        "of itself": ({"body": SOURCE.format(relative=1, name="dem.vrt")}, REFUSED),
        "of nothing": ({"body": SOURCE.format(relative=1, name="nothing.tif")}, REFUSED),
        "of a zip": ({"body": SOURCE.format(relative=1, name="/vsizip/inside.zip/a.tif")}, REFUSED),
        "of a link outside": ({"body": SOURCE.format(relative=1, name="link.tif")}, REFUSED),
        "of a folder": ({"body": SOURCE.format(relative=1, name=".")}, REFUSED),
        "huge": ({"x": 2_000_000_000, "y": 2_000_000_000}, REFUSED),
        "wide": ({"x": 2_000_000_000}, REFUSED),
        "of no size": ({"x": 0}, REFUSED),
        "of a negative size": ({"x": -5}, REFUSED),
        "without a source": ({"body": ""}, READ),
        "of raw bytes": ({"more": ' subClass="VRTRawRasterBand"', "body": "<SourceFilename>/etc/passwd</SourceFilename>"}, REFUSED),
        "of Python": ({"more": ' subClass="VRTDerivedRasterBand"', "body": f"<PixelFunctionLanguage>Python</PixelFunctionLanguage><PixelFunctionType>os.getpid</PixelFunctionType>{inside}"}, REFUSED),
        "of an address as CRS": ({"srs": f"{place.url}crs"}, READ),
        "1000 sources": ({"body": inside * 1000}, READ),
        "nested deep": ({"body": "<A>" * 5000}, REFUSED),
        "with an entity": ({"body": f"<!DOCTYPE a [<!ENTITY b SYSTEM '{place.url}'>]>&b;"}, REFUSED),
    }  # fmt: skip
    (place.folder / "models/link.tif").symlink_to("../dem.tif")
    name = rng.choice(sorted(ways))
    changes, codes = ways[name]
    text = VRT.format(**(form | changes))
    note = f"a VRT {name}"
    if rng.random() < 0.2:
        data, note = damaged(text.encode(), rng)
        place.write("models/dem.vrt", data)
        return _read(place, READ, note, "models/dem.vrt")
    place.write("models/dem.vrt", text)
    return _read(place, codes, note, "models/dem.vrt")


@kind("raster-text", 0.6)
def texts(place: Place) -> Case:
    """ASCII grids, labels and what only looks so."""
    rng = place.rng
    rows = cols = 96
    values = np.random.default_rng(rng.randrange(9)).normal(0, 300, (rows, cols))
    words = {"rows": rows, "cols": cols, "cell": 0.0625}
    name = rng.choice(
        (
            "plain",
            "rows",
            "cols",
            "cell",
            "cut",
            "words",
            "damaged",
            "label",
            "label damaged",
            "world file",
        )
    )
    if name in ("rows", "cols"):
        words[name] = rng.choice((0, -1, 1, 10**6, 10**12, 2**31, 97, 95))
    if name == "cell":
        words["cell"] = rng.choice((0, -1, 1e300, float("nan"), 1e-300))
    text = GRID.format(**words) + "\n".join(" ".join(f"{v:.1f}" for v in row) for row in values)
    if name == "words":
        text = text.replace("0.", rng.choice(("nan", "x", "1e999", "--")), 50)
    data = text.encode()
    if name == "cut":
        data = data[: rng.randrange(len(data))]
    if name == "damaged":
        data, _ = damaged(data, rng)
    ending, note = "asc", f"an ASCII grid, {name} {words}"
    if name.startswith("label"):
        ending, data = "lbl", _label(rng).encode()
        place.write("dem.img", np.asarray(values, "<i2").tobytes())
        if name.endswith("damaged"):
            data, _ = damaged(data, rng)
        note = name
    place.write(f"dem.{ending}", data)
    if name == "world file":
        place.write(
            "dem.prj", rng.choice((MOON_DEG, "", "x" * 10_000, f"{place.url}crs", 'PROJCS["a"'))
        )
    return _read(place, READ, note, f"dem.{ending}", more=f'crs = "{MOON_DEG}"\n')


def _label(rng: random.Random) -> str:
    lines = {
        "PDS_VERSION_ID": "PDS3", "RECORD_TYPE": "FIXED_LENGTH", "RECORD_BYTES": "192", "FILE_RECORDS": "96",
        "^IMAGE": '("dem.img", 1)', "OBJECT": "IMAGE", "LINES": "96", "LINE_SAMPLES": "96", "SAMPLE_TYPE": "LSB_INTEGER",
        "SAMPLE_BITS": "16", "SCALING_FACTOR": "1.0", "OFFSET": "0.0", "END_OBJECT": "IMAGE",
    }  # fmt: skip
    key = rng.choice(sorted(lines))
    lines[key] = rng.choice(
        (
            lines[key],
            "0",
            "-1",
            "99999999999",
            '"../../etc/passwd"',
            '("/etc/passwd", 1)',
            "",
            "((((((((",
        )
    )
    return "".join(f"{k} = {v}\r\n" for k, v in lines.items()) + "END\r\n"


@kind("raster-relief", 0.3)
def reliefs(place: Place) -> Case:
    """A damaged model of the whole body, for navigation's horizon or for a simulation."""
    rng = place.rng
    data, note = rng.choice((damaged, changed_tag))(place.material("globe.tif"), rng)
    place.write("globe.tif", data)
    if rng.random() < 0.5:
        place.take("limb", "moon.gpkg")
        args = (
            "-q",
            "navigate",
            "limb",
            "--catalog",
            "moon.gpkg",
            "--relief",
            "globe.tif",
            "-o",
            "new",
        )
        return Case(args, READ, "new", frozenset({OK, NOTHING}), note=note)
    place.take("flight.toml", "cam.toml")
    return Case(
        ("-q", "simulate", "flight.toml", "-o", "new"), frozenset({OK, DATA}), "new", note=note
    )


def _read(
    place: Place, codes: frozenset[int], note: str, name: str = "dem.tif", more: str = ""
) -> Case:
    """A build of one cell of the model, or its first stage."""
    config = (
        place.material("moon.toml")
        .decode()
        .replace('path = "dem.tif"\n', f'path = "{name}"\n{more}')
    )
    place.write("moon.toml", config)
    common = ("--workers", "1", "--bbox", BOX)
    if place.rng.random() < 0.8:
        args = ("-q", "ingest", "moon.toml", "--work", "w", *common)
        return Case(args, codes, leaves=("w",), note=note)
    args = ("-q", "build", "moon.toml", "-o", "new.gpkg", *common)
    codes = codes | ({NOTHING} if OK in codes else set())
    return Case(args, codes, "new.gpkg", frozenset({OK, NOTHING}), ("new.gpkg.work",), note=note)
