"""What PDS3, PDS4 and ISIS labels say about their pixels: special values, row order, coding.

Sources: PDS3 Data Dictionary (image objects); PDS4 Information Model, Special_Constants and
Display_Settings.
"""

from collections.abc import Callable
from pathlib import Path

from catalog.errors import DataError
from catalog.keywords import Keyword
from catalog.special_values import (
    MISSING_KEYWORDS,
    SATURATED_KEYWORDS,
    SpecialValues,
    read_stored_value,
)

_CODED = (
    "the counts are coded by the camera's own table or cut to 8 bits: state the table in the "
    "[coding] of the camera file, or take another product"
)
KEYWORDS = {
    # 8LSB, too: its counts begin at 0 again above 255
    "DATA_CONVERSION_TYPE": Keyword("refused", _CODED, ("", "12BIT", "N/A", "UNK")),
    "DataConversionType": Keyword("refused", _CODED, ("", "12BIT", "N/A", "UNK")),
    "MESS:COMP12_8": Keyword("refused", _CODED, ("", "0", "N/A", "UNK")),
    "COMP12_8": Keyword("refused", _CODED, ("", "0", "N/A", "UNK")),
    "IMAGE.ENCODING_TYPE": Keyword(  # others are the telemetry's, as Galileo's
        "refused", "the pixels are compressed: unpack the picture", ("", "N/A", "NONE", "UNK")
    ),
    "LINE_DISPLAY_DIRECTION": Keyword("used", "which line is uppermost"),
    "vertical_display_direction": Keyword("used", "which line is uppermost"),
    **{name: Keyword("used", "no value") for name in MISSING_KEYWORDS},
    **{name: Keyword("used", "saturated") for name in SATURATED_KEYWORDS},
    "UNIT": Keyword("harmless", "brightness is compared with itself alone"),
    "SCALING_FACTOR": Keyword("used", "GDAL hands it on as a scale"),
    "OFFSET": Keyword("used", "GDAL hands it on as an offset"),
}
CODING_KEYWORDS = ("DATA_CONVERSION_TYPE", "DataConversionType", "MESS:COMP12_8", "COMP12_8")
_BOTTOM_FIRST = ("UP", "BOTTOM TO TOP")  # of PDS3 and PDS4


def read_specials(path: Path, text: Callable[[str], str], dtype: str) -> SpecialValues | None:
    """Special values that a label names; None for none.

    text   gives a keyword's value, empty where it is not stated
    dtype  of the pixels as stored
    Raises DataError for one that is no number.
    """
    specials: dict[bool, list[float]] = {False: [], True: []}
    for names, saturated in ((MISSING_KEYWORDS, False), (SATURATED_KEYWORDS, True)):
        for name in names:
            stated = text(name) or text(f"Special_Constants/{name.lower()}")
            if not stated:
                continue
            value = read_stored_value(stated, dtype)
            if value is None:
                raise DataError(
                    f"{path}: {name} = {stated[:40]}; wanted a number of the type {dtype}: correct "
                    "the label"
                )
            specials[saturated].append(value)
    if not (specials[False] or specials[True]):
        return None
    return SpecialValues(tuple(specials[False]), tuple(specials[True]))


def is_bottom_first(text: Callable[[str], str]) -> bool:
    """Whether a label's first line is the lowest on a screen."""
    stated = text("LINE_DISPLAY_DIRECTION") or text("vertical_display_direction")
    return stated.upper() in _BOTTOM_FIRST


def collect_keywords(text: Callable[[str], str], *, coded: bool) -> list[tuple[str, str]]:
    """Collect the stated KEYWORDS of a label, without coding where the camera file has it."""
    names = [name for name in KEYWORDS if not (coded and name in CODING_KEYWORDS)]
    return [(name, value) for name in names if (value := text(name))]
