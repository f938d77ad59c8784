"""The ground that a picture shows: the frame's border, and the limb where it crosses the frame.

The ground is the body's ellipsoid. Divided by its semi-axes it is the unit sphere; seen from a
camera at the distance d from the centre, it is a disc about the nadir of the angular radius
asin(1/d). In the plane with the angle from the nadir, over that radius, as the distance from the
origin, this disc is the unit circle and the picture's border a ring, which is cut to it.
"""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.geometry.ellipsoid import distance_to_sphere
from catalog.geometry.map_pieces import clip_ring
from catalog.geometry.vectors import perpendicular_basis, unit
from optnav_cli.camera.camera import Camera

ALONG = 48  # points of the border a side
LIMB_STEP = np.radians(2.0)  # between points of the limb, about the nadir


def footprint_of(
    camera: Camera, position_m: FloatArray, camera_from_body: FloatArray, radii_m: ArrayLike
) -> list[FloatArray]:
    """Rings (n, 3) of places, m, body frame, around the ground in view, at their left.

    position_m (3,) of the camera; camera_from_body (3, 3); radii_m (3,) semi-axes of the ellipsoid
    Empty where the picture shows none of it, or the camera is inside.
    """
    radii = np.asarray(radii_m, dtype=np.float64)
    eye = position_m / radii
    distance = float(np.linalg.norm(eye))
    if not distance > 1.0:
        return []
    reach = float(np.arcsin(1.0 / distance))
    up = eye / distance
    axes = np.vstack([*perpendicular_basis(up), up])  # rows: across, across, away from the body
    rays = camera.unproject(camera.border(ALONG))
    rays = unit(rays[np.isfinite(rays).all(axis=1)] @ camera_from_body / radii)
    across, away = rays @ axes[:2].T, rays @ up
    angle = np.arctan2(np.linalg.norm(across, axis=1), -away)
    # the border goes clockwise round the picture, which is looked at from outside of the body
    ring = (unit_rows(across) * (angle / reach)[:, None])[::-1]
    depth = 1.0 - np.linalg.norm(ring, axis=1)
    if depth.size and not (depth > 0.0).any() and _sees(camera, camera_from_body @ -position_m):
        parts = [np.vstack([[[1.0, 0.0]], _circle(0.0, 2.0 * np.pi)])]  # the whole disc
    else:
        parts = clip_ring(ring, depth, _azimuth, _circle, 2.0 * np.pi)
    return [_places(part, eye, axes, reach) * radii for part in parts]


def unit_rows(vectors: FloatArray) -> FloatArray:
    """Directions (n, 2) of vectors; zero for none."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    directions: FloatArray = vectors / np.where(length > 0.0, length, 1.0)
    return directions


def _sees(camera: Camera, direction: FloatArray) -> bool:
    pixel = camera.project(direction)
    return bool(np.isfinite(pixel).all() and camera.contains(pixel))


def _azimuth(points: FloatArray) -> FloatArray:
    return np.arctan2(points[:, 1], points[:, 0])


def _circle(start: float, length: float) -> FloatArray:
    """Points of the unit circle between a place on it and another one so far along it."""
    count = int(length / LIMB_STEP) + 1
    angles = start + length * np.arange(1, count + 1) / (count + 1)
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _places(part: FloatArray, eye: FloatArray, axes: FloatArray, reach: float) -> FloatArray:
    """Places (n, 3) of the unit sphere that points of the plane stand for."""
    share = np.linalg.norm(part, axis=1)
    way = unit_rows(part) @ axes[:2]
    limb = share >= 1.0 - 1e-9
    angle = np.minimum(share, 1.0 - 1e-9)[:, None] * reach
    rays = np.sin(angle) * way - np.cos(angle) * axes[2]
    ground: FloatArray = eye + distance_to_sphere(eye, rays, 1.0)[:, None] * rays
    # where the line of sight touches the sphere, as far from the nadir as `reach` is from square
    ground[limb] = np.cos(reach) * way[limb] + np.sin(reach) * axes[2]
    return ground
