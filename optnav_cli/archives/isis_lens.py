"""The instrument keywords of an ISIS cube, and the lens that it states, as one of optnav's.

Sources: USGS ISIS, RadialDistortionMap, TaylorCameraDistortionMap, OsirisRexTagcamsDistortionMap.
Radial and polynomial lenses are fitted by Brown's, that of OpenCV is taken as it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.keywords import Keyword
from optnav_cli.camera.camera import Camera

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
MAX_DISTORTION = 0.2  # of the distance of the corners from the axis
MAX_FIT_PX = 0.05  # error of a fitted lens that nobody needs to know
ENOUGH_PX = 0.003  # a fit so good needs no more terms
# Unknowns by column: principal point, scale, then k1, k2, k3, p1, p2.
LENSES = ([0, 1, 2, 3], [0, 1, 2, 3, 4], [0, 1, 2, 3, 6, 7], list(range(8)))
GRID = 21  # points along a side that a lens is fitted to


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


def add_lens(
    stated: Stated,
    camera: Camera,
    focal_mm: float,
    turn: FloatArray,
    upside_down: bool,
    summing: float,
    notes: list[str],
) -> Camera:
    """The camera with the distortion of its lens, where that is of a form that is read.

    turn  (2, 2) unit vectors of right and down in the focal plane, as columns
    """
    opencv = [stated.numbers(f"OPENCV_OD_{key}", n) for key, n in (("K", 6), ("P", 2), ("F", 2))]
    if all(part is not None for part in opencv):
        return _add_opencv(stated, camera, np.concatenate([p for p in opencv if p is not None]),
                            upside_down, summing)  # fmt: skip
    undistort = _choose_lens_model(stated)
    if undistort is None:
        return camera
    fitted, worst_px = _fit_lens(camera, focal_mm, turn, undistort)
    if worst_px > MAX_FIT_PX:
        notes.append(f"the lens to better than {worst_px:.2g} px, the error of its fit")
    return fitted


def _add_opencv(
    stated: Stated, camera: Camera, terms: FloatArray, upside_down: bool, summing: float
) -> Camera:
    """The lens as OpenCV has it, in the cube's samples and lines."""
    k, (p1, p2), focal = terms[:6], terms[6:8], terms[8:]
    slope = stated.numbers("OPENCV_OD_A", 1)
    degrees = strip_unit(stated.instrument.get("CameraHeadTemperature", 0.0))
    if slope is not None and isinstance(degrees, int | float):
        focal = focal * (1.0 + float(slope[0]) * float(degrees))
    # turned over, y and with it the tangential term along y change their sign
    coefficients = (k[0], k[1], -p1 if upside_down else p1, p2, *k[2:])
    return replace(
        camera,
        focal_length_px=float(focal[0]) / summing,
        focal_length_y_px=float(focal[1]) / summing,
        distortion="opencv",
        coefficients=tuple(map(float, coefficients if k[3:].any() else coefficients[:5])),
    )


def _choose_lens_model(stated: Stated) -> Callable[[FloatArray], FloatArray] | None:
    """The function that takes points of the focal plane (n, 2), mm, to those without distortion."""
    taylor = [stated.numbers(f"OD_T_{axis}", 10) for axis in "XY"]
    if taylor[0] is not None and taylor[1] is not None:
        return lambda points: _invert_taylor(points, np.array(taylor))
    for name, count in (("K1", 1), ("K1_COVER", 1), ("OD_K", 3)):
        if (terms := stated.numbers(name, count)) is not None:
            # of K1 ISIS adds, of OD_K it takes away
            powers = np.array([0.0, -terms[0], 0.0]) if count == 1 else terms
            if not np.any(powers):
                return None
            return lambda points: _undo_radial(points, powers)
    return None


def _undo_radial(points: FloatArray, terms: FloatArray) -> FloatArray:
    """Undo ISIS's RadialDistortionMap: u = d (1 - k0 - k1 r^2 - k2 r^4), r that of d, mm."""
    square = np.sum(points**2, axis=1, keepdims=True)
    plain: FloatArray = points * (1.0 - terms[0] - terms[1] * square - terms[2] * square**2)
    return plain


def _invert_taylor(points: FloatArray, terms: Sequence[FloatArray] | FloatArray) -> FloatArray:
    """Undo ISIS's TaylorCameraDistortionMap: cubic polynomials from plain to distorted points."""
    plain = points.copy()
    for _ in range(20):
        x, y = plain.T
        unity = np.ones_like(x)
        powers = np.array([unity, x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3])
        plain = plain + points - (np.asarray(terms) @ powers).T
    return plain


def _fit_lens(
    camera: Camera, focal_mm: float, turn: FloatArray, undistort: Callable[[FloatArray], FloatArray]
) -> tuple[Camera, float]:
    """Fit Brown's lens to a function of the focal plane; the camera and the worst error, px.

    All unknowns are linear: the principal point, the scale, and the scale by k1, k2, k3, p1, p2.
    Terms that are not needed stay zero: of narrow cameras they are huge.
    """
    x, y = np.meshgrid(np.linspace(-0.5, camera.width_px - 0.5, GRID),
                       np.linspace(-0.5, camera.height_px - 0.5, GRID))  # fmt: skip
    pixels = np.column_stack([x.ravel(), y.ravel()])
    focal = np.array([camera.focal_length_px, camera.focal_length_px * camera.aspect])
    distorted = (pixels - camera.principal_point_px) / focal
    rays = undistort(distorted * focal_mm @ turn.T) @ turn / focal_mm
    largest_shift, most = (
        np.linalg.norm(part, axis=1).max() for part in (rays - distorted, distorted)
    )
    if not largest_shift <= MAX_DISTORTION * most:
        raise DataError(
            f"camera {camera.name}: the cube's lens moves points by more than "
            f"{MAX_DISTORTION:.0%} of the picture's half width; name the camera with --camera"
        )
    u, v = rays.T
    square = u * u + v * v
    zero, unity = np.zeros_like(u), np.ones_like(u)
    radial = np.array([unity, square, square**2, square**3])
    along_x = np.vstack([unity, zero, u * radial, 2.0 * u * v, square + 2.0 * u * u])
    along_y = np.vstack([zero, unity, v * radial, square + 2.0 * v * v, 2.0 * u * v])
    design = np.concatenate([along_x.T, along_y.T])
    wanted = distorted.T.ravel()
    for columns in LENSES:
        used = design[:, columns]
        size = np.linalg.norm(used, axis=0)
        terms = np.zeros(design.shape[1])
        terms[columns] = np.linalg.lstsq(used / size, wanted, rcond=None)[0] / size
        error = (design @ terms - wanted).reshape(2, -1).T * focal
        worst_px = float(np.linalg.norm(error, axis=1).max())
        if worst_px < ENOUGH_PX:
            break
    (cx, cy, scale), powers = terms[:3], terms[3:] / terms[2]
    k1, k2, k3, p1, p2 = powers
    shifted = np.array(camera.principal_point_px) + np.array([cx, cy]) * focal
    fitted = replace(
        camera.with_focal_factor(float(scale)),
        principal_point_px=(float(shifted[0]), float(shifted[1])),
        distortion="brown",
        coefficients=tuple(map(float, (k1, k2, p1, p2, k3))),
    )
    return fitted, worst_px
