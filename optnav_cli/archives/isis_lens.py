"""The lens that an ISIS cube states, as one of the lenses that cameras have here.

Sources: USGS ISIS, RadialDistortionMap, TaylorCameraDistortionMap, OsirisRexTagcamsDistortionMap.
Radial and polynomial lenses are fitted by Brown's, that of OpenCV is taken as it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import DataError
from optnav_cli.archives.isis_keywords import Stated, strip_unit
from optnav_cli.camera.camera import Camera

MAX_DISTORTION = 0.2  # of the distance of the corners from the axis
MAX_FIT_PX = 0.05  # error of a fitted lens that nobody needs to know
ENOUGH_PX = 0.003  # a fit so good needs no more terms
# Unknowns by column: principal point, scale, then k1, k2, k3, p1, p2.
LENSES = ([0, 1, 2, 3], [0, 1, 2, 3, 4], [0, 1, 2, 3, 6, 7], list(range(8)))
GRID = 21  # points along a side that a lens is fitted to


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
    camera: Camera,
    focal_mm: float,
    turn: FloatArray,
    undistort: Callable[[FloatArray], FloatArray],
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
