"""Known points in a picture: where a camera must be, and how it must be turned, to see them so.

The geometry is r_i = R + L_i T e_i of Zhukov (2025), ch. 3; here it is solved in the picture, by
pixel residuals, so that any camera model and any pixel covariance fit in. With the attitude known
three numbers are sought, otherwise six: a star sensor's sigma then enters as a measurement of zero
rotation, and a free attitude has none.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray, IndexArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.geometry.ellipsoid import compute_normals
from catalog.geometry.rotations import cross_matrix
from optnav_cli.estimation.least_squares import Linearisation, linearised
from optnav_cli.reasons import ReasonCode

MAX_ZENITH_DEG = 70.0  # the formula of refraction is a few per cent off there, and grows


class ProjectingCamera(Protocol):
    """A camera as resection needs it."""

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (..., 2) of camera-frame points (..., 3); NaN for those out of view."""

    def project_with_jacobian(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) of camera-frame points (n, 3), and d pixel / d point (n, 2, 3)."""


@dataclass(frozen=True)
class Pose:
    """Where a camera is and how it is turned: body-fixed position, m, and camera_from_body."""

    position_m: FloatArray
    camera_from_body: Rotation

    @cached_property
    def turn(self) -> FloatArray:
        """(3, 3) of camera_from_body."""
        matrix: FloatArray = self.camera_from_body.as_matrix()
        return matrix

    def moved(self, step: FloatArray) -> "Pose":
        """The pose after a step (3,) or (6,) in the unknowns of `predict`."""
        turn = self.camera_from_body
        if step.size == 6:
            turn = Rotation.from_rotvec(step[3:]) * turn
        return Pose(self.position_m + step[:3], turn)


@dataclass(frozen=True)
class Sightings:
    """Points seen: body-fixed places, the pixels where they were found, their covariances.

    points_body_m (n, 3), pixels (n, 2), covariances_px2 (n, 2, 2)
    """

    points_body_m: FloatArray
    pixels: FloatArray
    covariances_px2: FloatArray

    def __len__(self) -> int:
        return len(self.points_body_m)

    def subset(self, index: IndexArray | BoolArray) -> "Sightings":
        """The sightings that an index array or mask picks."""
        return Sightings(self.points_body_m[index], self.pixels[index], self.covariances_px2[index])


def predict(
    camera: ProjectingCamera, pose: Pose, points_body_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) of body-fixed points, and their Jacobian (n, 2, 6).

    The six columns are the position (m) and a rotation vector in the camera frame (rad) applied
    after camera_from_body.
    """
    turn = pose.turn
    points_camera = (points_body_m - pose.position_m) @ turn.T
    pixels, by_point = camera.project_with_jacobian(points_camera)
    by_position = -by_point @ turn
    # exp(w) p = p + w x p = p - [p]x w
    by_rotation = -by_point @ cross_matrix(points_camera)
    return pixels, np.concatenate([by_position, by_rotation], axis=-1)


def compute_zeniths(places_m: FloatArray, position_m: FloatArray, body: Body) -> FloatArray:
    """Compute angles (n,), rad, of the lines of sight from the vertical at places (n, 3).

    Of a camera at position_m (3,); all body-fixed.
    """
    up = compute_normals(places_m, body.radii_m)
    sights = position_m - places_m
    sights = sights / np.linalg.norm(sights, axis=1, keepdims=True)
    zeniths: FloatArray = np.arccos(np.clip((up * sights).sum(axis=1), -1.0, 1.0))
    return zeniths


def correct_refraction(places_m: FloatArray, position_m: FloatArray, body: Body) -> FloatArray:
    """Move places (n, 3) away from the nadir, to where straight lines of sight would end.

    A ray that comes straight to z from the vertical meets the ground (n - 1) H tan z / cos^2 z
    nearer to the nadir, for a camera above the air; ray tracing agrees to 3 % up to 70 deg. On the
    Earth these are 0.4 m at 10 deg, 4.6 m at 45 deg and 53 m at 70 deg.
    """
    air = body.atmosphere
    if air is None:
        return places_m
    up = compute_normals(places_m, body.radii_m)
    sights = places_m - position_m
    across = sights - (sights * up).sum(axis=1, keepdims=True) * up
    length = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    zenith = np.minimum(compute_zeniths(places_m, position_m, body), np.radians(MAX_ZENITH_DEG))
    bent = air.refractivity * air.scale_height_m * np.tan(zenith) / np.cos(zenith) ** 2
    refracted: FloatArray = places_m + across / length * bent[:, None]
    return refracted


class PointsModel:
    """Sightings of known points as measurements of a pose.

    unknowns  3: the position alone; 6: with the attitude
    """

    def __init__(self, camera: ProjectingCamera, sightings: Sightings, unknowns: int) -> None:
        self._camera, self._sightings, self._unknowns = camera, sightings, unknowns
        self._information = np.linalg.inv(sightings.covariances_px2).astype(np.float64)

    def linearise(self, state: Pose) -> Linearisation:
        """The sightings at a pose. Raises NoSolutionError for a point out of view."""
        pixels, jacobian = predict(self._camera, state, self._sightings.points_body_m)
        residuals = self._sightings.pixels - pixels
        if not np.isfinite(residuals).all():
            text = "a control point left the camera's view during the iteration"
            raise NoSolutionError(text, ReasonCode.NOT_SETTLED)
        return linearised(residuals, jacobian[:, :, : self._unknowns], self._information)

    def squares(self, pose: Pose) -> FloatArray:
        """(n,) squared residuals in units of their covariance; infinite when out of view."""
        pixels, _ = predict(self._camera, pose, self._sightings.points_body_m)
        residuals = self._sightings.pixels - pixels
        squares = np.einsum("ni,nij,nj->n", residuals, self._information, residuals)
        return np.where(np.isfinite(squares), squares, np.inf)


class AttitudeModel:
    """A measured attitude (camera_from_body) with one sigma an axis, rad."""

    def __init__(self, camera_from_body: Rotation, sigma_rad: float) -> None:
        self._measured, self._weights = camera_from_body, np.full(3, sigma_rad**-2)

    def linearise(self, state: Pose) -> Linearisation:
        """The measured turn, seen from the present attitude, in the camera frame."""
        offset = (self._measured * state.camera_from_body.inv()).as_rotvec()
        return linearised(offset, np.eye(3, 6, 3), self._weights)


def differentiate_places(sight_m: FloatArray, up: FloatArray) -> FloatArray:
    """Compute how places on the ground that pixels show move with the pose, (n, 3, 7).

    sight_m  (n, 3) from the camera to the places, body frame;  up (n, 3) or (3,) unit verticals
    Columns: by the camera's position (3), by its turn about the body's axes (3, rad), by the height
    of the ground. A ray that moves by d meets the ground where it moves by d less its height along
    the ray.
    """
    along = sight_m / (sight_m * up).sum(axis=1, keepdims=True)
    slide = np.eye(3) - along[:, :, None] * np.atleast_2d(up)[:, None, :]
    turned = -slide @ cross_matrix(sight_m)
    return np.concatenate([slide, turned, along[:, :, None]], axis=2)
