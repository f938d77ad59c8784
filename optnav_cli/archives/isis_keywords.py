"""What ISIS cubes state of their instrument: the keywords that are known, and their values.

`spiceinit` copies what its instrument kernels state into the label's NaifKeywords.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.keywords import Keyword

Label = dict[str, Any]

_UNUSED = "the lens model is not one that is read; its effect is left out"
# Keywords of the Instrument group are named as they are, those of kernels without their INSn_.
KEYWORDS = {
    "FOCAL_LENGTH": Keyword("used", "mm, or m where mm make no picture"),
    "FOCAL_LENGTH_COVER": Keyword("used", "as FOCAL_LENGTH, with the lens cover on"),
    "TempDependentFocalLength": Keyword("used", "mm; in place of FOCAL_LENGTH"),
    "TRANSX": Keyword("used", "pixels to the focal plane"),
    "TRANSY": Keyword("used", "pixels to the focal plane"),
    "ITRANSS": Keyword("used", "where TRANSX and TRANSY are not there"),
    "ITRANSL": Keyword("used", "where TRANSX and TRANSY are not there"),
    "BORESIGHT_SAMPLE": Keyword("used", "from 1"),
    "BORESIGHT_LINE": Keyword("used", "from 1"),
    "CCD_CENTER": Keyword("used", "from 0, unless it is the middle of the picture from 1"),
    "OPENCV_OD_K": Keyword("used", "lens"),
    "OPENCV_OD_P": Keyword("used", "lens"),
    "OPENCV_OD_F": Keyword("used", "lens, px"),
    "OPENCV_OD_C": Keyword("used", "lens, from 1"),
    "OPENCV_OD_A": Keyword("used", "lens by temperature, with CameraHeadTemperature"),
    "K1": Keyword("used", "lens"),
    "K1_COVER": Keyword("used", "lens"),
    "OD_K": Keyword("used", "lens"),
    "OD_T_X": Keyword("used", "lens"),
    "OD_T_Y": Keyword("used", "lens"),
    "DECENTER": Keyword("reported", _UNUSED),
    "PP": Keyword("reported", _UNUSED),
    "RAD_DIST_COEFF": Keyword("reported", _UNUSED),
    "OD_CENTER": Keyword("reported", _UNUSED),
    "OD_K_": Keyword("reported", _UNUSED),
    "LIGHTTIME_CORRECTION": Keyword(
        "reported", "light time is left out of its tables", ("LT", "LT+S", "CN", "CN+S")
    ),
    "DISTORTION_COEF_X": Keyword("reported", _UNUSED),
    "DISTORTION_COEF_Y": Keyword("reported", _UNUSED),
    "Summing": Keyword("used", "detector's pixels by those of the picture"),
    "SummingMode": Keyword("used", "detector's pixels by those of the picture"),
    "Binning": Keyword("used", "detector's pixels by those of the picture"),
    "BinningMode": Keyword("used", "detector's pixels by those of the picture"),
    "PixelBinningMode": Keyword("used", "detector's pixels by those of the picture"),
    "FpuBinningMode": Keyword("used", "1: two of the detector's pixels to one of the picture"),
    "LineExposureDuration": Keyword("refused", "a line scanner, whose lines have a pose each"),
    "LineRate": Keyword("refused", "a line scanner, whose lines have a pose each"),
    "LineScanRate": Keyword("refused", "a line scanner, whose lines have a pose each"),
    "NumFramelets": Keyword("refused", "a push frame camera, whose framelets have a pose each"),
    "NumberFramelets": Keyword("refused", "a push frame camera, whose framelets have a pose each"),
    "InterframeDelay": Keyword("refused", "a push frame camera, whose framelets have a pose each"),
    "Mapping": Keyword("refused", "a map, not a picture: import the cube from before cam2map"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Stated:
    """Statements of a cube's label about its instrument."""

    path: Path
    naif: Label
    instrument: Label
    codes: tuple[str, ...]

    def numbers(self, name: str, count: int) -> FloatArray | None:
        """Numbers (count,) of INSn_name; None where there is none. Raises DataError."""
        stated = [
            self.naif[key] for code in self.codes if (key := f"INS{code}_{name}") in self.naif
        ]
        if not stated:
            others = {str(v): v for k, v in self.naif.items() if _is_key(k, name)}
            if len(others) > 1:
                raise DataError(
                    f"{self.path}: states {len(others)} values of INSn_{name}, none for instrument "
                    f"{self.codes[0] if self.codes else 'n'}; name the camera with --camera"
                )
            stated = list(others.values())
        if not stated:
            return None
        values = np.atleast_1d(np.array(strip_unit(stated[0]), dtype=object))[:count]
        try:
            numbers = values.astype(np.float64)
        except (TypeError, ValueError):
            numbers = np.full(0, np.nan)
        if numbers.shape != (count,) or not (np.abs(numbers) < 1e12).all():
            raise DataError(f"{self.path}: INSn_{name} is {stated[0]}; wanted {count} numbers")
        return numbers


def report_keywords(naif: Label) -> list[str]:
    """Say which keywords of an instrument kernel are not used, a line for each reason."""
    by_reason: dict[str, list[str]] = {}
    for key, value in naif.items():
        name = key.partition("_")[2]
        by_filter = [start for start in ("OD_CENTER", "OD_K_") if name.startswith(start)]
        keyword = KEYWORDS.get(name) or KEYWORDS.get("".join(by_filter))
        if keyword is None or keyword.fate != "reported" or not key.startswith("INS"):
            continue
        if str(value).upper() not in keyword.allowed:
            by_reason.setdefault(keyword.why, []).append(f"{key} = {value}")
    return [f"the effect of {', '.join(keys)}: {why}" for why, keys in by_reason.items()]


def _is_key(key: str, name: str) -> bool:
    head, _, tail = key.partition("_")
    return tail == name and head.startswith("INS")


def strip_unit(value: object) -> object:
    """A value without its unit."""
    return value["value"] if isinstance(value, dict) and "value" in value else value
