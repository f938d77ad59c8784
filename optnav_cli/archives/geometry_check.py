"""A cheap look at whether a stated geometry and the picture can belong together.

Three things are compared: whether the body stands in the view, how much of the picture the Sun can
light, and how large the lit disc is. Each contradiction names the changes of the statement that
would remove it: the sign of a vector, the direction of the rotation, the range. Nothing is
corrected. Errors of pointing move the body inside of the view; what is compared does not depend on
where it stands.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.bodies.ephemeris import Ephemeris
from catalog.errors import DataError
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import load_picture

GRID_PX = 200  # longer side of the picture that is looked at
SIGMAS = 3.0  # of the stated attitude and position that excuse a contradiction
MIN_CONTRAST = 8.0  # of the bright level above the dark one, in scatters of the dark
CORE_LEVEL, WIDE_LEVEL = 0.5, 0.1  # from the dark level to the bright one
MIN_BRIGHT = 30  # pixels of the small picture in a lit disc; fewer have no measurable size
MAX_RATIO = 1.6  # of the lit disc by the stated one: cusps are dim, shapes no ellipsoids
FULL_VIEW = 0.8  # of the shorter side: a disc so large may be cut
BEYOND_VIEW = 1.1  # of the longer side: so large a disc reaches a side of the picture
LIT_FACTOR = 5.0  # as much again lit as the Sun can light is a contradiction
MIN_DARK_PHASE = np.radians(120.0)  # of the Sun behind the body


@dataclass(frozen=True, eq=False)
class StatedGeometry:
    """Geometry of one picture as an import states it, body frame.

    sun_body              (3,) unit vector to the Sun
    attitude_sigma_rad    None for a first guess, with which the view proves nothing
    body_from_inertial    orientation of the body at the time
    """

    camera: Camera
    position_m: FloatArray
    camera_from_body: Rotation
    sun_body: FloatArray
    attitude_sigma_rad: float | None
    position_sigma_m: float
    body_from_inertial: Rotation


@dataclass(frozen=True, eq=False)
class _Disc:
    """The bright part of a picture, in pixels of the camera.

    diameter_px   of the least circle about it;  area_px2  its area
    inside        it touches no side of the picture
    """

    diameter_px: float
    area_px2: float
    inside: bool


def check_import(path: Path, frame: Frame, camera: Camera, motion: Ephemeris) -> list[str]:
    """Say what a picture file contradicts of its frame's stated geometry, a line each.

    path  of the picture as imported; one without content, or of a time that the body's file does
          not hold, contradicts nothing
    """
    if frame.position_m is None or frame.camera_from_body is None or frame.tdb_s is None:
        return []
    try:
        values = load_picture(path, camera).values
        sun = motion.sun_body(frame.tdb_s) if frame.sun_body is None else frame.sun_body
        turn = Rotation.from_matrix(motion.body_from_inertial(frame.tdb_s))
    except DataError:
        return []
    stated = StatedGeometry(
        camera,
        frame.position_m,
        frame.camera_from_body,
        sun,
        frame.attitude_sigma_rad,
        frame.position_sigma_m or 0.0,
        turn,
    )
    return find_contradictions(stated, motion.body, values)


def find_contradictions(stated: StatedGeometry, body: Body, values: Float32Array) -> list[str]:
    """Say what of a stated geometry the picture contradicts, a line each; none where it may hold.

    values  (h, w) of the picture; NaN where a pixel has no value
    """
    distance_m = float(np.linalg.norm(stated.position_m))
    if distance_m <= min(body.radii_m):
        return [
            f"the stated position is {distance_m / 1e3:.6g} km from the centre, inside the body, "
            f"whose radius is {body.radius_m / 1e3:.6g} km: mend the unit of the position or name "
            "the body (--body)"
        ]
    misses = _check_view(stated, body)
    core, wide = _find_disc(values, CORE_LEVEL), _find_disc(values, WIDE_LEVEL)
    if misses or core is None or wide is None:
        return misses
    size = _check_size(stated, body, (core, wide), distance_m)
    return size or _check_sun_side(stated, body, core, distance_m)


def _check_view(stated: StatedGeometry, body: Body) -> list[str]:
    """Whether the body stands outside the view by more than its radius and the sigmas."""
    if stated.attitude_sigma_rad is None:
        return []
    camera, distance_m = stated.camera, float(np.linalg.norm(stated.position_m))
    corners = camera.unproject(camera.border(8))
    view = float(np.nanmax(np.arccos(np.clip(corners[:, 2], -1.0, 1.0))))
    radius = float(np.arcsin(min(max(body.radii_m) / distance_m, 1.0)))
    room = view + radius + SIGMAS * stated.attitude_sigma_rad
    room += SIGMAS * stated.position_sigma_m / distance_m
    off = _measure_off_axis(stated.camera_from_body, stated.position_m)
    if off <= room:
        return []
    inertial = stated.body_from_inertial
    inverted = (stated.camera_from_body * inertial).inv() * inertial.inv()
    turned = Rotation.from_euler("z", 180.0, degrees=True) * stated.camera_from_body
    ways = {
        "the sign of the position vector": _measure_off_axis(
            stated.camera_from_body, -stated.position_m
        ),
        "the direction of the rotation": _measure_off_axis(inverted, stated.position_m),
        "the sign of the boresight": np.pi - _measure_off_axis(turned, stated.position_m),
    }
    mend = [words for words, angle in ways.items() if angle <= room]
    return [
        f"the camera looks away from {body.name}: its centre stands {np.degrees(off):.3g} deg off "
        f"the boresight, the view ends at {np.degrees(view):.3g} deg, the body's radius is "
        f"{np.degrees(radius):.3g} deg: mend {' or '.join(mend) or 'the attitude or the position'}"
    ]


def _measure_off_axis(camera_from_body: Rotation, position_m: FloatArray) -> float:
    centre = camera_from_body.apply(-position_m / np.linalg.norm(position_m))
    return float(np.arccos(np.clip(centre[2], -1.0, 1.0)))


def _check_size(
    stated: StatedGeometry, body: Body, discs: tuple[_Disc, _Disc], distance_m: float
) -> list[str]:
    """Whether the lit disc is larger or smaller than the range allows.

    A lit disc reaches from cusp to cusp, which is the whole diameter at any phase. Its bright core
    must be too large, since smear and stray light widen it, or its dim edge too small.
    """
    (core, wide), focal_px = discs, stated.camera.coarse_focal_px
    small_px = _compute_diameter_px(focal_px, min(body.radii_m), distance_m)
    large_px = _compute_diameter_px(focal_px, max(body.radii_m), distance_m)
    excuse = MAX_RATIO * (1.0 + SIGMAS * stated.position_sigma_m / distance_m)
    fits = large_px < FULL_VIEW * min(stated.camera.shape)
    too_large = fits and core.diameter_px > excuse * large_px
    # a disc larger than the picture leaves no dark rim about a lit patch, unless at the terminator
    bounded = fits or (small_px > BEYOND_VIEW * max(stated.camera.shape) and _is_day(stated))
    too_small = bounded and wide.inside and wide.diameter_px * excuse < small_px
    if not (too_large or too_small):
        return []
    disc = core if too_large else wide
    angle = np.arctan(0.5 * disc.diameter_px / focal_px)
    implied_km = body.radius_m / np.sin(angle) / 1e3
    return [
        f"the lit disc is {disc.diameter_px:.4g} px wide, the stated range of "
        f"{distance_m / 1e3:.6g} km makes it {large_px:.4g} px: mend the unit of the position or "
        f"the camera's focal length (the disc would be {body.name} at about {implied_km:.3g} km)"
    ]


def _compute_diameter_px(focal_px: float, radius_m: float, distance_m: float) -> float:
    sine = min(radius_m / distance_m, 0.999999)
    return float(2.0 * focal_px * sine / np.sqrt(1.0 - sine * sine))


def _is_day(stated: StatedGeometry) -> bool:
    up = stated.position_m / np.linalg.norm(stated.position_m)
    return bool(up @ stated.sun_body > np.sin(np.radians(30.0)))


def _check_sun_side(
    stated: StatedGeometry, body: Body, disc: _Disc, distance_m: float
) -> list[str]:
    """Whether much more of the body is lit than a Sun behind it can light."""
    cosine = float(stated.sun_body @ stated.position_m) / distance_m
    phase = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    focal_px = stated.camera.coarse_focal_px
    whole_px2 = 0.25 * np.pi * _compute_diameter_px(focal_px, body.radius_m, distance_m) ** 2
    whole_px2 = min(whole_px2, float(np.prod(stated.camera.shape)))
    lit = 0.5 * (1.0 + cosine)
    if phase < MIN_DARK_PHASE or disc.area_px2 < max(LIT_FACTOR * lit, 0.3) * whole_px2:
        return []
    return [
        f"the stated Sun is behind {body.name} (phase angle {np.degrees(phase):.3g} deg), where it "
        f"lights {lit:.2%} of the disc, but {disc.area_px2 / whole_px2:.0%} of it is bright: mend "
        "the sign of the Sun's vector or of the position"
    ]


def _find_disc(values: Float32Array, level: float) -> _Disc | None:
    """The part of a picture above a level from dark to bright; None where none stands out."""
    height, width = values.shape
    scale = min(GRID_PX / max(height, width), 1.0)
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    small = cv2.resize(np.nan_to_num(values, nan=0.0), size, interpolation=cv2.INTER_AREA)
    dark, bright = np.percentile(small, (5.0, 99.0))
    scatter = 1.4826 * float(np.median(np.abs(small[small <= np.median(small)] - dark)))
    if not bright - dark > MIN_CONTRAST * max(scatter, 1e-6 * abs(float(bright))):
        return None
    mask: BoolArray = small > dark + level * (bright - dark)
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count < 2:
        return None
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    area = int(statistics[largest, cv2.CC_STAT_AREA])
    if area < MIN_BRIGHT or area < 0.5 * int(mask.sum()):
        return None
    rows, columns = np.nonzero(labels == largest)
    points = np.column_stack([columns, rows]).astype(np.float32)
    _, radius = cv2.minEnclosingCircle(points)
    inside = rows.min() > 0 and columns.min() > 0
    inside &= rows.max() < small.shape[0] - 1 and columns.max() < small.shape[1] - 1
    return _Disc((2.0 * radius + 1.0) / scale, area / scale**2, bool(inside))
