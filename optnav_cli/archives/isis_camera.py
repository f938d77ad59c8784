"""The camera in an ISIS cube after `spiceinit`: focal length, pixels, lens and orientation.

`spiceinit` copies what its instrument kernels state into the label's NaifKeywords (USGS ISIS,
CameraFocalPlaneMap, CameraDetectorMap, CameraDistortionMap). There x = TRANSX . (1, s, l) and y =
TRANSY . (1, s, l), mm, with s and l counted from the boresight's sample and line; a pixel looks
along (x, y, +-f). So the signs of TRANSX and TRANSY say how the picture lies in the ISIS frame.
Where they make it a mirrored one, its lines run from the bottom up, and the rows are turned over.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.keywords import check_keywords
from optnav_cli.archives.isis_lens import (
    KEYWORDS,
    Label,
    Stated,
    add_lens,
    report_keywords,
    strip_unit,
)
from optnav_cli.camera.camera import Camera

MM_BY_M = 1e3
MAX_HALF_ANGLE = np.radians(
    85.0
)  # of a pinhole's corner: beyond, the focal length has another unit
MAX_MISFIT = 0.1  # relative, of twice the boresight by the picture's size: centres are off by less
MAX_SKEW = 0.02  # rad between a picture's rows and columns; none of the known cameras has 1e-3

_SUMMING = ("Summing", "SummingMode", "Binning", "BinningMode", "PixelBinningMode")


@dataclass(frozen=True, eq=False)
class CubeCamera:
    """The camera of a cube's picture and how the picture lies.

    camera            of the picture with its rows as `upside_down` says
    camera_from_isis  rotation from the ISIS frame of the instrument to the camera's: x right, y
                      down, z along the boresight
    upside_down       the cube's last line is the picture's top
    notes             what people must know, a line each
    """

    camera: Camera
    camera_from_isis: Rotation
    upside_down: bool
    notes: tuple[str, ...] = ()


def read_cube_camera(path: Path, label: Label, body_isis: FloatArray) -> CubeCamera | None:
    """The camera of a cube's full picture; None where the label has no NaifKeywords.

    body_isis  (3,) direction to the body's centre, ISIS camera frame
    Raises DataError for keywords that contradict each other or the size of the picture.
    """
    cube = label.get("IsisCube", {})
    naif, instrument = label.get("NaifKeywords"), cube.get("Instrument", {})
    texts = [(key, str(strip_unit(value))) for key, value in instrument.items()]
    texts += [("Mapping", "a group")] if "Mapping" in cube else []
    check_keywords(path, texts, KEYWORDS)
    if not isinstance(naif, dict) or not any("FOCAL" in key.upper() for key in naif):
        return None
    stated = Stated(path, naif, instrument, _list_codes(cube))
    columns, rows = _read_full_size(path, cube)
    notes = report_keywords(naif)
    plane = _read_focal_plane(stated)
    matrix, upside_down, camera_from_isis = _orient(path, plane[:, 1:], body_isis)
    pitch_mm = np.linalg.norm(matrix, axis=0)
    origin = _find_origin(stated, columns, rows, notes)
    summing = _find_summing(stated, origin, (columns, rows))
    focal_mm = _read_focal_length(stated, pitch_mm, summing, (columns, rows), notes)
    # constants of TRANSX and TRANSY move the boresight over the detector
    centre = origin - np.linalg.solve(plane[:, 1:], plane[:, 0])
    centre = (centre - 0.5) / summing - 0.5
    if upside_down:
        centre[1] = rows - 1 - centre[1]
    focal_x, focal_y = focal_mm / pitch_mm / summing
    camera = Camera(
        name=_make_name(cube),
        model="pinhole",
        width_px=columns,
        height_px=rows,
        focal_length_px=float(focal_x),
        focal_length_y_px=None if abs(focal_y / focal_x - 1.0) < 1e-9 else float(focal_y),
        principal_point_px=(float(centre[0]), float(centre[1])),
    )
    turn = matrix / pitch_mm
    camera = add_lens(stated, camera, focal_mm, turn, upside_down, summing, notes)
    return CubeCamera(camera, camera_from_isis, upside_down, tuple(notes))


def _list_codes(cube: Label) -> tuple[str, ...]:
    """Numbers of the instrument: that of its filter first, whose keywords are the finer ones."""
    kernels = cube.get("Kernels", {})
    code = kernels.get("NaifFrameCode", kernels.get("NaifIkCode"))
    if not isinstance(code, int):
        return ()
    band = cube.get("BandBin", {}).get("Number")
    return (str(code - band), str(code)) if isinstance(band, int) and band > 0 else (str(code),)


def _read_full_size(path: Path, cube: Label) -> tuple[int, int]:
    """Samples and lines of the whole picture, of which a cube may be a part."""
    try:
        if "AlphaCube" in cube:
            columns, rows = (int(cube["AlphaCube"][f"Alpha{key}"]) for key in ("Samples", "Lines"))
        else:
            dimensions = cube["Core"]["Dimensions"]
            columns, rows = int(dimensions["Samples"]), int(dimensions["Lines"])
    except (KeyError, TypeError, ValueError):
        raise DataError(f"{path}: its AlphaCube or Core group is damaged") from None
    if not (0 < columns <= 100_000 and 0 < rows <= 100_000):
        raise DataError(f"{path}: states a picture of {columns} x {rows} pixels")
    return columns, rows


def _read_focal_plane(stated: Stated) -> FloatArray:
    """TRANSX and TRANSY, (2, 3): constant, by sample, by line, mm."""
    rows = [stated.numbers(name, 3) for name in ("TRANSX", "TRANSY")]
    if rows[0] is not None and rows[1] is not None:
        plane = np.array(rows)
    else:
        inverse = [stated.numbers(name, 3) for name in ("ITRANSS", "ITRANSL")]
        if inverse[0] is None or inverse[1] is None:
            raise DataError(
                f"{stated.path}: its NaifKeywords have no TRANSX and TRANSY; run spiceinit of a "
                "newer ISIS on it, or name a table that states the camera (--table)"
            )
        turned = _invert_plane(stated.path, np.array(inverse)[:, 1:])
        plane = np.column_stack([-turned @ np.array(inverse)[:, 0], turned])
    _invert_plane(stated.path, plane[:, 1:])
    return plane


def _invert_plane(path: Path, matrix: FloatArray) -> FloatArray:
    sizes = np.linalg.norm(matrix, axis=0)
    skew = float(np.abs(matrix[:, 0] @ matrix[:, 1])) / max(float(sizes.prod()), 1e-300)
    if not (sizes > 1e-9).all() or skew > MAX_SKEW:
        raise DataError(
            f"{path}: its TRANSX and TRANSY make no picture with rows and columns at right angles; "
            "name a table that states the camera (--table)"
        )
    inverse: FloatArray = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    return inverse


def _orient(
    path: Path, by_pixel: FloatArray, body_isis: FloatArray
) -> tuple[FloatArray, bool, Rotation]:
    """Derive mm per pixel right and down, whether the picture is upside down, and its rotation.

    A pixel looks along (x, y, f) or, for some cameras, (x, y, -f), and no keyword says which. With
    -f it must be the picture of a proper camera, and the body behind the other way.
    """
    mirrored = float(np.linalg.det(by_pixel)) < 0.0
    backwards = mirrored and body_isis[2] < 0.0
    upside_down = mirrored and not backwards
    matrix = by_pixel * (1.0, -1.0) if upside_down else by_pixel
    right = np.append(matrix[:, 0], 0.0) / np.linalg.norm(matrix[:, 0])
    boresight = np.array([0.0, 0.0, -1.0 if backwards else 1.0])
    return matrix, upside_down, Rotation.from_matrix([right, np.cross(boresight, right), boresight])


def _find_origin(stated: Stated, columns: int, rows: int, notes: list[str]) -> FloatArray:
    """Sample and line of the boresight on the detector, (2,), counted from 1."""
    opencv = stated.numbers("OPENCV_OD_C", 2)
    if opencv is not None:  # where its lens is centred, the boresight is
        return opencv
    sample, line = stated.numbers("BORESIGHT_SAMPLE", 1), stated.numbers("BORESIGHT_LINE", 1)
    if sample is not None and line is not None:
        return np.concatenate([sample, line])
    middle = 0.5 * np.array([columns, rows]) + 0.5
    centre = stated.numbers("CCD_CENTER", 2)
    if centre is not None:
        return centre if (centre == middle).all() else centre + 1.0
    notes.append("the boresight's pixel: the middle of the picture is taken")
    return middle


def _find_summing(stated: Stated, origin: FloatArray, size: tuple[int, int]) -> float:
    """The detector's pixels by those of the picture, as the label says and the boresight bears out.

    Raises DataError where both differ: the picture may be a window of the detector.
    """
    factor = 1.0
    for key in _SUMMING:
        text = str(strip_unit(stated.instrument.get(key, 1))).lower().partition("x")[0]
        factor *= max(float(text), 1.0) if text.replace(".", "", 1).isdigit() else 1.0
    factor *= 2.0 if str(strip_unit(stated.instrument.get("FpuBinningMode", 0))) == "1" else 1.0
    by_size = 2.0 * (origin - 0.5) / np.array(size)
    if not (np.abs(by_size / factor - 1.0) < MAX_MISFIT).all():
        raise DataError(
            f"{stated.path}: its boresight at sample {origin[0]:g}, line {origin[1]:g} is not near "
            f"the middle of {size[0]} x {size[1]} pixels summed {factor:g} x {factor:g}: a window "
            "of the detector, or summing that the label does not state; name the camera (--camera)"
        )
    return factor


def _read_focal_length(
    stated: Stated, pitch_mm: FloatArray, summing: float, size: tuple[int, int], notes: list[str]
) -> float:
    """The focal length, mm."""
    warm = stated.naif.get("TempDependentFocalLength")
    values = [stated.numbers(name, 1) for name in ("FOCAL_LENGTH", "FOCAL_LENGTH_COVER")]
    known = [abs(float(value[0])) for value in values if value is not None]
    if isinstance(warm, int | float) and warm > 0.0:
        known.insert(0, float(warm))
    if not known or known[0] <= 0.0:
        raise DataError(f"{stated.path}: states no FOCAL_LENGTH; name the camera with --camera")
    focal_mm = known[0]
    least = 0.5 * max(size) * summing * float(pitch_mm.max()) / np.tan(MAX_HALF_ANGLE)
    if focal_mm < least <= focal_mm * MM_BY_M:
        notes.append(f"the unit of FOCAL_LENGTH = {focal_mm:g}: m, since mm make no picture")
        focal_mm *= MM_BY_M
    if focal_mm < least:
        raise DataError(
            f"{stated.path}: states FOCAL_LENGTH = {focal_mm:g} for pixels of {pitch_mm[0]:g} mm; "
            "no lens has both: name the camera with --camera"
        )
    return focal_mm


def _make_name(cube: Label) -> str:
    """A plain name of the camera."""
    text = str(cube.get("Instrument", {}).get("InstrumentId", "")).lower()
    word = "".join(letter if letter.isalnum() else "_" for letter in text).strip("_")[:40]
    return word or "cube_camera"


def crop_camera(path: Path, label: Label, camera: Camera, upside_down: bool) -> Camera:
    """The camera of a cube that is a part of the camera's picture, enlarged or reduced.

    label        of the cube
    upside_down  the cube's last line is the picture's top
    Raises DataError for a damaged AlphaCube group.
    """
    alpha = label.get("IsisCube", {}).get("AlphaCube")
    if not isinstance(alpha, dict):
        return camera
    try:
        full = np.array([alpha["AlphaSamples"], alpha["AlphaLines"]], float)
        # ISIS counts pixels from 1 at their middle: 0.5 is the picture's edge
        start = np.array([alpha["AlphaStartingSample"], alpha["AlphaStartingLine"]], float) - 0.5
        end = np.array([alpha["AlphaEndingSample"], alpha["AlphaEndingLine"]], float) - 0.5
        size = np.array([alpha["BetaSamples"], alpha["BetaLines"]], int)
    except (KeyError, TypeError, ValueError):
        raise DataError(f"{path}: its AlphaCube group is damaged") from None
    if upside_down:
        start[1], end[1] = full[1] - end[1], full[1] - start[1]
    step = (end - start) / size  # pixels of the whole a pixel of the cube
    scale = full / (camera.width_px, camera.height_px) / step
    if not (np.isfinite(scale).all() and (scale > 0.0).all() and (size > 0).all()):
        raise DataError(f"{path}: its AlphaCube group is damaged")
    point = (np.array(camera.principal_point_px) + 0.5) * scale - start / step - 0.5
    along_y = camera.focal_length_px * camera.aspect * float(scale[1])
    along_x = camera.focal_length_px * float(scale[0])
    return replace(
        camera,
        name=f"{camera.name}_crop",
        width_px=int(size[0]),
        height_px=int(size[1]),
        focal_length_px=along_x,
        focal_length_y_px=None if abs(along_y / along_x - 1.0) < 1e-6 else along_y,
        principal_point_px=(float(point[0]), float(point[1])),
        pixel_pitch_um=None,
        psf_sigma_px=None,
        psf_error_px=None,
    )
