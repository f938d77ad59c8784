"""The keywords of map labels: ISIS cubes (Mapping, Pixels), PDS3 and VICAR, PDS4; GeoTIFF tags.

Names are those of the last group or element and of the keyword in it.
"""

from catalog.keywords import Keyword
from catalog.special_values import MISSING_KEYWORDS, SATURATED_KEYWORDS

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
