"""Map labels' entries that GDAL does not use: ISIS cubes, PDS3, VICAR and PDS4 labels.

GDAL takes the projection, its sphere, scale, offset and one no-data value. It reads past the
direction of longitudes of ISIS and PDS3 labels (it heeds that of PDS4), past the unit of a PDS3
image and past all special constants but one.

The keywords of map labels: ISIS cubes (Mapping, Pixels), PDS3 and VICAR, PDS4; GeoTIFF tags.

Names are those of the last group or element and of the keyword in it.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np

from catalog.errors import DataError
from catalog.inputs import MEGABYTE, read_input
from catalog.keywords import Keyword, check_keywords
from catalog.special_values import (
    ISIS,
    MISSING_KEYWORDS,
    SATURATED_KEYWORDS,
    SpecialValues,
    read_stored_value,
)

_NONE = ("N/A", "UNK", "NULL", "NONE", "")
_BY_GDAL = "GDAL places the pixels by it"
_COUNTS = "GDAL reads the counts by it"
_DIRECTION = "the central meridian is negated where longitudes count westward"
_LATITUDES = "planetographic latitudes on a flattened body are refused"
_AXES = "heights above a flattened ellipsoid are refused, those above another sphere are shifted"
_AREA = "says what the map shows; its pixels are placed by the projection"
_UPRIGHT = "turn it with gdal_translate or in ISIS, so that its first line is the northern one"
_ROTATED = "reproject it without a rotation, in ISIS by map2map"
_CONSTANT = "stored values that are no measurement"
_ZERO = ("0", *_NONE)
PDS3_MAPS = ("IMAGE_MAP_PROJECTION", "MAP")  # of PDS3, of VICAR


KEYWORDS = {
    "Mapping.ProjectionName": Keyword("used", _BY_GDAL),
    "Mapping.TargetName": Keyword("harmless", "the radius shows another body"),
    "Mapping.EquatorialRadius": Keyword("used", _AXES),
    "Mapping.PolarRadius": Keyword("used", _AXES),
    "Mapping.LatitudeType": Keyword("used", _LATITUDES),
    "Mapping.LongitudeDirection": Keyword("used", _DIRECTION),
    "Mapping.LongitudeDomain": Keyword("harmless", "longitudes of any turn are one"),
    "Mapping.CenterLongitude": Keyword("used", _BY_GDAL),
    "Mapping.CenterLatitude": Keyword("used", _BY_GDAL),
    "Mapping.UpperLeftCornerX": Keyword("used", _BY_GDAL),
    "Mapping.UpperLeftCornerY": Keyword("used", _BY_GDAL),
    "Mapping.PixelResolution": Keyword("used", _BY_GDAL),
    "Mapping.Scale": Keyword("harmless", "the resolution again"),
    "Mapping.MinimumLatitude": Keyword("harmless", _AREA),
    "Mapping.MaximumLatitude": Keyword("harmless", _AREA),
    "Mapping.MinimumLongitude": Keyword("harmless", _AREA),
    "Mapping.MaximumLongitude": Keyword("harmless", _AREA),
    "Mapping.Rotation": Keyword("refused", _ROTATED, _ZERO),
    "Pixels.Type": Keyword("used", "special pixels are those of the type"),
    "Pixels.ByteOrder": Keyword("used", _COUNTS),
    "Pixels.Base": Keyword("used", _COUNTS),
    "Pixels.Multiplier": Keyword("used", _COUNTS),
    "IMAGE.SAMPLE_TYPE": Keyword("used", _COUNTS),
    "IMAGE.SAMPLE_BITS": Keyword("used", _COUNTS),
    "IMAGE.SCALING_FACTOR": Keyword("used", _COUNTS),
    "IMAGE.OFFSET": Keyword("used", _COUNTS),
    "IMAGE.UNIT": Keyword("used", "m, km, dm or cm; others are refused"),
    "IMAGE.VALID_MINIMUM": Keyword("used", _CONSTANT),
    "IMAGE.VALID_MAXIMUM": Keyword("used", _CONSTANT),
    **{f"IMAGE.{name}": Keyword("used", _CONSTANT) for name in MISSING_KEYWORDS},
    **{f"IMAGE.{name}": Keyword("used", _CONSTANT) for name in SATURATED_KEYWORDS},
    "IMAGE.LINE_DISPLAY_DIRECTION": Keyword("refused", _UPRIGHT, ("DOWN", *_NONE)),
    "IMAGE.SAMPLE_DISPLAY_DIRECTION": Keyword("refused", _UPRIGHT, ("RIGHT", *_NONE)),
    "IMAGE.SAMPLE_BIT_MASK": Keyword("reported", "all bits of a sample are read"),
    **{
        f"{group}.{name}": entry
        for group in PDS3_MAPS
        for name, entry in {
            "MAP_PROJECTION_TYPE": Keyword("used", _BY_GDAL),
            "A_AXIS_RADIUS": Keyword("used", _AXES),
            "B_AXIS_RADIUS": Keyword("harmless", "GDAL takes the first and third axis"),
            "C_AXIS_RADIUS": Keyword("used", _AXES),
            "POSITIVE_LONGITUDE_DIRECTION": Keyword("used", _DIRECTION),
            "COORDINATE_SYSTEM_NAME": Keyword("used", _LATITUDES),
            "COORDINATE_SYSTEM_TYPE": Keyword(
                "refused",
                "reproject it to a system that turns with the body",
                ("BODY-FIXED ROTATING", "BODY-FIXED", "BODYFIXED ROTATING", *_NONE),
            ),
            "CENTER_LONGITUDE": Keyword("used", _BY_GDAL),
            "CENTER_LATITUDE": Keyword("used", _BY_GDAL),
            "FIRST_STANDARD_PARALLEL": Keyword("used", _BY_GDAL),
            "SECOND_STANDARD_PARALLEL": Keyword("used", _BY_GDAL),
            "LINE_PROJECTION_OFFSET": Keyword("used", _BY_GDAL),
            "SAMPLE_PROJECTION_OFFSET": Keyword("used", _BY_GDAL),
            "MAP_SCALE": Keyword("used", _BY_GDAL),
            "MAP_RESOLUTION": Keyword("harmless", "the scale again"),
            "MAP_PROJECTION_ROTATION": Keyword("refused", _ROTATED, _ZERO),
            "MINIMUM_LATITUDE": Keyword("harmless", _AREA),
            "MAXIMUM_LATITUDE": Keyword("harmless", _AREA),
            "WESTERNMOST_LONGITUDE": Keyword("harmless", _AREA),
            "EASTERNMOST_LONGITUDE": Keyword("harmless", _AREA),
        }.items()
    },
    "GDAL.AREA_OR_POINT": Keyword("used", "GDAL shifts a map of points by half a pixel"),
    "GDAL.UNITTYPE": Keyword("used", "m, km, dm or cm; others are refused"),
    "GDAL.SCALE": Keyword("used", _COUNTS),
    "GDAL.OFFSET": Keyword("used", _COUNTS),
    "GDAL.NODATA": Keyword("used", _CONSTANT),
    "Geodetic_Model.latitude_type": Keyword("used", _LATITUDES),
    "Geodetic_Model.longitude_direction": Keyword("used", _BY_GDAL),
    "Geodetic_Model.semi_major_radius": Keyword("used", _AXES),
    "Geodetic_Model.a_axis_radius": Keyword("used", _AXES),
    "Geodetic_Model.polar_radius": Keyword("used", _AXES),
    "Geodetic_Model.c_axis_radius": Keyword("used", _AXES),
    "Element_Array.data_type": Keyword("used", _COUNTS),
    "Element_Array.scaling_factor": Keyword("used", _COUNTS),
    "Element_Array.value_offset": Keyword("used", _COUNTS),
    "Element_Array.unit": Keyword("used", "m, km, dm or cm; others are refused"),
    "Display_Direction.vertical_display_direction": Keyword("used", _BY_GDAL),
    "Display_Direction.horizontal_display_direction": Keyword(
        "refused", _UPRIGHT, ("LEFT TO RIGHT",)
    ),
    "Special_Constants.valid_minimum": Keyword("used", _CONSTANT),
    "Special_Constants.valid_maximum": Keyword("used", _CONSTANT),
    **{
        f"Special_Constants.{name.lower()}": Keyword("used", _CONSTANT) for name in MISSING_KEYWORDS
    },
    **{
        f"Special_Constants.{name.lower()}": Keyword("used", _CONSTANT)
        for name in SATURATED_KEYWORDS
    },
}


MAX_LABEL = 8 * MEGABYTE
FLATTENED = 1e-6  # by which axes of an ellipsoid differ, share of the larger one
DOMAINS = {"ISIS3": "json:ISIS3", "PDS": "json:PDS", "VICAR": "json:VICAR"}
PDS3_KM = 1000.0  # m; radii of PDS3 and VICAR labels are in km where no unit is stated
_METRES = {"m": 1.0, "meters": 1.0, "meter": 1.0, "km": 1e3, "kilometers": 1e3, "kilometer": 1e3}

Stated = dict[str, tuple[str, str]]  # value and unit by GROUP.KEYWORD


@dataclass(frozen=True)
class MapLabel:
    """The entries of a label that GDAL does not use.

    longitude  direction in which longitudes count, where GDAL reads past it
    axes_m     equatorial and polar radius
    unit       of the scaled values
    special    stored values that are no measurement
    nodata     the no-data value of GDAL, which takes constants in hexadecimal for 0 or 16: None
               where `special` has all that the label names
    remarks    to show
    """

    longitude: Literal["east", "west"] | None = None
    axes_m: tuple[float, float] = (1.0, 1.0)
    unit: str = ""
    special: SpecialValues | None = None
    nodata: float | None = None
    remarks: tuple[str, ...] = ()

    @property
    def is_flattened(self) -> bool:
        """Whether the reference of its heights is no sphere."""
        equatorial, polar = self.axes_m
        return abs(equatorial - polar) > FLATTENED * max(equatorial, polar)


def read_map_label(path: Path, dataset: Any) -> MapLabel:
    """Read the label of an open dataset; an empty one for a file of a format without labels.

    Raises DataError for what can be neither used nor passed: planetographic latitudes on a
    flattened ellipsoid, a rotated map, lines from the bottom.
    """
    dtype = str(dataset.dtypes[0])
    if dataset.driver in DOMAINS:
        stated = dict(_flatten("", _read_metadata(dataset, DOMAINS[dataset.driver])))
    elif dataset.driver == "PDS4":
        stated = _read_elements(path)
    else:
        special = ISIS.get(dtype) if dataset.driver == "ISIS2" else None
        return MapLabel(special=special, nodata=dataset.nodata)
    texts = [(name, _normalise_text(text)) for name, (text, _) in stated.items()]
    remarks = check_keywords(path, texts, KEYWORDS)
    names = "Mapping.LongitudeDirection", *_list_map_keywords("POSITIVE_LONGITUDE_DIRECTION")
    direction = _find_first(stated, *names)[0].strip("'\" ").upper().removeprefix("POSITIVE")
    known: dict[str, Literal["east", "west"]] = {"EAST": "east", "WEST": "west"}
    label = MapLabel(
        known.get(direction),
        _read_axes(stated),
        _find_first(stated, "IMAGE.UNIT")[0],
        *_read_special_values(path, stated, dtype, dataset),
        tuple(remarks),
    )
    names = (
        "Mapping.LatitudeType",
        "Geodetic_Model.latitude_type",
        *_list_map_keywords("COORDINATE_SYSTEM_NAME"),
    )
    kind = _find_first(stated, *names)[0]
    if label.is_flattened and "GRAPHIC" in kind.upper():
        equatorial, polar = label.axes_m
        raise DataError(
            f"{path}: states latitudes as {kind}, on radii of {equatorial / 1e3:.10g} and "
            f"{polar / 1e3:.10g} km; wanted planetocentric ones: reproject it, in ISIS by map2map "
            "with LatitudeType = Planetocentric"
        )
    return label


def _list_map_keywords(name: str) -> list[str]:
    return [f"{group}.{name}" for group in PDS3_MAPS]


def _find_first(stated: Stated, *names: str) -> tuple[str, str]:
    """Value and unit of the first keyword that is stated; empty for none."""
    return next((stated[name] for name in names if name in stated), ("", ""))


def _normalise_text(text: str) -> str:
    """A number as short as it can be written, other text without its quotes."""
    try:
        return f"{float(text):.10g}"
    except ValueError:
        return text.strip("'\" ")


def _read_metadata(dataset: Any, domain: str) -> Any:
    """The label as GDAL has it in JSON; rasterio cuts the text in two at its first colon."""
    for start, end in dataset.tags(ns=domain).items():
        try:
            return json.loads(f"{start}:{end}")
        except ValueError:
            return {}
    return {}


def _flatten(group: str, value: Any) -> Iterator[tuple[str, tuple[str, str]]]:
    """Keywords by the group that they stand in; of repeated ones the last counts."""
    if not isinstance(value, dict):
        return
    for name, inner in value.items():
        if isinstance(inner, dict) and "value" in inner:
            yield f"{group}.{name}", (str(inner["value"]).strip(), str(inner.get("unit", "")))
        elif isinstance(inner, dict):
            yield from _flatten(name, inner)
        elif isinstance(inner, str | int | float):
            yield f"{group}.{name}", (str(inner).strip(), "")


def _read_elements(path: Path) -> Stated:
    """Elements of a PDS4 label by the one that holds them; the first of a name counts."""
    raw = read_input(path, "label", "get it again", limit=MAX_LABEL)
    if b"<!DOCTYPE" in raw or b"<!ENTITY" in raw:
        raise DataError(f"{path}: declares XML of its own; wanted a plain PDS4 label")
    try:
        root = ElementTree.fromstring(raw)
    except ElementTree.ParseError:
        return {}  # GDAL has read it: only its georeference is left
    stated: Stated = {}
    for parent in root.iter():
        for child in parent:
            name = f"{parent.tag.rpartition('}')[2]}.{child.tag.rpartition('}')[2]}"
            stated.setdefault(name, ((child.text or "").strip(), child.get("unit", "")))
    return stated


def _read_axes(stated: Stated) -> tuple[float, float]:
    """Equatorial and polar radius, m; two of a unit sphere where they are not stated."""
    pairs = (
        ("Mapping.EquatorialRadius", "Mapping.PolarRadius", 1.0),
        *(
            (a, c, PDS3_KM)
            for a, c in zip(
                _list_map_keywords("A_AXIS_RADIUS"), _list_map_keywords("C_AXIS_RADIUS")
            )
        ),
        ("Geodetic_Model.a_axis_radius", "Geodetic_Model.c_axis_radius", PDS3_KM),
        ("Geodetic_Model.semi_major_radius", "Geodetic_Model.polar_radius", PDS3_KM),
    )
    for first, last, unstated_m in pairs:
        numbers = []
        for name in (first, last):
            text, unit = _find_first(stated, name)
            try:
                numbers.append(float(text) * _METRES.get(unit.strip("<> ").lower(), unstated_m))
            except ValueError:
                break
        if len(numbers) == 2 and min(numbers) > 0.0:
            return numbers[0], numbers[1]
    return 1.0, 1.0


def _read_special_values(
    path: Path, stated: Stated, dtype: str, dataset: Any
) -> tuple[SpecialValues | None, float | None]:
    """Special values of the type and those that the label names, and GDAL's no-data value.

    None in place of the first where the second is all, and of the second where the first is.
    """
    isis = ISIS[dtype] if dataset.driver == "ISIS3" and dtype in ISIS else SpecialValues()

    def numbers(*names: str) -> list[float]:
        return [
            number
            for name in names
            for where in (f"IMAGE.{name}", f"Special_Constants.{name.lower()}")
            if (number := _parse_number(path, where, _find_first(stated, where)[0], dtype))
            is not None
        ]

    named = numbers(*MISSING_KEYWORDS)
    missing = {*isis.missing, *named}
    saturated = {*isis.saturated, *numbers(*SATURATED_KEYWORDS)}
    lowest, highest = numbers("VALID_MINIMUM"), numbers("VALID_MAXIMUM")
    if missing <= {dataset.nodata} and not (saturated or lowest or highest):
        return None, dataset.nodata
    special = SpecialValues(
        tuple(sorted(missing)),
        tuple(sorted(saturated)),
        max(lowest, default=-np.inf),
        min(highest, default=np.inf),
    )
    return special, None if named else dataset.nodata


def _parse_number(path: Path, name: str, text: str, dtype: str) -> float | None:
    """A stored value. Raises DataError for text that is no number nor says that there is none."""
    shown = text.strip("'\" ")
    if shown.upper() in KEYWORDS["Mapping.Rotation"].allowed[1:]:
        return None
    value = read_stored_value(shown, dtype)
    if value is None:
        raise DataError(
            f"{path}: states {name} = {shown[:40]}; wanted a number of the type {dtype}: correct "
            "the label"
        )
    return value
