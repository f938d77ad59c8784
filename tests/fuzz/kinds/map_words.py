"""Rasters that say something about themselves: masks, no-data, datums, labels; lawful builds."""

import random
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.enums import ColorInterp
from rasterio.transform import Affine

from tests.fuzz.cases import DATA, NOTHING, OK, REFUSED, Case, Place, kind
from tests.fuzz.materials import BOX, MOON_DEG

READ = frozenset({OK, DATA, NOTHING})
SIDE = 96
NUMBERS = (
    "0",
    "-0",
    "1e999",
    "nan",
    "16#FF7FFFFB#",
    "16#8000#",
    "0xFFFF",
    "99#zz#",
    "'N/A'",
    "UNK",
    "",
    '"',
)


def _ground(rng: random.Random) -> Any:
    field = np.random.default_rng(rng.randrange(99)).normal(0.0, 300.0, (SIDE, SIDE))
    return np.rint(cv2.GaussianBlur(field, (0, 0), 2.0) * 4.0)


@kind("map-masks", 0.6)
def masks(place: Place) -> Case:
    """Heights with a hole, stated in every way that there is, or in none."""
    rng = place.rng
    dtype = rng.choice(("float32", "float64", "int16", "int32"))
    how = rng.choice(("alpha", "inside", "beside", "nodata", "digits", "untagged", "band", "all"))
    value = rng.choice((-9999.0, -32768.0, 9999.0, 0.0, -12345.0))
    if how == "digits" and dtype.startswith("f"):
        value = -3.4028234663852886e38
    values = _ground(rng) - (5000.0 if value == 0.0 else 0.0)
    valid = np.ones(values.shape, bool)
    valid[20:50, 30:70] = False
    valid &= how != "all"
    values = np.where(valid, values, value).astype(dtype)
    profile = {
        "driver": "GTiff", "height": SIDE, "width": SIDE, "dtype": dtype, "crs": MOON_DEG,
        "transform": Affine(1 / 16, 0, 8, 0, -1 / 16, 23), "count": 2 if how in ("alpha", "band") else 1,
    }  # fmt: skip
    if how in ("nodata", "digits"):
        profile["nodata"] = -3.4e38 if value < -1e38 else value
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=how == "inside"),
        rasterio.open(place.folder / "map.tif", "w", **profile) as file,
    ):
        file.write(values, 1)
        if how in ("alpha", "band"):
            file.write(valid.astype(dtype), 2)
        if how == "alpha":
            file.colorinterp = ColorInterp.gray, ColorInterp.alpha
        if how in ("inside", "beside", "all"):
            file.write_mask(valid)
    codes = frozenset({OK})
    if how in ("untagged", "band"):
        codes = REFUSED
    elif how == "all":
        codes = frozenset({NOTHING})
    return Case(
        ("-q", "slopes", "map.tif", "--base-m", "5000"), codes, note=f"{how} {dtype} {value}"
    )


@kind("map-labels", 0.6)
def labels(place: Place) -> Case:
    """ISIS and PDS3 labels of maps with keywords of all kinds of values."""
    rng = place.rng
    values = _ground(rng).astype("<i2")
    mapping = {
        "ProjectionName": "SimpleCylindrical", "TargetName": "Moon", "EquatorialRadius": "1737400.0 <meters>",
        "PolarRadius": "1737400.0 <meters>", "LatitudeType": "Planetocentric", "LongitudeDirection": "PositiveEast",
        "CenterLongitude": "0.0", "UpperLeftCornerX": "-90000.0 <meters>", "UpperLeftCornerY": "90000.0 <meters>",
        "PixelResolution": "1895.0 <meters/pixel>", "Scale": "16.0 <pixels/degree>",
    }  # fmt: skip
    others = {
        "LongitudeDirection": ("PositiveWest", "West", "", "1"), "LatitudeType": ("Planetographic", "", "2"),
        "PolarRadius": ("1730000.0 <meters>", "0", "-1", "nan"), "Rotation": ("90.0", "0.0", ""),
        "EquatorialRadius": ("1738000.0 <meters>", "1700000.0", "1737.4 <km>", "0"), "CenterLongitude": ("90.0", "1e300", "nan"),
    }  # fmt: skip
    image = {"LINES": SIDE, "LINE_SAMPLES": SIDE, "SAMPLE_TYPE": "LSB_INTEGER", "SAMPLE_BITS": 16}
    if rng.random() < 0.5:
        key = rng.choice(sorted(others))
        mapping[key] = rng.choice(others[key])
        text = _isis(mapping).encode().ljust(4096, b"\0")
        place.write("map.cub", text + values.tobytes())
        return _slopes("map.cub", f"{key} = {mapping[key]}")
    words = {
        "MAP_PROJECTION_TYPE": '"SIMPLE CYLINDRICAL"', "A_AXIS_RADIUS": "1737.4 <km>", "B_AXIS_RADIUS": "1737.4 <km>",
        "C_AXIS_RADIUS": "1737.4 <km>", "POSITIVE_LONGITUDE_DIRECTION": '"EAST"', "CENTER_LATITUDE": "0 <deg>",
        "CENTER_LONGITUDE": "0 <deg>", "MAP_SCALE": "1.895 <km/pix>", "LINE_PROJECTION_OFFSET": "47.5",
        "SAMPLE_PROJECTION_OFFSET": "47.5", "COORDINATE_SYSTEM_NAME": "PLANETOCENTRIC",
    }  # fmt: skip
    key = rng.choice((*sorted(words), "MAP_PROJECTION_ROTATION", "COORDINATE_SYSTEM_TYPE"))
    if rng.random() < 0.5:
        words[key] = rng.choice(("WEST", '"PLANETOGRAPHIC"', "1738.0 <km>", "INERTIAL", *NUMBERS))
        note = f"{key} = {words[key]}"
    else:
        name = rng.choice(
            (
                "MISSING_CONSTANT",
                "INVALID_CONSTANT",
                "SATURATED_CONSTANT",
                "VALID_MINIMUM",
                "UNIT",
                "OFFSET",
            )
        )
        image[name] = rng.choice(("-9999", "KM", "METER", "DEGREE", "1737400.", *NUMBERS))
        note = f"{name} = {image[name]}"
    lines = ["PDS_VERSION_ID = PDS3", "RECORD_TYPE = FIXED_LENGTH", f"RECORD_BYTES = {2 * SIDE}"]
    lines += [f"FILE_RECORDS = {SIDE}", '^IMAGE = "MAP.IMG"', "OBJECT = IMAGE"]
    lines += [f"{k} = {v}" for k, v in image.items()] + ["END_OBJECT = IMAGE"]
    lines += ["OBJECT = IMAGE_MAP_PROJECTION", *(f"{k} = {v}" for k, v in words.items())]
    lines += ["END_OBJECT = IMAGE_MAP_PROJECTION", "END", ""]
    place.write("MAP.LBL", "\r\n".join(lines))
    place.write("MAP.IMG", values.tobytes())
    return _slopes("MAP.LBL", note)


def _isis(mapping: dict[str, str]) -> str:
    group = "".join(f"    {key} = {value}\n" for key, value in mapping.items())
    return (
        "Object = IsisCube\n  Object = Core\n    StartByte = 4097\n    Format = BandSequential\n"
        f"    Group = Dimensions\n      Samples = {SIDE}\n      Lines = {SIDE}\n      Bands = 1\n"
        "    End_Group\n    Group = Pixels\n      Type = SignedWord\n      ByteOrder = Lsb\n"
        "      Base = 0.0\n      Multiplier = 1.0\n    End_Group\n  End_Object\n"
        f"  Group = Mapping\n{group}  End_Group\nEnd_Object\n"
        "Object = Label\n  Bytes = 4096\nEnd_Object\nEnd\n"
    )


def _slopes(name: str, note: str) -> Case:
    return Case(("-q", "slopes", name, "--base-m", "5000"), READ, note=note)


LAWFUL: dict[str, dict[str, tuple[object, ...]]] = {
    "pyramid": {"size": (32, 34, 48, 64), "levels": (1, 2)},
    "render": {
        "window_nodes": (16, 17, 64, 100), "levels": (1, 2, 10), "candidates": (1, 3, 64), "separation_cell": (1e-6, 0.12, 1.0),
        "inset_cell": (0.0, 0.49), "sun_elevations": (1, 3), "sun_azimuths": (2, 4), "snr": (1e-3, 1e6),
        "sun_declination_deg": (0.0, 90.0), "law": ("hapke", "lambert", "lommel_seeliger", "lunar_lambert"),
    },
    "select": {"percentile": (0.0, 50.0, 100.0), "spacing_cell": (0.0, 1.0)},
    "check": {
        "places": (1, 64), "search_km": (1e-3, 4.0, 1e3), "min_margin": (0.0, 1.0), "max_shadowed": (0.0, 1.0),
        "min_recognition": (0.0, 1.0), "good_recognition": (0.0, 1.0), "template_nodes": (16, 32, 256), "min_score": (0.0, 1.0),
        "rival_ratio": (0.0, 1.0), "scale_error": (0.0, 0.3), "roll_deg": (0.0, 20.0), "off_nadir_deg": (0.0, 60.0),
        "max_localisation_nodes": (1e-9, 1e9), "max_error_nodes": (1e-9, 1e9), "relief_slope_deg": (0.0, 20.0),
    },
    "grid": {"cell_deg": (0.5, 1.0, 3.0)},
    "write": {"height_step_m": (0.01, 100.0)},
}  # fmt: skip


@kind("map-corners", 0.1)
def corners(place: Place) -> Case:
    """A build with some settings at the ends of what is lawful."""
    rng = place.rng
    place.take("dem.tif")
    lines = ["[body]", 'name = "moon"', "[[dem]]", 'path = "dem.tif"']
    keys = [(section, key) for section in LAWFUL for key in LAWFUL[section]]
    stated = {("pyramid", "size"), ("pyramid", "levels"), *rng.sample(keys, 4)}
    for section in LAWFUL:
        lines.append(f"[{section}]")
        lines += ["trials = 1"] if section == "check" else []
        for key in (key for where, key in sorted(stated) if where == section):
            value = rng.choice(LAWFUL[section][key])
            lines.append(f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}")
    place.write("moon.toml", "\n".join(lines) + "\n")
    args = ("-q", "build", "moon.toml", "-o", "new.gpkg", "--workers", "1", "--bbox", BOX)
    note = " ".join(lines[4:])
    return Case(args, READ, "new.gpkg", frozenset({OK, NOTHING}), ("new.gpkg.work",), note=note)
