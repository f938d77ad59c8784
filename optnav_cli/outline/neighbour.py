"""The other body in the picture: where it must stand if a lit disc is the body itself.

On the way to the Moon the Earth shines beside it, and one lit disc looks like another. Time and
attitude separate them: a disc taken for the Moon gives a position, and from there the Earth has
one direction and one size. Light time and aberration move it by 20" and 2 km, which is left out.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray, Int32Array, IntArray
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import Ephemeris, Neighbour
from catalog.geometry.kernel import kernel
from catalog.geometry.vectors import angle_between, unit
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.segmentation import Blobs

_OTHERS: dict[str, Neighbour] = {"moon": "earth", "earth": "moon"}
SIGMAS = 3.0
# Of a neighbour that must be seen: a thinner crescent or a smaller disc may be missed.
MAX_PHASE = np.radians(120.0)
# Half extent of a lit spot over the disc's radius: cusps are dark, blur and a bent lens widen.
EXTENTS = (0.5, 1.35)
SPOT_BLUR_PX = 2.0


class OtherBody(NamedTuple):
    """A neighbour at a time: its centre (3,) from the body's, body frame, m, and its radius."""

    name: str
    centre_m: FloatArray
    radius_m: float


class CameraView(NamedTuple):
    """A camera at a time: where it may look, and what it is lit by.

    attitude_sigma_rad  1 sigma an axis;  sun_body (3,) unit vector, body frame
    """

    camera: Camera
    camera_from_body: Rotation
    attitude_sigma_rad: float
    sun_body: FloatArray


class PredictedDisc(NamedTuple):
    """A disc as a position predicts it.

    towards  (3,) unit vector to its centre, camera frame
    angle    its angular radius;  sigma  1-sigma error of `towards`, rad
    phase    of its illumination, rad
    """

    towards: FloatArray
    angle: float
    sigma: float
    phase: float


class Spot(NamedTuple):
    """A lit area: unit vector (3,) to its middle, camera frame, and its farthest pixel, rad."""

    label: int
    towards: FloatArray
    extent: float
    rad_per_px: float


def find_other_body(motion: Ephemeris, tdb_s: float) -> OtherBody | None:
    """The neighbour that shines like the body itself; None for a body without one."""
    name = _OTHERS.get(motion.body.name)
    if name is None:
        return None
    centre = motion.body_from_inertial(tdb_s) @ motion.position_m(name, tdb_s)
    return OtherBody(name, np.asarray(centre), _load_radius_m(name))


@cache
def _load_radius_m(name: str) -> float:
    return load_body(name).radius_m


def predict_disc(
    view: CameraView, centre_m: FloatArray, radius_m: float, position_m: FloatArray, sigma_m: float
) -> PredictedDisc:
    """A sphere's disc from a position that is good to sigma_m; all in the body frame."""
    offset = centre_m - position_m
    distance = float(np.linalg.norm(offset))
    towards = offset / distance
    phase = float(np.arccos(np.clip(-(towards @ view.sun_body), -1.0, 1.0)))
    sigma = float(np.hypot(sigma_m / distance, view.attitude_sigma_rad))
    angle = float(np.arcsin(min(radius_m / distance, 1.0)))
    return PredictedDisc(view.camera_from_body.apply(towards), angle, sigma, phase)


def is_expected_in_view(view: CameraView, disc: PredictedDisc, before: PredictedDisc) -> bool:
    """Whether a disc lies whole in the picture, large, lit and clear of another one before it."""
    if disc.phase > MAX_PHASE:
        return False
    apart = angle_between(disc.towards, before.towards)
    if apart < before.angle + disc.angle + SIGMAS * disc.sigma:
        return False
    per_px = _measure_rad_per_px(view.camera, disc.towards)
    reach_px = (disc.angle + SIGMAS * disc.sigma) / per_px
    large = 2.0 * disc.angle / per_px >= 5.0
    return large and _is_inside(view.camera, disc.towards, reach_px + 6.0)


def make_spots(camera: Camera, blobs: Blobs, numbers: IntArray) -> list[Spot]:
    """The blobs of these numbers as directions."""
    spots = []
    for number in numbers:
        left, top, wide, high = (int(value) for value in blobs.box[number])
        label = int(blobs.label[number])
        box = blobs.labels[top : top + high, left : left + wide]
        # At most about 4000 pixels of a spot are used.
        pixels = _sample_pixels(box, label, 1 + int(blobs.area[number]) // 4000)
        rays = camera.unproject(pixels + np.array([left, top]))
        rays = rays[np.isfinite(rays).all(axis=1)]
        if not len(rays):
            continue
        middle = unit(rays.mean(axis=0))
        extent = float(np.linalg.norm(np.cross(rays, middle), axis=1).max())
        spots.append(Spot(label, middle, extent, _measure_rad_per_px(camera, middle)))
    return spots


@kernel
def _sample_pixels(labels: Int32Array, label: int, step: int) -> FloatArray:
    """Every so many-th pixel x, y (n, 2) of a label, row by row."""
    rows, cols = labels.shape
    pixels, count, seen = np.empty((rows * cols // step + 1, 2)), 0, 0
    for r in range(rows):
        for c in range(cols):
            if labels[r, c] == label:
                if seen % step == 0:
                    pixels[count, 0], pixels[count, 1] = c, r
                    count += 1
                seen += 1
    return pixels[:count]


def is_seen(disc: PredictedDisc, spot: Spot) -> bool:
    """Whether a lit spot is the disc: in its place and of its size."""
    blur = SPOT_BLUR_PX * spot.rad_per_px
    if angle_between(disc.towards, spot.towards) > disc.angle + SIGMAS * disc.sigma + blur:
        return False
    return EXTENTS[0] * disc.angle - blur < spot.extent < EXTENTS[1] * disc.angle + blur


def is_lit(disc: PredictedDisc, spots: list[Spot]) -> bool:
    """Whether any light comes from where a disc is predicted."""
    reach = disc.angle + SIGMAS * disc.sigma
    return any(angle_between(disc.towards, spot.towards) < reach + spot.extent for spot in spots)


def is_within(spot: Spot, disc: PredictedDisc) -> bool:
    """Whether a lit spot's middle lies on a disc."""
    return bool(angle_between(disc.towards, spot.towards) < disc.angle)


def is_more_likely_neighbour(
    view: CameraView, other: OtherBody, position_m: FloatArray, sigma_m: float, body_radius_m: float
) -> bool:
    """Whether a disc taken for the body is the neighbour as the body's surroundings show it.

    position_m, sigma_m  where the disc puts the camera as the body, body frame
    It must be of the direction and the size that the neighbour has from near the body, and the
    body itself out of view or dark there.
    """
    distance = float(np.linalg.norm(position_m))
    towards = -position_m / distance
    share = max(SIGMAS * sigma_m / distance, 0.01)
    from_there = other.radius_m * distance / body_radius_m
    along = float(other.centre_m @ towards)
    along = float(np.clip(along, from_there * (1.0 - share), from_there * (1.0 + share)))
    position = other.centre_m - along * towards
    # From within five radii of the body the neighbour is what a camera shows that misses the body.
    if float(np.linalg.norm(position)) > 5.0 * body_radius_m:
        return False
    body = predict_disc(view, np.zeros(3), body_radius_m, position, 0.0)
    return body.phase > MAX_PHASE or not _is_inside(view.camera, body.towards, 0.0)


def _is_inside(camera: Camera, towards: FloatArray, margin_px: float) -> bool:
    pixel = camera.project(towards[None])
    if not np.isfinite(pixel).all() or not bool(camera.contains(pixel, margin_px)[0]):
        return False
    circle = camera.image_circle_radius_px
    return circle is None or float(camera.radius_px(pixel[0])) < circle - margin_px


def _measure_rad_per_px(camera: Camera, towards: FloatArray) -> float:
    """The wider of a pixel's two sides there; the focal length's where nothing is projected."""
    pixel = camera.project(towards[None])[0]
    if not np.isfinite(pixel).all():
        return camera.angular_resolution
    steps = camera.unproject(pixel + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    sides = np.linalg.norm(steps[1:] - steps[0], axis=1)
    return float(sides.max()) if np.isfinite(sides).all() else camera.angular_resolution
